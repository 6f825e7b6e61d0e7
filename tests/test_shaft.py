"""Shadow rays that few triangles can block: the same answers as embree's, and the same pixels."""

from __future__ import annotations

import numpy as np
import pytest
import reference
from fitting import fitting
from reference import (
    camera_at,
    grey,
    intersect,
    light_at,
    light_samples,
    mesh_scene,
    quad,
    sampling,
    shadowed_values,
)

from ncv_cl.integrands import DirectLight
from ncv_cl.rendering.render import render
from ncv_cl.sampling.samples import NO_RAY, SEEN
from ncv_cl.visibility import shaft
from ncv_cl.visibility.shaft import COMMON_LISTS
from ncv_cl.visibility.tuning import MOST_LIGHTS

CAMERA = camera_at([0, 3, 7], [0, 0, 0], 45)
FLOOR = quad([-4, -1, -4], [0, 0, 8], [8, 0, 0])
LIGHTS = (light_at([-1, 4, -1], [2, 0, 0], [0, 0, 2], (5, 4, 3)),)
SEVERAL_LIGHTS = (
    *LIGHTS,
    light_at([3, 0, -1], [0, 2, 0], [0, 0, 2], 4, two_sided=True),
)


def soup(count, lights=LIGHTS, size=0.4, seed=3):
    """A floor under a light, and triangles of any shape and place between."""
    generator = np.random.default_rng(seed)
    centres = generator.uniform([-2.5, -0.8, -2.5], [2.5, 3.5, 2.5], (count, 1, 3))
    triangles = centres + size * generator.normal(size=(count, 3, 3))
    return mesh_scene(np.concatenate([FLOOR, triangles]), CAMERA, lights, (grey(),))


def both(device, scene, samples=64, size=(12, 10)):
    """Values with their visibility by embree and by occluders, slots, and the source with these."""
    found = []
    for with_occluders in (False, True):
        points, source, _ = sampling(
            device, scene, DirectLight(), size, samples, with_occluders=with_occluders
        )
        batch = source.draw(range(points.active), range(samples), 0)
        slot = batch.slot.read()[: points.active * batch.stride].reshape(points.active, -1)
        found.append(shadowed_values(batch, 3))
    return *found, slot[:, :samples], source


@pytest.mark.parametrize("count", [0, 3, 40, 600, 9000])
@pytest.mark.parametrize("lights", [LIGHTS, SEVERAL_LIGHTS], ids=["one-light", "two-lights"])
def test_occluders_answer_as_embree_does(device, count, lights):
    by_embree, by_occluders, slot, source = both(device, soup(count, lights, 3 / (2 + count**0.5)))
    lit = by_embree > 0
    # Where a ray grazes an edge rounding decides.
    assert np.mean(lit != (by_occluders > 0)) < 2e-5
    same = lit == (by_occluders > 0)
    np.testing.assert_array_equal(by_embree[same], by_occluders[same])
    rays = source.rays
    assert rays.on_device > 0 and (count < 9000 or rays.traced > 0)
    assert rays.on_device + rays.traced + rays.skipped == slot.size
    assert np.count_nonzero(slot < SEEN) == rays.traced


def test_lists_hold_all_that_blocks(device, monkeypatch):
    """Against every triangle, by brute force in double precision."""
    monkeypatch.setattr(reference, "MOST_OCCLUDERS", 15)
    scene = soup(300)
    points, source, _ = sampling(device, scene, DirectLight(), (8, 6), 32, with_occluders=True)
    lists = [source.occluders.list_of(point) for point in range(points.active)]
    known = np.array([one is not None for one in lists])
    assert source.occluders.unknown == np.count_nonzero(~known)
    counts = source.occluders.counts(np.arange(points.active))
    assert [len(one) for one in lists if one is not None] == counts[known].tolist()
    corners = source.occluders.hierarchy.triangles.read().transpose(0, 2, 1).reshape(-1, 3, 3)
    batch = source.draw(range(points.active), range(32), 0)
    uv = np.stack([a.read()[: points.active * 32].reshape(-1, 32) for a in (batch.u, batch.v)])
    light = scene.lights[0]
    position = points.rows("position").T.astype(float)
    ends = np.array(
        [light_samples(light, at, *uv[:, k].astype(float))[0] for k, at in enumerate(position)]
    )
    origin = (points.rows("position") + points.rows("offset") * points.rows("geometric_normal")).T
    size = 3 * points.active * 32
    lit = batch.value.read().ravel()[:size].reshape(3, -1, 32).max(axis=0) > 0
    known = np.flatnonzero(known)
    assert 0 < len(known) < points.active
    blocked = 0
    for point in known:
        own = corners[lists[point]]
        start = np.repeat(origin[point][None].astype(float), 32, 0)
        triangle, _, _, distance = intersect(scene, start, ends[point] - start)
        for index in np.unique(triangle[lit[point] & (triangle >= 0) & (distance < 0.9999)]):
            wanted = scene.vertices[scene.triangles[index]]
            if scene.triangle_light[index] < 0:
                blocked += 1
                assert (own == wanted).all(axis=(1, 2)).any()
    assert blocked > 10


def test_occluders_are_counted_where_they_are_too_many(device):
    found = [
        sampling(device, soup(300), DirectLight(), (12, 10), 64, with_occluders=True, most=most)[
            1
        ].occluders
        for most in (1023, 15)
    ]
    lists, short = found
    assert lists.unknown == 0 < short.unknown
    # Of so few points each is counted.
    every = np.arange(lists.starts.shape[0])
    assert lists.mean_count == short.mean_count == lists.counts(every).mean() > 15


def test_no_ray_slips_through_a_common_edge(device):
    """A sheet of triangles whose edges and corners the rays of a grid of points run along."""
    grid = np.linspace(-1, 1, 5)
    sheet = [quad([x, 1, z], [0, 0, 0.5], [0.5, 0, 0]) for x in grid[:-1] for z in grid[:-1]]
    light = light_at([-0.25, 3, -0.25], [0.5, 0, 0], [0, 0, 0.5])
    camera = camera_at([0, 0.5, 0], [0, -1, 0], 20, up=(0, 0, 1))
    scene = mesh_scene(np.concatenate([FLOOR, *sheet]), camera, (light,), (grey(),))
    _, values, slot, _ = both(device, scene, 256, (16, 16))
    assert not values.any() and (slot == NO_RAY).all()


def test_points_that_see_all_of_the_light_trace_nothing(device):
    _, values, slot, source = both(device, soup(0))
    assert (slot == SEEN).all() and (values > 0).all() and source.rays.traced == 0


@pytest.mark.parametrize("method", ["mc", "ncv"])
@pytest.mark.parametrize("name", ["cornell_box", "occluders"])
def test_pixels_do_not_depend_on_who_answers(device, scenes, name, method):
    images = [
        render(
            scenes / f"{name}.toml", "direct", spp=16, size=(24, 24), visibility=visibility,
            device=device, **fitting(method, train_spp=4),
        )
        for visibility in ("points", "embree")
    ]  # fmt: skip
    np.testing.assert_array_equal(images[0].pixels, images[1].pixels)
    first, second = (image.stats for image in images)
    assert first["rays_on_device"] > 0 and second["rays_on_device"] == 0
    assert first["rays_on_device"] + first["rays_traced"] == second["rays_traced"]


@pytest.mark.parametrize("words", [2, 40, 300])
def test_lists_are_shorter_where_memory_is_short(device, monkeypatch, words):
    scene = soup(40)
    whole = both(device, scene)[1]
    monkeypatch.setattr(shaft, "MOST_LIST_WORDS", words)
    _, values, _, source = both(device, scene)
    np.testing.assert_array_equal(values, whole)
    lists = [source.occluders.list_of(point) for point in range(source.points.active)]
    lengths = np.array([len(one) for one in lists if one is not None])
    assert source.occluders.unknown == len(lists) - len(lengths) > 0
    used = COMMON_LISTS + (lengths[lengths > 0] + 1).sum()
    assert used <= words
    # The next longer ones would not have fitted.
    monkeypatch.undo()
    full = sampling(device, scene, DirectLight(), (12, 10), 64, with_occluders=True)[1].occluders
    longer = [len(full.list_of(point)) for point in range(len(lists)) if lists[point] is None]
    assert min(longer) > lengths.max(initial=0)
    assert used + (min(longer) + 1) * longer.count(min(longer)) > words


def test_shafts_are_looked_for_where_lights_are_few(one_device, scenes, tmp_path):
    text = (scenes / "interior.toml").read_text(encoding="utf-8")
    lamp = "[[lights]]\ncorner = [{}, 2.5, 0]\nedge1 = [0.1, 0, 0]\nedge2 = [0, 0, 0.1]\nradiance = 1\n"
    path = tmp_path / "lights.toml"
    for lamps in (MOST_LIGHTS, MOST_LIGHTS + 1):
        more = "".join(lamp.format(0.2 * k - 1) for k in range(lamps - 2))
        path.write_text(text + more, encoding="utf-8")
        options = {"spp": 8, "size": (16, 16), "device": one_device}
        image = render(path, "direct", "mc", visibility="points", **options)
        assert ("shafts" in image.stats["seconds"]) == (lamps == MOST_LIGHTS)
        if lamps > MOST_LIGHTS:
            with pytest.raises(
                ValueError, match="at most 8 parallelograms, triangles and discs that shine, there are 9"
            ):
                render(path, "direct", "mc", visibility="lines", **options)
        traced = render(path, "direct", "mc", visibility="embree", **options)
        np.testing.assert_array_equal(image.pixels, traced.pixels)
