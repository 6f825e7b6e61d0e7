"""The parent's side of a render on other machines: what it tells workers, and what it puts together."""

from __future__ import annotations

import functools
import itertools
import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from ...estimation.control_variate import ControlVariate
from ...estimation.image_estimate import ImageEstimate
from ...estimation.passes import Edges, Passes, Target
from ...host.clock import Run
from ...machines.crew import Crew, Job
from ...machines.values import Values
from ...points.arrays import PointArrays
from ...points.groups import BLOCK_POINTS
from ...sampling.callable import CallableSource
from ...sampling.guide import Guide
from ...sampling.problem import Problem
from ...scene.load import Scene
from ...settings.options import Machine
from ...settings.settings import Settings
from .spec import EstimateSpec, ProblemSpec, Request, TileData, TileResult, this_build
from .tile import BENCHES, OWN_DEVICES, Learned, draw_tile
from .travel import TravellingIntegrand

# Samples of a task: seconds of a core, a hundred times what it takes to send, to set up and to return
# one. Paths take longer.
SAMPLES_A_TASK, PATHS_A_TASK = 1 << 22, 1 << 21
# Points of a task: enough for whole batches; few enough for their memory, and for a few tasks a worker.
FEWEST_POINTS, MOST_POINTS, FEWEST_TASKS = 1 << 10, 1 << 16, 16
# Of the time between two checkpoints within a step, that of writing one is at most this part.
CHECKPOINT_SHARE = 1 / 16


class Carrier:
    """Draws a problem's passes by the workers of an executor.

    Parameters
    ----------
    executor : Executor
    machine : Machine
    run : Run
    problem : Problem
    scene : Scene, optional
    given : PointArrays, optional
        Points that are not a camera's.
    """

    def __init__(
        self,
        executor: Executor,
        machine: Machine,
        run: Run,
        problem: Problem,
        scene: Scene | None = None,
        given: PointArrays | None = None,
    ) -> None:
        self.values = Values(machine.shared)
        self.crew = Crew(executor, self.values, machine.task_limit, run.stop)
        self.run, self._machine = run, machine
        self._problem, self._scene, self._given = problem, scene, given
        # Those of the plan, which `take` brings.
        self._settings: Settings
        self._spec = ""
        self._keys: tuple[str, ...] = ()
        self._alpha: np.ndarray | None = None
        # What makes the passes of an estimate.
        self.passes: Callable[..., Passes] = Passes
        # Writes a checkpoint, once there is something to be kept.
        self.save: Callable[[], None] = lambda: None
        self._saved, self._save_seconds = time.perf_counter(), 0.0
        self.devices: dict[str, list[tuple[int, int]]] = {}

    def take(self, settings: Settings, variate: ControlVariate | None, guide: Guide | None) -> None:
        """Take what is to be known before the first pass; `settings` are those of the plan.

        Raises
        ------
        CannotTravel
            For an integrand or a function that cannot be sent.
        """
        problem, put = self._problem, self.values.put
        device, source = problem.device, problem.source
        keys: dict[str, str | None] = {"scene": None, "learned": None, "function": None}
        if self._scene is not None:
            # What is computed from the scene on the way is not sent.
            keys["scene"] = put(replace(self._scene), "the scene")
        elif isinstance(source, CallableSource):
            keys["function"] = put(source.function, "f")
        if variate is not None or guide is not None:
            network = variate.folded.network if variate else None
            density = variate.density_network if variate else None
            keys["learned"] = put(Learned(network, density, guide), "the network")
            self._alpha = variate.alpha if variate else None
        self._settings = settings
        spec = ProblemSpec(
            TravellingIntegrand.of(settings.integrand),
            None if self._scene is None else settings.integrand.digest(self._scene),
            settings.method,
            settings.spp,
            settings.size,
            settings.seed,
            settings.sampling,
            replace(settings.training, network=None),
            problem.decisions,
            source.offset if isinstance(source, CallableSource) else None,
            None if self._given is None else self._given.is_sensor,
            this_build(),
            device.identity,
            device.shape,
            (device.vector_width, device.lanes, device.use_fma),
            self._machine.mixed_devices,
            self._machine.threads,
            **keys,
        )
        self._spec = put(spec, "the problem")
        self._keys = (self._spec, *(key for key in keys.values() if key is not None))
        OWN_DEVICES[self._spec] = device

    def step_end(self, done: int, last: int, apart: bool) -> int:
        """The pass up to which tasks may go on after pass `done` without anything being asked."""
        stopping = self._settings.stopping
        if stopping.target_mse is not None or stopping.time_limit is not None:
            return done + 1
        if self._problem.apart is None or apart:
            return last
        # Direct light is compared with the rest at powers of two.
        return min(last, 1 << done.bit_length())

    def results(
        self,
        image_estimate: ImageEstimate,
        targets: list[Target],
        edges: Edges,
        apart: bool,
        step: tuple[int, int],
    ) -> Iterator[tuple[range, TileResult]]:
        """Points and what has come of them, in the order in which workers return them."""
        wanted = image_estimate.begin_step(*step)
        allocation = targets[0].allocation
        streams, grouped = [target.stream for target in targets], allocation.grouped > 0
        found = EstimateSpec(
            apart,
            [int(one) for one in edges],
            allocation.at_once,
            image_estimate.twice,
            streams,
            grouped,
        )
        estimate = self.values.put(found, "the estimate")
        counts = np.zeros(self._problem.points.active, np.int64)
        counts[allocation.chosen] = allocation.counts
        share = (edges[step[1]] - edges[step[0]]) / edges[-1]
        ahead = image_estimate.ahead
        if ahead is None:
            raise RuntimeError("no step of passes has begun")
        tiles = self._tiles(ahead, float(counts.mean()) * share, grouped)

        def jobs() -> Iterator[Job]:
            for tile in tiles:
                states = None
                if step[0] > 0:
                    states = [one.part(tile) for one in image_estimate.accumulators]
                own = self._own(tile, counts, None if apart else self._alpha).pack()
                request = Request(
                    self._spec, estimate, tile.start, tile.stop, *step, wanted, own, states
                )
                name = f"the task of points {tile.start} to {tile.stop - 1}"
                yield Job(name, draw_tile, (*self._keys, estimate), (request,))

        for job, answer in self.crew.run(jobs()):
            (request,) = job.arguments
            result = answer.result
            self.devices.setdefault(result.device, []).append((request.begin, request.end))
            yield range(request.begin, request.end), result

    def _tiles(self, ahead: np.ndarray, samples: float, grouped: bool) -> list[range]:
        """The points that are not `ahead`, cut into tasks; `samples` a point of each.

        Where points are `grouped`, tasks are of whole blocks, which begin where the first point does.
        """
        total, size = len(ahead), self._machine.task_points
        if size is None:
            by_samples = PATHS_A_TASK if self._settings.integrand.nested else SAMPLES_A_TASK
            size = min(int(by_samples / max(samples, 1.0)), MOST_POINTS, -(-total // FEWEST_TASKS))
            size = max(size, FEWEST_POINTS)
        if grouped:
            size = -(-size // BLOCK_POINTS) * BLOCK_POINTS
        # Cells increase but where what is done last begins.
        cells, ends = self._problem.points.cell[:total], {0, total}
        if self._has_cells:
            ends |= set((np.flatnonzero(cells[1:] < cells[:-1]) + 1).tolist())
        ends |= set((np.flatnonzero(ahead[1:] != ahead[:-1]) + 1).tolist())
        cuts = sorted(ends)
        return [
            range(first, min(first + size, end))
            for begin, end in itertools.pairwise(cuts)
            if not ahead[begin]
            for first in range(begin, end, size)
        ]

    @property
    def _has_cells(self) -> bool:
        return self._scene is not None and self._given is None

    def _own(self, tile: range, counts: np.ndarray, alpha: np.ndarray | None) -> TileData:
        """What belongs to a task's points alone."""
        own, points = slice(tile.start, tile.stop), self._problem.points
        each = counts[own]
        few = int(each[0]) if (each == each[0]).all() else each
        steps = vectors = None
        if self._has_cells:
            steps = np.diff(points.cell[own], prepend=np.uint32(0))
        elif self._given is not None:
            rows = self._rows[own]
            given = (self._given.positions, self._given.normals, self._given.outgoing)
            vectors = tuple(one[rows] for one in given)
        else:
            vectors = (np.ascontiguousarray(self._positions[:, own].T),)
        return TileData(few, None if alpha is None else alpha[:, own], steps, vectors)

    @functools.cached_property
    def _rows(self) -> np.ndarray:
        """Which of the points given each shading point is, int64 (points.total,)."""
        if self._given is None:
            raise RuntimeError("the points are a camera's")
        order = np.argsort(self._given.cells, kind="stable")
        return order[np.searchsorted(self._given.cells, self._problem.points.cell, sorter=order)]

    @functools.cached_property
    def _positions(self) -> np.ndarray:
        """Of the points of a function of the user, float32 (3, points.total)."""
        return self._problem.points.rows("position")

    def is_apart(self, problem: Problem) -> bool:
        """Whether a problem is the one of direct light apart."""
        return self._problem.apart is not None and problem.source is self._problem.apart.source

    def save_now_and_then(self) -> None:
        """Write a checkpoint, if it takes a small part of the time since the last one."""
        now = time.perf_counter()
        if (now - self._saved) * CHECKPOINT_SHARE > self._save_seconds:
            self.save_now()

    def save_now(self) -> None:
        """Write a checkpoint."""
        now = time.perf_counter()
        self.save()
        self._saved = time.perf_counter()
        self._save_seconds = self._saved - now

    def statistics(self) -> dict[str, object]:
        """What workers did and were sent, for an image's statistics."""
        tasks = {device: len(found) for device, found in self.devices.items()}
        return self.crew.statistics() | {"tasks_by_device": tasks}

    def metadata(self) -> str:
        """Each task's device: JSON of the points of tasks, first and last, by device."""
        found = {
            device: [[first, last - 1] for first, last in sorted(ranges)]
            for device, ranges in self.devices.items()
        }
        return json.dumps(found, separators=(",", ":"))

    def close(self) -> None:
        """Let go of what the render held."""
        OWN_DEVICES.pop(self._spec, None)
        BENCHES.pop(self._spec, None)
        self.values.close()
        self.crew.close()
