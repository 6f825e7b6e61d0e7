"""Paths that points share: what is grouped, no expectation that changes, and variance that falls."""

from __future__ import annotations

import numpy as np
import pytest
from reference import camera_at, grey, light_at, mesh_scene, quad, sampling, tangent_frame, unit
from test_gi import glowing, room
from test_guide import NONSENSE, nonsense
from test_warp import random_probabilities

from ncv_cl import GlobalIllumination, load_scene, render
from ncv_cl.estimation.allocate import Allocation
from ncv_cl.estimation.calibrate import points_done_twice
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.groups import Groups, group_points
from ncv_cl.points.sampler import Stream
from ncv_cl.sampling import tuning
from ncv_cl.sampling.share import SHARED
from ncv_cl.sampling.warp import TableWarp, pack_records

MEMBERS = 4
COLOURED = grey((0.3, 0.6, 0.9))
POLISHED = grey((0.3, 0.6, 0.9), 0.3, 0.4)


@pytest.fixture(autouse=True)
def small_groups(monkeypatch):
    monkeypatch.setattr(tuning, "MEMBERS", MEMBERS)
    monkeypatch.setattr(tuning, "GROUP_WINDOW", 2)


def uneven(kind):
    """A room whose floor has a lobe, or whose normals are between those of triangles far from flat."""
    scene = room(COLOURED)
    triangles = scene.vertices[scene.triangles].astype(float)[:8]
    normals, material = None, np.arange(8) < 2
    if kind == "smooth":
        flat = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        normals = np.random.default_rng(3).normal(size=(8, 3, 3)) + 2 * unit(flat)[:, None]
        normals, material = unit(normals), None
    lights = tuple(scene.lights)
    return mesh_scene(triangles, scene.camera, lights, (COLOURED, POLISHED), normals, material)


def draws(device, scene, integrand, samples, grouped, seed, probability=None, guide=None):
    """Means of samples' values and of their weights, each with its variances: (4, points).

    The fourth row is what is estimated of a constant one.
    """
    points, source, _ = sampling(device, scene, integrand, (4, 3), samples, "independent", seed)
    assert points.active == 12
    if guide is not None:
        source.use_guide(guide)
    density = None
    if probability is not None:
        density = TableWarp(HostArray.of(device, pack_records(probability)))
    groups = Groups(np.arange(12, dtype=np.uint32))
    if grouped:
        # Without the fixture, too: bench/device_checks.py calls this on GPUs.
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(tuning, "MOST_OWN", 1.0)
            groups = source.groups("table", 1)
    order = HostArray.of(device, groups.order)
    sums = np.zeros((2, 4, points.active))
    for part, run in source.parts(range(12), range(samples), None, groups.grouped):
        shared = {"grouped": True} if part.start < groups.grouped else {}
        batch = source.draw(part, run, Stream.RESIDUAL, order, density, **shared)
        shape = (len(part), batch.entries, batch.stride)
        value = batch.value.read().ravel()[: 3 * np.prod(shape)].reshape(3, *shape)
        weight = np.ones(shape)
        if batch.weight is not None:
            weight = batch.weight.read()[: np.prod(shape)].reshape(shape).astype(float)
        both = np.concatenate([value.astype(float) * weight, weight[None]])[..., : batch.samples]
        each = both.mean(axis=2)
        which = groups.order[part.start : part.stop]
        sums[0][:, which] += each.sum(axis=2)
        sums[1][:, which] += (each**2).sum(axis=2)
    mean = sums[0] / samples
    return mean, (sums[1] / samples - mean**2) / samples


def assert_equal_means(first, second):
    """By each point's own deviation, and by those of all: points of a group are not independent."""
    (once, variance), (again, others) = first, second
    assert (np.abs(once - again) < 5.5 * np.sqrt(variance + others) + 1e-6).all()
    together = np.sqrt(np.sum(variance + others, axis=1) * MEMBERS)
    assert (np.abs(np.sum(once - again, axis=1)) < 4 * together + 1e-5).all()


@pytest.fixture(autouse=True)
def share_anywhere(monkeypatch):
    """Paths are shared whether that pays or not."""
    monkeypatch.setattr(tuning, "MOST_OWN", 1.0)


CASES = {
    "matte": lambda: room(COLOURED),
    "polished": lambda: room(POLISHED),
    "glowing": lambda: room(glowing(0.5, 0.3)),
    "uneven": lambda: uneven("polished"),
    "smooth": lambda: uneven("smooth"),
}


@pytest.mark.parametrize(
    "kind, depth",
    [("matte", 3), ("polished", None), ("glowing", 3), ("uneven", None), ("smooth", None)],
)
def test_sharing_changes_no_expectation(device, kind, depth):
    scene, samples = CASES[kind](), 3000
    integrand = GlobalIllumination(depth, direct=False)
    alone = draws(device, scene, integrand, samples, False, 1)
    shared = draws(device, scene, integrand, samples, True, 2)
    assert_equal_means(alone, shared)
    # What a direction counts for is spread over the members.
    assert shared[1][3].mean() > 0


def test_neither_do_densities_and_guides(device):
    scene, samples = uneven("polished"), 3000
    integrand = GlobalIllumination(direct=False)
    alone = draws(device, scene, integrand, samples, False, 1)
    probability = random_probabilities(12, 4).reshape(12, -1)
    guide = nonsense(**NONSENSE["anything"])
    assert_equal_means(alone, draws(device, scene, integrand, samples, True, 2, probability, guide))


def test_sharing_lowers_variance(one_device, scenes, monkeypatch):
    scene, found = load_scene(scenes / "cornell_box.toml"), []
    for members in (1, MEMBERS):
        monkeypatch.setattr(tuning, "MEMBERS", members)
        both = [
            render(scene, "gi", "mc", spp=32, size=(24, 24), seed=seed, device=one_device).pixels
            for seed in (1, 2)
        ]
        found.append(np.mean((both[0] - both[1]) ** 2))
    assert found[1] < 0.6 * found[0]


def test_places_lie_where_their_coordinates_say(device):
    """(u, v) of what another member found: the direction from here to the place that it found."""
    points, source, _ = sampling(
        device, room(COLOURED), GlobalIllumination(direct=False), (4, 3), 64, "sobol"
    )
    groups = source.groups("none", 1)
    batch = source.draw(
        range(12), range(64), Stream.RESIDUAL, HostArray.of(device, groups.order), grouped=True
    )
    shape = (3, MEMBERS, MEMBERS, batch.stride)
    u, v, weight = (
        getattr(batch, name).read()[: np.prod(shape)].reshape(shape).astype(float)
        for name in ("u", "v", "weight")
    )
    places = 12 * batch.stride
    hits = source._entries.hits.read()[: SHARED.size * places].reshape(SHARED.size, 3, MEMBERS, -1)
    position = hits[SHARED["position"]].astype(float)
    found = 0
    for group in range(3):
        for k in range(MEMBERS):
            point = groups.order[group * MEMBERS + k]
            normal, origin = (
                points.rows(name)[:, point].astype(float) for name in ("normal", "position")
            )
            origin = origin + points.rows("offset")[0, point] * points.rows("geometric_normal")[:, point]
            tangent, bitangent = tangent_frame(normal)
            to = position[:, group] - origin[:, None, None]
            to /= np.linalg.norm(to, axis=0)
            x, y = (np.einsum("a,aij->ij", axis, to) for axis in (tangent, bitangent))
            a, b = 2 * u[group, k] - 1, 2 * v[group, k] - 1
            wide = np.abs(a) > np.abs(b)
            radius, other = np.where(wide, a, b), np.where(wide, b, a)
            turn = 0.125 * other / radius
            angle = 2 * np.pi * np.where(wide, turn, 0.25 - turn)
            counts = weight[group, k] > 0
            counts[k] = False
            found += counts.sum()
            np.testing.assert_allclose((radius * np.cos(angle))[counts], x[counts], atol=2e-5)
            np.testing.assert_allclose((radius * np.sin(angle))[counts], y[counts], atol=2e-5)
    assert found > 300


def test_groups_are_of_points_that_lie_and_face_alike(device):
    scene = mesh_scene(
        np.concatenate(
            [quad([-2, -1, -2], [0, 0, 4], [4, 0, 0]), quad([-2, -1, -2], [4, 0, 0], [0, 3, 0])]
        ),
        camera_at([0, 1, 3], [0, -0.6, -1], 60),
        (light_at([-1, 3, -1], [2, 0, 0], [0, 0, 2]),),
    )
    points, _, _ = sampling(device, scene, GlobalIllumination(direct=False), (24, 24), 16)
    groups = group_points(points, 8, 4)
    assert np.array_equal(np.sort(groups.order), np.arange(points.active))
    assert points.active - 8 < groups.grouped <= points.active
    members = groups.order[: groups.grouped].reshape(-1, 8)
    normal, position = (points.rows(name)[:, members] for name in ("normal", "position"))
    # Only a group at the border of both surfaces has points of both.
    mixed = (np.ptp(normal, axis=2) > 0.5).any(axis=0)
    assert mixed.sum() <= 4
    everywhere = np.ptp(points.rows("position"), axis=1).max()
    assert np.median(np.ptp(position, axis=2).max(axis=0)) < 0.4 * everywhere
    # Neighbours of the image are rarely together.
    cells = points.cell[members].astype(int)
    steps = np.abs(cells[:, :, None] - cells[:, None])
    assert np.mean(np.any((steps == 1).reshape(len(members), -1), axis=1)) < 0.5


def test_points_that_are_averaged_are_in_different_groups(device):
    scene, size = room(COLOURED), (16, 16)
    points, _, _ = sampling(device, scene, GlobalIllumination(direct=False), size, 16)
    with points.surface.mapped(update=True) as surface:
        # Each position six times.
        surface[:, : points.active] = surface[:, np.arange(points.active) // 6 * 6]
    groups = group_points(points, 8, 4)
    position = points.rows("position")[:, groups.order[: groups.grouped]].reshape(3, -1, 8)
    assert groups.grouped > 0.8 * points.active
    for group in range(position.shape[1]):
        assert len(np.unique(position[:, group], axis=1).T) == 8
    # One position alone makes no groups.
    with points.surface.mapped(update=True) as surface:
        surface[:] = surface[:, :1]
    assert group_points(points, 8, 4).grouped == 0


def test_groups_are_done_twice_as_wholes():
    groups = Groups(np.random.default_rng(1).permutation(5003).astype(np.uint32), 5000, 8)
    allocation = Allocation.of_groups(groups, 16)
    twice = points_done_twice(5003, 7, allocation)
    again = allocation.restricted(twice, 5003)
    assert 200 < len(twice) < 320 and again.grouped % 8 == 0
    assert len(np.unique(twice)) == len(twice)
    wholes = {tuple(one) for one in groups.order[:5000].reshape(-1, 8)}
    assert all(tuple(one) in wholes for one in again.chosen[: again.grouped].reshape(-1, 8))


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_variances_of_images_of_shared_paths_hold(one_device, scenes, method):
    """The errors are those that the image says, and the image is that of paths of each point's own."""
    scene = load_scene(scenes / "cornell_box.toml")
    options = {"size": (16, 16), "spp": 64, "device": one_device}
    images = [render(scene, "gi", method, seed=seed, **options) for seed in range(6)]
    pixels = np.array([image.pixels for image in images], float)
    measured = pixels.var(axis=0, ddof=1).mean()
    said = np.mean([image.variance.mean() for image in images])
    assert 0.6 < said / measured < 1.6
