"""A normalizing flow times a learned integral as control variate.

Müller, Rousselle, Keller and Novák, *Neural Control Variates*, ACM TOG 39(6), 2020. g = c(φ) p(u, v | φ)
where the density p of a flow integrates to one, so c is the integral. The flow is made of `zuko`'s
rational-quadratic spline transforms (Durkan et al. 2019). Each maps [-1, 1]² to itself, and what they
map to is uniform; so p is a density on the square, with no mass outside, and equals the determinant of
their Jacobian. Flow and integral are fitted by least squares to f: the residual's variance counts.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from .interface import ControlVariate, Method, Samples
from .schedule import evaluate, fit_module, unit_of

if TYPE_CHECKING:
    import torch

BINS = 16
TRANSFORMS = 2
HIDDEN = (32, 32)
# Least slope of a spline.
SLOPE = 1e-3
BATCH, STEPS, RATE = 1024, 1000, 1e-2
INTEGRAL_WIDTH = 32


def build_modules(features: int, seed: int) -> torch.nn.ModuleDict:
    """The flow's transform, and the network (without features: the number) that is its integral."""
    import torch
    from zuko.flows.autoregressive import MaskedAutoregressiveTransform
    from zuko.lazy import LazyComposedTransform
    from zuko.transforms import MonotonicRQSTransform

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        transforms = [
            MaskedAutoregressiveTransform(
                2,
                features,
                order=[k % 2, 1 - k % 2],
                univariate=partial(MonotonicRQSTransform, bound=1.0, slope=SLOPE),
                shapes=[(BINS,), (BINS,), (BINS - 1,)],
                hidden_features=HIDDEN,
            )
            for k in range(TRANSFORMS)
        ]
        integral = torch.nn.Sequential(
            torch.nn.Linear(max(features, 1), INTEGRAL_WIDTH),
            torch.nn.SiLU(),
            torch.nn.Linear(INTEGRAL_WIDTH, 1),
        )
    return torch.nn.ModuleDict({"flow": LazyComposedTransform(*transforms), "integral": integral})


def density(flow: torch.nn.Module, inputs: torch.Tensor) -> torch.Tensor:
    """p over the unit square, (n,), at inputs (n, 2 + k)."""
    context = inputs[:, 2:] if inputs.shape[1] > 2 else None
    return flow(context).call_and_ladj(2 * inputs[:, :2] - 1)[1].exp()


def integral_of(network: torch.nn.Module, features: torch.Tensor) -> torch.Tensor:
    """c, (n,), of features (n, k)."""
    import torch

    if not features.shape[1]:
        features = torch.zeros(len(features), 1, dtype=features.dtype)
    return network(features)[:, 0]


class FlowVariate(ControlVariate):
    """A trained flow and its integral.

    Parameters
    ----------
    modules : torch.nn.ModuleDict
        As `build_modules` makes it.
    features : ndarray
        float32 (points, k).
    unit : float
        What the integral is multiplied by.
    """

    def __init__(self, modules: torch.nn.ModuleDict, features: np.ndarray, unit: float) -> None:
        import torch

        self._modules = modules
        self._features = features
        with torch.no_grad():
            scale = integral_of(modules["integral"], torch.from_numpy(features))
        self.integral = unit * scale.numpy().astype(np.float64)

    def evaluate(self, u: np.ndarray, v: np.ndarray, index: np.ndarray) -> np.ndarray:
        def predict(inputs: torch.Tensor) -> torch.Tensor:
            return density(self._modules["flow"], inputs)

        return self.integral[index] * evaluate(predict, u, v, self._features, index)


class NormalizingFlow(Method):
    """Flow and integral are trained together."""

    name = "normalizing flow"
    source = "Müller et al. 2020, flow by zuko"
    modules = ("torch", "zuko")

    def __init__(self, steps: int = STEPS) -> None:
        self.steps = steps

    def fit(self, training: Samples, seed: int, seconds: float | None = None) -> FlowVariate:
        modules, unit = build_modules(training.features.shape[1], seed), unit_of(training)

        def predict(inputs: torch.Tensor) -> torch.Tensor:
            scale = integral_of(modules["integral"], inputs[:, 2:])
            return scale * density(modules["flow"], inputs)

        fit_module(modules, predict, training, unit, seed, self.steps, BATCH, RATE, seconds)
        return FlowVariate(modules, training.features, unit)
