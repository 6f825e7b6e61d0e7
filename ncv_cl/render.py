"""The one place that orders the stages: scene to image."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .allocate import Allocation, allocate
from .auto import Prediction
from .checkpoint import Checkpoint
from .choose import choose_device
from .density import DensityNetwork
from .device import Device, HostArray
from .encode import GridCube, varying_inputs
from .estimate import Estimate
from .estimation import Estimation
from .first_pass import first_samples, predict_from_first_pass, predict_without
from .guide import Guide
from .image import Image, error_metrics
from .integrands import INTEGRANDS, Integrand
from .learn import learn
from .network import Network
from .passes import pass_edges
from .paths import sample_source
from .pilot import allocate_by_pilot, draw_pilot
from .points import ShadingPoints, find_points
from .presets import PRESETS
from .report import identity, metadata, seconds_of, skips, statistics
from .resolve import resolve_image
from .scene import Scene, load_scene
from .settings import RenderSettings, Stopwatch
from .shaft import Occluders
from .trace import Tracer
from .variate import ControlVariate, control_variate, idle

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
        pass that would outlast so many seconds; `spp` is then the most that is drawn.
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
    if not isinstance(scene, Scene):
        scene = load_scene(scene)
    if isinstance(integrand, str):
        if integrand not in INTEGRANDS:
            raise ValueError(f"integrand must be one of {', '.join(INTEGRANDS)}, got {integrand!r}")
        integrand = INTEGRANDS[integrand]()
    settings = RenderSettings(
        integrand, method, sampler, spp, train_spp, size, supersample, seed, preset, density, allocation,
        target_mse, time_limit, skip_dark, visibility,
    )  # fmt: skip
    # Fails for scenes that do not suit the integrand before anything is traced.
    integrand.data(scene)
    learned, given_network = None, network is not None
    if network is not None and not isinstance(network, Network):
        network, learned = Network.load(network), DensityNetwork.load(network)
    device = choose_device(device)
    asked = identity(scene, settings, device, given_network)
    resumed = Checkpoint.load(resume) if resume is not None else None
    if resumed is not None:
        resumed.check(asked)
        network, learned = resumed.network, resumed.density
    rendering = _Rendering(scene, settings, device, threads, progress, stop, started)
    rendering.keep = _Keep(checkpoint, asked, resumed)
    return rendering.run(network, learned, save_network, reference)


@dataclass(frozen=True)
class _Keep:
    """Where to keep checkpoints, under which identity, and the one to go on from."""

    path: str | Path | None
    identity: dict[str, object]
    resumed: Checkpoint | None


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
        # What was sampled before the estimate proper, and what was predicted from it.
        self.before: Estimate | None = None
        self.prediction: Prediction | None = None
        self.guide: Guide | None = None
        self.points_done_twice = 0
        # How the network was trained, if it was.
        self.training: dict[str, object] = {}
        self.keep = _Keep(None, {}, None)
        with self.watch("scene"):
            self.tracer = Tracer(scene, threads)
        with self.watch("points"):
            self.points = find_points(
                device,
                scene,
                self.tracer,
                *settings.size,
                settings.supersample,
                settings.integrand.emitters_active,
            )
            self.points = self._without_dark(self.points)
        occluders = None
        if settings.integrand.to_lights and settings.visibility == "auto" and self.points.active:
            with self.watch("shafts"):
                occluders = Occluders(device, scene, self.points, settings.integrand)
        self.source = sample_source(
            device,
            scene,
            self.tracer,
            self.points,
            settings.integrand,
            settings.sampler,
            settings.seed,
            RESIDUAL_PASS,
            occluders,
            shadows_tested=settings.visibility == "auto",
        )

    def _without_dark(self, points: ShadingPoints) -> ShadingPoints:
        """Points that cannot see a light are left out; all others keep their samples either way."""
        dark = self.settings.integrand.dark(self.scene, points)
        if dark is None:
            return points
        points = points.with_dark_last(dark)
        return points.without_last(int(dark.sum())) if self.settings.skip_dark else points

    def run(
        self,
        network: Network | None,
        density: DensityNetwork | None,
        save_network: str | Path | None,
        reference: np.ndarray | None,
    ) -> Image:
        settings, points, resumed = self.settings, self.points, self.keep.resumed
        begun = None
        if resumed is not None:
            self.before = resumed.before
            self.prediction = Prediction(**resumed.prediction) if resumed.prediction else None
            if resumed.guide is not None:
                self.guide = resumed.guide
                self.source.use_guide(resumed.guide)
        elif settings.method == "auto" and points.active and network is None and save_network is None:
            # Who wants a network gets one; else the first pass decides.
            self.prediction = predict_without(
                self.device, points.active, self.source.occluders, settings
            )
            if self.prediction is None:
                begun = self._begin_plain()
        variate = None
        if points.active and self._wants_network(network):
            variate = self._control_variate(network, density, save_network)
        asked = self.prediction is not None and self.prediction.first_pass
        allocation = None
        if variate is not None or begun is None:
            first_pass = first_samples(settings) if asked and variate is None else None
            allocation = self._allocate(variate)
            begun = self._begin(allocation, variate, first_pass)
        first = 1 if asked and variate is None else 0
        if resumed is not None:
            first = resumed.passes
            begun.restore(resumed.states, resumed.parts, first)
        self._draw(begun, variate, first)
        integral, used = (variate.integral, variate.folded.network) if variate else (None, None)
        skipped = self._skipped(variate, allocation)
        # Of many points, folded weights and densities are most of the memory, and no longer needed.
        del variate
        plain, residual = begun.end()
        by_count = None if PRESETS[settings.preset].density else float(settings.spp)
        with self.watch("resolve"):
            image = resolve_image(
                self.scene, settings.integrand, points, settings.size, settings.supersample,
                plain, self.before, residual, integral, by_count,
            )  # fmt: skip
        self._describe(image, plain, residual, used)
        image.stats["skipped"] = skipped
        if reference is not None:
            image.stats |= error_metrics(image.pixels, reference)
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
        save_network: str | Path | None,
    ) -> ControlVariate | None:
        """Train (or take) the networks, fold and integrate; None where training fails twice."""
        settings, device = self.settings, self.device
        inputs = varying_inputs(self.points, settings.integrand.inputs)
        learned = None
        if network is None:
            guided = settings.guides
            if guided:
                self.source.record_guide()
            learned = learn(
                device,
                GridCube.of_points(self.points, self.scene.world_bounds),
                self.source,
                settings,
                inputs,
                self._factor,
                self.watch,
                self.stop,
            )
            network, self.training = learned.network, learned.statistics
            if guided:
                with self.watch("guide"):
                    self.guide = self.source.learn_guide()
            # The first pass of "auto", if there was one, and training have samples of their own.
            self.before = (
                learned.estimate if self.before is None else self.before.merged(learned.estimate)
            )
        else:
            network.check_fits(settings.integrand.channels, inputs)
        if network is None:
            return None
        return control_variate(
            device,
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
            save_network,
        )

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
            self.before = draw_pilot(self.device, self.source, settings, self.watch)
        return allocate_by_pilot(self.before, settings.spp)

    def _begin(
        self,
        allocation: Allocation,
        variate: ControlVariate | None,
        first_pass: int | None = None,
    ) -> Estimation:
        settings = self.settings
        edges = pass_edges(settings.spp, RESIDUAL_PASS, first_pass)
        folded, density = (variate.folded, variate.density) if variate else (None, None)
        return Estimation(
            self.device, self.source, settings, allocation, edges, folded, density, self.watch
        )

    def _begin_plain(self) -> Estimation:
        """The first pass of plain Monte Carlo, and from it what is to be expected."""
        everything = np.arange(self.points.active, dtype=np.uint32)
        allocation = Allocation.uniform(everything, self.settings.spp)
        estimation = self._begin(allocation, None, first_samples(self.settings))
        self.prediction = predict_from_first_pass(
            self.device, self.source, self.settings, estimation, self.watch, self.progress
        )
        if self.prediction.method == "ncv":
            self.before = estimation.results()[0]
        return estimation

    def _draw(self, estimation: Estimation, variate: ControlVariate | None, first: int) -> None:
        """Draw the passes from `first` on, until a target is met."""
        settings = self.settings
        began, done = time.perf_counter(), first
        self._write_checkpoint(estimation, variate, done)

        def enough() -> bool:
            nonlocal began, done
            done += 1
            self._write_checkpoint(estimation, variate, done)
            now = time.perf_counter()
            last, began = now - began, now
            if settings.time_limit is not None and now + last - self.started > settings.time_limit:
                return True
            target = settings.target_mse
            return (target is not None and estimation.image_error() <= target) or self.stop()

        if self.points.active:
            estimation.passes.run("render", self.progress, enough, first)
        self.points_done_twice = len(estimation.twice)

    def _write_checkpoint(
        self, estimation: Estimation, variate: ControlVariate | None, passes: int
    ) -> None:
        if self.keep.path is None:
            return
        with self.watch("checkpoint"):
            Checkpoint(
                self.keep.identity,
                "mc" if variate is None else "ncv",
                passes,
                estimation.states(),
                self.before,
                variate.folded.network if variate else None,
                variate.learned if variate else None,
                self.prediction.as_dict() if self.prediction else None,
                variate.alpha if variate else None,
                estimation.parts,
                self.guide,
            ).save(self.keep.path)
