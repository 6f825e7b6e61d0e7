"""The one place that orders the stages: scene to image."""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .allocate import Allocation, allocate
from .auto import FIRST_SAMPLES, Prediction, predict
from .calibrate import calibrate, points_done_twice
from .choose import choose_device
from .density import Density, DensityNetwork, tabulate
from .device import Device, HostArray
from .encode import varying_inputs
from .estimate import Estimate, Estimator
from .image import Image, error_metrics
from .integrands import INTEGRANDS, Integrand
from .integrator import Integrator
from .learn import learn, learn_density
from .network import FoldedNetwork, Network
from .passes import Passes, Target, pass_edges
from .points import find_points
from .presets import PRESETS
from .report import metadata, statistics
from .resolve import resolve_image
from .sampler import Stream
from .samples import SampleSource
from .scene import Scene, load_scene
from .settings import RenderSettings, Stopwatch
from .trace import Tracer

# Samples a point on average drawn at a time; Ctrl-C, targets and progress act between such passes.
RESIDUAL_PASS = 128
# Plain Monte Carlo that allocates: samples a point that it first learns the points' variances from.
PILOT_SAMPLES = 64


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
    network: Network | str | Path | None = None,
    save_network: str | Path | None = None,
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
    integrand : {"ao", "direct"} or Integrand
        Ambient occlusion or direct light; an `Integrand` object carries options.
    method : {"auto", "ncv", "mc"}
        Neural control variate, plain Monte Carlo, or after a first pass of plain Monte Carlo whichever
        is predicted to reach the error of the latter sooner.
    sampler : {"sobol", "independent"}
        Owen-scrambled Sobol points (one scramble a shading point) or independent ones.
    spp : int
        Samples a shading point on average: of the residual for "ncv", of the integrand for "mc".
    train_spp : float or "auto"
        Training samples a shading point ("ncv"), on average: few samples a point are drawn as more of
        them at fewer points. "auto" draws about a million in all, at most `spp` / 4 a point. Their own
        estimate enters the image by its inverse variance.
    size : (int, int)
        Width and height, pixels.
    supersample : int
        k makes k × k shading points a pixel, averaged by a box filter.
    seed : int
        From 0 to 2**64 − 1. Same seed, device and scene: the same image, bit for bit.
    preset : {"default", "slides"}
        The network, its schedule and how it is used: what measured best, or the slides' own.
    density : {"table", "none"}, optional
        "ncv": sample the residual where a second network predicts that it is large, or uniformly. By
        default what the preset says.
    allocation : {"magnitude", "pilot", "uniform"}, optional
        How `spp` is spent over the image: "magnitude" gives points samples by their predicted residual
        ("ncv"), "pilot" by their variance in a quarter of the samples, at most 64 ("mc"). By default
        what the preset says for "ncv", "uniform" for "mc".
    target_mse, time_limit : float, optional
        End after the pass in which the image's mean square error is estimated to be this, or before the
        pass that would outlast so many seconds; `spp` is then the most that is drawn.
    network : Network, str or Path, optional
        A trained network, or its file, to use instead of training one ("ncv"). Only a file holds the
        density as well.
    save_network : str or Path, optional
        Where to write the trained network and its density, ``.npz``.
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
        networks that do not fit).
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
        target_mse, time_limit,
    )  # fmt: skip
    # Fails for scenes that do not suit the integrand before anything is traced.
    integrand.data(scene)
    learned = None
    if network is not None and not isinstance(network, Network):
        network, learned = Network.load(network), DensityNetwork.load(network)
    rendering = _Rendering(scene, settings, choose_device(device), threads, progress, stop, started)
    return rendering.run(network, learned, save_network, reference)


@dataclass(frozen=True)
class _ControlVariate:
    """What the network stage hands to the estimate.

    Attributes
    ----------
    folded : FoldedNetwork
    integral : ndarray
        float32 (channels, points), G of each active point.
    density : Density, optional
        Where the residual is.
    """

    folded: FoldedNetwork
    integral: np.ndarray
    density: Density | None


@dataclass(frozen=True)
class _Sampling:
    """Estimates under way.

    Attributes
    ----------
    passes : Passes
    targets : list of Target
        The estimate of all points, then that of the points done twice.
    twice : ndarray, optional
        Indices of the points done twice.
    prior : ndarray, optional
        As `calibrate` takes it.
    """

    passes: Passes
    targets: list[Target]
    twice: np.ndarray | None
    prior: np.ndarray | None

    def results(self) -> list[Estimate]:
        """Estimates so far: of f and, with a control variate, of f − g."""
        first = self.targets[0].estimator
        results = [first.result(quantity) for quantity in range(first.quantities)]
        if self.twice is None:
            return results
        second = self.targets[1].estimator
        return [
            calibrate(result, second.result(quantity), self.twice, self.prior)
            for quantity, result in enumerate(results)
        ]


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
        self.points_done_twice = 0
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
        self.source = SampleSource(
            device,
            scene,
            self.tracer,
            self.points,
            settings.integrand,
            settings.sampler,
            settings.seed,
            RESIDUAL_PASS,
        )

    def run(
        self,
        network: Network | None,
        density: DensityNetwork | None,
        save_network: str | Path | None,
        reference: np.ndarray | None,
    ) -> Image:
        settings, points = self.settings, self.points
        begun = None
        # Who wants a network gets one.
        if settings.method == "auto" and points.active and network is None and save_network is None:
            begun = self._begin_plain()
        variate = None
        if points.active and self._wants_network(network):
            variate = self._control_variate(network, density, save_network)
        if variate is None and begun is not None:
            plain, residual = self._finish(begun, first=1)
        else:
            plain, residual = self._finish(self._begin(self._allocate(variate), variate))
        by_count = None if PRESETS[settings.preset].density else float(settings.spp)
        with self.watch("resolve"):
            image = resolve_image(
                self.scene, settings.integrand, points, settings.size, settings.supersample,
                plain, self.before, residual, variate.integral if variate else None, by_count,
            )  # fmt: skip
        self._describe(image, plain, residual, variate)
        if reference is not None:
            image.stats |= error_metrics(image.pixels, reference)
        return image

    def _wants_network(self, network: Network | None) -> bool:
        if self.settings.method == "auto" and network is None and self.prediction is not None:
            return self.prediction.method == "ncv"
        return self.settings.method != "mc"

    def _describe(
        self,
        image: Image,
        plain: Estimate,
        residual: Estimate | None,
        variate: _ControlVariate | None,
    ) -> None:
        """Statistics and metadata."""
        rays, active = self.source.rays, self.points.active
        seconds = {**self.watch.seconds, "trace": rays.trace_seconds, "sample": rays.sample_seconds}
        image.stats = {"seconds": {**seconds, "total": time.perf_counter() - self.started}}
        image.stats |= statistics(
            self.points, rays, self.device, plain, self.before, residual,
            variate.folded.network if variate else None, self.points_done_twice,
        )  # fmt: skip
        image.stats["method"] = "ncv" if variate is not None else "mc"
        if self.prediction is not None:
            image.stats["auto"] = self.prediction.as_dict()
        drawn, before = (
            float(one.samples.mean()) if one is not None and active else 0.0
            for one in (plain, self.before)
        )
        image.metadata = metadata(self.scene, self.settings, self.device, drawn, before)

    # ---- the control variate -------------------------------------------------------------------------

    def _control_variate(
        self,
        network: Network | None,
        density: DensityNetwork | None,
        save_network: str | Path | None,
    ) -> _ControlVariate | None:
        """Train (or take) the networks, fold and integrate; None where training fails twice."""
        settings, device = self.settings, self.device
        inputs = varying_inputs(self.points, settings.integrand.inputs)
        trainer = None
        if network is None:
            learned = learn(
                device, self.scene, self.source, settings, inputs, self._factor, self.watch, self.stop
            )
            network, trainer = learned.network, learned.trainer
            # The first pass of "auto" has more samples than training.
            self.before = self.before or learned.estimate
        else:
            network.check_fits(settings.integrand.channels, inputs)
        if network is None:
            return None
        with self.watch("fold"):
            factor = self._factor(network.description.demodulated)
            folded = FoldedNetwork(device, network, self.points, factor)
        table = None
        if settings.uses_density or settings.allocates:
            with self.watch("density"):
                unit = self._unit()
                if trainer is not None:
                    density = learn_density(device, self.points, folded, trainer, unit)
                if density is not None:
                    table = tabulate(device, density, network, self.points, unit)
        if save_network is not None:
            network.save(save_network, **(density.arrays() if density is not None else {}))
        return _ControlVariate(folded, self._integrate(folded), table)

    def _factor(self, demodulated: bool) -> HostArray | None:
        """What a demodulated network's output is multiplied by at each point."""
        return self._unshadowed_means if demodulated else None

    def _unit(self) -> np.ndarray | None:
        """Each point's scale of residuals: its unshadowed mean over the channels, if it is known."""
        if not self.settings.integrand.demodulated:
            return None
        return self._unshadowed_means.read().mean(axis=0)

    @functools.cached_property
    def _unshadowed_means(self) -> HostArray:
        return self.source.unshadowed_means()

    def _integrate(self, folded: FoldedNetwork) -> np.ndarray:
        """G of every active point, float32 (channels, points)."""
        with self.watch("integrate"):
            description = folded.network.description
            integrator = Integrator(
                self.device,
                widths=(2, *description.hidden, description.channels),
                per_point_weights=folded.per_point[0],
                per_point_biases=folded.per_point[1],
            )
            integral = HostArray(self.device, (self.points.active, description.channels), np.float32)
            statistics = integrator.run(*folded.layers(), integral)
            if statistics.uncertified_points:
                warnings.warn(
                    f"{statistics.uncertified_points} exact integrals failed their certification",
                    stacklevel=5,
                )
            return integral.read().T

    # ---- samples -------------------------------------------------------------------------------------

    def _allocate(self, variate: _ControlVariate | None) -> Allocation:
        """How many samples each point gets."""
        settings = self.settings
        everything = Allocation.uniform(np.arange(self.points.active, dtype=np.uint32), settings.spp)
        if variate is not None and variate.density is not None and settings.allocates:
            return Allocation.of_counts(allocate(variate.density.magnitude, settings.spp))
        if settings.allocation != "pilot" or not self.points.active:
            return everything
        pilot = max(1, min(PILOT_SAMPLES, settings.spp // 4))
        estimator = Estimator(self.device, self.points, settings.integrand.channels)
        targets = [Target(estimator, Allocation.uniform(everything.chosen, pilot), Stream.TRAINING)]
        Passes(self.device, self.source, targets, [0, pilot], None, self.watch).run("pilot")
        self.before = estimator.result()
        # What the pilot did not see may still be there: no point is left to much fewer samples.
        fewest = 1 << (pilot.bit_length() - 1)
        deviation = np.sqrt(self.before.variance.sum(axis=0))
        return Allocation.of_counts(allocate(deviation, max(1, settings.spp - pilot), fewest))

    def _begin(
        self,
        allocation: Allocation,
        variate: _ControlVariate | None,
        first_pass: int | None = None,
    ) -> _Sampling:
        """Estimators of f and, with a control variate, of f − g, and the passes that fill them."""
        settings, points, device = self.settings, self.points, self.device
        folded, density = (variate.folded, variate.density) if variate else (None, None)
        channels = settings.integrand.channels
        targets = [Target(Estimator(device, points, channels, folded), allocation, Stream.RESIDUAL)]
        twice = None
        # Independent samples tell their variance themselves; others need points that are done twice.
        if points.active and settings.sampler != "independent":
            twice = points_done_twice(points.active, settings.seed)
            second = Estimator(device, points, channels, folded, twice)
            restricted = allocation.restricted(twice, points.active)
            targets.append(Target(second, restricted, Stream.CALIBRATION))
        table = density.table if density is not None and settings.uses_density else None
        prior = density.magnitude**2 if density is not None else None
        edges = pass_edges(settings.spp, RESIDUAL_PASS, first_pass or RESIDUAL_PASS)
        passes = Passes(device, self.source, targets, edges, table, self.watch)
        return _Sampling(passes, targets, twice, prior)

    def _begin_plain(self) -> _Sampling:
        """The first pass of plain Monte Carlo, and from it what is to be expected."""
        settings = self.settings
        everything = np.arange(self.points.active, dtype=np.uint32)
        sampling = self._begin(Allocation.uniform(everything, settings.spp), None, FIRST_SAMPLES)
        started = time.perf_counter()
        sampling.passes.run("first pass", self.progress, last=1)
        seconds = time.perf_counter() - started
        self.prediction = predict(
            self.device, sampling.targets[0].estimator.result(), seconds, settings.spp
        )
        if self.prediction.method == "ncv":
            self.before = sampling.results()[0]
        return sampling

    def _finish(self, sampling: _Sampling, first: int = 0) -> tuple[Estimate, Estimate | None]:
        """Draw the passes from `first` on, until a target is met; estimates of f and of f − g."""
        settings = self.settings
        passes_began = time.perf_counter()

        def enough() -> bool:
            nonlocal passes_began
            now = time.perf_counter()
            last, passes_began = now - passes_began, now
            if settings.time_limit is not None and now + last - self.started > settings.time_limit:
                return True
            if settings.target_mse is not None:
                variance = sampling.results()[-1].variance_of_mean
                pixels = settings.size[0] * settings.size[1]
                # Errors of a pixel's points are independent; channels of one are all three.
                error = float(variance.mean(axis=0).sum()) / (pixels * settings.supersample**4)
                if error <= settings.target_mse:
                    return True
            return self.stop()

        if self.points.active:
            sampling.passes.run("render", self.progress, enough, first)
        self.points_done_twice = 0 if sampling.twice is None else len(sampling.twice)
        results = sampling.results()
        return results[0], results[1] if len(results) > 1 else None
