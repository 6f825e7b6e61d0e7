"""The project's own control variate: a ReLU network with its exact integral.

What `ncv_cl.estimate` does after it has drawn training samples, put together from the same parts: so all
methods learn from the same samples, and one fit can be estimated with many times over. Two forms: the
classical G + <f - g>, and the default's, whose residual is sampled by its learned density (and whose
samples, in a family, are allocated by it). Left out: the share of the training samples in the estimate,
and the points that are done twice for the variance. `ncv_cl.estimate` itself is measured too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import ncv_cl as ncv
from ncv_cl.estimation.allocate import Allocation, allocate
from ncv_cl.estimation.control_variate import integrals_of
from ncv_cl.estimation.passes import Passes, Target
from ncv_cl.host.clock import Stopwatch
from ncv_cl.learning.density import Density, DensityTrainer, tabulate
from ncv_cl.learning.train import Trainer
from ncv_cl.network.encode import GridCube
from ncv_cl.network.fold import FoldedNetwork
from ncv_cl.network.network import Network
from ncv_cl.opencl.device import Device
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import SURFACE, ShadingPoints
from ncv_cl.points.sampler import Stream
from ncv_cl.rendering.estimate import UNIT_CUBE
from ncv_cl.sampling.accumulate import Accumulator
from ncv_cl.sampling.callable import CallableSource, HostIntegrand
from ncv_cl.sampling.problem import Problem
from ncv_cl.sampling.samples import Batch
from ncv_cl.sampling.warp import TableWarp
from ncv_cl.settings.presets import PRESETS

from .interface import Estimator, FamilyFunction, Method, Samples

# One integral alone: its training samples are laid out over so many columns, to fill a step's tile, and
# used so often. A family takes the preset's network and schedule.
COLUMNS, EPOCHS = 16, 128
ALONE_HIDDEN = (32, 32)
CUBE = GridCube((0.0, 0.0, 0.0), 1.0)


def shading_points(device: Device, features: np.ndarray) -> ShadingPoints:
    """Points whose positions are `features`, (points, up to 3), scaled to [0, 1]."""
    points = len(features)
    surface = np.zeros((SURFACE.size, points), np.float32)
    surface[SURFACE["position"]][: features.shape[1]] = features.T
    nowhere = np.full(points, -1, np.int32)
    numbers = np.arange(points, dtype=np.uint32)
    return ShadingPoints(HostArray.of(device, surface), numbers, nowhere, points, 0)


class OursEstimator(Estimator):
    """A trained network, its integrals, and what predicts its residual."""

    def __init__(self, device: Device, training: Samples, seed: int, with_density: bool) -> None:
        self._device, self._features = device, training.features
        alone = training.features.shape[1] == 0
        preset = PRESETS["wide"]
        columns = COLUMNS if alone else training.points
        hidden = ALONE_HIDDEN if alone else preset.hidden
        schedule = replace(preset.schedule, epochs=EPOCHS) if alone else preset.schedule
        samples = training.samples * training.points // columns
        shape = columns, samples
        u, v, values = (
            array.reshape(-1)[: columns * samples].reshape(shape)
            for array in (training.u, training.v, training.values)
        )
        features = np.zeros((columns, 0), np.float32) if alone else training.features
        points = shading_points(device, features)
        description = replace(preset, hidden=hidden).description(HostIntegrand(1), ("position",))
        everyone = np.arange(columns, dtype=np.uint32)
        start = Network.random(description, CUBE, seed)
        trainer = Trainer(device, start, points, schedule, everyone, samples, seed)
        trainer.store(_batch(device, u, v, values), 0)
        trainer.fit()
        self._network = trainer.network()
        own = shading_points(device, self._features)
        self.integral = integrals_of(device, FoldedNetwork(device, self._network, own), own.active)[0]
        self._density = None
        if with_density:
            folded = FoldedNetwork(device, self._network, points)
            self._density = DensityTrainer(device, folded, trainer.samples_of(self._network)).fit()

    def estimate(
        self, function: FamilyFunction, samples: int, repeats: int, seed: int, sampler: str
    ) -> np.ndarray:
        device, count = self._device, len(self._features)
        points = shading_points(device, np.tile(self._features, (repeats, 1)))

        def repeated(u: np.ndarray, v: np.ndarray, index: np.ndarray) -> np.ndarray:
            return function(u, v, index % count)

        source = CallableSource(device, points, repeated, 1, sampler, seed)
        folded = FoldedNetwork(device, self._network, points)
        accumulator = Accumulator(device, points, 1, folded)
        table, allocation = None, Allocation.uniform(np.arange(points.active, dtype=np.uint32), samples)
        if self._density is not None:
            density: Density = tabulate(device, self._density, self._network, points)
            table = TableWarp(density.table)
            if count > 1:
                counts = allocate(density.magnitude[:count], samples)
                allocation = Allocation.of_counts(np.tile(counts, repeats))
        target = Target(accumulator, allocation, Stream.RESIDUAL)
        problem = Problem(device, points, source, UNIT_CUBE, ("position",), is_image=False)
        Passes(problem, [target], [0, samples], table, Stopwatch()).run("estimate")
        residual = accumulator.result(1).mean[0].reshape(repeats, count)
        return self.integral.astype(np.float64) + residual


def _batch(device: Device, u: np.ndarray, v: np.ndarray, values: np.ndarray) -> Batch:
    """Samples (columns, samples) as a batch of all columns, padded to whole vectors."""
    columns, samples = u.shape
    stride = -(-samples // device.vector_width) * device.vector_width

    def padded(array: np.ndarray) -> HostArray:
        wide = np.zeros((columns, stride), np.float32)
        wide[:, :samples] = array
        return HostArray.of(device, wide)

    slots = HostArray.of(device, np.arange(columns * stride, dtype=np.uint32))
    visible = HostArray.of(device, np.ones(columns * stride, np.uint8))
    order = HostArray.of(device, np.arange(columns, dtype=np.uint32))
    arrays = (padded(u), padded(v), padded(values), slots, visible)
    return Batch(range(columns), order, samples, stride, *arrays)


class Ours(Method):
    """Geometric integration: f - g by uniform samples, or by the residual's learned density."""

    source = "Meister and Harada 2025; ncv_cl"

    def __init__(self, device: Device, density: bool) -> None:
        self.name = "ours, density" if density else "ours, f - g"
        self._device, self._with_density = device, density

    def fit(self, training: Samples, seed: int, seconds: float | None = None) -> OursEstimator:
        return OursEstimator(self._device, training, seed, self._with_density)


class PublicEstimator(Estimator):
    """Calls `ncv_cl.estimate`, which trains anew each time; its density's training counts as estimation.

    One integral alone is asked for as so many equal ones as there are repeats, and shares the training
    samples among them: they have one network, and it learns from many columns at a time.
    """

    def __init__(self, device: Device, training: Samples, seed: int) -> None:
        self._device, self._training, self._seed = device, training, seed

    def estimate(
        self, function: FamilyFunction, samples: int, repeats: int, seed: int, sampler: str
    ) -> np.ndarray:
        training = self._training
        count, alone = training.points, training.features.shape[1] == 0
        copies = repeats if alone else 1
        results, self.trainings = [], []
        for number in range(repeats // copies):
            found = ncv.estimate(
                lambda u, v, index: function(u, v, index % count),
                count * copies,
                None if alone else training.features,
                sampler=sampler,
                spp=samples,
                train_spp=training.samples / copies,
                seed=seed + number,
                device=self._device,
            )
            results.append(found.mean.reshape(copies, count))
            self.trainings.append(found.stats["seconds"]["train"])
        return np.concatenate(results)


class PublicEstimate(Method):
    """`ncv_cl.estimate` as a user calls it; it draws its training samples itself, as many."""

    name = "ncv_cl.estimate"
    source = "Meister and Harada 2025; ncv_cl"

    def __init__(self, device: Device) -> None:
        self._device = device

    def fit(self, training: Samples, seed: int, seconds: float | None = None) -> PublicEstimator:
        return PublicEstimator(self._device, training, seed)
