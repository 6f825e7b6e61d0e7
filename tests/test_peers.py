"""The integrands and methods of bench_planar.py: exact integrals, unbiased estimates, integrals of g."""

from __future__ import annotations

import itertools
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

sys.path.append(str(Path(__file__).parent.parent / "bench"))

from peers.automatic import AutomaticIntegration, antiderivative, mixed_derivative
from peers.flow import NormalizingFlow
from peers.interface import Samples
from peers.ours import Ours, PublicEstimate
from peers.plain import Plain
from peers.polynomial import PolynomialRegression, legendre_terms
from peers.sampling import SAMPLERS, blocks
from planar import FAMILIES, INTEGRANDS
from planar_measure import bias_score, integral_error

FITTED = {
    "polynomial": PolynomialRegression,
    "automatic": lambda: AutomaticIntegration(steps=100),
    "flow": lambda: NormalizingFlow(steps=40),
}
METHODS = {
    "plain": lambda device: Plain(),
    **{name: lambda device, make=make: make() for name, make in FITTED.items()},
    "ours": lambda device: Ours(device, density=False),
    "ours-density": lambda device: Ours(device, density=True),
    "estimate": PublicEstimate,
}
FAMILY_POINTS = 32


def usable(method):
    """The method, or a skip that says what it lacks."""
    if method.missing:
        pytest.skip(f"{method.name} needs {', '.join(method.missing)}")
    return method


@pytest.mark.parametrize("integrand", INTEGRANDS.values(), ids=INTEGRANDS)
def test_the_integral_is_what_quadrature_finds(integrand):
    def along_u(v):
        breaks = sorted(x for x in integrand.breaks(v) if 0 < x < 1)
        edges = itertools.pairwise([0.0, *breaks, 1.0])
        # Between breaks f is smooth; Gauss points do not touch the ends.
        return sum(
            quad(lambda u: float(integrand.function(u, v)), a, b, epsabs=1e-11)[0]
            for a, b in edges
            if b > a
        )

    # Whole bands of v between which the inner integral is smooth.
    edges = itertools.pairwise([0.0, 0.15, 0.2, 0.4, 0.5, 0.6, 0.8, 0.85, 1.0])
    found = sum(quad(along_u, a, b, epsabs=1e-9, limit=100)[0] for a, b in edges)
    assert found == pytest.approx(integrand.integral, abs=1e-7)


@pytest.mark.parametrize("name", FAMILIES)
def test_a_family_has_its_integrals(name):
    family = FAMILIES[name](FAMILY_POINTS)
    side = (np.arange(1024) + 0.5) / 1024
    for index in range(0, FAMILY_POINTS, 4):
        mean = family.function(side[:, None], side[None, :], np.array(index)).mean()
        assert mean == pytest.approx(family.integrals[index], abs=2e-4)


@pytest.mark.filterwarnings("ignore:The balance properties")
@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("samples", [12, 64])
def test_every_sampler_is_uniform_in_each_point(sampler, samples):
    (_, u, v), *others = blocks(sampler, 4096, samples, 1)
    assert not others and u.shape == v.shape == (4096, samples) and u.max() < 1
    for values in (u[:, 3], v[:, 3], u[:, -1]):
        # One point of every row; of a stratum only its own range.
        if sampler != "stratified":
            assert stats.kstest(values, "uniform").pvalue > 1e-6
    assert abs(np.corrcoef(u[:, 0], u[:, 1])[0, 1]) < 5 / 64 or sampler == "sobol"
    assert u.mean() == pytest.approx(0.5, abs=5 / math.sqrt(12 * u.size))


def test_stratified_points_are_one_in_each_cell():
    ((_, u, v),) = blocks("stratified", 3, 12, 0)
    cells = np.floor(u * 3).astype(int) * 4 + np.floor(v * 4).astype(int)
    np.testing.assert_array_equal(np.sort(cells, axis=1), np.tile(np.arange(12), (3, 1)))


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_samples_beyond_one_block_are_parts_of_the_same_points(sampler, monkeypatch):
    whole = [np.concatenate([v for _, _, v in blocks(sampler, 1, 256, 5)], axis=1)]
    monkeypatch.setattr("peers.sampling.BLOCK", 64)
    parts = list(blocks(sampler, 1, 256, 5))
    assert len(parts) == 4
    found = np.concatenate([v for _, _, v in parts], axis=1)
    if sampler == "sobol":
        np.testing.assert_array_equal(found, whole[0])
    else:
        assert found.shape == whole[0].shape
    strata = np.bincount(np.floor(found[0] * 16).astype(int), minlength=16)
    assert sampler == "independent" or (strata == 16).all()


@pytest.mark.parametrize(
    ("name", "sampler"),
    [(name, sampler) for name in METHODS for sampler in ("independent", "sobol")]
    + [("plain", "stratified")],
)
def test_a_method_is_unbiased_for_one_integral(one_device, name, sampler):
    method = usable(METHODS[name](one_device))
    family = INTEGRANDS["disk"].family()
    training = Samples.draw(family.function, family.features, 512, seed=1)
    estimates = method.fit(training, 1).estimate(family.function, 64, 128, 2, sampler)
    assert estimates.shape == (128, 1)
    score, limit = bias_score(estimates - family.integrals)
    assert abs(score) < limit


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("family_name", FAMILIES)
def test_a_method_is_unbiased_for_a_family(one_device, name, family_name):
    method = usable(METHODS[name](one_device))
    family = FAMILIES[family_name](FAMILY_POINTS)
    training = Samples.draw(family.function, family.features, 16, seed=1)
    estimates = method.fit(training, 1).estimate(family.function, 16, 8, 2, "independent")
    assert estimates.shape == (8, FAMILY_POINTS)
    score, limit = bias_score(estimates - family.integrals)
    assert abs(score) < limit


@pytest.mark.parametrize("name", FITTED)
@pytest.mark.parametrize("features", ["alone", "family"])
def test_the_integral_of_g_is_what_quadrature_finds(name, features):
    method = usable(FITTED[name]())
    family = FAMILIES["bumps"](8) if features == "family" else INTEGRANDS["mixture"].family()
    training = Samples.draw(family.function, family.features, 4096 // family.points, seed=3)
    variate = method.fit(training, 3)
    assert integral_error(variate, float(np.sqrt(np.mean(training.values**2))), 256) < 1e-3
    # And g has learned something: of a g without shape the integral would be easy.
    index = np.repeat(np.arange(family.points), training.samples)
    g = variate.evaluate(training.u.ravel(), training.v.ravel(), index)
    assert np.var(training.values.ravel() - g) < 0.9 * np.var(training.values)


def test_the_score_sees_a_bias():
    errors = np.random.default_rng(0).normal(size=512)
    assert abs(bias_score(errors)[0]) < bias_score(errors)[1]
    assert abs(bias_score(errors + 0.3)[0]) > bias_score(errors + 0.3)[1]


def test_the_grad_network_is_autograd_twice():
    torch = pytest.importorskip("torch")
    network = antiderivative(3, 0).double()
    inputs = torch.rand(50, 5, dtype=torch.float64, requires_grad=True)
    (first,) = torch.autograd.grad(network_value(network, inputs).sum(), inputs, create_graph=True)
    (second,) = torch.autograd.grad(first[:, 0].sum(), inputs)
    found = mixed_derivative(network, inputs).detach().numpy()
    np.testing.assert_allclose(found, second[:, 1].numpy(), rtol=1e-9, atol=1e-9)


def network_value(network, inputs):
    """Written anew with PyTorch's own swish."""
    import torch

    first, second, last = network
    silu = torch.nn.functional.silu
    return last(silu(second(silu(first(inputs)))))[:, 0]


def test_legendre_terms_are_orthonormal():
    nodes, weights = np.polynomial.legendre.leggauss(12)
    x, w = 0.5 * (nodes + 1), 0.5 * weights
    u, v = (axis.ravel() for axis in np.meshgrid(x, x))
    terms = legendre_terms(u, v, 6)
    gram = terms.T @ (terms * np.outer(w, w).ravel()[:, None])
    np.testing.assert_allclose(gram, np.eye(28), atol=1e-12)


def test_a_polynomial_is_found_again_and_then_has_no_error():
    def function(u, v, index):
        return 1 + u.astype(np.float64) ** 2 * v

    training = Samples.draw(function, np.empty((1, 0)), 400, seed=0)
    estimates = PolynomialRegression().fit(training, 0).estimate(function, 8, 4, 1, "independent")
    np.testing.assert_allclose(estimates, 1 + 1 / 6, atol=1e-4)


@pytest.mark.parametrize("name", ["ours", "ours-density"])
def test_ours_lowers_the_variance(one_device, name):
    family = INTEGRANDS["disk"].family()
    training = Samples.draw(family.function, family.features, 2048, seed=0)
    accumulator = METHODS[name](one_device).fit(training, 0)
    errors = accumulator.estimate(family.function, 64, 256, 1, "independent") - family.integrals
    assert np.mean(errors**2) < 0.4 * family.spread()[0] / 64
