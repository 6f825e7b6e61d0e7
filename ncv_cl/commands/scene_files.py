"""The commands `ncv-cl info` and `ncv-cl import`: what scene files hold, and others as ours."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..host.console import complain, say
from ..host.files import check_paths
from ..host.reach import Reach
from ..scene import about
from ..scene.imports import SCENE_KINDS, read_tables
from ..scene.imports.write import write_scene
from ..scene.load import scene_from
from ..scene.table import SceneError
from ..scene.textures.image_file import ImageFiles
from .common import add_reading, add_scene, read_options


def add_info(commands: argparse._SubParsersAction) -> None:
    """The command and its arguments."""
    parser = commands.add_parser("info", help="say what a scene or a mesh file holds")
    parser.add_argument("file", metavar="SCENE|MESH", help="scene file or mesh file")
    parser.add_argument(
        "--toml", action="store_true", help="print a scene file for a mesh file, to be saved beside it"
    )
    add_reading(parser)
    parser.set_defaults(command=_info)


def add_import(commands: argparse._SubParsersAction) -> None:
    """The command and its arguments."""
    text = "write a glTF, OBJ or Mitsuba scene as a .toml file with its meshes and images beside it"
    parser = commands.add_parser("import", help=text, description=text)
    add_scene(parser)
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help="the scene file, .toml")
    parser.set_defaults(command=_import)


def _info(options: argparse.Namespace) -> int:
    said = about.mesh_toml if options.toml else about.describe
    say(said(options.file, **read_options(options)))
    return 0


def _import(options: argparse.Namespace) -> int:
    source, target = Path(options.scene), Path(options.output)
    kinds = [kind for kind in SCENE_KINDS if kind != ".toml"]
    if source.suffix.lower() not in kinds:
        raise SceneError(f"{source}: only {', '.join(kinds)} are imported")
    if target.suffix.lower() != ".toml":
        raise ValueError(f"{target} must end in .toml")
    check_paths({"--output": target}, {"the scene": source})
    images = ImageFiles(Reach(None if options.allow_outside else source.parent))
    found = read_tables(source, images, options.camera)
    # As it will be loaded: whatever is wrong is said before anything is written.
    scene = scene_from(found, source, images)
    for warning in scene.warnings:
        complain(warning, "warning")
    written = write_scene(found.tables, source, images.reach.checked_files, target, source.name)
    say(f"wrote {', '.join(map(str, written))}")
    return 0
