"""The one place that orders the stages: scene to image."""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..estimation.allocate import Allocation, allocate
from ..estimation.auto import Prediction
from ..estimation.control_variate import ControlVariate, control_variate, idle
from ..estimation.first_pass import first_samples, predict_from_first_pass, predict_without
from ..estimation.image_estimate import ImageEstimate
from ..estimation.passes import edges_of
from ..estimation.pilot import allocate_by_pilot, draw_pilot
from ..estimation.stopping import ErrorTarget, Stopping
from ..host.clock import NO_TIME, UNLIMITED, Clock, OutOfTime
from ..host.files import check_paths
from ..integrands import INTEGRANDS, Integrand
from ..learning.density import DensityNetwork
from ..learning.learn import Learned, learn
from ..network.encode import GridCube, varying_inputs
from ..network.network import Network
from ..opencl.choose import choose_device
from ..opencl.device import Device, HostArray
from ..output.checkpoint import Checkpoint
from ..output.image import Image, checked_reference
from ..output.keep import Keep
from ..output.report import about_values, identity, metadata, seconds_of, skips, statistics
from ..output.resolve import resolve_image
from ..sampling.accumulate import Estimate
from ..sampling.guide import Guide
from ..scene.load import Scene, load_scene
from ..settings.presets import PRESETS
from ..settings.settings import RenderSettings, Stopwatch
from .prepare import prepare

# Samples a point on average drawn at a time; Ctrl-C, targets and progress act between such passes.
RESIDUAL_PASS = 128


def render(
    scene: Scene | str | Path,
    integrand: str | Integrand = "direct",
    method: str = "ncv",
    sampler: str = "sobol",
    spp: int = 256,
    train_spp: float | str = "auto",
    size: tuple[int, int] = (512, 512),
    supersample: int = 1,
    seed: int = 0,
    preset: str = "default",
    density: str | None = None,
    allocation: str | None = None,
    target_mse: float | None = None,
    time_limit: float | None = None,
    skip_dark: bool = True,
    visibility: str = "auto",
    network: Network | str | Path | None = None,
    save_network: str | Path | None = None,
    checkpoint: str | Path | None = None,
    resume: str | Path | None = None,
    device: Device | int | str | None = None,
    threads: int | None = None,
    reference: np.ndarray | None = None,
    progress: bool = False,
    stop: Callable[[], bool] | None = None,
) -> Image:
    """Render an image of a scene.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, or the path of its TOML file.
    integrand : {"ao", "direct", "gi"} or Integrand
        Ambient occlusion, direct light or global illumination; an `Integrand` object carries options.
    method : {"auto", "ncv", "mc"}
        Neural control variate, plain Monte Carlo, or after a first pass of plain Monte Carlo whichever
        is predicted to reach the error of the latter sooner.
    sampler : {"sobol", "independent"}
        Owen-scrambled Sobol points (one scramble a shading point) or independent ones.
    spp : int
        Samples a shading point on average: of the residual for "ncv", of the integrand for "mc".
    train_spp : float or "auto"
        Training samples a shading point ("ncv"), on average: few samples a point are drawn as more of
        them at fewer points. "auto" draws rounds, each as many as all before, until what the next one is
        predicted to take off the residual's variance at points held out would not pay for it: from 2^18
        in all to 2^21, at most `spp` / 4 a point (half a million where guided paths learn from them
        too, and for the slides' preset). Their own estimate enters the image by its inverse variance.
    size : (int, int)
        Width and height, pixels.
    supersample : int
        k makes k × k shading points a pixel, averaged by a box filter.
    seed : int
        From 0 to 2**64 − 1. Same seed, device and scene: the same image, bit for bit.
    preset : {"default", "wide", "slides"}
        The network, its schedule and how it is used: what measured best in time to error, the same with
        twice as many neurons a layer, or the slides' own.
    density : {"table", "subdivision", "none"}, optional
        "ncv": sample the residual where a second network predicts that it is large, constant on 8 × 8
        cells or linear on the triangles that the control variate's first layer cuts the square into, or
        uniformly. By default what the preset says.
    allocation : {"magnitude", "pilot", "uniform"}, optional
        How `spp` is spent over the image: "magnitude" gives points samples by their predicted residual
        ("ncv"), "pilot" by their variance in a quarter of the samples, at most 64 ("mc"). By default
        what the preset says for "ncv", "uniform" for "mc".
    target_mse, time_limit : float, optional
        End after the pass in which the image's mean square error is estimated to be this, or before the
        pass that would outlast so many seconds; `spp` is then the most that is drawn. An error is
        believed only when thousands of the image's samples are to be expected on each light. Under a
        time limit passes are short, and training ends in time; what no limit can interrupt is one such
        pass, and the compilation of kernels that the driver has not kept. Bits then depend on the clock.
    skip_dark : bool
        Leave out points that face away from every light. False computes their zeros, to compare.
    visibility : {"auto", "embree"}
        Points between which and the lights few triangles can stand test their shadow rays against these
        on the device, and so do the bounces of global illumination in scenes of few triangles; or leave
        all to embree. Pixels differ only where a ray grazes an edge.
    network : Network, str or Path, optional
        A trained network, or its file, to use instead of training one ("ncv"). Only a file holds the
        density as well. Control coefficients belong to the image they were found for, and are 1 here.
    save_network : str or Path, optional
        Where to write the trained network and its density, ``.npz``.
    checkpoint : str or Path, optional
        Written after training and after every pass; a process that is killed loses one pass at most.
    resume : str or Path, optional
        A checkpoint to go on from, to the bits that a render without interruption would have had. All
        else must be as it was, but for targets and threads.
    device : Device, int or str, optional
        As `choose_device` takes it.
    threads : int, optional
        Host threads that trace rays; all cores by default.
    reference : ndarray, optional
        float (height, width, 3); adds `mse` and `relmse` to the statistics.
    progress : bool
        Draw a progress bar where standard error is a terminal.
    stop : callable, optional
        Asked between passes; True ends rendering with the passes done so far.

    Returns
    -------
    Image

    Raises
    ------
    ValueError
        For bad arguments (`SceneError` for scenes, `IntegrandError` for integrands, `NetworkError` for
        networks that do not fit, `CheckpointError` for checkpoints of other renders).
    DeviceError
        If there is no such OpenCL device.
    """
    started = time.perf_counter()
    check_paths({"checkpoint": checkpoint, "save_network": save_network})
    if not isinstance(scene, Scene):
        scene = load_scene(scene)
    if isinstance(integrand, str):
        if integrand not in INTEGRANDS:
            raise ValueError(f"integrand must be one of {', '.join(INTEGRANDS)}, got {integrand!r}")
        integrand = INTEGRANDS[integrand]()
    if not isinstance(integrand, Integrand):
        raise ValueError(f"integrand must be a name or an Integrand, got {integrand!r}")
    settings = RenderSettings(
        integrand, method, sampler, spp, train_spp, size, supersample, seed, preset, density, allocation,
        target_mse, time_limit, skip_dark, visibility,
    )  # fmt: skip
    # Fails for scenes that do not suit the integrand before anything is traced.
    integrand.check(scene)
    if reference is not None:
        reference = checked_reference(reference, settings.size)
    if method == "mc" and (network is not None or save_network is not None):
        raise ValueError("plain Monte Carlo has no network to use or to save: take method ncv or auto")
    learned = None
    if network is not None and not isinstance(network, Network):
        network, learned = Network.load(network), DensityNetwork.load(network)
    device = choose_device(device)
    asked = identity(scene, settings, device, network)
    resumed = Checkpoint.load(resume) if resume is not None else None
    if resumed is not None:
        resumed.check(asked)
        network, learned = resumed.network, resumed.density
    rendering = _Rendering(scene, settings, device, threads, progress, stop, started)
    rendering.keep = Keep(checkpoint, save_network, asked, resumed)
    return rendering.run(network, learned, reference)


class _Rendering:
    """One call of `render`: the stages in their order, and what they share."""

    def __init__(
        self,
        scene: Scene,
        settings: RenderSettings,
        device: Device,
        threads: int | None,
        progress: bool,
        stop: Callable[[], bool] | None,
        started: float,
    ) -> None:
        self.scene = scene
        self.settings = settings
        self.device = device
        self.watch = Stopwatch()
        self.stop = stop or (lambda: False)
        self.progress = progress
        self.started = started
        self.clock = Clock(settings.time_limit, started)
        # Why drawing ended.
        self.ended_by = "samples"
        # What was sampled before the estimate proper, and what was predicted from it.
        self.before: Estimate | None = None
        self.first_pass: Estimate | None = None
        self.prediction: Prediction | None = None
        self.guide: Guide | None = None
        self.points_done_twice = 0
        # How the network was trained, if it was.
        self.training: dict[str, object] = {}
        self.keep = Keep(None, None, {}, None)
        self.points, self.source = prepare(device, scene, settings, threads, RESIDUAL_PASS, self.watch)

    def run(
        self,
        network: Network | None,
        density: DensityNetwork | None,
        reference: np.ndarray | None,
    ) -> Image:
        settings, points, resumed = self.settings, self.points, self.keep.resumed
        begun = None
        if resumed is not None:
            needs_density = settings.uses_density or settings.allocates
            resumed.check_arrays(settings.integrand.channels, points.active, needs_density)
            self.before = resumed.before
            self.prediction = Prediction(**resumed.prediction) if resumed.prediction else None
            if resumed.guide is not None:
                self.guide = resumed.guide
                self.source.use_guide(resumed.guide)
        elif settings.method == "auto" and points.active and network is self.keep.network is None:
            # Who wants a network gets one; else the first pass decides.
            self.prediction = predict_without(
                self.device, points.active, self.source.occluders, settings, self.clock
            )
            if self.prediction is None:
                begun = self._begin_plain()
        variate = None
        if points.active and self._wants_network(network):
            variate = self._control_variate(network, density)
        if variate is None:
            self.keep.note_no_network()
        asked = self.prediction is not None and self.prediction.first_pass
        allocation = None
        if variate is not None or begun is None:
            first_pass = first_samples(settings) if asked and variate is None else None
            allocation = self._allocate(variate)
            begun = self._begin(allocation, variate, first_pass)
        if resumed is not None:
            begun.restore(resumed.states, resumed.parts, resumed.passes)
        self._draw(begun, variate)
        integral, used = (variate.integral, variate.folded.network) if variate else (None, None)
        skipped = self._skipped(variate, allocation)
        # Of many points, folded weights and densities are most of the memory, and no longer needed.
        del variate
        plain, residual = begun.end()
        by_count = not PRESETS[settings.preset].density
        with self.watch("resolve"):
            image = resolve_image(
                self.scene, settings.integrand, points, settings.size, settings.supersample,
                plain, self.before, residual, integral, float(settings.spp), by_count,
            )  # fmt: skip
        self._describe(image, plain, residual, used)
        image.stats["skipped"] = skipped
        about_values(image, reference)
        return image

    def _wants_network(self, network: Network | None) -> bool:
        if self.keep.resumed is not None:
            return self.keep.resumed.method == "ncv"
        if self.settings.method == "auto" and network is None and self.prediction is not None:
            return self.prediction.method == "ncv"
        return self.settings.method != "mc"

    def _describe(
        self,
        image: Image,
        plain: Estimate,
        residual: Estimate | None,
        network: Network | None,
    ) -> None:
        """Statistics and metadata."""
        image.stats = {
            "seconds": seconds_of(self.watch, self.source.rays, time.perf_counter() - self.started)
        }
        image.stats |= statistics(
            self.points, self.source.rays, self.device, plain, self.before, residual,
            network, self.points_done_twice,
        )  # fmt: skip
        if self.training:
            image.stats["training"] = self.training
        if self.prediction is not None:
            image.stats["auto"] = self.prediction.as_dict()
        image.stats["ended_by"] = self.ended_by
        if self.keep.not_written:
            image.stats["not_written"] = self.keep.not_written
        drawn = (plain, self.before) if self.points.active else (None, None)
        image.metadata = metadata(self.scene, self.settings, self.device, *drawn)

    def _skipped(
        self, variate: ControlVariate | None, allocation: Allocation | None
    ) -> dict[str, object]:
        """What the scene did not need."""
        inputs = self.settings.integrand.inputs
        found = skips(self.points, self.source.rays, inputs, varying_inputs(self.points, inputs))
        if variate is not None:
            found |= idle(variate, self.points.active)
        if allocation is not None:
            found |= allocation.converged()
        return found

    # ---- the control variate -------------------------------------------------------------------------

    def _control_variate(
        self,
        network: Network | None,
        density: DensityNetwork | None,
    ) -> ControlVariate | None:
        """Train (or take) the networks, fold and integrate; None where that fails, or time is up."""
        settings = self.settings
        inputs = varying_inputs(self.points, settings.integrand.inputs)
        learned = None
        if network is None:
            learned = self._learn(inputs)
            network = learned.network
        else:
            network.check_fits(settings.integrand.channels, inputs)
        if network is None:
            return None
        try:
            variate = control_variate(
                self.device,
                self.points,
                settings,
                network,
                self.watch,
                learned,
                density,
                self.keep.resumed.alpha if self.keep.resumed is not None else None,
                settings.size[0] * settings.supersample,
                self._factor(network.description.demodulated),
                self._unit(),
                functools.partial(self.keep.save_network, network),
                # What was begun before is gone on with as it was.
                self.clock if self.keep.resumed is None else UNLIMITED,
            )
        except OutOfTime:
            warnings.warn(NO_TIME, stacklevel=4)
            return None
        # The first pass of "auto" and training have samples of their own.
        if self.first_pass is not None:
            self.before = self.first_pass.merged(self.before)
        return variate

    def _learn(self, inputs: tuple[str, ...]) -> Learned:
        """Train the network, and what guides paths with it."""
        settings = self.settings
        if settings.guides:
            self.source.record_guide()
        learned = learn(
            self.device,
            GridCube.of_points(self.points, self.scene.world_bounds),
            self.source,
            settings,
            inputs,
            self._factor,
            self.watch,
            self.stop,
            self.clock,
        )
        self.training, self.before = learned.statistics, learned.estimate
        if settings.guides:
            with self.watch("guide"):
                self.guide = self.source.learn_guide()
        return learned

    def _factor(self, demodulated: bool) -> HostArray | None:
        """What a demodulated network's output is multiplied by at each point."""
        return self._unshadowed_means if demodulated else None

    def _unit(self) -> np.ndarray | None:
        """Each point's scale of residuals: its unshadowed mean over the channels, if it is known."""
        settings = self.settings
        if not settings.integrand.demodulated or not (settings.uses_density or settings.allocates):
            return None
        return self._unshadowed_means.read().mean(axis=0)

    @functools.cached_property
    def _unshadowed_means(self) -> HostArray:
        return self.source.unshadowed_means()

    # ---- samples -------------------------------------------------------------------------------------

    def _allocate(self, variate: ControlVariate | None) -> Allocation:
        """How many samples each point gets."""
        settings = self.settings
        if variate is not None and variate.density is not None and settings.allocates:
            return Allocation.of_counts(allocate(variate.density.magnitude, settings.spp))
        if settings.allocation != "pilot" or not self.points.active:
            return Allocation.uniform(np.arange(self.points.active, dtype=np.uint32), settings.spp)
        if self.before is None:
            self.before = draw_pilot(self.device, self.source, settings, self.watch, self.clock)
        return allocate_by_pilot(self.before, settings.spp)

    def _begin(
        self,
        allocation: Allocation,
        variate: ControlVariate | None,
        first_pass: int | None = None,
    ) -> ImageEstimate:
        settings = self.settings
        done = None if self.keep.resumed is None else self.keep.resumed.edges
        edges = edges_of(settings, self.points.active, RESIDUAL_PASS, first_pass, done)
        folded, density = (variate.folded, variate.density) if variate else (None, None)
        return ImageEstimate(
            self.device, self.source, settings, allocation, edges, folded, density, self.watch
        )

    def _begin_plain(self) -> ImageEstimate:
        """The first pass of plain Monte Carlo, and from it what is to be expected."""
        everything = np.arange(self.points.active, dtype=np.uint32)
        allocation = Allocation.uniform(everything, self.settings.spp)
        image_estimate = self._begin(allocation, None, first_samples(self.settings))
        self.prediction = predict_from_first_pass(
            self.device,
            self.source,
            self.settings,
            image_estimate,
            self.watch,
            self.clock,
            self.progress,
        )
        if self.prediction.method == "ncv":
            self.first_pass = image_estimate.results()[0]
        return image_estimate

    def _draw(self, image_estimate: ImageEstimate, variate: ControlVariate | None) -> None:
        """Draw the passes that are not done, until a target is met."""
        settings, passes = self.settings, image_estimate.passes
        uniform = variate.density.uniform_share if variate and image_estimate.follows_density else 1.0
        target = ErrorTarget(settings.target_mse, self.scene, settings.integrand, uniform)
        self._write_checkpoint(image_estimate, variate)
        if settings.time_limit is not None and self.points.active:
            with self.watch("compile"):
                image_estimate.warm_up(self.source)
        stopping = Stopping(image_estimate, target, self.clock, self.stop)

        def enough(done: int) -> bool:
            self._write_checkpoint(image_estimate, variate)
            return stopping.enough(done)

        if image_estimate.done and self.clock.over():
            stopping.ended_by = "time_limit"
        elif self.points.active:
            passes.run("render", self.progress, enough, image_estimate.done)
        self.ended_by = stopping.ended_by
        self.points_done_twice = len(image_estimate.twice)

    def _write_checkpoint(self, image_estimate: ImageEstimate, variate: ControlVariate | None) -> None:
        with self.watch("checkpoint"):
            prediction = self.prediction.as_dict() if self.prediction else None
            self.keep.write(image_estimate, self.before, variate, prediction, self.guide)
