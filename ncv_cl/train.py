"""Training: minibatches of stored samples, fixed-order gradients, Adam and a moving average."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from .device import Device, HostArray
from .encode import Encoder
from .network import Network
from .points import ShadingPoints
from .program import Program, build
from .samples import NO_RAY, Batch

# Bytes of local memory that the gradient kernel may use; every GPU has this much.
LOCAL_BYTES = 48 << 10
# On CPUs local memory is cache; a tile should stay in the second level.
CPU_LOCAL_BYTES = 256 << 10
MAX_TILE = 64
# Rows of partial sums; fixed, so that the order of additions does not depend on the device's size.
GROUPS = 64


@dataclass(frozen=True)
class TrainSettings:
    """The schedule.

    Attributes
    ----------
    batch : int
        Training points a minibatch, about.
    samples_a_step : int
        Samples of each of them that one Adam step sees; heads are paid once for all of these.
    passes : int
        How often each stored sample is used.
    rate, final_rate : float
        Adam's step size at first and, after a cosine decay, at last.
    beta1, beta2, epsilon : float
        Adam's constants.
    average_decay : float
        Weight of the past in the moving average of all parameters; the average is what is used.
    weight_power : float
        Demodulated networks: samples weigh as this power of the point's factor.
    """

    batch: int = 128
    samples_a_step: int = 4
    passes: int = 4
    rate: float = 1e-2
    final_rate: float = 1e-3
    beta1: float = 0.9
    beta2: float = 0.99
    epsilon: float = 1e-8
    average_decay: float = 0.99
    weight_power: float = 1.0


@dataclass(frozen=True)
class TrainingSamples:
    """What a `Trainer` keeps of its samples, one column a shading point.

    Attributes
    ----------
    order : HostArray
        uint32 (count,), the shading point of each column.
    u, v, target : HostArray
        float32 (samples, stride), (samples, stride) and (samples, channels, stride).
    encoder : Encoder
        Features of the same columns, those of the grid encoded from the trained table.
    """

    order: HostArray
    u: HostArray
    v: HostArray
    target: HostArray
    encoder: Encoder

    @property
    def count(self) -> int:
        return self.order.shape[0]

    @property
    def samples(self) -> int:
        return self.u.shape[0]


class Trainer:
    """Trains one network on samples of one image's shading points.

    Parameters
    ----------
    device, network, points
        The network to start from and the points of the image.
    settings : TrainSettings
    chosen : ndarray
        uint32, the shading points that have training samples, in the order in which they are drawn.
    samples : int
        Samples that `store` will be given for each of them.
    seed : int
        Shuffles the points into minibatches.
    factor : HostArray, optional
        float32 (channels, points.active), what a demodulated network's output is multiplied by.
    """

    def __init__(
        self,
        device: Device,
        network: Network,
        points: ShadingPoints,
        settings: TrainSettings,
        chosen: np.ndarray,
        samples: int,
        seed: int,
        factor: HostArray | None = None,
    ) -> None:
        self.device = device
        self.settings = settings
        self.samples = samples
        self._start = network
        self._steps = 0
        self._scale = 1.0
        description = network.description
        count = len(chosen)
        generator = np.random.Generator(np.random.Philox([seed, 1]))
        shuffled = generator.permutation(count).astype(np.uint32)
        position = np.empty_like(shuffled)
        position[shuffled] = np.arange(count, dtype=np.uint32)
        self._position = HostArray.of(device, position)
        order = chosen[shuffled]
        self._order = HostArray.of(device, order)
        self._encoder = Encoder(device, description.encoding, points, network.cube, self._order)
        batches = max(1, round(count / settings.batch))
        edges = np.linspace(0, count, batches + 1).astype(int)
        self._batches = [range(a, b) for a, b in itertools.pairwise(edges)]
        self._index = GridIndex(device, self._encoder, self._batches)

        self._program = self._build()
        self._parameters = _Averaged(device, np.pad(network.parameters, (0, self._padding)))
        self._table = _Averaged(device, network.table)
        self._partial = HostArray(device, (GROUPS, self._parameters.value.shape[0]), np.float32)
        self._partial.fill(0.0)
        self._loss = HostArray(device, 1, np.float32)
        stride, channels = self._encoder.stride, description.channels
        self._grid_gradient = HostArray(device, (stride, description.encoding.grid_rows), np.float32)
        self._u = HostArray(device, (samples, stride), np.float32)
        self._v = HostArray(device, (samples, stride), np.float32)
        self._target = HostArray(device, (samples, channels, stride), np.float32)
        self._factor = HostArray(device, (channels, stride), np.float32)
        self._weight = HostArray(device, (channels, stride), np.float32)
        self._set_factors(None if factor is None else factor.read()[:, order])

    def _set_factors(self, factor: np.ndarray | None) -> None:
        """Factors by column, and from them the weights; without factors one for all comes with `fit`."""
        count, power = self._encoder.count, self.settings.weight_power
        self._has_factors = factor is not None
        if factor is None:
            return
        mean = float(factor.mean(dtype=np.float64)) or 1.0
        for array, values in ((self._factor, factor), (self._weight, (factor / mean) ** power)):
            with array.mapped(write=True) as view:
                view[:, :count], view[:, count:] = values, 0.0

    def store(self, batch: Batch, first_sample: int) -> None:
        """Keep a batch's samples as number `first_sample` and on of their points."""
        self._program.kernel("store_samples")(
            len(batch.points) * batch.stride // self.device.vector_width,
            batch.points.start,
            len(batch.points),
            batch.samples,
            batch.stride,
            self._encoder.stride,
            first_sample,
            self._position,
            batch.u,
            batch.v,
            batch.value,
            batch.slot,
            batch.visible,
            self._u,
            self._v,
            self._target,
        )

    def fit(self, rounds: int = 1) -> float:
        """All passes over the stored samples, as one of `rounds` such calls; returns the mean loss.

        The loss is the mean over the last pass's steps at the end of each stored sample.
        """
        if not self._has_factors:
            self._set_common_factor()
        settings = self.settings
        step = min(settings.samples_a_step, self.samples)
        starts = range(0, self.samples - step + 1, step)
        total = rounds * settings.passes * len(starts) * len(self._batches)
        losses = []
        for _ in range(settings.passes):
            losses.clear()
            for sample in starts:
                for number in range(len(self._batches)):
                    self._step(sample, number, total)
                losses.append(float(self._loss.read()[0]))
        return float(np.mean(losses))

    def network(self) -> Network:
        """The network with the moving averages of its parameters, in the integrand's own units."""
        description = self._start.description
        parameters = self._parameters.average.read()[: description.parameter_count]
        if not description.demodulated:
            rows, shapes = description.group_rows, description.group_shapes
            _, heads, bases = description.unpack(parameters)
            for group in ("W3", "B3"):
                first = rows[group]
                part = slice(first, first + math.prod(shapes[group]))
                if group in description.modulated:
                    heads[part] *= self._scale
                else:
                    bases[part.start - len(heads) : part.stop - len(heads)] *= self._scale
        return Network(description, parameters, self._table.average.read(), self._start.cube)

    def samples_of(self, network: Network) -> TrainingSamples:
        """The samples stored last, with features as `network`, a result of this training, sees them."""
        self._encoder.encode_grid(HostArray.of(self.device, network.table))
        return TrainingSamples(self._order, self._u, self._v, self._target, self._encoder)

    def _set_common_factor(self) -> None:
        """The integrand's mean for all, so that rates and losses do not depend on the scene's units."""
        count = self._encoder.count
        with self._target.mapped() as target:
            mean = float(np.mean(target[:, :, :count], dtype=np.float64))
        self._scale = mean if mean > 0.0 else 1.0
        channels = self._start.description.channels
        self._set_factors(np.full((channels, count), self._scale, np.float32))

    def _step(self, sample: int, number: int, total: int) -> None:
        settings, encoder, columns = self.settings, self._encoder, self._batches[number]
        parameters, table = self._parameters, self._table
        tiles = -(-len(columns) // self._tile)
        groups = min(GROUPS, tiles)
        lanes = self.device.lanes
        self._program.kernel("gradients")(
            groups * lanes,
            sample,
            columns.start,
            len(columns),
            encoder.stride,
            encoder.features,
            encoder.corner,
            encoder.weight,
            table.value,
            self._u,
            self._v,
            self._target,
            self._factor,
            self._weight,
            parameters.value,
            self._grid_gradient,
            self._partial,
            group=lanes,
        )
        self._steps += 1
        step = self._steps
        decay = 0.5 * (1.0 + math.cos(math.pi * min(step / total, 1.0)))
        adam = (
            settings.final_rate + (settings.rate - settings.final_rate) * decay,
            1.0 / (1.0 - settings.beta1**step),
            1.0 / (1.0 - settings.beta2**step),
            # A short memory at first, or the average would remember the random start.
            min(settings.average_decay, (1 + step) / (10 + step)),
        )
        entries = self._index.batches[number]
        self._program.kernel("adam")(
            self._partial.shape[1] // self.device.vector_width + len(entries),
            groups,
            entries.start,
            len(entries),
            *adam,
            self._partial,
            *parameters.arrays,
            self._loss,
            *self._index.arrays,
            self._grid_gradient,
            *table.arrays,
        )

    def _build(self) -> Program:
        description, settings, device = self._start.description, self.settings, self.device
        features = description.encoding.feature_count
        vec = device.vector_width
        feature_stride = -(-(features + 1) // vec) * vec
        rows = description.head_rows + description.base_rows
        hidden = min(settings.samples_a_step, self.samples) * sum(description.hidden)
        floats_a_column = features + feature_stride + 2 * rows + hidden + 1
        available = device.cl_device.local_mem_size
        budget = min(CPU_LOCAL_BYTES if device.lanes == 1 else LOCAL_BYTES, available)
        self._tile = vec
        while 8 * self._tile * floats_a_column <= budget and self._tile < MAX_TILE:
            self._tile *= 2
        if 4 * self._tile * floats_a_column > available:
            raise MemoryError(
                f"training hidden layers of {description.hidden} needs "
                f"{4 * self._tile * floats_a_column} bytes of local memory, but {device.name} has "
                f"{available}: use a narrower network or fewer modulated groups"
            )
        # Whole vectors, with room for the loss.
        padded = -(-(description.parameter_count + 1) // vec) * vec
        self._padding = padded - description.parameter_count
        defines = {
            **description.defines(),
            "TILE": self._tile,
            "SAMPLES_A_STEP": min(settings.samples_a_step, self.samples),
            "FEATURE_BLOCKS": feature_stride // vec,
            "PARTIAL_FLOATS": f"{padded}u",
            "AT_LOSS": description.parameter_count,
            "ADAM_BETA1": f"{settings.beta1!r}f",
            "ADAM_BETA2": f"{settings.beta2!r}f",
            "ADAM_EPSILON": f"{settings.epsilon!r}f",
            "NO_RAY": f"{NO_RAY}u",
        }
        return build(device, ("common", "surface", "encode", "batch", "mlp", "train"), defines)


class _Averaged:
    """A trained array on the device with Adam's moments and its moving average."""

    def __init__(self, device: Device, start: np.ndarray) -> None:
        self.value = HostArray.of(device, start)
        self.moment1 = HostArray.of(device, np.zeros_like(start))
        self.moment2 = HostArray.of(device, np.zeros_like(start))
        self.average = HostArray.of(device, start)

    @property
    def arrays(self) -> tuple[HostArray, HostArray, HostArray, HostArray]:
        return self.value, self.moment1, self.moment2, self.average


class GridIndex:
    """Which columns touch which table entry, for each minibatch: the hash grid's gather lists.

    Attributes
    ----------
    batches : list of range
        For each minibatch, its items in `entries` and `starts`.
    arrays : tuple of HostArray
        entries, starts, columns, weights as train.cl reads them.
    """

    def __init__(self, device: Device, encoder: Encoder, batches: list[range]) -> None:
        corner, weight = encoder.corner.read(), encoder.weight.read()
        entries, starts, columns, weights = [], [], [], []
        self.batches: list[range] = []
        touched = pairs = 0
        for batch in batches:
            part = slice(batch.start, batch.stop)
            flat = corner[:, part].ravel()
            order = np.argsort(flat, kind="stable")
            unique, first = np.unique(flat[order], return_index=True)
            entries.append(unique)
            starts.append((first + pairs).astype(np.uint32))
            columns.append((order % len(batch) + batch.start).astype(np.uint32))
            weights.append(weight[:, part].ravel()[order])
            self.batches.append(range(touched, touched + len(unique)))
            touched += len(unique)
            pairs += len(flat)
        starts.append(np.array([pairs], np.uint32))
        self.arrays = tuple(
            HostArray.of(device, np.concatenate(parts)) for parts in (entries, starts, columns, weights)
        )
