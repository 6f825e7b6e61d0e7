"""Every integrand, method and sampler agrees with a high-sample Monte Carlo reference on every scene.

Images of several seeds are compared with the reference by Z-tests: each pixel by itself, and the mean
of all pixels, which sees a small bias that all pixels share. Thresholds are corrected (Bonferroni) for
the number of values, so that all tests of this file together fail by chance once in a thousand.

The variance of a pixel's mean is unknown under Sobol sampling, and a few samples may miss all rare
events. So a pixel is given the largest of three: that between the seeds, the renderer's own upper bound,
and the reference's variance at as many samples. Over the whole image the variance between seeds is
estimated well enough to be used alone: points are sampled independently, so it adds up.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest
from fitting import fitting
from scipy import stats

from ncv_cl import AmbientOcclusion, DirectLight, render
from ncv_cl.points.sampler import SAMPLERS

SCENES = ("cornell_box", "knot", "occluders", "plane_light")
INTEGRANDS = {
    "ao-height": AmbientOcclusion(mapping="height"),
    "ao-cosine": AmbientOcclusion(mapping="cosine"),
    "direct": DirectLight(),
}
# How samples are drawn and spent.
METHODS = {
    "mc": {"method": "mc"},
    "ncv": {"method": "ncv"},
    "mc-pilot": {"method": "mc", "allocation": "pilot"},
    "ncv-slides": {"method": "ncv", "preset": "slides"},
    "ncv-density": {"method": "ncv", "allocation": "uniform"},
    "ncv-subdivision": {"method": "ncv", "density": "subdivision"},
    "ncv-allocation": {"method": "ncv", "density": "none"},
    "ncv-relative": {"method": "ncv", "allocation": "relative"},
    "mc-rays": {"method": "mc", "visibility": "points", "rays": "device"},
    "ncv-rays": {"method": "ncv", "visibility": "points", "rays": "device"},
    "mc-lines": {"method": "mc", "visibility": "lines"},
    "ncv-lines": {"method": "ncv", "visibility": "lines"},
    "judge": {"method": "mc", "visibility": "embree"},
}
SIZE = (24, 24)
SEEDS = range(100, 108)
LINES = ("mc-lines", "ncv-lines")
SPP, TRAIN_SPP, REFERENCE_SPP = 48, 8, 8192
CASES = [
    *itertools.product(SCENES, INTEGRANDS, ("mc", "ncv"), SAMPLERS),
    *itertools.product(("occluders",), ("ao-height", "direct"), list(METHODS)[2:-3], SAMPLERS),
    *itertools.product(("cornell_box", "interior", "knot", "occluders"), ("direct",), LINES, SAMPLERS),
    *itertools.product(("knot", "occluders"), ("ao-height", "ao-cosine"), LINES, SAMPLERS),
]
FALSE_ALARMS = 1e-3 / len(CASES)
# Rounding of float32 arithmetic, for pixels without variance.
ROUNDING = 2e-6

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Sampled:
    """Images of one picture: float64 (seeds, height, width, 3), and the samples behind each."""

    pixels: np.ndarray
    variance: np.ndarray
    samples: int


def sample(device, scenes, scene, integrand, method, sampler, seeds=SEEDS, spp=SPP) -> Sampled:
    images = [
        render(
            scenes / f"{scene}.toml", INTEGRANDS[integrand], sampler=sampler, spp=spp, size=SIZE,
            seed=seed, device=device, **fitting(**{"train_spp": TRAIN_SPP, **METHODS[method]}),
        )
        for seed in seeds
    ]  # fmt: skip
    return Sampled(
        np.array([image.pixels for image in images], np.float64),
        np.array([image.variance for image in images], np.float64),
        images[0].stats["samples_per_point"],
    )


@pytest.fixture(scope="module")
def reference(one_device, scenes):
    """The reference of a scene and integrand, rendered once."""

    @functools.cache
    def render_reference(scene: str, integrand: str) -> Sampled:
        return sample(one_device, scenes, scene, integrand, "judge", "independent", [1], REFERENCE_SPP)

    return render_reference


def pixel_scores(found: Sampled, truth: Sampled) -> np.ndarray:
    """Z of each value, conservative."""
    seeds = len(found.pixels)
    variance = np.maximum.reduce(
        [
            found.pixels.var(axis=0, ddof=1) / seeds,
            found.variance.mean(axis=0) / seeds,
            truth.variance[0] * truth.samples / (found.samples * seeds),
        ]
    )
    return scores(found.pixels.mean(axis=0), variance, truth.pixels[0], truth.variance[0])


def image_scores(found: Sampled, truth: Sampled) -> np.ndarray:
    """Z of the image's mean, a channel each."""
    values = found.pixels[0, ..., 0].size
    between = found.pixels.var(axis=0, ddof=1).sum(axis=(0, 1)) / len(found.pixels) / values**2
    own = truth.variance[0].sum(axis=(0, 1)) / values**2
    return scores(found.pixels.mean(axis=(0, 1, 2)), between, truth.pixels[0].mean(axis=(0, 1)), own)


def scores(mean, variance, true_mean, true_variance) -> np.ndarray:
    deviation = np.sqrt(variance + true_variance + (ROUNDING * true_mean) ** 2)
    return np.abs(mean - true_mean) / np.maximum(deviation, np.finfo(np.float32).tiny)


def threshold(values: int) -> float:
    """The Z that `values` values exceed with a probability of FALSE_ALARMS / 2 in all."""
    return float(stats.norm.isf(FALSE_ALARMS / 2 / values / 2))


def agrees(found: Sampled, truth: Sampled) -> bool:
    pixels, whole = pixel_scores(found, truth), image_scores(found, truth)
    return bool(pixels.max() < threshold(pixels.size) and whole.max() < threshold(whole.size))


@pytest.mark.parametrize("scene, integrand, method, sampler", CASES)
def test_image_agrees_with_the_reference(
    one_device, scenes, reference, scene, integrand, method, sampler
):
    truth = reference(scene, integrand)
    found = sample(one_device, scenes, scene, integrand, method, sampler)
    pixels, whole = pixel_scores(found, truth), image_scores(found, truth)
    worst = np.unravel_index(pixels.argmax(), pixels.shape)
    assert agrees(found, truth), (
        f"worst pixel {worst}: Z {pixels.max():.2f} (threshold {threshold(pixels.size):.2f}), "
        f"image: Z {whole} (threshold {threshold(whole.size):.2f})"
    )
    assert truth.pixels.any() and not np.array_equal(found.pixels[0], found.pixels[1])


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("integrand", INTEGRANDS)
@pytest.mark.parametrize("method", ("mc", "ncv"))
def test_a_bias_of_one_percent_is_noticed(one_device, scenes, reference, scene, integrand, method):
    found = sample(one_device, scenes, scene, integrand, method, "sobol")
    for factor in (0.99, 1.01):
        assert not agrees(replace(found, pixels=factor * found.pixels), reference(scene, integrand))


def test_one_wrong_pixel_is_noticed(one_device, scenes, reference):
    truth = reference("cornell_box", "direct")
    found = sample(one_device, scenes, "cornell_box", "direct", "mc", "sobol")
    sampled = np.where(truth.variance[0] > 0, truth.pixels[0], 0)
    row, column, _ = np.unravel_index(sampled.argmax(), sampled.shape)
    wrong = found.pixels.copy()
    wrong[:, row, column] *= 2
    assert agrees(found, truth)
    assert not agrees(replace(found, pixels=wrong), truth)
