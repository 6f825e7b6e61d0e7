"""Automatic integration: a network is the antiderivative, its mixed derivative the control variate.

Lindell, Martel and Wetzstein, *AutoInt: Automatic Integration for Fast Neural Volume Rendering*, CVPR
2021; Li et al., *Neural Control Variates with Automatic Integration*, SIGGRAPH 2024.

N(u, v, φ) has two hidden layers of 32, as in the slides' comparison. g = ∂²N/∂u∂v, and its integral over
the square is N(1, 1) - N(1, 0) - N(0, 1) + N(0, 0). The derivative is propagated forwards beside the
value, layer by layer: the "grad network" of Lindell et al., written out. Autograd, twice, gives the same
numbers (`tests/test_peers.py`) but needs a graph to do so; gradients of the loss are autograd's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .interface import ControlVariate, Method, Samples
from .schedule import evaluate, fit_module, unit_of

if TYPE_CHECKING:
    import torch

WIDTH = 32
BATCH, STEPS, RATE = 1024, 3000, 1e-2
# Spread of the first layer's lines: larger sees finer detail.
FREQUENCY = 8.0


def antiderivative(features: int, seed: int) -> torch.nn.Sequential:
    """N: two hidden layers of swish."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    layers = [
        torch.nn.Linear(2 + features, WIDTH),
        torch.nn.Linear(WIDTH, WIDTH),
        torch.nn.Linear(WIDTH, 1),
    ]
    with torch.no_grad():
        for layer in layers:
            bound = (3 / layer.in_features) ** 0.5
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.zero_()
        first = layers[0]
        first.weight.mul_(FREQUENCY)
        through = torch.rand(first.weight.shape, generator=generator)
        first.bias.copy_(-(first.weight * through).sum(1))
    return torch.nn.Sequential(*layers)


def mixed_derivative(network: torch.nn.Sequential, inputs: torch.Tensor) -> torch.Tensor:
    """∂²N/∂u∂v, (n,), at inputs (n, 2 + k) whose first columns are u and v."""
    first, *others = network
    z = first(inputs)
    # Of each unit: value, derivatives by u and by v, and the mixed one.
    z_u, z_v, z_uv = first.weight[:, 0], first.weight[:, 1], None
    for layer in others:
        value, slope, curvature = _swish(z)
        a_u, a_v = slope * z_u, slope * z_v
        a_uv = curvature * z_u * z_v
        if z_uv is not None:
            a_uv = a_uv + slope * z_uv
        last = layer is others[-1]
        z = layer(value)
        if not last:
            z_u, z_v = a_u @ layer.weight.T, a_v @ layer.weight.T
        z_uv = a_uv @ layer.weight.T
    return z_uv[:, 0]


def _swish(z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """z times its sigmoid, and two derivatives."""
    s = z.sigmoid()
    d = s * (1 - s)
    return z * s, s + z * d, d * (2 + z * (1 - 2 * s))


def value(network: torch.nn.Sequential, inputs: torch.Tensor) -> torch.Tensor:
    """N itself, (n,)."""
    first, second, last = network
    return last(_swish(second(_swish(first(inputs))[0]))[0])[:, 0]


class AutomaticIntegral(ControlVariate):
    """A trained antiderivative.

    Parameters
    ----------
    network : torch.nn.Sequential
    features : ndarray
        float32 (points, k).
    unit : float
        What the network's derivative is multiplied by.
    """

    def __init__(self, network: torch.nn.Sequential, features: np.ndarray, unit: float) -> None:
        import torch

        self.network, self._unit = network, unit
        self._features = features
        double = antiderivative(features.shape[1], 0).double()
        double.load_state_dict(network.state_dict())
        with torch.no_grad():
            corner = [
                value(
                    double, torch.from_numpy(np.insert(features.astype(np.float64), [0, 0], uv, axis=1))
                )
                for uv in ((1, 1), (1, 0), (0, 1), (0, 0))
            ]
        self.integral = unit * (corner[0] - corner[1] - corner[2] + corner[3]).numpy()

    def evaluate(self, u: np.ndarray, v: np.ndarray, index: np.ndarray) -> np.ndarray:
        def predict(inputs: torch.Tensor) -> torch.Tensor:
            return mixed_derivative(self.network, inputs)

        return self._unit * evaluate(predict, u, v, self._features, index)


class AutomaticIntegration(Method):
    """The antiderivative is trained so that its mixed derivative fits f."""

    name = "automatic integration"
    source = "Lindell et al. 2021, Li et al. 2024"
    modules = ("torch",)

    def __init__(self, steps: int = STEPS) -> None:
        self.steps = steps

    def fit(self, training: Samples, seed: int, seconds: float | None = None) -> AutomaticIntegral:
        network, unit = antiderivative(training.features.shape[1], seed), unit_of(training)
        fit_module(
            network,
            lambda inputs: mixed_derivative(network, inputs),
            training,
            unit,
            seed,
            self.steps,
            BATCH,
            RATE,
            seconds,
        )
        return AutomaticIntegral(network, training.features, unit)
