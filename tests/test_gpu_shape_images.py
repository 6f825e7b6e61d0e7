"""Whole images in the shape of a GPU (32 work-items a group, none a vector) against a CPU's.

Each is compared with independent samples whose rays embree traces, in the shape of a CPU: the variance
of these is known, and they share neither kernels' shape, points, rays nor a network with what is
tested. A Z-test of the image's mean sees a bias that pixels share, one of every pixel what is wrong at
one group of points, and errors have the deviation that the image says.
"""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from scipy import stats

import ncv_cl as ncv
from ncv_cl.integrands import AmbientOcclusion, DirectLight, GlobalIllumination, Integrand
from ncv_cl.output.image import Image
from ncv_cl.rendering import prepare
from ncv_cl.sampling.tuning import MEMBERS

# More triangles than kernels test one by one, several lights, and surfaces matte and glossy.
SCENE = "interior"
INTEGRANDS: dict[str, Integrand] = {
    "direct": DirectLight(),
    "ao": AmbientOcclusion(radius=1.0),
    "gi": GlobalIllumination(3),
}
METHODS: dict[str, dict[str, float]] = {"mc": {}, "ncv": {"train_spp": 4}}
RAYS = ("embree", "device")
CASES = [
    *itertools.product(("direct", "ao"), METHODS, ("points", "lines"), RAYS),
    # Direct light apart by lines, and paths that points share; or neither.
    *itertools.product(("gi",), METHODS, ("auto", "points"), RAYS),
]
SIZE, SPP, REFERENCE_SPP = (32, 32), 64, {"direct": 4096, "ao": 4096, "gi": 1024}
# A bias of so much of the image's mean is noticed.
NOTICED = {"direct": 0.01, "ao": 0.01, "gi": 0.04}
# All Z-tests of images and of callables together fail by chance once in a thousand.
FALSE_ALARMS = 1e-3 / (len(CASES) + 2)


@pytest.fixture(scope="module")
def reference(one_device, scenes):
    @functools.cache
    def render_reference(integrand: str) -> Image:
        return ncv.render(
            scenes / f"{SCENE}.toml", INTEGRANDS[integrand], "mc", sampler="independent", seed=999,
            visibility="embree", spp=REFERENCE_SPP[integrand], size=SIZE, device=one_device,
        )  # fmt: skip

    return render_reference


def threshold(values: int) -> float:
    """The Z that `values` values exceed with a probability of FALSE_ALARMS."""
    return float(stats.norm.isf(FALSE_ALARMS / values / 2))


def image_score(image: Image, truth: Image, factor: float = 1.0) -> float:
    """Largest Z of the channels' means, of the image times a factor.

    Points of a group share paths: up to so many times the variance that independent ones would have.
    """
    shared = MEMBERS if "direct" in image.layers else 1
    variance = shared * image.variance.sum(axis=(0, 1), dtype=float)
    variance += truth.variance.sum(axis=(0, 1), dtype=float)
    difference = (factor * image.pixels.astype(float) - truth.pixels).sum(axis=(0, 1))
    return float((np.abs(difference) / np.sqrt(variance)).max())


@pytest.mark.parametrize(("integrand", "method", "visibility", "rays"), CASES)
def test_images_are_a_cpus(
    gpu_shape, scenes, reference, monkeypatch, integrand, method, visibility, rays
):
    # Without lists of occluders all shadow rays are traced by whom `rays` names.
    if visibility == "points":
        monkeypatch.setattr(prepare, "shafts_pay", lambda scene: False)
    image = ncv.render(
        scenes / f"{SCENE}.toml", INTEGRANDS[integrand], method, visibility=visibility, rays=rays,
        spp=SPP, size=SIZE, seed=7, device=gpu_shape, **METHODS[method],
    )  # fmt: skip
    truth = reference(integrand)
    assert (image.stats["seconds"]["trace"] > 0) == (rays == "embree")
    assert (image.stats["rays_traced"] > 0) == (visibility != "lines")
    assert ("direct" in image.layers) == (visibility == "auto")
    # Z of the means, which a small bias of all pixels would fail.
    assert image_score(image, truth) < threshold(3)
    for factor in (1 - NOTICED[integrand], 1 + NOTICED[integrand]):
        assert image_score(image, truth, factor) > threshold(3)
    # Z of each value, by the larger of two variances: few Sobol points may have missed all rare events.
    # After so little training a few pixels are farther off than normal ones; 32 are a group's points.
    more = truth.stats["samples_per_point"] / image.stats["samples_per_point"]
    variance = np.maximum(image.variance, more * truth.variance.astype(float)) + truth.variance
    errors = image.pixels.astype(float) - truth.pixels
    far = (np.abs(errors) > threshold(1) * np.sqrt(variance)) & (variance > 0)
    assert far.any(axis=-1).sum() <= 5
    # Calibration, within what tests/test_calibration.py allows images so small.
    known = image.variance > 0
    own = (image.variance.astype(float) + truth.variance)[known]
    assert abs(np.sqrt(np.mean(errors[known] ** 2 / own)) - 1) < 0.25


@pytest.mark.parametrize("method", METHODS)
def test_a_callable_has_its_integrals(gpu_shape, method):
    """Discs, whose areas are known."""
    radii = np.linspace(0.1, 0.5, 256)
    options = {"features": radii[:, None], "spp": SPP, "device": gpu_shape, **METHODS[method]}
    found = [
        ncv.estimate(
            lambda u, v, point: np.hypot(u - 0.5, v - 0.5) < radii[point],
            len(radii), method=method, seed=seed, **options,
        )
        for seed in range(3)
    ]  # fmt: skip
    areas = np.pi * radii**2
    errors = np.array([one.mean[:, 0] for one in found]) - areas
    variance = np.array([one.variance[:, 0] for one in found])
    deviation = np.sqrt(variance.sum())
    assert abs(errors.sum()) < threshold(1) * deviation
    # A bias of two percent would be noticed, either way.
    assert 0.02 * len(found) * areas.sum() - abs(errors.sum()) > threshold(1) * deviation
    assert abs(np.sqrt((errors**2).mean() / variance.mean()) - 1) < 0.25
