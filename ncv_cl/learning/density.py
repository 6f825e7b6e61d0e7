"""The residual's magnitude over the square, learned: every point's sampling density and mean."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..host.clock import CHECKED_STEPS
from ..host.files import array_of, read_arrays, real_number
from ..network.encode import Encoder
from ..network.fold import POINTS_PER_FOLD, FoldedNetwork
from ..network.network import Network, NetworkDescription, NetworkError
from ..opencl.device import GPU_LOCAL_BYTES, GROUP_SIZE, Device
from ..opencl.kernel import Arguments
from ..opencl.layout import Record
from ..opencl.memory import HostArray
from ..opencl.program import Program, build
from ..points.points import ShadingPoints
from ..points.sampler import HostStream, host_generator
from ..sampling.warp import DENSITY_BINS, DENSITY_WORDS, warp_defines
from . import tuning
from .train import TrainingSamples

# Work-groups of a gradient step at most; fixed, so that the order of additions does not depend on the
# device. On GPUs, a work-item a sample of the default's steps, the groups and the columns of each; and
# the points of a group that tabulates, a work-item a strip.
GRADIENT_GROUPS = 16
GPU_GROUPS, GPU_COLUMNS, GPU_POINTS = 64, 4, 8
DENSITY_CELLS = DENSITY_BINS**2
# A file's density leaves at least this much uniform, or weights have no bound.
SMALLEST_UNIFORM_SHARE = 1e-3


@dataclass(frozen=True)
class DensitySettings:
    """The network that predicts the residual's magnitude, and its schedule.

    Attributes
    ----------
    hidden : int
        Units of its one hidden layer; a multiple of 16.
    columns : int
        Training points a minibatch, about.
    samples_a_step : int
        Samples of each of them that one Adam step sees.
    steps : int
        Adam steps: what the predictor needs does not depend on how many samples there are.
    most_epochs : int
        How often each stored sample is used at most; where there are few, there are fewer steps.
    rate, final_rate : float
        Adam's step size at first and, after a cosine decay, at last.
    beta1, beta2, epsilon : float
        Adam's constants.
    uniform_share : float
        Part of every density that is uniform, which bounds the weight of a sample where the network
        predicts too little.
    """

    hidden: int = tuning.DENSITY_HIDDEN
    columns: int = tuning.DENSITY_COLUMNS
    samples_a_step: int = tuning.DENSITY_SAMPLES_A_STEP
    steps: int = tuning.DENSITY_STEPS
    most_epochs: int = tuning.DENSITY_EPOCHS
    rate: float = tuning.DENSITY_RATE
    final_rate: float = tuning.DENSITY_FINAL_RATE
    beta1: float = tuning.DENSITY_BETA1
    beta2: float = tuning.DENSITY_BETA2
    epsilon: float = 1e-8
    uniform_share: float = tuning.DENSITY_UNIFORM_SHARE

    def parameters(self, features: int) -> Record:
        """The network's numbers: weights and biases of its units, then rows and biases of cells."""
        fields = {"units": features * self.hidden, "unit_bias": self.hidden}
        return Record(
            "MAGNITUDE", {**fields, "rows": DENSITY_CELLS * self.hidden, "cell_bias": DENSITY_CELLS}
        )

    def defines(self, description: NetworkDescription) -> dict[str, int | str]:
        """The `-D` constants of density.cl but those of fitting."""
        return {
            **description.defines(),
            "FITTING": 0,
            **warp_defines(),
            "DENSITY_HIDDEN": self.hidden,
            **self.parameters(description.encoding.feature_count).defines(),
            "UNIFORM_SHARE": f"{self.uniform_share!r}f",
        }


@dataclass(frozen=True)
class DensityNetwork:
    """A trained predictor of the residual's magnitude.

    Attributes
    ----------
    parameters : ndarray
        float32, as density.cl lays them out.
    feature_mean, feature_scale : ndarray
        float32 (features,): features enter as (feature - mean) * scale.
    unit : float
        What its output is multiplied by: the root mean square of the residuals it has seen.
    settings : DensitySettings
    """

    parameters: np.ndarray
    feature_mean: np.ndarray
    feature_scale: np.ndarray
    unit: float
    settings: DensitySettings

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that are saved in the control variate's file."""
        return {
            "density_parameters": self.parameters,
            "density_features": np.stack([self.feature_mean, self.feature_scale]),
            "density_scalars": np.array(
                [self.unit, self.settings.hidden, self.settings.uniform_share], np.float64
            ),
        }

    @classmethod
    def load(cls, path: str | Path) -> DensityNetwork | None:
        """The density network of a control variate's file; None if the file has none.

        Raises
        ------
        NetworkError
            If the arrays do not fit each other.
        """
        try:
            arrays = read_arrays(path)
            return cls.of_arrays(arrays, Network.of_arrays(arrays).description)
        except ValueError as error:
            raise NetworkError(f"{path} is not a network saved by ncv_cl: {error}") from error

    @classmethod
    def of_arrays(
        cls, arrays: Mapping[str, np.ndarray], description: NetworkDescription
    ) -> DensityNetwork | None:
        """The density network among the arrays of a file of this description; None if there is none.

        Raises
        ------
        ValueError
            Naming what is missing, of another type or shape, or out of range.
        """
        if not any(name.startswith("density_") for name in arrays):
            return None
        unit, hidden, uniform_share = array_of(arrays, "density_scalars", np.float64, (3,)).tolist()
        real_number("the density's unit", unit, 0.0, float(np.finfo(np.float32).max))
        real_number("the density's uniform share", uniform_share, SMALLEST_UNIFORM_SHARE, 1.0)
        if hidden not in range(16, 513, 16):
            raise ValueError(f"the density's hidden units must be 16, 32, ... 512, are {hidden}")
        settings = DensitySettings(hidden=int(hidden), uniform_share=uniform_share)
        features = description.encoding.feature_count
        size = settings.parameters(features).size
        parameters = array_of(arrays, "density_parameters", np.float32, (size,))
        scales = array_of(arrays, "density_features", np.float32, (2, features))
        shift, factor = scales
        return cls(parameters, shift, factor, unit, settings)


@dataclass(frozen=True)
class Density:
    """Sampling densities of all active points.

    Attributes
    ----------
    table : HostArray
        uint32 (points, DENSITY_WORDS), as warp.cl reads it.
    magnitude : ndarray
        float64 (points,), the mean over the square of the residual's predicted root mean square, in the
        integrand's units.
    uniform_share : float
        Part of every density that is uniform.
    """

    table: HostArray
    magnitude: np.ndarray
    uniform_share: float


def tabulate(
    device: Device,
    density: DensityNetwork,
    network: Network,
    points: ShadingPoints,
    unit: np.ndarray | None = None,
) -> Density:
    """The densities of all active points.

    Parameters
    ----------
    network : Network
        The control variate, whose features `density` takes.
    unit : ndarray, optional
        float32 (points.active,), each point's scale, as the trainer was given it.
    """
    defines = density.settings.defines(network.description)
    if _by_groups(device, density.settings):
        defines |= {"TILE": GPU_POINTS, "GROUP_ITEMS": GROUP_SIZE}
        file, items = "density_lanes", GROUP_SIZE / GPU_POINTS
    else:
        file, items = "density_tables", 1 / device.vector_width
    program = build(device, ("common", "warp", "density", file), defines)
    table = HostArray(device, (points.active, DENSITY_WORDS), np.uint32)
    magnitude = HostArray(device, points.active, np.float32)
    entries = HostArray.of(device, network.table)
    inputs: Arguments = {
        name: HostArray.of(device, getattr(density, name))
        for name in ("feature_mean", "feature_scale", "parameters")
    }
    for first in range(0, points.active, POINTS_PER_FOLD):
        count = min(POINTS_PER_FOLD, points.active - first)
        order = HostArray.of(device, np.arange(first, first + count, dtype=np.uint32))
        encoder = Encoder(device, network.description.encoding, points, network.cube, order)
        encoder.encode_grid(entries)
        program.kernel("density_tables")(
            math.ceil(count * items),
            count=count,
            stride=encoder.stride,
            first_point=first,
            features=encoder.features,
            **inputs,
            magnitude=magnitude,
            density=table,
        )
    scale = density.unit if unit is None else density.unit * unit.astype(np.float64)
    magnitudes = magnitude.read().astype(np.float64) * scale
    return Density(table, magnitudes, density.settings.uniform_share)


def _by_groups(device: Device, settings: DensitySettings) -> bool:
    """Whether groups share columns (density_lanes.cl): on GPUs, if local memory holds all rows."""
    rows_bytes = 4 * DENSITY_CELLS * settings.hidden
    by_lanes = device.lanes > 1 and device.vector_width == 1
    return by_lanes and rows_bytes <= GPU_LOCAL_BYTES // 2


class DensityTrainer:
    """Learns the magnitude of f - g from the control variate's own training samples.

    Parameters
    ----------
    device
    network : FoldedNetwork
        The control variate.
    samples : TrainingSamples
    unit : ndarray, optional
        float32 (points,), each point's scale, by which its residuals are divided; 1 by default.
    settings : DensitySettings, optional
    """

    def __init__(
        self,
        device: Device,
        network: FoldedNetwork,
        samples: TrainingSamples,
        unit: np.ndarray | None = None,
        settings: DensitySettings | None = None,
    ) -> None:
        self.device = device
        self.settings = settings or DensitySettings()
        self._network, self._samples = network, samples
        features = samples.encoder.features.read()[:, : samples.count]
        mean, deviation = features.mean(1, dtype=np.float64), features.std(1, dtype=np.float64)
        scale = np.where(deviation > 0, 1 / np.maximum(deviation, 1e-30), 0.0)
        self._mean, self._scale = (HostArray.of(device, a.astype(np.float32)) for a in (mean, scale))
        self._by_samples = _by_groups(device, self.settings)
        self._program = self._build()
        self._squared = self._squared_residuals(unit)
        with self._squared.mapped() as squared:
            self._mean_square = float(squared[:, : samples.count].mean(dtype=np.float64)) or 1.0
        start = self._start(len(features))
        self._parameters = HostArray.of(device, start)
        self._moments: Arguments = {
            name: HostArray.of(device, np.zeros_like(start)) for name in ("moment1", "moment2")
        }
        rows = GPU_GROUPS if self._by_samples else GRADIENT_GROUPS
        self._partial = HostArray(device, (rows, len(start)), np.float32)

    @property
    def _step_samples(self) -> int:
        return min(self.settings.samples_a_step, self._samples.samples)

    def _build(self) -> Program:
        settings = self.settings
        defines = {
            **settings.defines(self._network.network.description),
            "FITTING": 1,
            "DENSITY_SAMPLES": self._step_samples,
            "ADAM_BETA1": f"{settings.beta1!r}f",
            "ADAM_BETA2": f"{settings.beta2!r}f",
            "ADAM_EPSILON": f"{settings.epsilon!r}f",
        }
        if self._by_samples:
            defines |= {"TILE": GPU_COLUMNS, "GROUP_ITEMS": GROUP_SIZE}
        step = "density_lanes" if self._by_samples else "density_gradients"
        return build(self.device, ("common", "mlp", "density", step), defines)

    def _start(self, features: int) -> np.ndarray:
        """Random start: He-uniform units, and rows so small that e is near the samples' RMS."""
        hidden = self.settings.hidden
        generator = host_generator(0, HostStream.DENSITY)
        layout = self.settings.parameters(features)
        parameters = np.zeros(layout.size, np.float32)
        units = generator.uniform(-1, 1, features * hidden)
        parameters[layout["units"]] = units * math.sqrt(3 / features)
        bound = 1 / math.sqrt(hidden)
        parameters[layout["rows"]] = generator.uniform(-bound, bound, DENSITY_CELLS * hidden)
        return parameters

    def _squared_residuals(self, unit: np.ndarray | None) -> HostArray:
        samples, device = self._samples, self.device
        points = int(samples.order.read().max(initial=0)) + 1
        unit = np.ones(points, np.float32) if unit is None else unit
        squared = HostArray(device, samples.u.shape, np.float32)
        squared.fill(0.0)
        self._program.kernel("squared_residuals")(
            samples.count * -(-samples.samples // device.vector_width),
            count=samples.count,
            stride=samples.u.shape[1],
            samples=samples.samples,
            order=samples.order,
            all_u=samples.u,
            all_v=samples.v,
            all_targets=samples.target,
            unit=HostArray.of(device, unit),
            **self._network.arrays,
            squared=squared,
        )
        return squared

    def fit(self, check: Callable[[], None] | None = None) -> DensityNetwork:
        """Run the schedule over the stored samples; `check` is called now and then, and may raise."""
        settings, samples = self.settings, self._samples
        batches = max(1, round(samples.count / settings.columns))
        edges = np.linspace(0, samples.count, batches + 1).astype(int)
        starts = range(0, samples.samples - self._step_samples + 1, self._step_samples)
        batches_and_samples = list(itertools.product(starts, itertools.pairwise(edges.tolist())))
        total = min(settings.steps, settings.most_epochs * len(batches_and_samples))
        steps = itertools.islice(itertools.cycle(batches_and_samples), total)
        for number, (sample, (begin, end)) in enumerate(steps, 1):
            self._step(sample, begin, end - begin, number, total)
            if check is not None and number % CHECKED_STEPS == 0:
                self.device.queue.finish()
                check()
        return DensityNetwork(
            self._parameters.read(),
            self._mean.read(),
            self._scale.read(),
            math.sqrt(self._mean_square),
            settings,
        )

    def gradients(self, sample: int, first: int, count: int) -> int:
        """Enqueue one step's gradients; returns the number of rows of partial sums."""
        samples, group, columns = self._samples, self.device.lanes, 1
        if self._by_samples:
            group, columns = GROUP_SIZE, GPU_COLUMNS
        groups = min(self._partial.shape[0], -(-count // columns))
        self._program.kernel("density_gradients")(
            groups * group,
            sample=sample,
            first=first,
            count=count,
            stride=samples.u.shape[1],
            unit_square=1.0 / self._mean_square,
            features=samples.encoder.features,
            feature_mean=self._mean,
            feature_scale=self._scale,
            all_u=samples.u,
            all_v=samples.v,
            squared=self._squared,
            parameters=self._parameters,
            partial=self._partial,
            group=group,
        )
        return groups

    def _step(self, sample: int, first: int, count: int, number: int, total: int) -> None:
        settings = self.settings
        groups = self.gradients(sample, first, count)
        decay = 0.5 * (1.0 + math.cos(math.pi * number / total))
        self._program.kernel("density_adam")(
            -(-self._parameters.shape[0] // self.device.vector_width),
            groups=groups,
            rate=settings.final_rate + (settings.rate - settings.final_rate) * decay,
            correction1=1.0 / (1.0 - settings.beta1**number),
            correction2=1.0 / (1.0 - settings.beta2**number),
            partial=self._partial,
            parameters=self._parameters,
            **self._moments,
        )
