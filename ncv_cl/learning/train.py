"""Training: minibatches of stored samples, fixed-order gradients, Adam and a moving average."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..host.clock import CHECKED_STEPS
from ..network.encode import Encoder, TouchedTable
from ..network.grid_index import GridIndex
from ..network.network import Network
from ..network.padded import Averaged, PaddedLayout
from ..opencl.device import Device
from ..opencl.layout import Record
from ..opencl.memory import HostArray
from ..opencl.program import Program, build
from ..points.points import ShadingPoints
from ..points.sampler import HostStream, host_generator
from ..sampling.samples import ray_defines
from ..settings.schedule import Schedule
from ..visibility.room import Batch
from . import tuning
from .step_shape import PARTIAL_SUMS, StepShape

# A step: the first of its samples, its columns, its work-groups, and its entries of the grid's index.
PLAN = Record(
    "PLAN",
    dict.fromkeys(("sample", "first", "count", "groups", "first_entry", "end_entry"), 1),
    np.uint32,
)
# A step's sizes, Adam's corrections of its moments, and the share that the moving average keeps.
RATES = Record("RATE", dict.fromkeys(("network", "table", "correction1", "correction2", "average"), 1))


def minibatches(count: int, columns: int) -> list[range]:
    """`count` columns cut into runs of about `columns`, of whole tiles of CPUs but for the last.

    If a run ended one column into a tile, one thread would do that tile while the others wait.
    """
    width = min(tuning.CPU_TILE, columns)
    tiles = -(-count // width)
    edges = np.linspace(0, tiles, max(1, round(count / columns)) + 1).astype(int) * width
    return [range(a, b) for a, b in itertools.pairwise(np.minimum(edges, count).tolist())]


@dataclass(frozen=True)
class TrainingSamples:
    """The samples that a `Trainer` holds, one column a shading point.

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
    settings : Schedule
    chosen : ndarray
        uint32, the shading points that have training samples, in the order in which they are drawn.
    samples : int
        Samples that `store` will be given for each of them.
    seed : int
        Shuffles the points into minibatches.
    factor : HostArray, optional
        float32 (channels, points.active), what a demodulated network's output is multiplied by.
    previous : Trainer, optional
        A trainer of a network of the same description on other samples. This one starts from its
        parameters and their moments, and not from `network`. The learning rate starts anew, as in
        stochastic gradient descent with warm restarts (Loshchilov and Hutter 2017), and so do the grid's
        moments, whose memory is short.
    """

    def __init__(
        self,
        device: Device,
        network: Network,
        points: ShadingPoints,
        settings: Schedule,
        chosen: np.ndarray,
        samples: int,
        seed: int,
        factor: HostArray | None = None,
        previous: Trainer | None = None,
    ) -> None:
        self.device = device
        self.settings = settings
        self.samples = samples
        self._start = network
        # Adam's steps so far, and those before this trainer's schedule.
        self._steps: int = previous._steps if previous else 0
        self._begun = self._steps
        self._scale: float = previous._scale if previous else 1.0
        description = network.description
        count = len(chosen)
        generator = host_generator(seed, HostStream.MINIBATCHES)
        shuffled = generator.permutation(count).astype(np.uint32)
        position = np.empty_like(shuffled)
        position[shuffled] = np.arange(count, dtype=np.uint32)
        self._position = HostArray.of(device, position)
        order = chosen[shuffled]
        self._order = HostArray.of(device, order)
        self._encoder = Encoder(device, description.encoding, points, network.cube, self._order)
        self._batches = minibatches(count, settings.batch)
        self._index = GridIndex.of(self._encoder, description.encoding, self._batches)

        self._layout = PaddedLayout(description, device.vector_width)
        self._parameters: Averaged
        if previous is not None:
            self._parameters, table = previous._parameters, previous._table.read()
        else:
            self._parameters = Averaged(device, self._layout.pack(network.parameters))
            table = network.table
        moments = 2 * description.encoding.grid_features if settings.table_adam else 2
        self._table: TouchedTable = TouchedTable(device, table, self._index.touched, moments)
        self._shape = StepShape.of(device, description, self._layout, settings, samples)
        self._program = self._build()
        self._gradients, self._adam = (self._program.own_kernel(n) for n in ("gradients", "adam"))
        groups = [self._shape.groups(len(batch)) for batch in self._batches]
        self._gradient_items = [(n + self._shape.idle_groups) * self._shape.group for n in groups]
        blocks = self._layout.size // device.vector_width
        self._adam_items = [
            blocks + -(-len(entries) // device.vector_width) for entries in self._index.batches
        ]
        self._partial = HostArray(device, (PARTIAL_SUMS, self._layout.size), np.float32)
        self._partial.fill(0.0)
        self._loss = HostArray(device, 1, np.float32)
        stride, channels = self._encoder.stride, description.channels
        largest = max(map(len, self._batches))
        self._grid_gradient = HostArray(device, (largest, description.encoding.grid_rows), np.float32)
        self._u = HostArray(device, (samples, stride), np.float32)
        self._v = HostArray(device, (samples, stride), np.float32)
        self._target = HostArray(device, (samples, channels, stride), np.float32)
        self._factor = HostArray(device, (channels, stride), np.float32)
        self._weight = HostArray(device, (channels, stride), np.float32)
        self._set_factors(None if factor is None else factor.read()[:, order])
        if previous is not None and factor is None:
            self._set_factors(np.full((channels, count), self._scale, np.float32))

    def _set_factors(self, factor: np.ndarray | None) -> None:
        """Set the factors of all columns and the weights; without factors `fit` sets a common one."""
        count, power = self._encoder.count, self.settings.weight_power
        self._has_factors = factor is not None
        if factor is None:
            return
        mean = float(factor.mean(dtype=np.float64)) or 1.0
        for array, values in ((self._factor, factor), (self._weight, (factor / mean) ** power)):
            with array.mapped(write=True) as view:
                view[:, :count], view[:, count:] = values, 0.0

    def store(self, batch: Batch, first_sample: int) -> None:
        """Keep a batch: samples number `first_sample` and on of its points."""
        self._program.kernel("store_samples")(
            len(batch.points) * batch.stride // self.device.vector_width,
            first_point=batch.points.start,
            point_count=len(batch.points),
            sample_count=batch.samples,
            batch_stride=batch.stride,
            stride=self._encoder.stride,
            first_row=first_sample,
            position=self._position,
            batch_u=batch.u,
            batch_v=batch.v,
            value=batch.value,
            slot=batch.slot,
            visible=batch.visible,
            u=self._u,
            v=self._v,
            target=self._target,
        )

    def fit(self, parts: int = 1, check: Callable[[], None] | None = None) -> float:
        """Train all epochs on the stored samples, as one of `parts` such calls; returns the mean loss.

        The loss is the last minibatch's, averaged over the last epoch. `check` is called now and then,
        and may raise.
        """
        if not self._has_factors:
            self._set_common_factor()
        settings = self.settings
        step = min(settings.samples_a_step, self.samples)
        starts = range(0, self.samples - step + 1, step)
        numbers = range(len(self._batches))
        order = [(sample, n) for _ in range(settings.epochs) for sample in starts for n in numbers]
        self._bind(*self._plan(order, parts * len(order)))
        losses = []
        for number, (_, batch) in enumerate(order):
            self._gradients.repeat(number, self._gradient_items[batch], self._shape.group)
            self._adam.repeat(number, self._adam_items[batch])
            if check is not None and number % CHECKED_STEPS == 0:
                self.device.queue.finish()
                check()
            if batch == numbers[-1] and number >= len(order) - len(starts) * len(numbers):
                losses.append(float(self._loss.read()[0]))
        self._steps += len(order)
        return float(np.mean(losses))

    def network(self) -> Network:
        """The network with the moving averages of its parameters, in the integrand's own units."""
        description = self._start.description
        parameters = self._layout.unpack(self._parameters.average.read())
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
        return Network(description, parameters, self._table.read(), self._start.cube)

    def samples_of(self, network: Network) -> TrainingSamples:
        """The samples stored last, with the features that `network`, a result of this training, gets."""
        self._encoder.encode_grid(HostArray.of(self.device, network.table))
        return TrainingSamples(self._order, self._u, self._v, self._target, self._encoder)

    def _set_common_factor(self) -> None:
        """Take the integrand's mean magnitude as every factor: losses do not depend on the units."""
        count = self._encoder.count
        with self._target.mapped() as target:
            mean = float(np.mean(np.abs(target[:, :, :count]), dtype=np.float64))
        self._scale = mean if mean > 0.0 else 1.0
        channels = self._start.description.channels
        self._set_factors(np.full((channels, count), self._scale, np.float32))

    def _plan(self, order: list[tuple[int, int]], total: int) -> tuple[HostArray, HostArray]:
        """The kernels' plan and rates, a row for each step of `order`, (first sample, minibatch)."""
        settings = self.settings
        sample, batch = np.array(order).T
        columns = np.array([(b.start, len(b)) for b in self._batches])[batch]
        entries = np.array([(e.start, e.stop) for e in self._index.batches])[batch]
        groups = np.array([self._shape.groups(count) for count in columns[:, 1].tolist()])
        plan = PLAN.pack(
            sample=sample,
            first=columns[:, 0],
            count=columns[:, 1],
            groups=groups,
            first_entry=entries[:, 0],
            end_entry=entries[:, 1],
        )
        step = self._steps + 1.0 + np.arange(len(order))
        decay = 0.5 * (1.0 + np.cos(math.pi * np.minimum((step - self._begun) / total, 1.0)))
        rate = settings.final_rate + (settings.rate - settings.final_rate) * decay
        rates = RATES.pack(
            network=rate,
            table=rate * settings.table_rate,
            correction1=1.0 / (1.0 - settings.beta1**step),
            correction2=1.0 / (1.0 - settings.beta2**step),
            # A short memory at first, or the average would remember the random start.
            average=np.minimum(settings.average_decay, (1 + step) / (10 + step)),
        )
        return HostArray.of(self.device, plan), HostArray.of(self.device, rates)

    def _bind(self, plan: HostArray, rates: HostArray) -> None:
        """Set the arguments of a step's two kernels."""
        encoder, index, parameters = self._encoder, self._index, self._parameters
        self._gradients.bind(
            plan=plan,
            stride=encoder.stride,
            features=encoder.features,
            unit=encoder.unit,
            corner=index.corner,
            table=self._table.state,
            all_u=self._u,
            all_v=self._v,
            all_targets=self._target,
            factor=self._factor,
            weights=self._weight,
            parameters=parameters.value,
            grid_gradient=self._grid_gradient,
            partial=self._partial,
        )
        self._adam.bind(
            plan=plan,
            rates=rates,
            partial=self._partial,
            **parameters.arrays,
            loss=self._loss,
            **index.arrays,
            grid_gradient=self._grid_gradient,
            table=self._table.state,
        )
        # The kernels do not keep these arrays alive, so this object does.
        self._bound = plan, rates

    def _build(self) -> Program:
        description, settings, shape = self._start.description, self.settings, self._shape
        defines = {
            **description.defines(),
            **self._layout.defines(),
            **PLAN.defines(),
            **RATES.defines(),
            **shape.defines,
            "ENTRY_FLOATS": f"{self._table.entry_floats}u",
            "SAMPLES_A_STEP": min(settings.samples_a_step, self.samples),
            "ADAM_BETA1": f"{settings.beta1!r}f",
            "ADAM_BETA2": f"{settings.beta2!r}f",
            "TABLE_BETA2": f"{settings.table_beta2!r}f",
            "TABLE_ADAM": int(settings.table_adam),
            "ADAM_EPSILON": f"{settings.epsilon!r}f",
            **ray_defines(),
        }
        files = ("common", "surface", "encode", "batch", "mlp", shape.file, "store", "adam")
        return build(self.device, files, defines)
