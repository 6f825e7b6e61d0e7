"""`ncv-cl info`: what a scene or a mesh file holds, and a scene file for a mesh."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import SCENE, obj_text
from reference import camera_directions, intersect

import ncv_cl as ncv
from ncv_cl.cli import main
from ncv_cl.scene.about import describe, mesh_toml, view_of

SQUARE = [(0, 0, 0), (2, 0, 0), (2, 3, 0), (0, 3, 0)]


@pytest.fixture
def mesh(tmp_path: Path) -> Path:
    """A glowing rectangle whose library asks for what is not read."""
    (tmp_path / "m.mtl").write_text("newmtl lamp\nKd 0.2 0.4 0.6\nKe 5 5 5\nd 0.5\n")
    path = tmp_path / "a b.obj"
    path.write_text("mtllib m.mtl\nusemtl lamp\n" + obj_text([SQUARE]))
    return path


def test_a_mesh_is_described(mesh: Path) -> None:
    lines = describe(mesh).splitlines()
    assert lines[:4] == [
        f"{mesh}: 2 triangles",
        "bounds    (0, 0, 0) to (2, 3, 0), size (2, 3, 0)",
        "materials 1",
        "  a b.obj:lamp: albedo (0.2, 0.4, 0.6), emits 5, on 2 triangles",
    ]
    assert (
        "  meshes[0].file: a b.obj: materials that let light through are drawn opaque: 1 (lamp)" in lines
    )
    assert lines[-5] == "[camera]"


def test_a_scene_is_described(scenes: Path) -> None:
    text = describe(scenes / "interior.toml")
    assert (
        "  metal: albedo 0.02, reflectance (0.7, 0.65, 0.55), roughness 0.3, on 1292 triangles" in text
    )
    assert (
        "lights    2\n  area 0.122 at (1.3, 1.7, -2.6), radiance (60, 52, 40), towards (0, 1, 0)" in text
    )
    assert "camera    at (1.2, 1.5, 1.7), to (-0.5, 0.85, -1.6), 62° high" in text
    assert "but for" not in text


def test_images_are_described(scenes: Path) -> None:
    text = describe(scenes / "textured_room.toml")
    assert (
        "  leaf: albedo 1, colour by an image of 128 × 128, opacity by an image of 128 × 128, on 6"
        in text
    )
    assert (
        "  bricks: albedo 1, colour by an image of 128 × 128, normal by an image of 128 × 128, on 2"
        in text
    )


def test_a_scene_far_from_the_origin_is_described_in_world_coordinates(tmp_path: Path) -> None:
    far = SCENE.replace("[0, 1, 5]", "[3e6, 1, 5]").replace("[0, 0, 0]", "[3e6, 0, 0]")
    quad = '[[quads]]\ncorner = [3e6, 0, 0]\nedge1 = [1, 0, 0]\nedge2 = [0, 0, 1]\nmaterial = "grey"\n'
    (tmp_path / "x.toml").write_text(far + quad)
    text = describe(tmp_path / "x.toml")
    assert "bounds    (3e+06, 0, 0) to (3e+06, 0, 1), size (1, 0, 1)" in text
    assert "camera    at (3e+06, 1, 5)" in text and "target = [3000000.5, 0, 0.5]" in text


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_the_suggested_camera_sees_every_corner(scale: float) -> None:
    bounds = scale * np.array([[-1.0, 2.0, -3.0], [4.0, 2.5, 1.0]])
    camera = view_of(bounds)
    corners = np.array(np.meshgrid(*bounds.T)).reshape(3, -1).T - camera.position
    forward = camera.target - camera.position
    depth = corners @ forward / np.linalg.norm(forward)
    across = np.sqrt(np.sum(corners**2, axis=1) - depth**2)
    assert (depth > 0).all()
    assert (across < depth * np.tan(np.radians(camera.vertical_fov / 2))).all()


def test_the_scene_file_of_a_mesh_shows_all_of_it(mesh: Path, one_device: ncv.Device) -> None:
    path = mesh.parent / "scene.toml"
    path.write_text(mesh_toml(mesh), encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = ncv.load_scene(path)
    triangle, *_ = intersect(scene, *_rays(scene, 40))
    light = np.append(scene.triangle_light, -2)[triangle]
    # The mesh is in the middle and not cut off by the picture's sides, and the light is out of sight.
    hit = (light == -1).reshape(40, 40)
    assert hit[20, 20] and hit.mean() > 0.05 and (light < 0).all()
    assert not (hit[0].any() or hit[-1].any() or hit[:, 0].any() or hit[:, -1].any())
    image = ncv.render(scene, "gi", "mc", spp=4, size=(8, 8), device=one_device)
    assert image.pixels.max() > 4


def test_what_is_printed_is_a_whole_scene_file(tmp_path: Path, capsys, one_device: ncv.Device) -> None:
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(subdivisions=2).export(path)
    assert main(["info", "--toml", str(path)]) == 0
    (tmp_path / "ball.toml").write_text(capsys.readouterr().out)
    with pytest.warns(UserWarning, match="no material"):
        image = ncv.render(
            tmp_path / "ball.toml", "direct", "mc", spp=16, size=(8, 8), device=one_device
        )
    # Neither black nor burnt out.
    assert 0.1 < image.pixels[3:5, 3:5].mean() < 1.0
    assert main(["info", str(path)]) == 0
    assert "320 triangles" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, said",
    [(["none.toml"], "cannot read the scene file"), (["none.obj"], "the mesh file does not exist"),
     (["--toml", "a.toml"], "--toml is for mesh files: .obj, ")],
)  # fmt: skip
def test_what_cannot_be_described_is_refused(arguments: list[str], said: str, capsys) -> None:
    assert main(["info", *arguments]) == 2
    assert said in capsys.readouterr().err


def _rays(scene: ncv.Scene, size: int) -> tuple[np.ndarray, np.ndarray]:
    directions = camera_directions(scene.camera, size, size)
    return np.broadcast_to(scene.camera.position, directions.shape), directions
