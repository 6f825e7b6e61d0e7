"""Shapes of Mitsuba's scene files, and images on them, are where Mitsuba has them."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_files import SQUARE, obj_text, write_image
from mitsuba_files import load, matrix_text, rectangle, scene, serialized
from reference import intersect

import ncv_cl as ncv
from ncv_cl.cli import main
from ncv_cl.scene.textures.surface import surface_at

pytest.importorskip("mitsuba", reason="mitsuba is not installed")
pytest.importorskip("defusedxml", reason="defusedxml is not installed")
AREA = '<emitter type="area"><rgb name="radiance" value="1 2 3"/></emitter>'
SHAPES = {
    "rectangle": "", "cube": "", "disk": "", "sphere": '<float name="radius" value="0.7"/>',
    "cylinder": '<point name="p0" x="0.1" y="0" z="0"/><point name="p1" x="0" y="0.5" z="1"/>',
    "obj": '<string name="filename" value="a.obj"/>', "ply": '<string name="filename" value="a.ply"/>',
    "serialized": '<string name="filename" value="a.serialized"/>'
    '<integer name="shape_index" value="1"/>',
}  # fmt: skip
PLACES = {
    "turned": np.array([[0, -2, 0, 1], [2, 0, 0, 0], [0, 0, 2, -1], [0, 0, 0, 1]], float),
    "sheared": np.array([[1, 0.5, 0, 0], [0, 2, 0.3, 1], [0, 0, 0.5, 2], [0, 0, 0, 1]], float),
    "mirrored": np.array([[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]], float),
}


def write_meshes(folder: Path) -> None:
    (folder / "a.obj").write_text(obj_text([SQUARE.tolist()]))
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.export(folder / "a.ply")
    (folder / "a.serialized").write_bytes(serialized(trimesh.creation.box(), ball))
    write_image(folder / "t.png", np.arange(48, dtype=np.float32).reshape(4, 4, 3) / 48)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_are_where_mitsuba_has_them(tmp_path: Path, scalar, shape: str, place: str) -> None:
    """The same bounds, and rays hit at the same distance or miss."""
    if (shape, place) == ("sphere", "sheared"):
        pytest.skip("Mitsuba has no sheared spheres")
    write_meshes(tmp_path)
    content = f'{SHAPES[shape]}<transform name="to_world">{matrix_text(PLACES[place])}</transform>'
    bsdf = '<bsdf type="diffuse"><float name="reflectance" value="0.5"/></bsdf>'
    (tmp_path / "x.xml").write_text(scene(f'<shape type="{shape}">{content}{bsdf}</shape>'))
    ours = load(tmp_path / "x.xml")
    theirs = scalar.load_file(str(tmp_path / "x.xml"), parallel=False)
    mesh = trimesh.Trimesh(ours.vertices + ours.origin, ours.triangles, process=False)
    generator = np.random.default_rng(2)
    box = theirs.bbox()
    low, high = np.array(box.min), np.array(box.max)
    np.testing.assert_allclose(mesh.bounds, [low, high], atol=4e-3 * np.ptp([low, high]))
    targets = generator.uniform(low, high, (200, 3))
    origins = (low + high) / 2 + 9 * generator.normal(size=(200, 3))
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances = np.full(200, np.inf)
    for i, (o, d) in enumerate(zip(origins, directions, strict=True)):
        hit = theirs.ray_intersect(scalar.Ray3f(o.tolist(), d.tolist()))
        distances[i] = float(hit.t)
    places, rays, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    found = np.full(200, np.inf)
    found[rays] = np.linalg.norm(places - origins[rays], axis=1)
    both = np.isfinite(found) & np.isfinite(distances)
    # At a silhouette one may hit and the other not.
    assert both.sum() > 20 and (np.isfinite(found) != np.isfinite(distances)).mean() < 0.02
    assert np.mean(np.abs(found[both] - distances[both]) < 5e-3 * np.linalg.norm(high - low)) > 0.98


@pytest.mark.parametrize("shape", [name for name in SHAPES if name != "obj"])
@pytest.mark.parametrize("flip", ["false", "true"])
def test_images_lie_as_mitsubas(tmp_path: Path, scalar, shape: str, flip: str) -> None:
    write_meshes(tmp_path)
    sphere = trimesh.creation.icosphere(subdivisions=1)
    rows = "\n".join(f"{x} {y} {z} {0.3 * x + 0.5} {0.2 * y + 0.4}" for x, y, z in sphere.vertices)
    faces = "\n".join(f"3 {a} {b} {c}" for a, b, c in sphere.faces)
    (tmp_path / "a.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(sphere.vertices)}\nproperty float x\n"
        "property float y\nproperty float z\nproperty float u\nproperty float v\n"
        f"element face {len(sphere.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        f"{rows}\n{faces}\n"
    )
    texture = (
        '<bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
        '<boolean name="raw" value="true"/>'
        '<string name="filename" value="t.png"/><string name="filter_type" value="nearest"/>'
        '<transform name="to_uv"><scale x="2" y="3"/><translate x="0.15" y="0.35"/></transform>'
        "</texture></bsdf>"
    )
    turned = f'<boolean name="flip_tex_coords" value="{flip}"/>' if shape == "ply" else ""
    content = f"{SHAPES[shape]}{turned}{texture}"
    (tmp_path / "x.xml").write_text(scene(f'<shape type="{shape}">{content}</shape>'))
    ours = load(tmp_path / "x.xml")
    theirs = scalar.load_file(str(tmp_path / "x.xml"), parallel=False)
    generator = np.random.default_rng(2)
    origins = 4 * generator.normal(size=(60, 3))
    directions = generator.uniform(-0.6, 0.6, (60, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    triangle, u, v, _ = intersect(ours, origins - ours.origin, directions)
    hits = [
        theirs.ray_intersect(scalar.Ray3f(o.tolist(), d.tolist()))
        for o, d in zip(origins, directions, strict=True)
    ]
    both = np.array([hit.is_valid() for hit in hits]) & (triangle >= 0)
    met = [hit for hit, meets in zip(hits, both, strict=True) if meets]
    there = np.array([hit.bsdf().eval_diffuse_reflectance(hit) for hit in met])
    here = surface_at(ours, triangle[both], u[both], v[both]).albedo
    # Beside a texel's edge a tessellated surface may show its neighbour.
    agree = np.abs(here - there).max(axis=1) < 1e-3
    assert both.sum() > 20 and agree.mean() > (0.9 if shape in ("sphere", "cylinder", "disk") else 0.97)


def test_import_writes_the_same_scene(tmp_path: Path, capsys) -> None:
    write_meshes(tmp_path)
    image = '<texture type="bitmap" name="reflectance"><string name="filename" value="t.png"/></texture>'
    shapes = ""
    for i, (kind, keys) in enumerate(SHAPES.items()):
        bsdf = f'<bsdf type="diffuse" id="b{i}">{image if kind in ("disk", "sphere") else ""}</bsdf>'
        shapes += f'<shape type="{kind}">{keys}{bsdf}</shape>'
    (tmp_path / "x.xml").write_text(scene(shapes + rectangle(AREA, '<translate z="9"/>')))
    (tmp_path / "out").mkdir()
    assert main(["import", str(tmp_path / "x.xml"), "-o", str(tmp_path / "out" / "y.toml")]) == 0
    assert "reflect from both sides" in capsys.readouterr().err
    one, other = load(tmp_path / "x.xml"), load(tmp_path / "out" / "y.toml")
    assert one.digest == other.digest
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["a.obj", "a.ply", "t.png", "y.toml", "y_1.ply", "y_2.ply", "y_3.ply", "y_4.ply"]


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda data: data[:-60] + data[-20:], "cut off|decompressed|refers to"),
        (lambda data: data[:-4] + b"\xff\xff\xff\xff", "has no mesh 1"),
        (lambda data: b"", "has no mesh 1"),
        (
            lambda data: bytes(len(data) - 20) + data[-20:],
            "no serialized mesh of version 3 or 4|has no mesh",
        ),
        (
            lambda data: (
                struct.pack("<HH", 0x041C, 4)
                + zlib.compress(struct.pack("<IBQQ", 0x1000, 0, 1 << 40, 1))
                + struct.pack("<QQI", 0, 0, 2)
            ),
            "announces more than it can hold",
        ),
    ],
)
def test_broken_serialized_meshes_are_errors(tmp_path: Path, change, said: str) -> None:
    write_meshes(tmp_path)
    file = tmp_path / "a.serialized"
    file.write_bytes(change(file.read_bytes()))
    (tmp_path / "x.xml").write_text(scene(f'<shape type="serialized">{SHAPES["serialized"]}</shape>'))
    with pytest.raises(ncv.SceneError, match=said):
        load(tmp_path / "x.xml")
