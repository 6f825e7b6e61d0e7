"""Exact integrals of ReLU networks over the unit square, from plain numpy arrays.

`Integrator` is the same for arrays that already lie on the device.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..opencl.choose import choose_device
from ..opencl.device import Device
from ..opencl.memory import HostArray
from .certificate import PRECISIONS, Statistics
from .integrator import Integrator, check_options

# Points that an error names.
NAMED_POINTS = 5


class IntegrationError(FloatingPointError):
    """Some points have no finite integral in the precision asked for.

    Attributes
    ----------
    points : int array
        Their indices.
    values : array (points, channels)
        G of all points, NaN or infinite at those.
    """

    def __init__(self, message: str, points: np.ndarray, values: np.ndarray) -> None:
        super().__init__(message)
        self.points = points
        self.values = values


def integrate(
    weights: Sequence[np.ndarray],
    biases: Sequence[np.ndarray],
    *,
    method: str = "decoupled",
    precision: str = "float32",
    activation: str = "relu",
    negative_slope: float = 0.01,
    device: Device | str | int | None = None,
    return_stats: bool = False,
    return_moments: bool = False,
    return_bound: bool = False,
) -> np.ndarray | tuple[Any, ...]:
    """Integrate ReLU networks g(u, v) over the unit square, exactly up to rounding.

    Parameters
    ----------
    weights : sequence of array
        weights[k] has shape (n_out, n_in), or (points, n_out, n_in). The first n_in is 2, for (u, v).
        0 to 4 hidden layers of 1 to 128 neurons, any number of outputs.
    biases : sequence of array
        biases[k] has shape (n_out,), or (points, n_out).
    method : {"decoupled", "full"}
        ``full`` cuts the square into all cells of the network; ``decoupled`` spares the last hidden
        layer's cells by closed forms. They agree up to rounding; ``decoupled`` is several times faster.
    precision : {"float32", "float64"}
        ``float64`` needs a device with double precision.
    activation : {"relu", "leaky_relu"}
    negative_slope : float
        Slope of leaky_relu below zero.
    device : Device, str or int, optional
        Where to compute; by default the device that the package chooses.
    return_stats, return_moments, return_bound : bool
        Also return `Statistics`; the integrals of the last hidden layer's neurons, (points, n); and a
        bound of |G - exact|, (points, channels).

    Returns
    -------
    G : array (points, channels)
        Of the precision's dtype. One row if no array has a points axis.
    moments : array, with `return_moments`
    bound : array, with `return_bound`
    statistics : Statistics, with `return_stats`

    Raises
    ------
    ValueError
        Shapes, sizes, NaN or infinity, unknown names; the message says what and where.
    IntegrationError
        A FloatingPointError: the result of some points is not finite in this precision. It names them
        and keeps the others' results.

    Notes
    -----
    Relative to Σ |w_j| ∫|activation(z_j)| + |b|, errors stay below 1e-6 (float32) and 1e-13 (float64).
    This is measured and not proven: ``bench_integrate.py --torture`` compares networks of 37 families
    that are made to break it with rational arithmetic. What `return_bound` returns is a bound to first
    order in rounding, some hundred times the errors of ordinary networks.

    Every point is certified: no line crosses another twice, areas add up to 1, each arranged neuron has
    the same integral over the faces as over the whole square, and sums do not cancel so much that
    rounding matters. A point that fails is done again by arrangements in double precision, then by
    cutting polygons, which takes some ten times as long. A device without double precision does these in
    single precision; sums that cancel are then only as exact as the bound says.

    Threads may call this at the same time; those that share a device wait for each other.

    Meister and Harada, "Geometric Integration for Neural Control Variates", Computer Graphics
    Forum 2025.
    """
    device = choose_device(device)
    slope = activation_slope(activation, negative_slope)
    check_options(method, precision, slope, device)
    weights, biases, points = plain_arrays(weights, biases, PRECISIONS[precision])
    widths = (weights[0].shape[-1], *(bias.shape[-1] for bias in biases))
    integrator = Integrator(
        device,
        widths,
        [array.ndim == 3 for array in weights],
        [array.ndim == 2 for array in biases],
        method=method,
        precision=precision,
        negative_slope=slope,
        write_moments=return_moments,
        write_bounds=return_bound,
    )
    out = HostArray(device, (points, widths[-1]), integrator.dtype)
    moments = HostArray(device, (points, widths[-2]), integrator.dtype) if return_moments else None
    bounds = HostArray(device, (points, widths[-1]), integrator.dtype) if return_bound else None
    statistics = integrator.run(
        [HostArray.of(device, array) for array in weights],
        [HostArray.of(device, array) for array in biases],
        out,
        moments=moments,
        bounds=bounds,
    )
    values = out.read()
    if statistics.uncertified:
        raise _not_finite(statistics.uncertified, values, precision)
    results: list[np.ndarray | Statistics] = [
        values,
        *(array.read() for array in (moments, bounds) if array is not None),
    ]
    if return_stats:
        results.append(statistics)
    return values if len(results) == 1 else tuple(results)


def activation_slope(activation: str, negative_slope: float) -> float:
    """The slope below zero of an activation by its name; ValueError for an unknown one."""
    if activation not in ("relu", "leaky_relu"):
        raise ValueError(f"activation must be 'relu' or 'leaky_relu', is {activation!r}")
    return float(negative_slope) if activation == "leaky_relu" else 0.0


def _not_finite(points: tuple[int, ...], values: np.ndarray, precision: str) -> IntegrationError:
    names = ", ".join(map(str, points[:NAMED_POINTS]))
    more = f" and {len(points) - NAMED_POINTS} more" if len(points) > NAMED_POINTS else ""
    advice = (
        "use precision='float64', or smaller weights"
        if precision == "float32"
        else "use smaller weights"
    )
    return IntegrationError(
        f"no finite result in {precision} at {'point' if len(points) == 1 else 'points'} {names}{more} "
        f"of {len(values)}: {advice}",
        np.array(points),
        values,
    )


def plain_arrays(
    weights: Sequence[np.ndarray], biases: Sequence[np.ndarray], dtype: np.dtype
) -> tuple[list[np.ndarray], list[np.ndarray], int]:
    """Check shapes and values of a network; returns arrays of `dtype` and the number of points."""
    for name, part in (("weights", weights), ("biases", biases)):
        if not isinstance(part, list | tuple):
            raise ValueError(f"{name} must be a list of arrays, one a layer, is {type(part).__name__}")
    if len(weights) != len(biases) or not weights:
        raise ValueError(
            f"need as many weights as biases, one of each a layer; got {len(weights)} and {len(biases)}"
        )
    points = None
    inputs = 2
    arrays: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        for name, array, core, target in (
            (f"weights[{k}]", weight, 2, arrays[0]),
            (f"biases[{k}]", bias, 1, arrays[1]),
        ):
            if np.ma.is_masked(array):
                raise ValueError(f"{name} has masked entries: fill them first")
            array = np.asarray(array)
            if array.dtype.kind not in "fiu":
                raise ValueError(f"{name} must hold real numbers, has dtype {array.dtype}")
            if array.ndim not in (core, core + 1):
                axes = "(n_out, n_in)" if core == 2 else "(n_out,)"
                raise ValueError(
                    f"{name} must be {axes} or have a leading points axis, is {array.shape}"
                )
            if array.ndim == core + 1:
                if points is not None and array.shape[0] != points:
                    raise ValueError(f"{name} has {array.shape[0]} points, another array has {points}")
                points = array.shape[0]
            with np.errstate(over="ignore"):
                converted = np.ascontiguousarray(array, dtype)
            if not np.isfinite(converted).all():
                raise ValueError(f"{name} holds NaN or infinity (as {dtype})")
            target.append(converted)
        matrix = arrays[0][-1].shape[-2:]
        if matrix[1] != inputs or arrays[1][-1].shape[-1] != matrix[0]:
            raise ValueError(
                f"layer {k} maps {inputs} numbers, so weights[{k}] must be (n, {inputs}) and "
                f"biases[{k}] (n,); they are {arrays[0][-1].shape} and {arrays[1][-1].shape}"
            )
        inputs = matrix[0]
    return arrays[0], arrays[1], 1 if points is None else points
