"""No file is read from beyond the scene's folder, unless that is asked for."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import SCENE, Gltf, obj_text, png_bytes

import ncv_cl as ncv
from ncv_cl.cli import main
from ncv_cl.host.reach import OutsideError, Reach

SQUARE = [(0, 0, 0), (2, 0, 0), (2, 3, 0), (0, 3, 0)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene's folder, beside one with files that it must not read."""
    (tmp_path / "outside").mkdir()
    (tmp_path / "scene").mkdir()
    (tmp_path / "outside" / "a.obj").write_text(obj_text([SQUARE]))
    (tmp_path / "outside" / "red.png").write_bytes(png_bytes(200, 10, 10))
    (tmp_path / "outside" / "a.mtl").write_text("newmtl red\nKd 0.9 0.1 0.1\n")
    return tmp_path / "scene"


def read(path: Path, **options: bool) -> tuple[ncv.Scene, str]:
    """A scene, and all that is said of it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = ncv.load_scene(path, **options)
    return scene, " ".join(scene.warnings)


def toml(folder: Path, text: str) -> Path:
    path = folder / "x.toml"
    path.write_text(SCENE + text, encoding="utf-8")
    return path


def textured(folder: Path, statement: str) -> Path:
    (folder / "t.mtl").write_text(f"newmtl t\nKd 1 1 1\n{statement}\n")
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in SQUARE) + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (folder / "t.obj").write_text(f"mtllib t.mtl\n{corners}usemtl t\nf 1/1 2/2 3/3 4/4\n")
    return toml(folder, '[[meshes]]\nfile = "t.obj"\n')


def gltf(folder: Path, **tree: object) -> Path:
    made = Gltf()
    primitive = made.square()
    made.tree["meshes"] = [{"primitives": [primitive]}]
    made.tree |= tree
    made.write(folder / "g.gltf")
    return folder / "g.gltf"


def mesh(folder: Path) -> Path:
    return toml(folder, '[[meshes]]\nfile = "../outside/a.obj"\nmaterial = "grey"\n')


def whole_path(folder: Path) -> Path:
    file = (folder.parent / "outside" / "a.obj").as_posix()
    return toml(folder, f'[[meshes]]\nfile = "{file}"\nmaterial = "grey"\n')


def linked(folder: Path) -> Path:
    (folder / "link.obj").symlink_to(folder.parent / "outside" / "a.obj")
    return toml(folder, '[[meshes]]\nfile = "link.obj"\nmaterial = "grey"\n')


def linked_folder(folder: Path) -> Path:
    (folder / "sub").symlink_to(folder.parent / "outside")
    return toml(folder, '[[meshes]]\nfile = "sub/a.obj"\nmaterial = "grey"\n')


def texture(folder: Path) -> Path:
    quad = '[[quads]]\ncorner = [0, 0, 0]\nedge1 = [1, 0, 0]\nedge2 = [0, 1, 0]\nmaterial = "red"\n'
    return toml(folder, f'[materials.red]\nalbedo = {{ file = "../outside/red.png" }}\n{quad}')


def map_of_material(folder: Path) -> Path:
    return textured(folder, "map_Kd -s 2 2 ../outside/red.png")


def map_with_backslashes(folder: Path) -> Path:
    return textured(folder, "map_Kd ..\\outside\\red.png")


def library(folder: Path) -> Path:
    (folder / "t.obj").write_text("mtllib ../outside/a.mtl\nusemtl red\n" + obj_text([SQUARE]))
    return toml(folder, '[[meshes]]\nfile = "t.obj"\n')


def buffer(folder: Path) -> Path:
    path = gltf(folder)
    tree = json.loads(path.read_text())
    data = folder.parent / "outside" / "g.bin"
    made = Gltf()
    made.square()
    data.write_bytes(made.blob)
    tree["buffers"][0]["uri"] = "..%2Foutside/g.bin"
    path.write_text(json.dumps(tree))
    return path


def image_of_gltf(folder: Path) -> Path:
    made = Gltf()
    primitive = made.square(material=0)
    primitive["attributes"]["TEXCOORD_0"] = made.accessor(np.zeros((4, 2), np.float32))
    made.tree |= {
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "../outside/red.png"}],
    }
    made.write(folder / "g.gltf")
    return folder / "g.gltf"


def texture_of_ply(folder: Path) -> Path:
    box = trimesh.creation.box()
    rows = "\n".join(f"{x} {y} {z} 0 0" for x, y, z in box.vertices)
    faces = "\n".join(f"3 {a} {b} {c}" for a, b, c in box.faces)
    (folder / "p.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile ../outside/red.png\nelement vertex 8\n"
        "property float x\nproperty float y\nproperty float z\nproperty float u\nproperty float v\n"
        f"element face 12\nproperty list uchar int vertex_indices\nend_header\n{rows}\n{faces}\n"
    )
    return toml(folder, '[[meshes]]\nfile = "p.ply"\n')


CASES = [
    mesh, whole_path, linked, linked_folder, texture, map_of_material, map_with_backslashes, library,
    buffer, image_of_gltf, texture_of_ply,
]  # fmt: skip


@pytest.mark.parametrize("make", CASES, ids=lambda make: make.__name__)
def test_what_lies_outside_is_refused_and_read_when_asked(folder: Path, make) -> None:
    path = make(folder)
    with pytest.raises(
        ncv.SceneError, match=r"outside of the scene's folder .*--allow-outside"
    ) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")
    scene, said = read(path, allow_outside=True)
    assert "missing" not in said and "exist" not in said
    assert len(scene.triangles) >= 2


def test_links_and_dots_within_the_folder_are_read(folder: Path) -> None:
    (folder / "meshes").mkdir()
    (folder / "meshes" / "a.obj").write_text(obj_text([SQUARE]))
    (folder / "link.obj").symlink_to(folder / "meshes" / "a.obj")
    for file in ("meshes/../meshes/a.obj", "link.obj", (folder / "meshes" / "a.obj").as_posix()):
        read(toml(folder, f'[[meshes]]\nfile = "{file}"\nmaterial = "grey"\n'))


def test_a_folder_that_is_a_link_is_the_scenes(folder: Path) -> None:
    (folder / "a.obj").write_text(obj_text([SQUARE]))
    toml(folder, '[[meshes]]\nfile = "a.obj"\nmaterial = "grey"\n')
    (folder.parent / "linked").symlink_to(folder)
    read(folder.parent / "linked" / "x.toml")


def test_a_file_beside_stands_for_one_outside(folder: Path) -> None:
    """Exporters write whole paths of their machine."""
    path = textured(folder, f"map_Kd {folder.parent}/outside/red.png")
    (folder / "red.png").write_bytes(png_bytes(10, 200, 10))
    scene, _ = read(path)
    green = next(one.maps.colour.texels[0, 0] for one in scene.materials if one.maps is not None)
    assert green[1] > green[0]


def test_the_command_line_reads_them_when_asked(folder: Path, capsys) -> None:
    path = str(mesh(folder))
    assert main(["info", path]) == 2
    assert "--allow-outside" in capsys.readouterr().err
    assert main(["info", "--allow-outside", path]) == 0


def test_links_in_a_circle_are_beyond_reach(tmp_path: Path) -> None:
    (tmp_path / "one").symlink_to(tmp_path / "two")
    (tmp_path / "two").symlink_to(tmp_path / "one")
    reach = Reach(tmp_path)
    assert not reach.allows(Path("a\0b"))
    try:
        assert not reach.allows(tmp_path / "one") or not (tmp_path / "one").is_file()
    finally:
        with pytest.raises(OutsideError):
            reach.checked(tmp_path.parent)
