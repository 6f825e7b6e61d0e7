"""A worker's part of a render: the problem of a few points, and the passes of a task."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...estimation.allocate import Allocation
from ...estimation.draw import grouped_allocation
from ...estimation.image_estimate import warp_of
from ...estimation.passes import Passes, Target
from ...host.clock import Stopwatch
from ...learning.alpha import scale
from ...learning.density import Density, DensityNetwork, tabulate
from ...machines.worker import local_rank, worker_threads
from ...network.fold import FoldedNetwork
from ...network.network import Network
from ...opencl.choose import all_devices, choose_device, device_is_chosen
from ...opencl.device import Device, DeviceError, open_device
from ...points.arrays import PointArrays, place_points
from ...points.points import ShadingPoints, find_points
from ...points.trace import Tracer
from ...sampling.accumulate import Accumulator
from ...sampling.callable import CallableSource, Function, function_points
from ...sampling.guide import Guide
from ...sampling.problem import Problem
from ...scene.load import Scene
from ...settings.settings import Settings
from ...visibility.hierarchy import Hierarchy
from ...visibility.shaft import Occluders
from ...visibility.slices import Slices
from ...visibility.trace import DeviceTracer
from ..prepare import assemble, traces_on_device
from .spec import EstimateSpec, ProblemSpec, Request, TileData, TileResult, device_line, this_build


class OtherDevice(DeviceError):
    """A worker would work on a device whose bits differ from the parent's."""


@dataclass(frozen=True)
class Learned:
    """What training has left: the control variate's networks, and what guides bounces."""

    network: Network | None
    density_network: DensityNetwork | None
    guide: Guide | None


class Bench:
    """What a worker keeps for the tasks of one problem, made when it is first needed.

    Parameters
    ----------
    spec : ProblemSpec
    scene : Scene, optional
        None for functions of the user.
    device : Device, optional
        The parent's own, where this is a thread of it.
    """

    def __init__(self, spec: ProblemSpec, scene: Scene | None, device: Device | None) -> None:
        if spec.build != this_build():
            raise RuntimeError(
                f"this worker has ncv_cl {this_build()[0]} with other kernels or numbers than the "
                f"parent, which has {spec.build[0]}: install the same on all machines"
            )
        self.spec, self.scene = spec, scene
        self.device = device or device_like(spec)
        integrand = spec.integrand.make()
        if scene is not None and integrand.digest(scene) != spec.integrand_digest:
            raise RuntimeError(
                f"this worker's class {type(integrand).__name__} differs from the parent's: install the "
                "same on all machines"
            )
        self.settings = Settings(
            integrand, spec.method, spec.spp, spec.size, spec.seed, spec.sampling, spec.training
        )
        self._idle: list[Problem] = []
        self._lock = threading.Lock()
        if scene is None:
            return
        self.tracer = Tracer(scene, worker_threads(spec.threads))
        decided = spec.decisions
        on_device = traces_on_device(self.device, scene, self.settings)
        needed = on_device or decided.most_occluders
        self.hierarchy = Hierarchy(self.device, scene) if needed else None
        self.rays: Tracer | DeviceTracer = self.tracer
        if on_device and self.hierarchy is not None:
            self.rays = DeviceTracer(self.device, self.hierarchy)
        self.slices = Slices(self.device, scene) if decided.sliced else None

    @contextmanager
    def problem(
        self, points: ShadingPoints, function: Function | None, apart: bool
    ) -> Iterator[Problem]:
        """The problem of some points, or of their direct light apart; tasks take turns with memory."""
        occluders = self._occluders(points) if apart == self.spec.decisions.split else None
        with self._lock:
            made = self._idle.pop() if self._idle else None
        if made is None:
            made = self._assembled(points, function)
        source = made.apart.source if apart and made.apart is not None else made.source
        source.move_to(points, occluders)
        yield replace(made, points=points, source=source, apart=None, glow=None)
        with self._lock:
            self._idle.append(made)

    def _assembled(self, points: ShadingPoints, function: Function | None) -> Problem:
        """A problem with what it needs of memory."""
        spec, settings, decided = self.spec, self.settings, self.spec.decisions
        if self.scene is None:
            if function is None:
                raise RuntimeError("a task without a scene needs a function")
            channels, sampler = settings.integrand.channels, settings.sampling.sampler
            source = CallableSource(self.device, points, function, channels, sampler, spec.seed)
            if spec.offset is not None:
                source.offset = spec.offset
            return Problem(self.device, points, source, np.zeros((2, 3)), ("position",), is_image=False)
        return assemble(
            self.device,
            self.scene,
            self.rays,
            settings,
            points,
            self.scene.world_bounds,
            self._occluders(points),
            self.slices,
            decided.lines,
            decided.split,
        )

    def _occluders(self, points: ShadingPoints) -> Occluders | None:
        if self.scene is None or self.spec.decisions.most_occluders is None:
            return None
        room, kept = self.spec.decisions.most_occluders
        integrand = self.settings.integrand
        return Occluders(self.device, self.scene, points, integrand, room, self.hierarchy, kept)

    def points(self, begin: int, own: TileData) -> ShadingPoints:
        """A task's shading points, the first of which is `begin` in the whole image."""
        if self.scene is None and own.vectors is not None:
            return replace(function_points(self.device, own.vectors[0]), first_id=begin)
        if self.scene is None:
            raise RuntimeError("a task without a scene needs positions")
        if own.vectors is not None:
            position, normal, outgoing = own.vectors
            count = len(position)
            cells = np.arange(count, dtype=np.uint32)
            is_sensor = bool(self.spec.sensors)
            given = PointArrays(position, normal, outgoing, cells, (count, 1), is_sensor)
            active = self.settings.integrand.emitters_active
            return replace(
                place_points(self.device, self.scene, self.tracer, given, active), first_id=begin
            )
        if own.steps is None:
            raise RuntimeError("a task of a camera's points needs their sub-pixels")
        settings = self.settings
        cells = np.cumsum(own.steps, dtype=np.uint32)
        size, supersample = settings.size, settings.sampling.supersample
        active = settings.integrand.emitters_active
        found = find_points(
            self.device, self.scene, self.tracer, *size, supersample, active, chosen=cells
        )
        return replace(found, first_id=begin)


# This process's benches, by the digest of their problem.
BENCHES: dict[str, Bench] = {}
_LOCK = threading.Lock()
# Benches that a process keeps: of the render under way, and of those that take turns with it.
MOST_BENCHES = 4


def bench_of(values: Mapping[str, Any], key: str) -> Bench:
    """This process's bench for a problem."""
    with _LOCK:
        if key not in BENCHES:
            spec: ProblemSpec = values[key]
            scene = None if spec.scene is None else values[spec.scene]
            made = Bench(spec, scene, OWN_DEVICES.get(key))
            while len(BENCHES) >= MOST_BENCHES:
                del BENCHES[next(iter(BENCHES))]
            BENCHES[key] = made
        return BENCHES[key]


# Devices of renders in this process, by the digest of their problem: threads work on these.
OWN_DEVICES: dict[str, Device] = {}


def device_like(spec: ProblemSpec) -> Device:
    """This process's device for a problem.

    It is one like the parent's, in the same shape; of several, the one of this process's number on its
    machine. Where devices may be mixed, or there is none, a variable of the environment chooses, as for
    all that is done here.

    Raises
    ------
    OtherDevice
        If it is another one than the parent's, and mixed devices are not allowed.
    """
    alike = [one for one in all_devices() if one.identity == spec.device]
    if alike and not (spec.mixed and device_is_chosen()):
        one = alike[local_rank() % len(alike)]
        return open_device(one.cl_device, one.index, *spec.widths)
    device = choose_device()
    if not spec.mixed and device_line(device) != f"{spec.device}, {spec.shape}":
        raise OtherDevice(
            f"a worker's device is {device_line(device)}, the parent's {spec.device}, {spec.shape}: "
            "their bits may differ. Choose the same on all machines by NCV_CL_DEVICE, or allow "
            "mixed_devices"
        )
    return device


def draw_tile(values: Mapping[str, Any], request: Request) -> TileResult:
    """Draw the passes of a task."""
    bench = bench_of(values, request.spec)
    estimate: EstimateSpec = values[request.estimate]
    spec, watch = bench.spec, Stopwatch()
    learned = Learned(None, None, None)
    if spec.learned is not None:
        learned = values[spec.learned]
    function: Function | None = values[spec.function] if spec.function is not None else None
    own = TileData.unpack(request.own)
    with watch("points"):
        points = bench.points(request.begin, own)
    with bench.problem(points, function, estimate.apart) as problem:
        folded = density = warp = None
        if not estimate.apart:
            if learned.guide is not None:
                problem.paths.use_guide(learned.guide)
            with watch("fold"):
                folded, density = _control_variate(problem, bench.settings, learned, own.alpha)
        if density is not None and folded is not None:
            warp = warp_of(bench.device, bench.settings.residual_density, folded, density)
        settings = bench.settings if estimate.grouped else None
        targets = _targets(problem, estimate, request, own, folded, settings)
        means: list[np.ndarray] = []

        def keep(done: int) -> None:
            if done in request.wanted:
                means.append(targets[0].accumulator.means())

        passes = Passes(problem, targets, estimate.edges, warp, watch, keep)
        passes.run("", first=request.first, last=request.last)
        states = [one.accumulator.state() for one in targets]
    return TileResult(
        device_line(bench.device),
        [(state, samples.astype(np.uint32)) for state, samples in states],
        means,
        problem.source.rays,
        watch.seconds,
    )


def _control_variate(
    problem: Problem, settings: Settings, learned: Learned, alpha: np.ndarray | None
) -> tuple[FoldedNetwork | None, Density | None]:
    """The control variate of the points, as `control_variate` makes it of a trained network."""
    network, points = learned.network, problem.points
    if network is None:
        return None, None
    folded = FoldedNetwork(
        problem.device, network, points, problem.factor(network.description.demodulated)
    )
    if alpha is not None:
        scale(folded, alpha)
    if learned.density_network is None or not settings.needs_magnitude:
        return folded, None
    # The magnitude is the parent's; here only the densities' shapes count.
    return folded, tabulate(problem.device, learned.density_network, network, points)


def _targets(
    problem: Problem,
    estimate: EstimateSpec,
    request: Request,
    own: TileData,
    folded: FoldedNetwork | None,
    grouped_by: Settings | None,
) -> list[Target]:
    """The estimates to be drawn, with what earlier passes have left.

    Parameters
    ----------
    grouped_by : Settings, optional
        Those by which the points share paths, if they do.
    """
    points = problem.points
    counts = np.broadcast_to(np.asarray(own.counts, np.int64), points.active)
    if grouped_by is None:
        order = np.argsort(counts, kind="stable").astype(np.uint32)
        order = order[counts[order] > 0]
        whole = Allocation(order, counts[order], estimate.at_once)
    else:
        whole = grouped_allocation(problem, grouped_by, folded is not None, int(own.counts))
    first, last = np.searchsorted(estimate.twice, (request.begin, request.end))
    twice = estimate.twice[first:last] - np.uint32(request.begin)
    targets = []
    for number, stream in enumerate(estimate.streams):
        allocation = whole if number == 0 else whole.restricted(twice, points.active)
        chosen = None if number == 0 else twice
        accumulator = Accumulator(problem.device, points, problem.source.channels, folded, chosen)
        if request.states is not None:
            accumulator.restore(*request.states[number])
        targets.append(Target(accumulator, allocation, stream))
    return targets
