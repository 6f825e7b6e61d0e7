"""Visibility "auto" in ambient occlusion: the rule, what it counts, and that pictures stay right."""

from __future__ import annotations

import functools
import itertools
import math

import numpy as np
import pytest
from reference import camera_at, mesh_scene, quad, sampling
from scipy import stats
from test_determinism import assert_same_bits
from test_slices import FLOOR, soup
from test_unbiased import Sampled, image_scores, pixel_scores

from ncv_cl.integrands import AmbientOcclusion
from ncv_cl.integrands.ao import MAPPINGS
from ncv_cl.opencl.device import open_device
from ncv_cl.points.sampler import SAMPLERS
from ncv_cl.rendering.render import render
from ncv_cl.visibility import tuning
from ncv_cl.visibility.slices import COUNTED_SLICES, SliceCost, Slices, boxes_pay, slices_for

OPTIONS = {"method": "mc", "size": (24, 20)}


def comb():
    """A floor under more bars than a slice has room for."""
    bars = [quad([-6, 0, z], [0, 0, 0.03], [12, 0, 0]) for z in np.arange(-4, 4, 0.1)]
    return mesh_scene(np.concatenate([FLOOR, *bars]), camera_at([0, -0.2, 3], [0, -1, 0], 40))


@pytest.mark.parametrize("leaves", [0.5, 3, 13, 40])
@pytest.mark.parametrize("rays", [1, 7, 16, 100, 1000, 1 << 20])
def test_slices_take_no_more_time_than_the_rays(leaves, rays):
    cost = SliceCost(leaves, 0.0)
    for sampler in SAMPLERS:
        assert slices_for(rays, cost, sampler) * cost.rays <= rays
    number = slices_for(rays, cost, "sobol")
    # Equidistant, and not far from what the time buys.
    assert number & (number - 1) == 0
    assert number == 0 or 2 * number * cost.rays > rays
    assert (number > 0) == (rays >= cost.rays * 2 ** math.ceil(math.log2(max(8, cost.rays))))


def test_slices_that_are_refused_or_dear_are_left():
    for rays in (256, 1 << 12, 1 << 16):
        few, many = (slices_for(rays, SliceCost(10, share), "sobol") for share in (1e-5, 0.5))
        assert few == slices_for(rays, SliceCost(10, 0), "sobol") > 0 == many
    # The more slices, the less error, and the more tells what a ray at random adds.
    lost = [slices_for(1 << k, SliceCost(10, 1e-3), "sobol") > 0 for k in range(8, 30)]
    assert lost[0] and not lost[-1] and lost == sorted(lost, reverse=True)
    cheap, dear = SliceCost(2, 0), SliceCost(12, 0)
    assert slices_for(100, cheap, "independent") > 0 == slices_for(1 << 20, dear, "independent")


def test_boxes_are_not_built_for_few_samples():
    assert boxes_pay(32, 1000, tuning.FEWEST_SLICES) and not boxes_pay(32, 1000, 4)
    least = math.ceil(tuning.FEWEST_SLICES * tuning.LEAST_RAYS_OF_MANY)
    many = tuning.MANY_TRIANGLES
    assert boxes_pay(many, 10000, least - 1) and boxes_pay(many + 1, 10000, least)
    assert not boxes_pay(many + 1, 10000, least - 1)
    # What is not looked into would have been left.
    for sampler in SAMPLERS:
        cost = SliceCost(
            (tuning.LEAST_RAYS_OF_MANY - tuning.RAYS_A_SLICE) / tuning.RAYS_A_LEAF + 0.01, 0
        )
        assert slices_for(least - 1, cost, sampler) == 0
    assert boxes_pay(1000, tuning.SAMPLES_A_TRIANGLE, 1000)
    assert not boxes_pay(1001, tuning.SAMPLES_A_TRIANGLE, 1000)


def test_what_slices_cost_is_counted_alike_everywhere(one_device):
    scene, found = soup(600), []
    for width in (1, 4, 16):
        shaped = open_device(one_device.cl_device, one_device.index, width, 1)
        points, _, _ = sampling(shaped, scene, AmbientOcclusion(), (12, 10), 1)
        found.append(Slices(shaped, scene).cost(points, math.inf))
    for other in found[1:]:
        assert other.leaves == pytest.approx(found[0].leaves, rel=1e-3)
        assert other.refused == pytest.approx(found[0].refused, abs=1e-3)
    points, _, _ = sampling(one_device, scene, AmbientOcclusion(), (12, 10), 1)
    near = Slices(one_device, scene).cost(points, 0.3)
    assert 1 < near.leaves < 0.5 * found[0].leaves
    again = Slices(one_device, scene).cost(points, 0.3)
    assert again == near


def test_refused_slices_are_those_of_a_draw(device):
    scene, spp = comb(), 64
    points, source, _ = sampling(device, scene, AmbientOcclusion(), (12, 10), spp, sliced=True)
    source.draw(range(points.active), range(spp), 0)
    share = source.rays.off_lines / (spp * points.active)
    cost = Slices(device, scene).cost(points, math.inf)
    assert share > 0.05
    # Each of them is refused or not, and so is each of the draw's, at the same points.
    assert abs(cost.refused - share) < 5 * math.sqrt(
        share * (1 / COUNTED_SLICES + 1 / (spp * points.active))
    )


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_auto_takes_as_many_slices_as_it_says(one_device, scenes, sampler):
    scene = scenes / "cornell_box.toml"
    options = {**OPTIONS, "sampler": sampler, "device": one_device}
    found = render(scene, "ao", spp=100, **options)
    number, cost = found.stats["slices"]["a_point"], found.stats["slices"]["rays_each"]
    assert 8 <= number <= 100 / cost and found.stats["rays_traced"] == 0
    assert_same_bits(found, render(scene, "ao", spp=number, visibility="lines", **options))


@pytest.mark.parametrize("case", ["few samples", "refused", "network"])
def test_auto_keeps_rays_where_slices_do_not_pay(one_device, scenes, case):
    scene, spp, options = scenes / "cornell_box.toml", 64, {**OPTIONS, "device": one_device}
    if case == "few samples":
        spp = 4
    elif case == "refused":
        scene, spp = comb(), 256
    else:
        options |= {"method": "ncv", "train_spp": 4}
    found = render(scene, "ao", spp=spp, **options)
    if case == "refused":
        assert found.stats["slices"]["a_point"] == 0 and found.stats["slices"]["refused"] > 0.05
    else:
        assert "slices" not in found.stats
    assert found.stats["rays_traced"] > 0
    assert_same_bits(found, render(scene, "ao", spp=spp, visibility="points", **options))


CASES = list(itertools.product(MAPPINGS, (math.inf, 1.2), SAMPLERS))


@functools.cache
def judged(device, mapping: str, radius: float) -> Sampled:
    """By embree's rays, independent of each other."""
    image = render(
        soup(12, 0.8), AmbientOcclusion(radius, mapping), spp=8192, sampler="independent",
        visibility="embree", device=device, **OPTIONS,
    )  # fmt: skip
    return Sampled(image.pixels[None].astype(float), image.variance[None].astype(float), 8192)


@pytest.mark.slow
@pytest.mark.parametrize(("mapping", "radius", "sampler"), CASES)
def test_auto_agrees_with_rays(one_device, mapping, radius, sampler):
    images = [
        render(
            soup(12, 0.8), AmbientOcclusion(radius, mapping), spp=48, sampler=sampler, seed=seed,
            device=one_device, **OPTIONS,
        )
        for seed in range(8)
    ]  # fmt: skip
    for image in images:
        assert image.stats["slices"]["a_point"] > 0 == image.stats["rays_traced"]
    pixels = np.array([image.pixels for image in images], np.float64)
    variance = np.array([image.variance for image in images], np.float64)
    found = Sampled(pixels, variance, images[0].stats["samples_per_point"])
    truth = judged(one_device, mapping, radius)
    assert 0.3 < truth.pixels.mean() < 0.95
    for values in (pixel_scores(found, truth), image_scores(found, truth)):
        limit = stats.norm.isf(1e-3 / len(CASES) / values.size / 2)
        assert np.abs(values).max() < limit
