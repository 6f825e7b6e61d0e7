"""Which points share paths: what sharing leaves of their noise, where that is known."""

from __future__ import annotations

import numpy as np
import pytest
from reference import camera_at, grey, light_at, mesh_scene, quad, sampling

from ncv_cl import GlobalIllumination
from ncv_cl.points.groups import group_points
from ncv_cl.points.points import find_points
from ncv_cl.points.trace import Tracer
from ncv_cl.sampling import tuning
from ncv_cl.sampling.own_noise import GROUPS_SEEN, OwnNoise
from ncv_cl.visibility.hierarchy import Hierarchy
from ncv_cl.visibility.trace import DeviceTracer

# Of the halls below, whose walls are farther than paths mostly go.
WIDE, HEIGHT = 200.0, 2.0
FLOOR = quad([-WIDE, 0, -WIDE], [0, 0, 2 * WIDE], [2 * WIDE, 0, 0])
CEILING = quad([-WIDE, HEIGHT, -WIDE], [2 * WIDE, 0, 0], [0, 0, 2 * WIDE])
# Reaches from floor to ceiling.
WALL = quad([0.5, 0, -WIDE], [0, 0, 2 * WIDE], [0, HEIGHT, 0])
SKYWARDS = camera_at([0, 1, 0], [0, -1, 0.1])


def part_of(device, places, *surfaces, material=None, on_device=False, lights=()):
    """What sharing leaves between the places (n, 3) of a floor, each a point of every group."""
    scene = mesh_scene(np.concatenate([FLOOR, *surfaces]), SKYWARDS, lights, (material or grey(),))
    tracer = Tracer(scene)
    points = find_points(device, scene, tracer, 32, 32)
    assert points.active == 1024
    members = len(places)
    with points.surface.mapped(update=True) as surface:
        surface[:] = surface[:, :1]
        for member, place in enumerate(places):
            surface[:3, member::members] = np.array(place)[:, None]
    groups = np.arange(GROUPS_SEEN * members).reshape(-1, members)
    rays = DeviceTracer(device, Hierarchy(device, scene)) if on_device else tracer
    return OwnNoise(scene, rays).part(points, groups)


def test_points_at_one_place_leave_each_other_their_share(device):
    assert part_of(device, 4 * [(0, 0, 0)], CEILING) == pytest.approx(1 / 4, rel=1e-4)


def test_points_that_see_different_places_share_nothing(device):
    assert part_of(device, [(0, 0, 0), (1, 0, 0)], CEILING, WALL) == 1


def test_where_no_surface_is_found_nothing_is_shared(device):
    assert part_of(device, [(0, 0, 0), (1, 0, 0)]) == 1
    lamp = light_at([-WIDE, HEIGHT, -WIDE], [2 * WIDE, 0, 0], [0, 0, 2 * WIDE])
    assert part_of(device, [(0, 0, 0), (1, 0, 0)], lights=(lamp,)) == 1


@pytest.mark.parametrize("distance", [0.5, 2.0, 8.0])
def test_the_part_is_that_of_densities_below_a_plane(one_device, distance):
    """Of a place at distances r, s from two points it is s^4 / (r^4 + s^4): cos / pi * cos / r^2."""
    # Midpoints of the unit square, mapped to directions that go as the cosine.
    u, turn = np.meshgrid(*2 * [(np.arange(1000) + 0.5) / 1000])
    across = HEIGHT * np.sqrt(u / (1 - u))
    x, z = across * np.cos(2 * np.pi * turn), across * np.sin(2 * np.pi * turn)
    r, s = (np.hypot(np.hypot(x - at, z), HEIGHT) for at in (0, distance))
    own = s**4 / (r**4 + s**4)
    part = part_of(one_device, [(0, 0, 0), (distance, 0, 0)], CEILING)
    assert abs(part - own.mean()) < 4 * own.std() / np.sqrt(2 * GROUPS_SEEN)


@pytest.mark.parametrize("roughness", [0.2, 0.4, 0.8])
def test_what_lobes_send_and_find_is_not_shared(one_device, roughness):
    """Their mean square: R^2 / (12 alpha^2), where that of matte parts is albedo^2."""
    material = grey(0.5, 0.2, roughness)
    lobes, matte = 0.2**2 / (12 * roughness**4), 0.5**2
    # Of the square, two sevenths are the points' own lobe's.
    left = 2 / 7 + 5 / 7 / 4
    part = part_of(one_device, 4 * [(0, 0, 0)], CEILING, material=material)
    assert part == pytest.approx((matte * left + lobes) / (matte + lobes), rel=1e-4)


def test_mean_square_of_a_lobe():
    """GGX's D, by itself: the integral of D^2 over half vectors is 1 / (3 pi alpha^2)."""
    alpha = 0.1
    theta = (np.arange(200_000) + 0.5) / 200_000 * np.pi / 2
    density = alpha**2 / (np.pi * (1 - (1 - alpha**2) * np.cos(theta) ** 2) ** 2)
    found = np.sum(density**2 * 2 * np.pi * np.sin(theta)) * np.pi / 2 / len(theta)
    assert found == pytest.approx(1 / (3 * np.pi * alpha**2), rel=0.03)


def test_it_is_the_same_where_a_device_traces(one_device):
    places = [(0, 0, 0), (1, 0, 0)]
    assert part_of(one_device, places, CEILING, on_device=True) == part_of(one_device, places, CEILING)


def test_blocks_share_where_little_is_left(one_device, monkeypatch):
    lamp = light_at([2, 1, 0], [1, 0, 0], [0, 0, 1])
    scene = mesh_scene(np.concatenate([FLOOR, CEILING]), SKYWARDS, (lamp,), (grey(),))
    points, source, _ = sampling(one_device, scene, GlobalIllumination(direct=False), (32, 32), 16)
    assert source.groups("none", 1).grouped > 0.9 * points.active
    monkeypatch.setattr(tuning, "MOST_OWN", 0.1)
    found = source.groups("none", 1)
    assert found.grouped == 0 and np.array_equal(found.order, np.arange(points.active))


def test_each_block_is_asked(one_device):
    scene = mesh_scene(np.concatenate([FLOOR, CEILING]), SKYWARDS, (), (grey(),))
    points = find_points(one_device, scene, Tracer(scene), 96, 96)
    asked = []

    def pays(_, groups):
        asked.append(groups)
        return len(asked) != 2

    found = group_points(points, 8, 8, 1, pays)
    assert [len(one) for one in asked] == [512, 512, 128]
    assert found.grouped == 8 * (512 + 128)
    assert np.array_equal(np.sort(found.order), np.arange(96 * 96))
    assert np.array_equal(found.order[found.grouped :], np.arange(4096, 8192))
