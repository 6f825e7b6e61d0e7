"""What renders say of their variance: errors over predicted deviations have a standard deviation of 1.

Sobol points leave errors of direct light at the edges of shadows only, and where these are is known from
the halves of each point's samples and of its neighbours'. In so small an image an edge has few
neighbours: the cases of `COARSE` hold to a quarter only.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest

from ncv_cl import render

SIZE = (48, 48)
SEEDS = range(10, 22)
POINTS = {"visibility": "points"}
CASES = {
    "cornell-direct-ncv": ("cornell_box", "direct", {"method": "ncv"}),
    "occluders-direct-ncv": ("occluders", "direct", {"method": "ncv"}),
    "occluders-direct-subdivision": ("occluders", "direct", {"method": "ncv", "density": "subdivision"}),
    "occluders-ao-ncv": ("occluders", "ao", {"method": "ncv"}),
    "occluders-gi-ncv": ("occluders", "gi", {"method": "ncv"}),
    "occluders-gi-mc": ("occluders", "gi", {"method": "mc"}),
    "occluders-ao-slides": ("occluders", "ao", {"method": "ncv", "preset": "slides", "train_spp": 8}),
    "occluders-ao-mc": ("occluders", "ao", {"method": "mc"}),
    "occluders-ao-independent": ("occluders", "ao", {"method": "mc", "sampler": "independent"}),
    "occluders-ao-lines": ("occluders", "ao", {"method": "mc", "visibility": "lines"}),
    "knot-ao-lines": ("knot", "ao", {"method": "mc", "visibility": "lines"}),
    "cornell-direct-mc": ("cornell_box", "direct", {"method": "mc"}),
    "occluders-direct-mc": ("occluders", "direct", {"method": "mc"}),
    "cornell-direct-pilot": ("cornell_box", "direct", {"method": "mc", "allocation": "pilot"}),
    "cornell-points-ncv": ("cornell_box", "direct", {"method": "ncv", **POINTS}),
    "cornell-points-pilot": ("cornell_box", "direct", {"method": "mc", "allocation": "pilot", **POINTS}),
    "occluders-points-mc": ("occluders", "direct", {"method": "mc", **POINTS}),
    "occluders-direct-uniform": (
        "occluders",
        "direct",
        {"method": "ncv", "density": "none", "allocation": "uniform"},
    ),
}
# Known to fail, at 1.24, 1.88 and 1.13 where measured: a few pixels in some renders are off by many
# deviations, as all samples near them have overlooked a shadow's edge.
TOO_SURE = [
    ("cornell-points-ncv", 16),
    ("cornell-points-pilot", 16),
    ("occluders-direct-subdivision", 64),
]
COARSE = {
    case
    for case in CASES
    if case.endswith(("direct-mc", "pilot", "direct-uniform", "points-mc", "gi-ncv"))
}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def reference(one_device, scenes):
    @functools.cache
    def render_reference(scene: str, integrand: str):
        # Errors are held against both variances, and paths' falls no faster than samples grow: with 1024
        # the reference has a sixteenth of the variance of an image of 64.
        spp = 1024 if integrand == "gi" else 4096
        return render(
            scenes / f"{scene}.toml", integrand, "ncv", spp=spp, size=SIZE, seed=999, device=one_device
        )

    return render_reference


@pytest.fixture(scope="module")
def measured(one_device, scenes, reference):
    """Squared errors and variances of several seeds, with the reference's variance: (seeds, ...)."""

    @functools.cache
    def measure(case: str, spp: int):
        scene, integrand, options = CASES[case]
        truth = reference(scene, integrand)
        images = [
            render(
                scenes / f"{scene}.toml",
                integrand,
                spp=spp,
                size=SIZE,
                seed=seed,
                device=one_device,
                **options,
            )
            for seed in SEEDS
        ]
        errors = np.array([image.pixels.astype(float) - truth.pixels for image in images])
        variances = np.array([image.variance.astype(float) for image in images])
        return errors**2, variances, truth.variance.astype(float)

    return measure


@pytest.mark.parametrize("spp", [16, 64])
@pytest.mark.parametrize("case", CASES)
def test_standardised_errors_have_unit_deviation(measured, case, spp, request):
    if (case, spp) in TOO_SURE:
        request.applymarker(pytest.mark.xfail(reason="a rare pixel's shadow edge is overlooked"))
    squares, variances, of_truth = measured(case, spp)
    known = variances > 0
    standardised = np.sqrt(np.mean(squares[known] / (variances + of_truth)[known]))
    assert abs(standardised - 1) < (0.25 if case in COARSE else 0.1)


@pytest.mark.parametrize("case, spp", TOO_SURE)
def test_the_median_render_of_those_has_unit_deviation(measured, case, spp):
    squares, variances, of_truth = measured(case, spp)
    standardised = np.median(
        [
            np.sqrt(np.mean(square[variance > 0] / (variance + of_truth)[variance > 0]))
            for square, variance in zip(squares, variances, strict=True)
        ]
    )
    assert abs(standardised - 1) < (0.25 if case in COARSE else 0.1)


@pytest.mark.parametrize("spp", [16, 64])
@pytest.mark.parametrize("case", CASES)
def test_the_mean_error_of_an_image_is_predicted(measured, case, spp):
    squares, variances, of_truth = measured(case, spp)
    tolerance = 0.3 if case in COARSE else 0.25
    assert variances.mean() == pytest.approx(squares.mean() - of_truth.mean(), rel=tolerance)
