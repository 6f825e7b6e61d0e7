"""Exact integrals of many networks in rational arithmetic, by all cores, kept on disk.

No OpenCL here: the processes that compute need none.
"""

from __future__ import annotations

import hashlib
import inspect
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

# The exact oracle is the tests' own.
sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import rational
from rational import Network, exact_integral, point_network


@dataclass(frozen=True)
class Exact:
    """Exact integrals of a batch of networks.

    Attributes
    ----------
    value, rest : (points, channels) float64
        The integral is their sum, right to 1e-32 of itself.
    scale : (points, channels) float64
        What rounding is measured against: Σ |w_j| ∫|activation(z_j)| + |b|, over the last hidden layer.
    """

    value: np.ndarray
    rest: np.ndarray
    scale: np.ndarray

    def distances(self, values: np.ndarray) -> np.ndarray:
        """|values - exact|, (points, channels); infinite where a value is not finite."""
        with np.errstate(invalid="ignore", over="ignore"):
            distances = np.abs((values.astype(np.float64) - self.value) - self.rest)
        return np.where(np.isfinite(values), distances, np.inf)

    def errors(self, values: np.ndarray) -> np.ndarray:
        """|values - exact| / scale, the worst of each point's channels, (points,).

        0 where value, exact value and scale are all 0.
        """
        distances = self.distances(values)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(distances == 0, 0.0, distances / self.scale).max(axis=1)


def exact_processes() -> ProcessPoolExecutor:
    """Processes for `exact_batches`; none is started before there is something to compute."""
    return ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn"))


def exact_batches(batches: Sequence[Network], slope: float, folder: Path, pool: Executor) -> list[Exact]:
    """The exact integrals of batches of networks, from disk or computed now.

    Parameters
    ----------
    batches : sequence of networks
        All arrays with a points axis.
    slope : float
        Of leaky relu below zero; 0 for relu.
    folder : Path
        Where results are kept, one file for all of `batches` together.
    pool : Executor
        Computes what is not there.
    """
    file = folder / f"torture_{_key(batches, slope)[:24]}.npz"
    if file.exists():
        with np.load(file) as found:
            stacked = [found[f"{k}"] for k in range(len(batches))]
    else:
        stacked = list(pool.map(exact_numbers, batches, [slope] * len(batches)))
        _write(file, stacked)
    return [Exact(*numbers) for numbers in stacked]


def exact_numbers(batch: Network, slope: float) -> np.ndarray:
    """Value, rest and scale of a batch of networks (see `Exact`): float64 (3, points, channels)."""
    rows = []
    for point in range(len(batch[1][0])):
        integrals, scales = exact_integral(*point_network(batch, point), slope)
        values = [float(one) for one in integrals]
        rests = [float(one - type(one)(value)) for one, value in zip(integrals, values, strict=True)]
        rows.append((values, rests, [float(one) for one in scales]))
    return np.array(rows).transpose(1, 0, 2)


def _key(batches: Sequence[Network], slope: float) -> str:
    """SHA-256, in hex, of all that decides the results."""
    found = hashlib.sha256(f"{slope!r} {inspect.getsource(rational)}".encode())
    for weights, biases in batches:
        for array in (*weights, *biases):
            found.update(f"{array.dtype}{array.shape}".encode())
            found.update(array.tobytes())
    return found.hexdigest()


def _write(file: Path, stacked: list[np.ndarray]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    # Complete under its name or not at all: others may look for it at the same time.
    with tempfile.TemporaryDirectory(dir=file.parent) as folder:
        complete = Path(folder) / file.name
        np.savez(complete, **{f"{k}": numbers for k, numbers in enumerate(stacked)})
        os.replace(complete, file)
