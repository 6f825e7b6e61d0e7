"""Exact integration under torture: networks that break it, against rational arithmetic.

Every family of torture_families.py is integrated in every shape of network, by both methods, in both
precisions, and in the shapes of a CPU and of a GPU; always in a process of its own, so that crashes and
hangs count. An error is |G - exact| relative to the scale Σ |w_j| ∫|activation(z_j)| + |b|.
"""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from references import cache_folder
from torture_exact import Exact, Network, exact_batches, exact_processes
from torture_families import FAMILIES, torture_networks
from torture_verdict import Program, Shape, Verdict, Verdicts, brief, report, total
from torture_worker import Outcome, Worker

from ncv_cl.integration.integrator import INTEGRATION_METHODS, PRECISIONS
from ncv_cl.opencl.device import GPU_LANES, Device

LIMIT = {"float32": 1e-6, "float64": 1e-13}
# Networks a family, shape of network and seed.
QUICK_PER_FAMILY, FULL_PER_FAMILY = 3, 25
QUICK_SEEDS, FULL_SEEDS = (11,), (11, 12, 13)
SHAPES = Shape((8, 8)), Shape((5, 4)), Shape((6, 6, 6)), Shape((8, 8), 0.01)
# Not of the quick form, and fewer networks each: their exact integrals take longer.
FURTHER_SHAPES = (
    *(Shape((12,)), Shape((16, 16)), Shape((7, 33)), Shape((10, 10, 10)), Shape((4, 4, 4, 4))),
    *(Shape((5, 4), -0.5), Shape((32, 32))),
)
FURTHER_SHARE = 12
# (vector width, lanes): the quick form tries it with the deepest networks only.
GPU_SHAPE = 1, GPU_LANES
QUICK_GPU_NETWORKS = SHAPES[2:3]
# Each compiles on one core, but integrates on all of them.
WORKERS = 4


@dataclass(frozen=True)
class Batch:
    """Networks of one family, shape and seed, with a points axis, and their exact integrals."""

    seed: int
    family: str
    networks: Network
    exact: Exact


def torture(
    device: Device,
    quick: bool = False,
    seeds: Sequence[int] | None = None,
    per_family: int | None = None,
) -> dict:
    """Integrate all networks and print tables of what came of them.

    Parameters
    ----------
    device : Device
        As `choose_device` returns it: the workers open the one of its index.
    quick : bool
        One seed, few networks, and the GPU's shape with the deepest networks only.
    seeds : sequence of int, optional
    per_family : int, optional
        Networks a family, shape and seed; of the further shapes fewer.

    Returns
    -------
    dict
        For JSON; `failed` says whether anything certified is beyond its limit, or crashed.
    """
    seeds = seeds or (QUICK_SEEDS if quick else FULL_SEEDS)
    per_family = per_family or (QUICK_PER_FAMILY if quick else FULL_PER_FAMILY)
    programs = programs_for(device, quick)
    batches: dict[tuple[Shape, str], list[Batch]] = {}
    sizes: Counter[str] = Counter()
    print(f"exact integrals first, which are kept in {cache_folder()}", flush=True)
    with exact_processes() as pool:
        for shape, precision in dict.fromkeys((one.shape, one.precision) for one in programs):
            count = per_family if shape in SHAPES else -(-per_family // FURTHER_SHARE)
            batches[shape, precision] = exact_networks(shape, precision, seeds, count, pool)
            sizes[precision] += count * len(seeds) * len(FAMILIES)
    print(f"networks: {', '.join(f'{size} in {name}' for name, size in sizes.items())}", flush=True)

    def work(program: Program) -> Verdicts:
        return judge(program, device, batches[program.shape, program.precision])

    verdicts: Verdicts = {}
    with ThreadPoolExecutor(min(WORKERS, os.cpu_count() or 1)) as threads:
        for program, found in zip(programs, threads.map(work, programs), strict=True):
            verdicts |= found
            print(f"{program!s:56}{brief(total(found.values()))}", flush=True)
    return report(verdicts)


def programs_for(device: Device, quick: bool) -> list[Program]:
    """All that is to be tried, the device's own shape first."""
    own = device.vector_width, device.lanes
    precisions = [name for name in PRECISIONS if name == "float32" or device.has_float64]
    shapes = SHAPES if quick else SHAPES + FURTHER_SHAPES
    tried = [(shape, own) for shape in shapes]
    if own != GPU_SHAPE:
        tried += [(shape, GPU_SHAPE) for shape in (QUICK_GPU_NETWORKS if quick else shapes)]
    return [
        Program(shape, precision, method, device_shape)
        for shape, device_shape in tried
        for precision in precisions
        for method in INTEGRATION_METHODS
    ]


def exact_networks(
    shape: Shape, precision: str, seeds: Sequence[int], count: int, pool: Executor
) -> list[Batch]:
    """The networks of all families and seeds with their exact integrals."""
    dtype = PRECISIONS[precision]
    # The kernels' slope is of their precision, too.
    slope = float(dtype.type(shape.slope))
    batches = []
    for seed in seeds:
        networks = [torture_networks(one, shape.widths, seed, count, dtype) for one in FAMILIES]
        exact = exact_batches(networks, slope, cache_folder(), pool)
        batches += itertools.starmap(
            Batch, zip([seed] * len(exact), FAMILIES, networks, exact, strict=True)
        )
    return batches


def judge(program: Program, device: Device, batches: Sequence[Batch]) -> Verdicts:
    """Integrate the batches, each in one call, and compare."""
    verdicts: Verdicts = {}
    options = {"precision": program.precision, "method": program.method, **program.shape.options()}
    with Worker(str(device.index), program.device_shape, options) as worker:
        for batch in batches:
            key = program, batch.family
            verdict = compare(worker.integrate(batch.networks), batch, program)
            verdicts[key] = verdicts.get(key, Verdict()) + verdict
    return verdicts


def compare(outcome: Outcome, batch: Batch, program: Program) -> Verdict:
    """Compare what came of a batch with its exact integrals."""
    errors, answered = batch.exact.errors(outcome.values), outcome.answered
    beyond = answered & (errors > LIMIT[program.precision])
    broken = answered & (batch.exact.distances(outcome.values) > outcome.bounds).any(axis=1)
    where = f"{batch.family}, seed {batch.seed}, {program}"
    failures = [
        (
            float(errors[k]),
            f"{where}, network {k}: {errors[k]:.1e}{', beyond its bound' if broken[k] else ''}",
        )
        for k in np.flatnonzero(beyond | broken)
    ]
    if outcome.crash:
        failures.append((np.inf, f"{where}: {outcome.crash}; {outcome.lost} networks on their own"))
    return Verdict(
        networks=int(answered.sum()),
        worst=float(errors[answered].max(initial=0.0)),
        beyond=int(beyond.sum()),
        bound_broken=int(broken.sum()),
        refused=outcome.refused,
        lost=outcome.lost,
        crashed=int(bool(outcome.crash)),
        redone=outcome.redone,
        failures=failures,
    )
