"""Training: minibatches of stored samples, fixed-order gradients, Adam and a moving average."""

from __future__ import annotations

import itertools
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
# Rows of partial sums; fixed, so that the order of additions does not depend on the device's size.
GROUPS = 64


@dataclass(frozen=True)
class TrainSettings:
    """The schedule.

    Attributes
    ----------
    batch : int
        Training points a minibatch, about; each takes one sample, then one Adam step follows.
    rate, beta1, beta2, epsilon : float
        Adam's step size and constants.
    average_decay : float
        Weight of the past in the moving average of all parameters; the average is what is used.
    """

    batch: int = 1024
    rate: float = 1e-2
    beta1: float = 0.9
    beta2: float = 0.99
    epsilon: float = 1e-8
    average_decay: float = 0.99


class Trainer:
    """Trains one network on samples of one image's shading points.

    Parameters
    ----------
    device, network, points
        The network to start from and the points it is trained at.
    settings : TrainSettings
    samples_held : int
        The most samples a point that `store` will be given before `fit`.
    seed : int
        Shuffles the points into minibatches.
    """

    def __init__(
        self,
        device: Device,
        network: Network,
        points: ShadingPoints,
        settings: TrainSettings,
        samples_held: int,
        seed: int,
    ) -> None:
        self.device = device
        self.settings = settings
        self._start = network
        self._steps = 0
        self._scale = 0.0
        description = network.description
        count = points.active
        generator = np.random.Generator(np.random.Philox([seed, 1]))
        order = generator.permutation(count).astype(np.uint32)
        position = np.empty_like(order)
        position[order] = np.arange(count, dtype=np.uint32)
        self._position = HostArray.of(device, position)
        self._encoder = Encoder(
            device, description.encoding, points, network.cube, HostArray.of(device, order)
        )
        batches = max(1, round(count / settings.batch))
        edges = np.linspace(0, count, batches + 1).astype(int)
        self._batches = [range(a, b) for a, b in itertools.pairwise(edges)]
        self._index = GridIndex(device, self._encoder, self._batches)

        self._program = self._build()
        self._parameters = _Averaged(device, network.parameters)
        self._table = _Averaged(device, network.table)
        self._partial = HostArray(device, (GROUPS, description.parameter_count + 1), np.float32)
        self._loss = HostArray(device, 1, np.float32)
        stride = self._encoder.stride
        self._grid_gradient = HostArray(device, (description.encoding.grid_rows, stride), np.float32)
        self._u = HostArray(device, (samples_held, stride), np.float32)
        self._v = HostArray(device, (samples_held, stride), np.float32)
        self._target = HostArray(device, (samples_held, description.channels, stride), np.float32)

    def store(self, batch: Batch) -> None:
        """Keep a batch's samples for `fit`, in training order."""
        self._program.kernel("store_samples")(
            len(batch.points) * batch.stride // self.device.vector_width,
            batch.points.start,
            len(batch.points),
            batch.samples,
            batch.stride,
            self._encoder.stride,
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

    def fit(self, samples: int) -> float:
        """One pass over the `samples` stored samples of every point; returns the last step's loss."""
        if self._scale == 0.0:
            self._scale = self._find_scale(samples)
        for sample in range(samples):
            for number in range(len(self._batches)):
                self._step(sample, number)
        return float(self._loss.read()[0])

    def network(self) -> Network:
        """The network with the moving averages of its parameters, in the integrand's own units."""
        description = self._start.description
        parameters = self._parameters.average.read()
        views = description.unpack(parameters)
        if self._scale > 0.0:
            views["W3"][...] /= self._scale
            views["B3"][...] /= self._scale
        return Network(description, parameters, self._table.average.read(), self._start.cube)

    def _find_scale(self, samples: int) -> float:
        """1 over the integrand's mean, so that rates and losses do not depend on the scene's units."""
        with self._target.mapped(count=samples) as target:
            mean = float(np.mean(target[:, :, : self._encoder.count], dtype=np.float64))
        return 1.0 / mean if mean > 0.0 else 1.0

    def _step(self, sample: int, number: int) -> None:
        settings, encoder, columns = self.settings, self._encoder, self._batches[number]
        encoder.encode_grid(self._table.value, columns.start, len(columns))
        place = (columns.start, len(columns), encoder.stride)
        tiles = -(-len(columns) // self._tile)
        groups = min(GROUPS, tiles)
        lanes = self.device.lanes
        self._program.kernel("gradients")(
            groups * lanes,
            sample,
            *place,
            self._scale,
            encoder.features,
            self._u,
            self._v,
            self._target,
            self._parameters.value,
            self._grid_gradient,
            self._partial,
            group=lanes,
        )
        self._steps += 1
        step = self._steps
        adam = (
            settings.rate,
            1.0 / (1.0 - settings.beta1**step),
            1.0 / (1.0 - settings.beta2**step),
            # A short memory at first, or the average would remember the random start.
            min(settings.average_decay, (1 + step) / (10 + step)),
        )
        parameters, table = self._parameters, self._table
        self._program.kernel("adam_network")(
            self._partial.shape[1], groups, *adam, self._partial, *parameters.arrays, self._loss
        )
        entries = self._index.batches[number]
        self._program.kernel("adam_grid")(
            len(entries),
            entries.start,
            len(entries),
            encoder.stride,
            *adam,
            *self._index.arrays,
            self._grid_gradient,
            *table.arrays,
        )

    def _build(self) -> Program:
        description, settings = self._start.description, self.settings
        floats = 2 * sum(description.hidden) + description.channels + 1
        step = self.device.lanes * self.device.vector_width
        self._tile = max(step, LOCAL_BYTES // (4 * floats) // step * step)
        defines = {
            **description.defines(),
            "TILE": self._tile,
            "PARTIAL_FLOATS": description.parameter_count + 1,
            "AT_LOSS": description.parameter_count,
            "ADAM_BETA1": f"{settings.beta1!r}f",
            "ADAM_BETA2": f"{settings.beta2!r}f",
            "ADAM_EPSILON": f"{settings.epsilon!r}f",
            "NO_RAY": f"{NO_RAY}u",
        }
        return build(self.device, ("common", "batch", "mlp", "train"), defines)


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
