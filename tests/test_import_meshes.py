"""glTF, OBJ and other meshes as scenes: their cameras and lights, or suggested ones; `ncv-cl import`."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from mesh_files import Gltf, obj_text, png_bytes, same_surface

import ncv_cl as ncv
from ncv_cl.cli import main
from ncv_cl.scene.imports import read_tables
from ncv_cl.scene.imports.mesh_scene import NO_CAMERA, NO_LIGHT
from ncv_cl.scene.imports.read import tomllib
from ncv_cl.scene.imports.toml_text import toml_text
from ncv_cl.scene.meshes.read import read_meshes
from ncv_cl.scene.textures.image_file import ImageFiles

SQUARE = [(0, 0, 0), (2, 0, 0), (2, 3, 0), (0, 3, 0)]
# A turn by 90° about y, which takes -z to -x.
TURN = [0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)]
CAMERA = {"type": "perspective", "perspective": {"yfov": 0.8, "znear": 0.1}}
LIGHTS = [
    {"type": "point", "color": [1, 0.5, 0.25], "intensity": 8},
    {"type": "spot", "intensity": 2, "spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.5}},
    {"type": "directional", "name": "sun", "intensity": 3, "range": 4},
]


def write(
    folder: Path, *nodes: dict, cameras: tuple[dict, ...] = (), lights: tuple[dict, ...] = ()
) -> Path:
    """A glTF file of a square and these nodes."""
    gltf = Gltf()
    gltf.tree["meshes"] = [{"primitives": [gltf.square()]}]
    gltf.tree["nodes"] = [{"mesh": 0}, *nodes]
    children = {child for node in nodes for child in node.get("children", [])}
    gltf.tree["scenes"] = [{"nodes": [i for i in range(len(nodes) + 1) if i not in children]}]
    gltf.tree |= {"cameras": list(cameras)} if cameras else {}
    if lights:
        gltf.tree["extensionsUsed"] = ["KHR_lights_punctual"]
        gltf.tree["extensions"] = {"KHR_lights_punctual": {"lights": list(lights)}}
    gltf.write(folder / "a.gltf")
    return folder / "a.gltf"


def lit(index: int, **node: object) -> dict:
    return {"extensions": {"KHR_lights_punctual": {"light": index}}} | node


def load(path: Path, **options: object) -> tuple[ncv.Scene, str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = ncv.load_scene(path, **options)
    return scene, "\n".join(scene.warnings)


def test_a_camera_looks_where_its_node_does(tmp_path: Path) -> None:
    moved = {"translation": [5, 1, 0], "rotation": TURN, "scale": [2, 2, 2], "children": [2]}
    path = write(tmp_path, moved, {"camera": 0, "translation": [0, 0, 1]}, cameras=(CAMERA,))
    scene, said = load(path)
    camera = scene.camera
    forward = camera.target - camera.position
    np.testing.assert_allclose(camera.position + scene.origin, [7, 1, 0], atol=1e-12)
    np.testing.assert_allclose(forward / np.linalg.norm(forward), [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(camera.up, [0, 1, 0], atol=1e-12)
    assert camera.vertical_fov == pytest.approx(np.degrees(0.8))
    assert NO_CAMERA not in said and NO_LIGHT in said


def test_one_of_several_cameras_is_chosen_by_its_name(tmp_path: Path, capsys) -> None:
    flat = {"type": "orthographic", "name": "plan", "orthographic": {"xmag": 1, "ymag": 1}}
    nodes = [{"camera": i, "name": f"node{i}", "translation": [i, 0, 5]} for i in range(3)]
    path = write(tmp_path, *nodes, cameras=(flat, CAMERA | {"name": "one"}, CAMERA))
    places = [load(path, camera=name)[0].camera.position[0] for name in (None, "one", "node2")]
    assert places == [1, 1, 2]
    with pytest.raises(ncv.SceneError, match=r"a\.gltf: the camera plan is of the type 'orthographic'"):
        load(path, camera="plan")
    with pytest.raises(ncv.SceneError, match=r"no camera 'two'; its cameras: plan, one, node2"):
        load(path, camera="two")
    assert main(["info", str(path), "--camera", "node2"]) == 0
    assert "camera    at (2, 0, 5)" in capsys.readouterr().out


def test_a_file_of_orthographic_cameras_is_refused_by_name(tmp_path: Path) -> None:
    flat = {"type": "orthographic", "name": "plan", "orthographic": {"xmag": 1, "ymag": 1}}
    path = write(tmp_path, {"camera": 0}, cameras=(flat,))
    with pytest.raises(ncv.SceneError, match="the camera plan is of the type 'orthographic'"):
        load(path)


def test_a_mirrored_camera_is_said(tmp_path: Path) -> None:
    path = write(
        tmp_path, {"camera": 0, "scale": [-1, 1, 1], "translation": [0, 0, 5]}, cameras=(CAMERA,)
    )
    assert "cameras that mirror the picture" in load(path)[1]


def test_lights_are_those_of_their_nodes(tmp_path: Path) -> None:
    place = {"translation": [1, 2, 3], "rotation": TURN}
    path = write(tmp_path, *(lit(i, **place) for i in range(3)), lights=tuple(LIGHTS))
    found = read_meshes(path, np.eye(4), None)
    point, spot, sun = found.lights
    assert point == {"kind": "point", "position": [1, 2, 3], "intensity": [8, 4, 2]}
    assert spot["kind"] == "spot" and spot["position"] == [1, 2, 3] and spot["intensity"] == [2, 2, 2]
    np.testing.assert_allclose(spot["direction"], [-1, 0, 0], atol=1e-12)
    angles = [spot["inner_angle"], spot["outer_angle"]]
    np.testing.assert_allclose(angles, np.degrees([0.2, 0.5]))
    assert sun["kind"] == "directional" and sun["irradiance"] == [3, 3, 3]
    np.testing.assert_allclose(sun["direction"], [-1, 0, 0], atol=1e-12)
    assert found.shape_notes == ["ranges of lights are not read, their light goes on: 1 (sun)"]


def test_lights_go_with_the_mesh_file(tmp_path: Path) -> None:
    path = write(tmp_path, *(lit(i) for i in range(3)), lights=tuple(LIGHTS))
    # Turned by 90° about x, which takes -z to y, and moved.
    transform = np.array([[1, 0, 0, 5], [0, 0, -1, 6], [0, 1, 0, 7], [0, 0, 0, 1]], float)
    point, spot, sun = read_meshes(path, transform, None).lights
    assert point["position"] == spot["position"] == [5, 6, 7]
    assert spot["direction"] == sun["direction"] == [0, 1, 0]


def test_lights_may_be_ignored(tmp_path: Path) -> None:
    write(tmp_path, lit(0), lights=tuple(LIGHTS))
    text = toml_text(
        {
            "camera": {"position": [0, 0, 5], "target": [0, 0, 0], "vertical_fov": 40},
            "meshes": [{"file": "a.gltf", "lights": "ignore"}],
        }
    )
    (tmp_path / "x.toml").write_text(text)
    assert load(tmp_path / "x.toml")[0].lights == ()


@pytest.mark.parametrize(
    "light, said",
    [
        ({"type": "area"}, "of the unknown type 'area'"),
        ({"type": "point", "intensity": float("nan")}, "not finite"),
        ({"type": "point", "color": [1, 2]}, "no colour"),
        ({"type": "spot", "spot": {"innerConeAngle": 1, "outerConeAngle": 0.5}}, "cones of 1 and 0.5"),
    ],
)
def test_a_wrong_light_is_an_error(tmp_path: Path, light: dict, said: str) -> None:
    path = write(tmp_path, lit(0), lights=(light,))
    with pytest.raises(ncv.SceneError, match=said) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_light_that_does_not_exist_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ncv.SceneError, match="the light 7 does not exist: the file has 3"):
        load(write(tmp_path, lit(7), lights=tuple(LIGHTS)))


def test_emission_takes_the_place_of_a_suggested_light(tmp_path: Path) -> None:
    (tmp_path / "m.mtl").write_text("newmtl lamp\nKd 0 0 0\nKe 5 5 5\n")
    (tmp_path / "a.obj").write_text("mtllib m.mtl\nusemtl lamp\n" + obj_text([SQUARE]))
    scene, said = load(tmp_path / "a.obj")
    assert scene.lights == () and NO_LIGHT not in said and NO_CAMERA in said


def test_a_mesh_alone_is_what_info_suggests(tmp_path: Path, capsys) -> None:
    (tmp_path / "a.obj").write_text(obj_text([SQUARE]))
    assert main(["info", "--toml", str(tmp_path / "a.obj")]) == 0
    (tmp_path / "x.toml").write_text(capsys.readouterr().out)
    one, other = (load(tmp_path / name)[0] for name in ("a.obj", "x.toml"))
    assert one.digest == other.digest and len(one.lights) == 1
    assert same_surface(one, [SQUARE]) is False  # the light is part of the mesh


def test_import_writes_the_same_scene(tmp_path: Path, capsys) -> None:
    source, target = tmp_path / "source", tmp_path / "target"
    (source / "sub").mkdir(parents=True)
    target.mkdir()
    (source / "red.png").write_bytes(png_bytes(200, 10, 10))
    (source / "sub" / "m.mtl").write_text("newmtl red\nKd 1 1 1\nmap_Kd ../red.png\n")
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in SQUARE) + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (source / "a.obj").write_text(f"mtllib sub/m.mtl\n{corners}usemtl red\nf 1/1 2/2 3/3 4/4\n")
    assert main(["import", str(source / "a.obj"), "-o", str(target / "x.toml")]) == 0
    said = capsys.readouterr()
    assert f"a.obj: {NO_CAMERA}" in said.err and str(target / "x.toml") in said.out
    one, other = (load(path)[0] for path in (source / "a.obj", target / "x.toml"))
    assert one.digest == other.digest
    assert sorted(str(p.relative_to(target)) for p in target.rglob("*.*")) == [
        "a.obj", "red.png", "sub/m.mtl", "x.toml",
    ]  # fmt: skip
    # Once more: what is there is the same. Other files in the place of copies are not overwritten.
    assert main(["import", str(source / "a.obj"), "-o", str(target / "x.toml")]) == 0
    (target / "red.png").write_bytes(b"mine")
    assert main(["import", str(source / "a.obj"), "-o", str(target / "x.toml")]) == 2
    assert (target / "red.png").read_bytes() == b"mine"
    assert "red.png is in the place of a copy" in capsys.readouterr().err


def test_import_beside_the_source_copies_nothing(tmp_path: Path) -> None:
    path = write(tmp_path, {"camera": 0, "translation": [0, 0, 5]}, cameras=(CAMERA,))
    assert main(["import", str(path), "-o", str(tmp_path / "x.toml")]) == 0
    assert load(path)[0].digest == load(tmp_path / "x.toml")[0].digest
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gltf", "x.toml"]


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["a.toml", "-o", "b.toml"], "only .obj, .ply, .stl, .gltf, .glb, .xml are imported"),
        (["a.obj", "-o", "b.txt"], "b.txt must end in .toml"),
        (["none.obj", "-o", "b.toml"], "none.obj: the mesh file does not exist"),
    ],
)
def test_what_cannot_be_imported_is_refused(
    tmp_path: Path, monkeypatch, capsys, arguments: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["import", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_a_toml_file_has_no_cameras_by_name(scenes: Path) -> None:
    with pytest.raises(ncv.SceneError, match="a TOML file has one camera"):
        ncv.load_scene(scenes / "cornell_box.toml", camera="left")


def test_what_is_written_reads_back_the_same() -> None:
    tables = {
        "name": 'a "name" \\ with\n\x7f\u00e9',
        "flag": True,
        "camera": {"position": [0.1, -2, 1e-300], "fov": 40.5},
        "materials": {
            "plain": {"albedo": 0.5},
            "with space.": {"albedo": {"file": "a.png", "scale": [2, 1]}, "roughness": 1},
        },
        "environment": {"radiance": [1, 2, 3], "sun": {"direction": [0, 1, 0]}},
        "lights": [{"kind": "point"}, {"kind": "spot", "two": [[1, 2], [3, 4]]}],
    }
    assert tomllib.loads(toml_text(tables)) == tables


def test_every_kind_is_read_to_tables(tmp_path: Path) -> None:
    path = write(tmp_path, {"camera": 0, "translation": [0, 0, 5]}, cameras=(CAMERA,))
    found = read_tables(path, ImageFiles())
    assert set(found.tables) == {"name", "camera", "meshes", "lights"}
    assert found.tables["meshes"] == [{"file": "a.gltf"}] and found.said == [NO_LIGHT]
