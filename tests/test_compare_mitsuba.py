"""Means agree with an independent renderer's: the scene's conversion, and ours."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from reference import camera_at, grey, light_at, mesh_scene, quad

import ncv_cl as ncv

pytest.importorskip("mitsuba", reason="mitsuba is not installed")
sys.path.insert(0, str(Path(__file__).parent.parent / "bench"))
import compare_mitsuba
from mitsuba_scene import MitsubaScene

CASES = [case for case in compare_mitsuba.CASES if case[0] != "knot"]
# Batch means of six images have few degrees of freedom.
DEVIATIONS = 6.0


@pytest.fixture(scope="module")
def mitsuba():
    return compare_mitsuba.import_mitsuba()


def check(row):
    for difference, error in zip(row["difference"], row["standard_error"], strict=True):
        # Shadow rays start and end elsewhere by design: that is a bias of at most a thousandth.
        assert abs(difference) <= DEVIATIONS * error + 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "integrand"), CASES)
def test_means_agree(one_device, mitsuba, scene, integrand):
    row = compare_mitsuba.agreement(
        mitsuba, one_device, scene, integrand, True, size=(24, 24), batches=6, spp=16
    )
    if "skipped" in row:
        pytest.skip(row["skipped"])
    check(row)


@pytest.mark.parametrize("two_sided", [False, True])
def test_a_light_shines_from_its_sides_and_reflects_nothing(one_device, mitsuba, two_sided):
    # A skewed light between two walls; its front is towards the right wall, and the camera sees it.
    light = light_at([-0.1, -0.6, -0.5], [0.2, 1, 0], [0, 0.3, 1], (3, 2, 1), two_sided)
    walls = [quad([x, -2, -2], [0, 4, 0], [0, 0, 4]) for x in (-1, 1)]
    scene = mesh_scene(np.concatenate(walls), camera_at([0, 0.3, 4], [0, 0, 0], 50), (light,), (grey(),))
    theirs = MitsubaScene(mitsuba, scene)
    size, spp = (16, 12), 64
    other = np.stack([theirs.radiance(compare_mitsuba.DIRECT, size, 1, spp, s) for s in range(6)])
    ours = np.stack(
        [
            ncv.render(scene, "direct", "mc", spp=spp, size=size, seed=s, device=one_device).pixels
            for s in range(6)
        ]
    ).astype(np.float64)
    check(compare_mitsuba.compare(ours, other, spp))
    right = np.s_[:, :, size[0] // 2 + 4 :], np.s_[:, :, : size[0] // 2 - 4]
    lit = [stack[half].mean() > 0 for stack in (ours, other) for half in right]
    assert lit == [True, two_sided] * 2


def test_a_difference_of_means_is_seen():
    generator = np.random.default_rng(0)
    images = 1 + 0.01 * generator.normal(size=(2, 8, 6, 5, 3))
    same = compare_mitsuba.compare(*images, 1)
    other = compare_mitsuba.compare(images[0] * 1.02, images[1], 1)
    assert same["agrees"] and not other["agrees"]
    np.testing.assert_allclose(other["difference"], 0.02, atol=0.005)
