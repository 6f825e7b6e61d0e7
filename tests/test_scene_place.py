"""Scenes anywhere and of any size: the picture is that of the same scene near the origin, by closed
forms.

A box stands on a ground under a light. Every pixel of the ground is either seen by the whole light,
and then Lambert's formula gives its value, or by nothing of it, and then it is black, or by a part:
which, follows in double precision from the box and the light alone. None of that depends on where
in the world the scene lies, how it is turned, how large it is, or how far the ground reaches.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from mesh_files import write_image
from reference import camera_directions, polygon_irradiance
from trimesh.transformations import rotation_matrix

from ncv_cl import AmbientOcclusion, GlobalIllumination, render
from ncv_cl.network.encode import GridCube
from ncv_cl.points.points import RELATIVE_OFFSET, find_points
from ncv_cl.points.trace import Tracer
from ncv_cl.sampling.triangles import triangle_records
from ncv_cl.scene.geometry import flat_mesh, quad_mesh, sphere_mesh
from ncv_cl.scene.load import Camera, load_scene
from ncv_cl.scene.place import (
    LARGEST_RATIO,
    cut_huge,
    is_coarse,
    moved,
    scene_origin,
    unresolved_steps,
)

BOX = np.array([[-0.3, 0.0, -0.2], [0.1, 0.05, 0.2]])
SIZE = (32, 32)
TURN = rotation_matrix(np.radians(37), [1, 2, 3])[:3, :3]
MAP = np.array([5e5, 4e6, 100.0])


@dataclass(frozen=True)
class World:
    """Where a scene of about a metre's size lies, and how far its ground reaches."""

    reach: float = 10.0
    turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    place: np.ndarray = field(default_factory=lambda: np.zeros(3))
    # Of what is seen, on the ground.
    beside: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Of the light and its size.
    height: float = 1.0
    camera: tuple[float, float, float] = (0.0, 1.0, 1.2)

    @property
    def light(self) -> np.ndarray:
        """The light's corners about the scene's middle, (4, 3)."""
        corner = np.array([1.0, 1.0, -0.2])
        edges = np.array([[0, 0, 0], [0.4, 0, 0], [0.4, 0, 0.4], [0, 0, 0.4]])
        return self.height * (corner + edges)

    def scene(self, folder: Path, extra: str = ""):
        def vector(values: np.ndarray) -> str:
            return repr([float(value) for value in values])

        def quad(kind: str, middle: np.ndarray, corners: np.ndarray, more: str) -> str:
            a, b, _, d = self.scale * (corners + middle) @ self.turn.T
            edges = f"edge1 = {vector(b - a)}\nedge2 = {vector(d - a)}\n"
            return f"[[{kind}]]\ncorner = {vector(a + self.place)}\n{edges}{more}\n"

        middle, grey = np.array(self.beside), 'material = "grey"'
        position, target = (self.scale * (np.array(p) + middle) @ self.turn.T + self.place
                            for p in (self.camera, (0, 0, 0)))  # fmt: skip
        ground = self.reach * np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
        text = [
            f"[camera]\nposition = {vector(position)}\ntarget = {vector(target)}\n",
            f"up = {vector(self.turn @ [0, 1, 0])}\nvertical_fov = 40\n",
            "[materials.grey]\nalbedo = 0.5\n",
            quad("quads", np.zeros(3), ground, grey),
            quad("lights", middle, self.light, "radiance = 20"),
        ]
        for axis in range(3):
            for side in range(2):
                first, second = (k for k in range(3) if k != axis)
                corners = np.repeat(BOX[side][None], 4, axis=0)
                corners[:, first] = BOX[[0, 1, 1, 0], first]
                corners[:, second] = BOX[[0, 0, 1, 1], second]
                text.append(quad("quads", middle, corners, grey))
        path = folder / "scene.toml"
        path.write_text("".join(text) + extra, encoding="utf-8")
        return load_scene(path)

    def ground_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Which pixels see the ground, and where, about the scene's middle."""
        camera = Camera(np.array(self.camera), np.zeros(3), 40.0)
        directions = camera_directions(camera, *SIZE)
        # Away from the box's outline, where rounding decides.
        through = passes_box(camera.position, 1e3 * directions, 1e-4)
        seen = (directions[:, 1] < -1e-3) & ~through
        distance = camera.position[1] / -directions[seen, 1]
        return np.flatnonzero(seen), camera.position + distance[:, None] * directions[seen]


def passes_box(start: np.ndarray, segment: np.ndarray, slack: float = 0.0) -> np.ndarray:
    """Whether start + t * segment, 0 < t < 1, is inside the box grown by `slack` (slabs)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = np.sort(
            [(BOX[0] - slack - start) / segment, (BOX[1] + slack - start) / segment], axis=0
        )
    first, last = np.nanmax(bounds[0], axis=-1), np.nanmin(bounds[1], axis=-1)
    return (first < last) & (last > 1e-9) & (first < 1)


WORLDS = {
    "as it is": World(),
    "ground of 20 km": World(1e4),
    "tilted ground of 20 km": World(1e4, TURN),
    "almost level ground": World(1e4, rotation_matrix(1e-4, [1, 2, 3])[:3, :3]),
    "beside the middle of the ground": World(1e4, TURN, beside=(5e3, 0, -3e3)),
    "ground to the horizon": World(1e7, TURN),
    "map coordinates": World(place=MAP),
    "tilted, 20 km, map coordinates": World(1e4, TURN, place=MAP, beside=(5e3, 0, -3e3)),
    "tiny": World(scale=1e-4, turn=TURN),
    "tiny on 20 km": World(1e8, TURN, 1e-4),
    "tiny at 50": World(scale=1e-4, place=np.array([50.0, 40, 1])),
    "huge": World(scale=1e8, turn=TURN),
    "light at 1e5": World(height=1e5),
    "light at 1e5, tilted, 20 km, map": World(1e4, TURN, place=MAP, height=1e5),
    "grazing": World(1e4, TURN, camera=(0.0, 1e-2, 1.2)),
}


def expected(world: World) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of the ground, their radiance if lit wholly, and the part of the light they see."""
    pixels, points = world.ground_points()
    grid = (np.arange(16) + 0.5) / 16
    corner, edge1, edge2 = (
        world.light[0],
        world.light[1] - world.light[0],
        world.light[3] - world.light[0],
    )
    ends = corner + grid[:, None, None] * edge1 + grid[None, :, None] * edge2
    part = np.array([
        1 - np.mean([passes_box(point, ends.reshape(-1, 3) - point, s) for s in (-1e-3, 1e-3)])
        for point in points
    ])  # fmt: skip
    lit = [polygon_irradiance(world.light, point, np.array([0.0, 1, 0])) for point in points]
    return pixels, 20 * 0.5 / np.pi * np.array(lit), part


@pytest.mark.parametrize("visibility", ["auto", "embree"])
@pytest.mark.parametrize("name", WORLDS)
def test_shadows_are_where_they_belong(device, tmp_path, name, visibility):
    world = WORLDS[name]
    scene = world.scene(tmp_path)
    assert scene.warnings == ()
    pixels, lit, part = expected(world)
    image = render(scene, "direct", "mc", spp=256, size=SIZE, visibility=visibility, device=device)
    found = image.pixels.reshape(-1, 3)[pixels, 0]
    whole, none = part == 1, part == 0
    assert whole.sum() > 300 and (none.sum() > 4 or world.camera[1] < 0.1)
    np.testing.assert_allclose(found[whole], lit[whole], rtol=2e-3)
    np.testing.assert_array_equal(found[none], 0)
    # Partly: no more than the light's grid and its samples are coarse.
    np.testing.assert_allclose(found / lit, part, atol=0.12)
    # What is reported is about the camera, so it does not depend on the place either.
    ground = world.ground_points()[1]
    depth = np.linalg.norm(ground - np.array(world.camera), axis=1)
    np.testing.assert_allclose(image.layers["depth"].ravel()[pixels], depth * world.scale, rtol=1e-4)
    normal = world.turn @ [0, 1, 0]
    normals = image.layers["N"].reshape(-1, 3)[pixels]
    np.testing.assert_allclose(normals, np.broadcast_to(normal, normals.shape), atol=1e-4)


@pytest.mark.parametrize("name", WORLDS)
def test_an_open_ground_sees_all_of_the_sky_and_paths_find_the_same(device, tmp_path, name):
    world = WORLDS[name]
    scene = world.scene(tmp_path)
    pixels, lit, part = expected(world)
    # Farther off the box than the radius nothing is in the way: no ray hits the ground it leaves.
    occlusion = AmbientOcclusion(0.2 * world.scale)
    image = render(scene, occlusion, "mc", spp=64, size=SIZE, device=device)
    points = world.ground_points()[1]
    away = np.linalg.norm(np.maximum(np.maximum(BOX[0] - points, points - BOX[1]), 0), axis=1) > 0.25
    assert away.sum() > 100
    np.testing.assert_allclose(image.pixels.reshape(-1, 3)[pixels[away], 0], 1, rtol=0.02)
    # One bounce brings little here, off the box; shadow rays behind it are traced and tested alike.
    for visibility in ("auto", "embree"):
        image = render(
            scene, GlobalIllumination(3), "mc", spp=64, size=SIZE, visibility=visibility, device=device
        )
        found = image.pixels.reshape(-1, 3)[pixels, 0]
        clear = away & (part == 1)
        np.testing.assert_allclose(found[clear].mean(), lit[clear].mean(), rtol=0.02)


@pytest.mark.parametrize("place", [0 * MAP, MAP])
@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e6])
@pytest.mark.parametrize("turn", [np.eye(3), TURN])
def test_no_light_leaks_into_a_closed_room(device, tmp_path, place, scale, turn):
    """Walls that emit: every path brings the same, unless a ray slips out or hits what it leaves."""
    if scale < 1 and place.any():
        # Of a millimetre's tenth at 4e6, double precision itself has but four digits.
        place = place / 1e4
    corners = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)]) * 2.0 - 1
    faces = [(0, 2, 6, 4), (1, 3, 7, 5), (0, 1, 5, 4), (2, 3, 7, 6), (0, 1, 3, 2), (4, 5, 7, 6)]
    world = scale * corners @ turn.T + place
    eye, aim = (scale * turn @ np.array(p) + place for p in ([0.1, 0.2, 0.4], [-0.3, -0.4, -0.6]))
    text = f"[camera]\nposition = {eye.tolist()}\ntarget = {aim.tolist()}\nvertical_fov = 60\n"
    # Of an image, so that paths alone find it.
    write_image(tmp_path / "white.exr", np.ones((1, 1, 3), np.float32), "half")
    text += '[materials.glow]\nalbedo = 0.5\nemission = { file = "white.exr" }\n'
    for face in faces:
        corner, after, _, before = world[list(face)]
        edges = f"edge1 = {(after - corner).tolist()}\nedge2 = {(before - corner).tolist()}"
        text += f'[[quads]]\ncorner = {corner.tolist()}\n{edges}\nmaterial = "glow"\n'
    path = tmp_path / "room.toml"
    path.write_text(text, encoding="utf-8")
    image = render(load_scene(path), GlobalIllumination(3), "mc", spp=16, size=(24, 24), device=device)
    np.testing.assert_allclose(image.pixels, 1.75, rtol=1e-5)


@pytest.mark.parametrize("name", ["cornell_box", "interior", "knot", "occluders", "plane_light"])
def test_shipped_scenes_stay_where_they_are(scenes, name):
    scene = load_scene(scenes / f"{name}.toml")
    assert not scene.origin.any() and scene.warnings == ()


def test_the_origin_is_near_the_viewer_and_steady():
    ground = quad_mesh(np.array([-1e4, 0, -1e4]), np.array([0, 0, 2e4]), np.array([2e4, 0, 0]))
    corners = ground.vertices[ground.triangles]

    def origin(position, of=corners):
        return scene_origin(of, Camera(np.array(position, float), np.zeros(3), 40.0))

    assert not origin([0, 1, 1.2]).any()
    for beside in ([5003, 1.5, -3000], [5003.2, 1.5, -3000.3]):
        assert np.abs(origin(beside) - beside).max() <= LARGEST_RATIO * 1.5 / 4
    np.testing.assert_array_equal(origin([5003, 1.5, -3000]), origin([5003.2, 1.5, -3000.3]))
    # From outside: not the camera, but what of the scene is nearest to it.
    far = origin([1e4 + 3.0, 5e5, 0], corners + np.array([1e7, 0, 0]))
    assert np.abs(far - [9990000, 0, 0]).max() < 2e5
    # On the surface itself, and in a place where it is but thin.
    assert np.abs(origin([5000, 0, -3000]) - [5000, 0, -3000]).max() < 1e-3
    thin = np.concatenate([corners, np.full((1, 3, 3), 7.0), [[[1, 2, 3], [2, 4, 6], [3, 6, 9]]]])
    assert np.isfinite(origin([5000, 1, -3000], thin)).all()


def boundary(triangles: np.ndarray) -> np.ndarray:
    """Edges that only one of the triangles (n, 3, 3) has, by positions, (edges, 2, 3)."""
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2, 3)
    swap = [tuple(a) > tuple(b) for a, b in ends]
    ends[swap] = ends[swap][:, ::-1]
    unique, count = np.unique(ends.reshape(-1, 6), axis=0, return_counts=True)
    assert count.max() <= 2
    return unique[count == 1].reshape(-1, 2, 3)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("eye", [[0.3, 1, 1.2], [5000, 2, 4990], [0, 0, 0], [-3000, 10, 9999]])
def test_huge_triangles_are_cut_without_gaps(eye, shared):
    mesh = quad_mesh(np.array([-1e4, 0, -1e4]), np.array([0, 0, 2e4]), np.array([2e4, 0, 0]))
    normals = np.array([[0, 1, 0], [0.6, 0.8, 0], [0, 0.8, 0.6], [0, 1, 0]])
    mesh = replace(mesh, normals=normals)
    if not shared:
        own = mesh.triangles.ravel()
        mesh = replace(flat_mesh(mesh.vertices[own], np.arange(6).reshape(2, 3)), normals=normals[own])
    cut = cut_huge(mesh, Camera(np.array(eye, float), np.zeros(3), 40.0))
    corners = cut.vertices[cut.triangles]
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    twice_area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (twice_area[:, 1] > 0).all() and np.isclose(twice_area[:, 1].sum(), 8e8, rtol=1e-12)
    # Right-angled as they were, or no narrower than half of that.
    assert (twice_area[:, 1] >= 0.24 * lengths.max(axis=1) ** 2).all()
    near = np.clip(np.array(eye, float), corners.min(axis=1), corners.max(axis=1))
    distance = np.maximum(np.linalg.norm(near - eye, axis=1), 1e-5)
    inside = lengths.max(axis=1) <= 1.5 * LARGEST_RATIO * distance
    assert inside.mean() > 0.9 and 40 < len(corners) < 1000
    # No vertex lies on another triangle's edge: only the ground's rim has edges without a neighbour.
    rim = boundary(corners)
    assert (np.abs(rim).max(axis=2) == 1e4).all()
    # Normals are those that interpolation had there.
    at = cut.vertices[cut.triangles].reshape(-1, 3)
    ours = cut.normals[cut.triangles].reshape(-1, 3)
    b1, b2 = (at[:, 2] + 1e4) / 2e4, (at[:, 0] + 1e4) / 2e4
    lower = b1 >= b2
    first = (1 - b1)[:, None] * normals[0] + (b1 - b2)[:, None] * normals[1] + b2[:, None] * normals[2]
    second = (1 - b2)[:, None] * normals[0] + b1[:, None] * normals[2] + (b2 - b1)[:, None] * normals[3]
    np.testing.assert_allclose(ours, np.where(lower[:, None], first, second), atol=1e-9)


def test_what_is_not_huge_is_left_alone():
    camera = Camera(np.array([0, 0, 3.0]), np.zeros(3), 40.0)
    ball = sphere_mesh(np.zeros(3), 1.0, 3)
    assert cut_huge(ball, camera) is ball
    # But through a narrow lens the same distance is near.
    narrow = replace(camera, vertical_fov=0.05)
    wall = quad_mesh(np.array([-9, -9, 0.0]), np.array([18.0, 0, 0]), np.array([0, 18.0, 0]))
    assert cut_huge(wall, camera) is wall
    assert len(cut_huge(wall, narrow).triangles) > 10


def test_a_warning_where_single_precision_cannot_resolve_the_view(tmp_path):
    """A narrow view from afar over a ground that reaches below the camera."""
    far = 1e4 * np.array([0, 1.0, 1.2])
    world = World(1e6, TURN, camera=tuple(far))
    text = (world.scene(tmp_path).path).read_text().replace("vertical_fov = 40", "vertical_fov = 0.004")
    (tmp_path / "narrow.toml").write_text(text)
    with pytest.warns(UserWarning, match=r"narrow.toml: single precision cannot resolve the scene"):
        scene = load_scene(tmp_path / "narrow.toml")
    assert any("widen its field of view" in warning for warning in scene.warnings)
    # Where nothing is in view there is nothing to resolve.
    away = Camera(np.zeros(3), np.array([0, 0, 1.0]), 1e-3)
    assert unresolved_steps(np.array([[0, 0, -1e6]]), np.zeros(3), away) == 0
    assert unresolved_steps(np.array([[0, 0, 1e6]]), np.zeros(3), away) > 1
    # Double precision has its limits too.
    wide = replace(away, vertical_fov=40.0)
    assert unresolved_steps(np.array([[0, 0, 1.0]]), np.array([1e14, 0, 0]), wide) > 1


def test_coarse_coordinates_are_known_by_their_steps():
    ball = sphere_mesh(np.zeros(3), 1.0, 2)
    rounded = replace(ball, vertices=(ball.vertices + 4e6).astype(np.float32).astype(float))
    assert is_coarse(rounded) and not is_coarse(ball)
    assert not is_coarse(replace(ball, vertices=ball.vertices + 4e6))
    assert not is_coarse(replace(ball, vertices=(ball.vertices + 40).astype(np.float32).astype(float)))


def test_offsets_of_paths_are_those_of_points(one_device, tmp_path):
    scene = WORLDS["tilted, 20 km, map coordinates"].scene(tmp_path)
    tracer = Tracer(scene, 1)
    points = find_points(one_device, scene, tracer, *SIZE)
    position, offset = points.rows("position").T, points.rows("offset")[0]
    towards = -np.ascontiguousarray(points.rows("outgoing").T)
    start = np.broadcast_to(scene.camera.position.astype(np.float32), towards.shape)
    records, defines = triangle_records(scene)
    hit = tracer.closest(np.ascontiguousarray(start), towards).triangle
    spread = np.abs(records[hit, defines["TRIANGLE_OFFSET"]])
    by_record = spread + RELATIVE_OFFSET * np.abs(position).max(axis=1)
    np.testing.assert_allclose(by_record, offset, rtol=1e-3)
    # Far less than the box's height.
    assert offset.min() > 0 and offset.max() < 1e-3


def corner_about(cube: GridCube, origin: np.ndarray) -> np.ndarray:
    """What kernels are told of the cube's lower corner."""
    told = cube.about(origin)
    return np.array([told[f"lower_{axis}"] for axis in "xyz"])


def test_networks_know_the_world_and_not_the_scenes_origin(one_device, tmp_path):
    """A network that was trained in one view is of use in another, whose origin is another."""
    world = World(1e4, TURN, place=MAP)
    scene = world.scene(tmp_path)
    file = tmp_path / "network.npz"
    options = {"size": (16, 16), "spp": 8, "device": one_device}
    render(scene, "direct", "ncv", save_network=file, train_spp=4, **options)
    here = render(scene, "direct", "ncv", network=file, **options).layers["G"]
    step = 64.0
    elsewhere = replace(
        scene,
        vertices=(scene.vertices + np.float32(step)),
        lights=tuple(replace(one, corner=one.corner + np.float32(step)) for one in scene.lights),
        camera=moved(scene.camera, np.full(3, -step)),
        origin=scene.origin - step,
    )
    there = render(elsewhere, "direct", "ncv", network=file, **options).layers["G"]
    assert here.any() and np.mean(np.abs(there - here)) < 1e-3 * np.mean(np.abs(here))
    cube = GridCube.around(scene.world_bounds)
    np.testing.assert_allclose(corner_about(cube, scene.origin), cube.lower - scene.origin)


def test_a_networks_grid_lies_around_what_is_seen(one_device, scenes, tmp_path):
    """On a ground to the horizon all that the camera sees would share one cell."""
    world = World(1e4, TURN, place=MAP)
    scene = world.scene(tmp_path)
    points = find_points(one_device, scene, Tracer(scene, 1), *SIZE)
    cube = GridCube.of_points(points, scene.world_bounds)
    assert 1 < cube.side < 10
    assert np.abs(np.array(cube.lower) + cube.side / 2 - MAP).max() < 3
    position = points.rows("position")[:, : points.active]
    inside = (position - corner_about(cube, points.origin)[:, None]) / cube.side
    assert np.mean(((inside >= 0) & (inside <= 1)).all(axis=0)) > 0.8
    # Scenes that are seen for a good part have the grid around them all.
    room = load_scene(scenes / "interior.toml")
    points = find_points(one_device, room, Tracer(room, 1), *SIZE)
    assert GridCube.of_points(points, room.world_bounds) == GridCube.around(room.world_bounds)
    nothing = replace(points, active=0)
    assert GridCube.of_points(nothing, room.world_bounds) == GridCube.around(room.world_bounds)
