"""The command `ncv-cl bake`: a map over the UVs of a mesh file."""

from __future__ import annotations

import argparse

from ..host.console import say
from ..host.files import check_paths
from ..host.interrupt import StopOnSignal
from ..integrands import AmbientOcclusion
from ..output.image import check_output_path
from ..scene.uv_mesh import read_uv_mesh
from ..sensing.bake import bake
from ..sensing.point_estimate import POINT_GROUPS
from ..settings.arguments import add_arguments, read_arguments
from ..settings.options import GROUPS
from .common import Help, add_common, add_scene, load, workers, write_json


def add_bake(commands: argparse._SubParsersAction) -> None:
    """The command and its arguments."""
    text = "ambient occlusion or light as a map over a mesh's UVs"
    parser = commands.add_parser("bake", help=text, description=text, formatter_class=Help)
    add = parser.add_argument
    add_scene(parser, is_seen=False)
    add("mesh", help="a mesh of the scene, with its UVs, where it is: .obj, .ply, .gltf or .glb")
    add("--integrand", choices=("ao", "direct", "gi"), default="ao", help="of light: irradiance over pi")
    add("--radius", type=float, help="ambient occlusion: farthest occluder (default: any)")
    add("--size", type=int, default=512, metavar="N", help="texels of a side")
    add("--samples", type=int, default=2, metavar="K", help="K x K places a texel")
    add("--padding", type=int, default=4, metavar="N", help="texels around charts that are filled")
    text = ".exr or .png; repeatable"
    add("-o", "--output", action="append", required=True, metavar="FILE", help=text)
    add("--target-error", type=float, metavar="E", help="end at this root mean square error of places")
    add_common(parser)
    for name in POINT_GROUPS:
        add_arguments(parser, GROUPS[name])
    parser.set_defaults(command=_bake)


def _bake(options: argparse.Namespace) -> int:
    for path in options.output:
        check_output_path(path)
    outputs = {f"output {number}": path for number, path in enumerate(options.output, 1)}
    check_paths(
        {**outputs, "--json": options.json}, {"the scene": options.scene, "the mesh": options.mesh}
    )
    integrand = options.integrand
    if options.radius is not None:
        if integrand != AmbientOcclusion.name:
            raise ValueError("--radius is for --integrand ao only")
        integrand = AmbientOcclusion(options.radius)
    chosen = [read_arguments(options, GROUPS[name]) for name in POINT_GROUPS]
    names = ("size", "samples", "padding", "method", "spp", "seed", "device", "target_error")
    with workers(options) as executor, StopOnSignal() as stop:
        image = bake(
            load(options),
            read_uv_mesh(options.mesh),
            integrand=integrand,
            progress=True,
            stop=stop,
            executor=executor,
            **{name: getattr(options, name) for name in names},
            **{name: value for group in chosen for name, value in group.items()},
        )
    for path in options.output:
        image.write(path)
    if options.json:
        write_json(options.json, image.stats)
    stats = image.stats
    say(
        f"{stats['texels']} texels, {stats['places']} places ({stats['places_inside']} inside of "
        f"something, {stats['places_apart']} behind a wall), in {stats['seconds']['total']:.3f} s\n"
        f"wrote {', '.join(options.output)}"
    )
    return 0
