"""Maps over UVs: nothing leaks through walls, closed forms, rasterisation, refusals, files."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh

import ncv_cl as ncv
from ncv_cl import BakeError, UVMesh
from ncv_cl.cli import main
from ncv_cl.points.texels import find_texels
from ncv_cl.points.trace import Tracer
from ncv_cl.scene.uv_mesh import read_uv_mesh
from ncv_cl.sensing.bake import _dilated

CAMERA = ncv.Camera((1, 0.5, 1), (3, 0.5, 1), 60)
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
# v goes up: the first row of the map is where z is 2, the end of the first edge.
WHOLE = np.array([[0, 0], [0, 1], [1, 1], [1, 0.0]])


def corners(corner, edge1, edge2):
    corner, edge1, edge2 = (np.array(vector, float) for vector in (corner, edge1, edge2))
    return np.array([corner, corner + edge1, corner + edge1 + edge2, corner + edge2])


FLOOR = UVMesh(corners((0, 0, 0), (0, 0, 2), (4, 0, 0)), HALVES, WHOLE)


def scene_of(*meshes, lights=()):
    found = [ncv.TriangleMesh(vertices, triangles, "grey") for vertices, triangles in meshes]
    return ncv.build_scene(CAMERA, {"grey": ncv.Material(0.7)}, found, list(lights))


def two_rooms(wall: float, thickness: float):
    """Of 4 x 1 x 2, with a wall across at x = `wall` and a lamp in the left one."""
    sides = [
        ((0, 0, 0), (0, 0, 2), (4, 0, 0)),
        ((0, 1, 0), (4, 0, 0), (0, 0, 2)),
        ((0, 0, 0), (0, 1, 0), (0, 0, 2)),
        ((4, 0, 0), (0, 0, 2), (0, 1, 0)),
        ((0, 0, 0), (4, 0, 0), (0, 1, 0)),
        ((0, 0, 2), (0, 1, 0), (4, 0, 0)),
    ]
    meshes = [(corners(*side), HALVES) for side in sides]
    if thickness:
        box = trimesh.creation.box(bounds=[[wall, 0, 0], [wall + thickness, 1, 2]])
        meshes.append((box.vertices, box.faces))
    else:
        meshes.append((corners((wall, 0, 0), (0, 1, 0), (0, 0, 2)), HALVES))
    lamp = ncv.QuadLight((0.8, 0.99, 0.8), (0.4, 0, 0), (0, 0, 0.4), 5.0)
    return scene_of(*meshes, lights=[lamp])


@pytest.mark.parametrize("thickness", [0.1, 0.0])
@pytest.mark.parametrize("integrand", ["direct", "gi"])
def test_no_light_leaks_through_a_wall(one_device, integrand, thickness):
    """The wall stands within a column of texels: that gets the light of its middle's room only."""
    wall = 2.035
    image = ncv.bake(
        two_rooms(wall, thickness), FLOOR, (64, 32), integrand=integrand, spp=16, samples=4, padding=0,
        method="mc", device=one_device,
    )  # fmt: skip
    middle = (np.arange(64) + 0.5) / 16
    dark, lit = image.pixels[:, middle > wall + thickness], image.pixels[:, middle < wall]
    assert not dark.any() and (lit > 0).all()
    stats = image.stats
    if thickness:
        # Of every row of places those from 2.035 to 2.135, and one column of texels.
        assert stats["places_inside"] == 32 * 4 * 7 and stats["texels_inside"] == 32
    else:
        # Places of the column on the other side of the wall from its middle.
        assert stats["places_apart"] == 32 * 4 * 2 and stats["places_inside"] == 0


def test_without_the_wall_there_is_light(one_device):
    image = ncv.bake(
        two_rooms(3.97, 0.0), FLOOR, (32, 16), integrand="direct", spp=16, device=one_device
    )
    assert (image.pixels[:, :31] > 0).all()


def test_map_of_a_floor_is_irradiance_over_pi_the_right_way_up(one_device):
    lamp = ncv.QuadLight((3, 1, 1.5), (0.5, 0, 0), (0, 0, 0.25), (2.0, 4.0, 8.0))
    scene = scene_of((FLOOR.vertices, HALVES), lights=[lamp])
    image = ncv.bake(scene, FLOOR, (32, 16), integrand="direct", samples=1, spp=64, device=one_device)
    x, z = (np.arange(32) + 0.5) / 8, 2 - (np.arange(16) + 0.5) / 8
    at = np.stack([*np.broadcast_arrays(x, 0.0, z[:, None])], axis=-1)
    up = np.broadcast_to([0.0, 1, 0], at.shape)
    same = ncv.irradiance(scene, at, up, spp=64, device=one_device)
    assert np.allclose(np.pi * image.pixels, same.values, rtol=1e-6, atol=0)
    assert np.allclose(np.pi**2 * image.variance, same.variance, rtol=1e-5, atol=0)
    row, column = np.unravel_index(image.pixels[..., 0].argmax(), (16, 32))
    assert row < 4 and 24 <= column < 28
    assert (image.layers["coverage"] == 1).all()
    assert np.allclose(image.layers["N"], [0, 1, 0])


def test_occlusion_of_a_map_is_that_of_a_wall(one_device):
    wall = corners((0, 0, -400), (0, 4, 0), (0, 0, 800))
    scene = scene_of((FLOOR.vertices, HALVES), (wall, HALVES))
    image = ncv.bake(scene, FLOOR, (64, 4), spp=64, visibility="lines", device=one_device)
    x = (np.arange(64) + 0.5) / 16
    exact = (1 + x / np.hypot(x, 4)) / 2
    assert np.abs(image.pixels[..., 0] - exact).max() < 6e-3
    assert image.stats["texels"] == 256 and image.stats["places"] == 1024


def test_rasterisation_is_conservative_and_points_are_in_their_triangles():
    rng = np.random.default_rng(3)
    # Triangles of their own, in rows of the map, some of them thinner than a texel.
    count, size = 24, (40, 48)
    uv = rng.random((count, 3, 2)) * [1, 1 / count] + (np.arange(count) / count)[:, None, None] * [0, 1]
    vertices = np.concatenate([uv, uv[..., :1] * uv[..., 1:]], axis=2).reshape(-1, 3)
    mesh = UVMesh(vertices, np.arange(3 * count).reshape(-1, 3), uv.reshape(-1, 2))
    found = find_texels(mesh, size, 2)
    assert len(np.unique(found.cell)) == len(found.cell)
    texel = found.cell // (2 * size[0]) // 2 * size[0] + found.cell % (2 * size[0]) // 2
    # Every texel in which a random point of a triangle lies is found.
    weights = rng.dirichlet([1, 1, 1], (count, 4000))
    places = (weights @ uv).reshape(-1, 2)
    hit = (size[1] - 1 - np.floor(places[:, 1] * size[1])) * size[0] + np.floor(places[:, 0] * size[0])
    missed = np.setdiff1d(hit.astype(int), texel)
    assert len(missed) == 0 and found.clamped.any()
    # Positions are the UVs here; a point is in the texel that it counts for.
    column, row = texel % size[0], texel // size[0]
    at = np.stack([found.positions[:, 0] * size[0], (1 - found.positions[:, 1]) * size[1]], axis=1)
    apart = np.abs(at - np.stack([column + 0.5, row + 0.5], axis=1)).max(axis=1)
    assert apart.max() <= 0.51
    assert set(found.counts.values()) == {0}


def test_smooth_normals_are_interpolated_on_the_front():
    ball = trimesh.creation.icosphere(subdivisions=2)
    longitude = np.arctan2(ball.vertices[:, 1], ball.vertices[:, 0]) / (2 * np.pi) + 0.5
    uv = np.stack([longitude, ball.vertices[:, 2] / 2 + 0.5], axis=1)
    # Without the triangles that reach around.
    faces = ball.faces[np.ptp(uv[ball.faces, 0], axis=1) < 0.5]
    mesh = UVMesh(ball.vertices, faces, uv, 3 * ball.vertices)
    found = find_texels(mesh, (32, 32), 2)
    outward = found.positions / np.linalg.norm(found.positions, axis=1, keepdims=True)
    assert np.abs(found.normals - outward).max() < 0.02
    flat = find_texels(UVMesh(ball.vertices, faces, uv), (32, 32), 2).normals
    assert 0.02 < np.abs(flat - outward).max() < 0.3


def test_bad_uvs_are_counted_and_said():
    doubled = UVMesh(
        np.concatenate([FLOOR.vertices, FLOOR.vertices + np.array([0, 1, 0])]),
        np.concatenate([HALVES, HALVES + 4, [[0, 0, 1]]]),
        np.concatenate([WHOLE, 0.5 * WHOLE + [0.75, 0]]),
    )
    with pytest.warns(UserWarning) as said:
        found = find_texels(doubled, (8, 6), 1)
    texts = " ".join(str(one.message) for one in said)
    assert "1 of 5 triangles have no area" in texts and "2 of 5 triangles reach beyond" in texts
    assert found.counts["places_covered_twice"] == 6
    # The first has them.
    assert (found.positions[:, 1] == 0).all() and len(found.cell) == 48


BAD = [
    ({"uv": None}, "has no uv"),
    ({"uv": WHOLE[:3]}, "uv: must be as many as vertices, 4, are 3"),
    ({"uv": WHOLE * np.nan}, r"uv\[0\]"),
    ({"triangles": [[0, 1, 4]]}, r"triangles\[0\] refers"),
    ({"triangles": HALVES * 1.0}, "triangles: expected whole numbers"),
    ({"vertices": np.zeros((4, 2))}, "vertices: expected numbers"),
    ({"uv": WHOLE + 2}, "no texel is on the mesh"),
    ({"vertices": FLOOR.vertices + np.array([0, 0.25, 0])}, "lies on no surface"),
    ({"vertices": corners((2.02, 0, 0.2), (0, 0, 1), (0.06, 0, 0))}, "backs of triangles"),
]


@pytest.mark.filterwarnings("ignore:.*reach beyond")
@pytest.mark.parametrize(("change", "message"), BAD)
def test_what_cannot_be_baked_is_refused(one_device, change, message):
    mesh = UVMesh(**{**vars(FLOOR), **change})
    scene = two_rooms(2, 0.1)
    with pytest.raises(BakeError, match=message):
        ncv.bake(scene, mesh, 8, spp=2, device=one_device)


def test_bad_sizes_are_refused(one_device):
    scene = two_rooms(2, 0.1)
    bad = {"size": 0}, {"size": (1, 2, 3)}, {"size": 8, "samples": 0}, {"size": 8, "padding": -1}
    for options in bad:
        with pytest.raises(ValueError):
            ncv.bake(scene, FLOOR, device=one_device, **options)


def test_padding_fills_from_known_neighbours():
    planes, known = np.zeros((5, 6, 1)), np.zeros((5, 6), bool)
    planes[2, 2], planes[2, 3] = 1.0, 3.0
    known[2, 2:4] = True
    one = _dilated(planes, known, 1)[..., 0]
    assert one[2].tolist() == [0, 1, 1, 3, 3, 0] and one[1].tolist() == [0, 1, 2, 2, 3, 0]
    assert (_dilated(planes, known, 9) > 0).all()
    assert not _dilated(planes, known, 0)[0].any()


def test_the_walls_base_is_not_dark(one_device):
    """Texels that a box covers in part have the occlusion of the part that is open."""
    scene = two_rooms(2.035, 0.1)
    image = ncv.bake(scene, FLOOR, (64, 32), integrand=ncv.AmbientOcclusion(0.25), spp=64, samples=4,
                     device=one_device)  # fmt: skip
    row = image.pixels[16, :, 0]
    # Beside a wall half of the sky is left, and it is more farther away.
    assert 0.45 < row[32] < 0.62 and row[31] > row[32] - 0.02 and row[28] > 0.95
    assert len(np.flatnonzero(row < 0.4)) == 0


def test_bake_writes_files(one_device, tmp_path, capsys):
    obj = "\n".join(
        [f"v {x} {y} {z}" for x, y, z in FLOOR.vertices] + [f"vt {u} {v}" for u, v in WHOLE]
        + ["f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]
    )  # fmt: skip
    (tmp_path / "floor.obj").write_text(obj)
    (tmp_path / "plain.obj").write_text("v 0 0 0\nv 0 0 2\nv 4 0 2\nf 1 2 3\n")
    scene = """
[camera]
position = [1, 1, 1]
target = [0, 0, 0]
vertical_fov = 40
[materials.grey]
albedo = 0.5
[[meshes]]
file = "floor.obj"
material = "grey"
[[boxes]]
min = [1, 0, 0.5]
max = [2, 1, 1.5]
material = "grey"
"""
    file = tmp_path / "scene.toml"
    file.write_text(scene)
    out = tmp_path / "map.exr"
    arguments = ["bake", str(file), str(tmp_path / "floor.obj"), "--size", "16", "--spp", "16", "-o",
                 str(out), "-o", str(tmp_path / "map.png"), "--json", str(tmp_path / "map.json"),
                 "--device", str(one_device.index)]  # fmt: skip
    assert main([*arguments, "--radius", "1"]) == 0
    assert "256 places" not in capsys.readouterr().err
    image = ncv.Image.read(out)
    again = ncv.bake(file, UVMesh(FLOOR.vertices, HALVES, WHOLE), 16, spp=16, device=one_device,
                     integrand=ncv.AmbientOcclusion(1))  # fmt: skip
    assert np.array_equal(image.pixels, again.pixels)
    assert set(image.layers) == {"coverage", "N"} and image.metadata["integrand"] == "ao"
    stats = json.loads((tmp_path / "map.json").read_text())
    # The box stands on a quarter by a half of the floor.
    assert stats["places_inside"] == 1024 // 8 and (tmp_path / "map.png").stat().st_size
    assert main(["bake", str(file), str(tmp_path / "plain.obj"), "-o", str(out)]) == 2
    assert "has no UVs" in capsys.readouterr().err
    assert main([*arguments, "--radius", "1", "--integrand", "gi"]) == 2


def test_a_thousand_rays_find_what_is_inside():
    """A point in a ball sees backs, one beside it fronts or nothing."""
    from ncv_cl.points.hidden import inside

    ball = trimesh.creation.icosphere(subdivisions=1)
    scene = scene_of((ball.vertices, ball.faces), (FLOOR.vertices, HALVES))
    rng = np.random.default_rng(0)
    at = rng.uniform(-1.5, 1.5, (500, 3))
    distance = np.linalg.norm(at, axis=1)
    at, distance = at[np.abs(distance - 0.95) > 0.1], distance[np.abs(distance - 0.95) > 0.1]
    normals = np.tile([0.0, 1, 0], (len(at), 1))
    found = inside(scene, Tracer(scene), at, normals)
    # Above the floor's level, whose upper side is its front.
    above = at[:, 1] > 0.01
    assert np.array_equal(found[above], distance[above] < 0.95)


def test_vertices_have_the_occlusion_of_their_corners(one_device, tmp_path):
    """Of a floor before an endless wall: at the wall a half, and the closed form at the far side."""
    wall = corners((0, 0, -400), (0, 4, 0), (0, 0, 800))
    x, z = np.meshgrid(np.linspace(0, 4, 9), np.linspace(0, 2, 5))
    first = (np.arange(4)[:, None] * 9 + np.arange(8)).ravel()
    # Counter-clockwise as seen from above.
    triangles = np.concatenate([np.stack([first, first + 9, first + 10], axis=1),
                                np.stack([first, first + 10, first + 1], axis=1)])  # fmt: skip
    floor = ncv.TriangleMesh(np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1), triangles, "grey")
    scene = scene_of((floor.vertices, floor.triangles), (wall, HALVES))
    found = ncv.bake_vertices(scene, floor, spp=256, visibility="lines", device=one_device)
    exact = (1 + x.ravel() / np.hypot(x.ravel(), 4)) / 2
    assert found.values.shape == found.variance.shape == (45, 1)
    assert np.abs(found.values[:, 0] - exact).max() < 4e-3
    assert found.stats["vertices_inside"] == 0 and found.stats["corners_detached"] == 0
    for suffix in ("ply", "glb"):
        file = tmp_path / f"floor.{suffix}"
        ncv.write_vertex_colours(file, floor, found.values)
        read = trimesh.load(file, process=False, force="mesh")
        colours = read.visual.vertex_colors[:, 0] / 255
        linear = ((colours + 0.055) / 1.055) ** 2.4 if suffix == "ply" else colours
        assert np.allclose(linear, found.values[:, 0].clip(0, 1), atol=0.01)
    with pytest.raises(ValueError, match="must end in"):
        ncv.write_vertex_colours(tmp_path / "floor.obj", floor, found.values)
    with pytest.raises(ValueError, match="values must be"):
        ncv.write_vertex_colours(tmp_path / "floor.ply", floor, found.values[:3])


def test_vertices_in_the_dark_room_are_black(one_device):
    room = two_rooms(2.0, 0.5)
    light = ncv.bake_vertices(room, FLOOR, integrand="gi", spp=64, method="mc", device=one_device)
    assert (light.values[FLOOR.vertices[:, 0] == 0] > 0).all()
    assert not light.values[FLOOR.vertices[:, 0] == 4].any()
    under = UVMesh(corners((2.1, 0, 0.2), (0, 0, 1), (0.3, 0, 0)), HALVES, WHOLE)
    with pytest.raises(BakeError, match="backs of triangles"):
        ncv.bake_vertices(room, under, spp=2, device=one_device)
    aside = UVMesh(FLOOR.vertices + np.array([0, 0, 1]), HALVES, WHOLE)
    with pytest.warns(UserWarning, match=r"of \d+ places of the mesh lie on no surface"):
        image = ncv.bake(room, aside, 8, spp=2, device=one_device)
    assert image.stats["places_detached"] > 0


def test_charts_have_no_seam(one_device):
    """A floor in two charts, apart and turned on the map, has the values of the floor in one."""
    lamp = ncv.QuadLight((1.5, 1, 0.5), (0.5, 0, 0), (0, 0, 0.25), 4.0)
    scene = scene_of((FLOOR.vertices, HALVES), lights=[lamp])
    options = {"integrand": "direct", "spp": 64, "method": "mc", "device": one_device}
    whole = ncv.bake(scene, FLOOR, (64, 32), **options)
    left = corners((0, 0, 0), (0, 0, 2), (2, 0, 0))
    right = corners((2, 0, 0), (0, 0, 2), (2, 0, 0))
    # On a map of 80 x 72 texels: the left half upright, the right one on its head with u along z.
    uv = np.concatenate([
        np.array([[4, 36], [4, 68], [36, 68], [36, 36]]) / [80, 72],
        np.array([[4, 2], [36, 2], [36, 34], [4, 34]]) / [80, 72],
    ])  # fmt: skip
    cut = UVMesh(np.concatenate([left, right]), np.concatenate([HALVES, HALVES + 4]), uv)
    image = ncv.bake(scene, cut, (80, 72), padding=2, **options)
    parts = [image.pixels[4:36, 4:36], image.pixels[38:70, 4:36][:, ::-1].transpose(1, 0, 2)[:, ::-1]]
    found = np.concatenate(parts, axis=1)
    error = 5 * np.sqrt(whole.variance.max() + image.variance.max()) + 1e-5
    assert np.abs(found - whole.pixels).max() < error < 0.02 * whole.pixels.max()
    # Around the charts the map goes on.
    assert (image.pixels[2:38, 2:38] > 0).all()
    assert np.count_nonzero(image.layers["coverage"] == 1) == 2 * 32 * 32


def test_a_mesh_without_uvs_is_unwrapped(one_device):
    pytest.importorskip("xatlas")
    box = trimesh.creation.box(bounds=[[1, 0, 0.5], [2, 1, 1.5]])
    mesh = ncv.TriangleMesh(box.vertices + np.array([1e6, 0, 0]), box.faces, "grey", 2 * box.vertices)
    cut = ncv.unwrap(mesh, size=64, padding=2)
    assert cut.uv.min() >= 0 and cut.uv.max() <= 1 and len(cut.triangles) == 12
    assert np.array_equal(np.sort(cut.vertices[cut.triangles].reshape(12, -1), axis=0),
                          np.sort(mesh.vertices[box.faces].reshape(12, -1), axis=0))  # fmt: skip
    assert cut.normals.shape == cut.vertices.shape
    found = find_texels(cut, (64, 64), 1)
    assert found.counts["places_covered_twice"] == 0 and found.counts["triangles_outside"] == 0
    near = ncv.unwrap(ncv.TriangleMesh(box.vertices, box.faces, "grey"), size=32)
    image = ncv.bake(scene_of((box.vertices, box.faces)), near, 32, spp=4, device=one_device)
    assert image.stats["places_detached"] == 0
    # Nothing is in the way of a convex box.
    assert np.allclose(image.pixels[image.layers["coverage"] > 0].mean(), 1, atol=0.02)
    with pytest.raises(BakeError, match="more than"):
        ncv.unwrap(mesh, time_limit=1e-3)
    with pytest.raises(BakeError, match="could not unwrap"):
        ncv.unwrap(mesh, size=-5, padding="x")


def test_a_file_keeps_its_normals_and_flat_parts_stay_flat(tmp_path):
    """Two objects, one with normals: it is smooth, the other has its triangles' normals."""
    square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    parts = "o flat\nusemtl a\nf 1/1 2/2 3/3\no smooth\nusemtl b\nvn 0.6 0 0.8\nf 1/1/1 3/3/1 4/4/1\n"
    (tmp_path / "two.obj").write_text(square + parts)
    mesh = read_uv_mesh(tmp_path / "two.obj")
    corners = mesh.vertices[mesh.triangles]
    assert len(corners) == 2 and np.array_equal(corners[..., :2], mesh.uv[mesh.triangles])
    expected = {(1.0, 0.0): (0, 0, 1), (0.0, 1.0): (0.6, 0, 0.8)}
    for corner, normal in expected.items():
        found = mesh.normals[(mesh.uv == corner).all(axis=1)]
        assert len(found) == 1 and np.allclose(found[0], normal, atol=1e-15)
    (tmp_path / "flat.obj").write_text(square + "f 1/1 2/2 3/3\n")
    assert read_uv_mesh(tmp_path / "flat.obj").normals is None
