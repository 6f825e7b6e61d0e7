"""Fitting and evaluation in PyTorch, for the peers that are built on it."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from .interface import Samples

if TYPE_CHECKING:
    import torch

FINAL_SHARE = 0.02
# Samples evaluated at a time by one thread: what its layers hold then fits the cache.
CHUNK = 1 << 13


@contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch's operations on one thread each, denormals as zeros.

    Layers this small are no work for two: 600 steps of automatic integration took 3.9 s on one thread
    and 51 s on two, beside other work.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.set_flush_denormal(False)


def fit_module(
    module: torch.nn.Module,
    predict: Callable[[torch.Tensor], torch.Tensor],
    training: Samples,
    unit: float,
    seed: int,
    steps: int,
    batch: int,
    rate: float,
    seconds: float | None,
) -> int:
    """Least squares of `predict(inputs)` against values over `unit`; returns the steps done.

    The mean square of f - g is what the variance of the estimate is made of, up to (F - G)². Adam's step
    size decays by a cosine, over the steps or the seconds, whichever end sooner.

    Parameters
    ----------
    predict : callable
        g over `unit`, (n,), of inputs (n, 2 + k).
    """
    import torch

    with one_thread():
        return _fit(torch, module, predict, training, unit, seed, steps, batch, rate, seconds)


def _fit(
    torch: ModuleType,
    module: torch.nn.Module,
    predict: Callable[[torch.Tensor], torch.Tensor],
    training: Samples,
    unit: float,
    seed: int,
    steps: int,
    batch: int,
    rate: float,
    seconds: float | None,
) -> int:
    inputs, values = (torch.from_numpy(array) for array in training.rows())
    target = values / unit
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(module.parameters(), lr=rate)
    count, batch = len(target), min(batch, len(target))
    order, at = torch.randperm(count, generator=generator), 0
    started = time.perf_counter()
    for step in range(steps):
        share = step / steps
        if seconds is not None:
            share = max(share, (time.perf_counter() - started) / seconds)
            if share >= 1:
                return step
        decay = FINAL_SHARE + (1 - FINAL_SHARE) * 0.5 * (1 + math.cos(math.pi * share))
        for group in optimizer.param_groups:
            group["lr"] = rate * decay
        if at + batch > count:
            order, at = torch.randperm(count, generator=generator), 0
        pick = order[at : at + batch]
        at += batch
        loss = ((predict(inputs[pick]) - target[pick]) ** 2).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    return steps


def unit_of(training: Samples) -> float:
    """What values are divided by, so that step sizes do not depend on their units."""
    return float(np.sqrt(np.mean(training.values.astype(np.float64) ** 2))) or 1.0


def evaluate(
    predict: Callable[[torch.Tensor], torch.Tensor],
    u: np.ndarray,
    v: np.ndarray,
    features: np.ndarray,
    index: np.ndarray,
) -> np.ndarray:
    """`predict` of inputs (u, v, features[index]), float32 (n,), on all cores, a chunk a thread."""
    import torch

    def part(first: int) -> None:
        some = slice(first, first + CHUNK)
        columns = [u[some, None], v[some, None]]
        if features.shape[1]:
            columns.append(features[index[some]])
        with torch.no_grad():
            found[some] = predict(torch.from_numpy(np.concatenate(columns, axis=1))).numpy()

    def prepare() -> None:
        # Both are settings of a thread.
        torch.set_num_threads(1)
        torch.set_flush_denormal(True)

    found = np.empty(len(u), np.float32)
    with one_thread(), ThreadPoolExecutor(os.cpu_count(), initializer=prepare) as pool:
        list(pool.map(part, range(0, len(u), CHUNK)))
    return found
