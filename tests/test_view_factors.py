"""View factors: closed forms, brute force, what must sum to one, names."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from reference import polygon_irradiance, unit
from test_sense import above_horizon

import ncv_cl as ncv
from ncv_cl import SceneError
from ncv_cl.points.patches import find_patch, patch_points
from ncv_cl.points.trace import Tracer
from ncv_cl.visibility.between import nothing_between
from ncv_cl.visibility.exchange import exchange_area

CAMERA = ncv.Camera((0.5, 0.5, 5), (0.5, 0.5, 0), 40)


def rectangle(name, corner, edge1, edge2):
    corner, edge1, edge2 = (np.array(vector, float) for vector in (corner, edge1, edge2))
    corners = np.array([corner, corner + edge1, corner + edge1 + edge2, corner + edge2])
    return ncv.TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), "grey", name=name)


def ball(name, centre, radius, subdivisions=2):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return ncv.TriangleMesh(mesh.vertices + centre, mesh.faces, "grey", name=name)


def scene_of(*meshes):
    return ncv.build_scene(CAMERA, {"grey": ncv.Material(0.5)}, list(meshes))


def parallel(x, y):
    """Equal, opposite rectangles of sides x and y in units of their distance (Howell C-11)."""
    root_x, root_y = np.sqrt(1 + x * x), np.sqrt(1 + y * y)
    logarithm = np.log(root_x * root_y / np.sqrt(1 + x * x + y * y))
    angles = x * root_y * np.arctan(x / root_y) + y * root_x * np.arctan(y / root_x)
    return 2 / (np.pi * x * y) * (logarithm + angles - x * np.arctan(x) - y * np.arctan(y))


def perpendicular(h, w):
    """To a rectangle of height h from one of width w, in units of the edge they share (Howell C-14)."""
    a, b, c = 1 + w * w, 1 + h * h, 1 + w * w + h * h
    root = np.hypot(h, w)
    logarithm = np.log(
        a * b / c * (w * w * c / (a * root**2)) ** (w * w) * (h * h * c / (b * root**2)) ** (h * h)
    )
    angles = w * np.arctan(1 / w) + h * np.arctan(1 / h) - root * np.arctan(1 / root)
    return (angles + logarithm / 4) / (np.pi * w)


@pytest.mark.parametrize(("x", "y", "height"), [(1, 1, 1), (2, 0.5, 0.25), (0.5, 0.25, 4)])
def test_rectangles_have_their_closed_forms(one_device, x, y, height):
    scene = scene_of(
        rectangle("floor", (0, 0, 0), (0, 0, y), (x, 0, 0)),
        rectangle("ceiling", (0, height, 0), (x, 0, 0), (0, 0, y)),
        rectangle("wall", (0, 0, 0), (0, height, 0), (0, 0, y)),
    )
    found = ncv.view_factors(scene, ["floor", "ceiling", "wall"], device=one_device)
    across, up = parallel(x / height, y / height), perpendicular(height / y, x / y)
    wanted = np.array([[0, across, up], [across, 0, up], [up * x / height, up * x / height, 0]])
    assert (found.how == "exact").all()
    assert np.allclose(found.values, wanted, rtol=1e-6, atol=0)
    assert (np.abs(found.values - wanted) <= 4 * found.standard_error).all()
    assert np.allclose(found.areas, [x * y, x * y, height * y])
    # From behind nothing is seen.
    assert not ncv.view_factors(scene, ["-floor", "ceiling"], device=one_device).values.any()


def test_discs_as_polygons(one_device):
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    fan = np.array([[0, k, k + 1] for k in range(1, 47)])
    low = ncv.TriangleMesh(ring, fan[:, ::-1], "grey", name="low")
    high = ncv.TriangleMesh(0.5 * ring + [0, 1, 0], fan, "grey", name="high")
    found = ncv.view_factors(scene_of(low, high), ["low", "high"], device=one_device)
    # Discs of radii 1 and 1/2 at distance 1 (Howell C-41); the polygons have a little less area.
    s = 1 + (1 + 0.25) / 1
    disc = 0.5 * (s - np.sqrt(s * s - 4 * 0.25))
    assert found.how[0, 1] == "exact"
    assert abs(found.values[0, 1] / disc - 1) < 4e-3
    assert abs(found.reciprocity[0, 1]) < 1e-12


def clipped_irradiance(polygon, position, normal):
    facing = (position - polygon[0]) @ np.cross(polygon[1] - polygon[0], polygon[2] - polygon[0]) > 0
    above = above_horizon(polygon, position, normal)
    return polygon_irradiance(above, position, normal) if facing and len(above) else 0.0


def test_exchange_of_polygons_that_cut_each_others_planes():
    """Against sums of Lambert's formula over points of one of them."""
    rng = np.random.default_rng(4)
    grid = (np.arange(48) + 0.5) / 48
    a, b = (axis.ravel() for axis in np.meshgrid(grid, grid))
    seen = 0
    for _ in range(12):
        corner, edges = rng.normal(size=(2, 3)), rng.normal(size=(2, 2, 3))
        first, second = (
            c + np.array([0 * e[0], e[0], e[0] + e[1], e[1]]) for c, e in zip(corner, edges, strict=True)
        )
        normal = np.cross(*edges[0])
        area = np.linalg.norm(normal)
        places = corner[0] + a[:, None] * edges[0, 0] + b[:, None] * edges[0, 1]
        values = [clipped_irradiance(second, place, normal / area) / np.pi for place in places]
        exact = exchange_area(first, second)
        assert exact == pytest.approx(exchange_area(second, first), rel=1e-9, abs=1e-12)
        assert exact / area == pytest.approx(np.mean(values), rel=4e-3, abs=2e-4)
        seen += exact > 1e-2
    assert seen >= 3


@pytest.fixture(scope="module")
def furnace():
    """A closed room of 2 x 1 x 1 with a baffle across the middle."""
    return scene_of(
        rectangle("floor", (0, 0, 0), (0, 0, 1), (2, 0, 0)),
        rectangle("ceiling", (0, 1, 0), (2, 0, 0), (0, 0, 1)),
        rectangle("left", (0, 0, 0), (0, 1, 0), (0, 0, 1)),
        rectangle("right", (2, 0, 0), (0, 0, 1), (0, 1, 0)),
        rectangle("walls", (0, 0, 0), (2, 0, 0), (0, 1, 0)),
        rectangle("walls", (0, 0, 1), (0, 1, 0), (2, 0, 0)),
        rectangle("baffle", (1, 0, 0.2), (0, 0.6, 0), (0, 0, 0.6)),
    )


ROOM = ["floor", "ceiling", "left", "right", "walls", "baffle", "-baffle"]


def by_brute_force(scene, names, rays):
    """Shares of random cosine-distributed rays, and their standard errors."""
    rng = np.random.default_rng(1)
    tracer, patches = Tracer(scene), [find_patch(scene, name) for name in names]
    values = np.zeros((len(names), len(names)))
    for i, patch in enumerate(patches):
        at, normal = patch.points(rng.random(rays), rng.random(rays))
        direction = unit(normal + unit(rng.normal(size=(rays, 3))))
        hits = tracer.closest(np.float32(at + 1e-5 * normal), np.float32(direction))
        for j, other in enumerate(patches):
            k = np.searchsorted(other.triangles, hits.triangle).clip(0, len(other.triangles) - 1)
            facing = np.sum(other.triangle_normals(scene)[k] * direction, axis=1) < 0
            values[i, j] = np.mean((other.triangles[k] == hits.triangle) & facing)
    return values, np.sqrt(np.maximum(values * (1 - values), 1 / rays) / rays)


def test_a_closed_room_with_a_baffle(one_device, furnace):
    found = ncv.view_factors(furnace, ROOM, points=256, lines=8, device=one_device)
    assert set(found.how.ravel()) == {"exact", "lines"}
    assert found.how[0, 1] == "lines" and found.how[5, 3] == "exact"
    # The baffle hides the walls from each other in part, and they see each other.
    assert found.values[4, 4] > 0.1 and found.how[4, 4] == "lines"
    z = (found.row_sums - 1) / np.sqrt(found.variance.sum(axis=1))
    assert np.abs(z).max() < 4.5 and np.abs(found.row_sums - 1).max() < 2e-3
    spread = found.areas[:, None] ** 2 * found.variance
    z = found.reciprocity / np.sqrt(spread + spread.T + 1e-30)
    assert np.abs(z).max() < 4.5
    assert not found.values[5, 2] and not found.values[6, 3]
    brute, error = by_brute_force(furnace, ROOM, 200_000)
    z = (found.values - brute) / np.hypot(error, found.standard_error)
    assert np.abs(z).max() < 4.5
    # The baffle matters: what is left to see is less.
    empty = parallel(2, 1)
    assert found.values[0, 1] < empty - 100 * found.standard_error[0, 1]


def test_same_seed_same_factors(one_device, furnace):
    options = {"points": 64, "lines": 4, "device": one_device}
    first, again = (ncv.view_factors(furnace, ROOM, seed=3, **options) for _ in range(2))
    assert np.array_equal(first.values, again.values)
    assert not np.array_equal(first.values, ncv.view_factors(furnace, ROOM, seed=4, **options).values)


def test_balls_in_a_shell_are_measured_by_rays(one_device):
    """A ball in a shell: all that leaves it arrives, and of what leaves the shell the ratio of areas."""
    scene = scene_of(ball("ball", (0.1, 0.05, 0), 0.3), ball("shell", (0, 0, 0), 1.0, 3))
    names = ["ball", "-shell"]
    found = ncv.view_factors(scene, names, points=512, lines=4, device=one_device)
    ratio = found.areas[0] / found.areas[1]
    assert (found.how == "rays").all()
    wanted = np.array([[0, 1], [ratio, 1 - ratio]])
    assert (np.abs(found.values - wanted) <= 4.5 * found.standard_error + 1e-4).all()
    # The shell's other side sees nothing of it.
    assert not ncv.view_factors(scene, ["shell", "ball"], points=64, device=one_device).values.any()


def test_patches_without_lines_get_the_opposite_direction(one_device):
    """From a floor to a ball behind a screen, by lines on the floor."""
    scene = scene_of(
        rectangle("floor", (-1, 0, -1), (0, 0, 2), (2, 0, 0)),
        rectangle(None, (0, 0.3, -1), (0, 0, 2), (1, 0, 0)),
        ball("ball", (0, 1, 0), 0.4),
    )
    names = ["floor", "ball"]
    found = ncv.view_factors(scene, names, points=256, lines=8, device=one_device)
    assert found.how[0, 1] == "reciprocal" and found.how[1, 0] == "lines"
    brute, error = by_brute_force(scene, names, 200_000)
    z = (found.values - brute) / np.hypot(error, found.standard_error)
    assert np.abs(z).max() < 4.5


def test_boxes_are_parallelograms_and_points_on_patches_are_even(one_device):
    box = trimesh.creation.box(extents=(1, 2, 4))
    scene = scene_of(ncv.TriangleMesh(box.vertices, box.faces, "grey", name="box"))
    patch = find_patch(scene, "box")
    assert len(patch.corner) == 6 and patch.is_parallelogram.all() and patch.area == 28
    assert (np.sum(patch.normals * (patch.corner + 0.5 * (patch.edge1 + patch.edge2)), axis=1) > 0).all()
    position, normal = patch_points(one_device, patch, 1024, range(4), 0)
    on_large = np.abs(normal[..., 0]) > 0.5
    assert np.allclose(on_large.mean(axis=1), 16 / 28, atol=2e-3)
    assert np.allclose(np.abs(position).max(axis=(0, 1)), [0.5, 1, 2], atol=1e-2)
    ring = find_patch(scene_of(ball("ball", (0, 0, 0), 1)), "ball")
    position, normal = patch_points(one_device, ring, 4096, range(1), 0)
    assert not ring.is_parallelogram.any()
    assert np.allclose(position.mean(axis=(0, 1)), 0, atol=5e-3)
    assert np.allclose((position**2).mean(axis=(0, 1)), (position**2).mean(), rtol=2e-2)
    assert nothing_between(scene, patch, patch)


def test_names(tmp_path, one_device):
    text = """
name = "named"
[camera]
position = [0, 1, 5]
target = [0, 0, 0]
vertical_fov = 40
[materials.grey]
albedo = 0.5
[[quads]]
corner = [0, 0, 0]
edge1 = [0, 0, 1]
edge2 = [1, 0, 0]
material = "grey"
name = "floor"
[[boxes]]
min = [0, 2, 0]
max = [1, 3, 1]
material = "grey"
name = "box"
[[spheres]]
center = [9, 9, 9]
radius = 1
material = "grey"
name = "ball"
[[polygons]]
vertices = [[0, 1, 0], [0.5, 1, 0], [0, 1, 0.5]]
material = "grey"
name = "leaf"
"""
    file = tmp_path / "named.toml"
    file.write_text(text)
    scene = ncv.load_scene(file)
    found = ncv.view_factors(file, ["floor", "box", "leaf"], points=64, lines=4, device=one_device)
    assert found.areas.tolist() == pytest.approx([1, 6, 0.125])
    assert 0 < found.values[1, 0] < 1 / 6
    file.write_text("\n".join(line for line in text.splitlines() if not line.startswith('name = "f')))
    assert ncv.load_scene(file).digest == scene.digest
    with pytest.raises(SceneError, match=r"no surface is called 'flor'; named surfaces: ball, box"):
        ncv.view_factors(scene, ["flor"], device=one_device)
    file.write_text(text.replace('"leaf"', '"-leaf"'))
    with pytest.raises(SceneError, match=r"polygons\[0\].name: '-leaf' must not begin with -"):
        ncv.load_scene(file)
    with pytest.raises(ValueError, match="names of surfaces"):
        ncv.view_factors(scene, "floor", device=one_device)
    with pytest.raises(ValueError, match="points must be"):
        ncv.view_factors(scene, ["floor"], points=0, device=one_device)
    nothing = ncv.view_factors(scene, [], device=one_device)
    assert nothing.values.shape == (0, 0)


def test_pyviewfactor_agrees(one_device):
    pvf = pytest.importorskip("pyviewfactor")
    pyvista = pytest.importorskip("pyvista")
    corners = [
        np.array([[0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 0, 0.0]]),
        np.array([[0.25, 0.5, 0.25], [1, 1, 0.25], [1, 1, 1.5], [0.25, 0.5, 1.5]]),
    ]
    meshes = [
        ncv.TriangleMesh(one, np.array([[0, 1, 2], [0, 2, 3]]), "grey", name=name)
        for one, name in zip(corners, ("one", "other"), strict=True)
    ]
    scene = scene_of(*meshes)
    cells = [pyvista.PolyData(one, faces=[4, 0, 1, 2, 3]) for one in corners]
    names = ["one" if pvf.face_normal_numpy(corners[0])[1] > 0 else "-one", "other"]
    ours = ncv.view_factors(scene, names, device=one_device)
    if not ours.values.any():
        ours = ncv.view_factors(scene, [names[0], "-other"], device=one_device)
    theirs = max(pvf.compute_viewfactor(cells[1], cells[0]), pvf.compute_viewfactor(cells[0], cells[1]))
    assert ours.values[0, 1] == pytest.approx(theirs, rel=1e-4) or ours.values[1, 0] == pytest.approx(
        theirs, rel=1e-4
    )
