"""The one place that orders the stages: scene to image."""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .allocate import Allocation, allocate
from .calibrate import calibrate, points_done_twice
from .choose import choose_device
from .density import Density, DensityTrainer, tabulate
from .device import Device, HostArray
from .encode import GridCube, varying_inputs
from .estimate import Estimate, Estimator
from .image import Image, error_metrics
from .integrands import INTEGRANDS, Integrand
from .integrator import Integrator
from .network import FoldedNetwork, Network, NetworkDescription
from .passes import Passes, Target
from .points import find_points
from .presets import PRESETS
from .report import metadata, statistics
from .resolve import resolve_image
from .sampler import Stream
from .samples import SampleSource
from .scene import Scene, load_scene
from .settings import RenderSettings, Stopwatch
from .trace import Tracer
from .train import Trainer, TrainSettings

# Samples a point on average drawn at a time; Ctrl-C and progress act between such passes.
RESIDUAL_PASS = 128
TRAINING_PASS = 16
# `train_spp` "auto": samples in all, since a network's need depends on the scene and not on pixels.
AUTO_TRAINING_SAMPLES = 1 << 20
# Training samples held at a time.
TRAINING_SAMPLES_HELD = 1 << 23
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
    method : {"ncv", "mc"}
        Neural control variate, or plain Monte Carlo.
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
    network : Network, str or Path, optional
        A trained network, or its file, to use instead of training one ("ncv").
    save_network : str or Path, optional
        Where to write the trained network, ``.npz``.
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
        integrand, method, sampler, spp, train_spp, size, supersample, seed, preset, density, allocation
    )
    # Fails for scenes that do not suit the integrand before anything is traced.
    integrand.data(scene)
    if network is not None and not isinstance(network, Network):
        network = Network.load(network)
    rendering = _Rendering(scene, settings, choose_device(device), threads, progress, stop)
    return rendering.run(network, save_network, reference, started)


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
    ) -> None:
        self.scene = scene
        self.settings = settings
        self.device = device
        self.watch = Stopwatch()
        self.stop = stop or (lambda: False)
        self.progress = progress
        self.training: Estimate | None = None
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
        save_network: str | Path | None,
        reference: np.ndarray | None,
        started: float,
    ) -> Image:
        settings, points = self.settings, self.points
        variate = None
        if settings.method == "ncv" and points.active:
            variate = self._control_variate(network, save_network)
        allocation = self._allocate(variate)
        plain, residual = self._estimate(allocation, variate)
        by_count = None if PRESETS[settings.preset].density else float(settings.spp)
        with self.watch("resolve"):
            image = resolve_image(
                self.scene, settings.integrand, points, settings.size, settings.supersample,
                plain, self.training, residual, variate.integral if variate else None, by_count,
            )  # fmt: skip
        rays = self.source.rays
        seconds = {**self.watch.seconds, "trace": rays.trace_seconds, "sample": rays.sample_seconds}
        image.stats = {"seconds": {**seconds, "total": time.perf_counter() - started}}
        image.stats |= statistics(
            points, rays, self.device, plain, self.training, residual,
            variate.folded.network if variate else None, self.points_done_twice,
        )  # fmt: skip
        if reference is not None:
            image.stats |= error_metrics(image.pixels, reference)
        drawn, trained = (
            float(one.samples.mean()) if one is not None and points.active else 0.0
            for one in (plain, self.training)
        )
        image.metadata = metadata(self.scene, settings, self.device, drawn, trained)
        return image

    # ---- the control variate -------------------------------------------------------------------------

    def _control_variate(
        self, network: Network | None, save_network: str | Path | None
    ) -> _ControlVariate | None:
        """Train (or take) a network, fold and integrate it; None where training fails twice."""
        settings = self.settings
        inputs = varying_inputs(self.points, settings.integrand.inputs)
        trainer = None
        if network is None:
            network, trainer = self._train(inputs)
        else:
            network.check_fits(settings.integrand.channels, inputs)
        if network is None:
            return None
        if save_network is not None:
            network.save(save_network)
        with self.watch("fold"):
            folded = FoldedNetwork(self.device, network, self.points, self._factor(network.description))
        density = None
        if trainer is not None and (settings.uses_density or settings.allocates):
            with self.watch("density"):
                unit = self._unit()
                learned = DensityTrainer(self.device, folded, trainer.samples_of(network), unit).fit()
                density = tabulate(self.device, learned, network, self.points, unit)
        return _ControlVariate(folded, self._integrate(folded), density)

    def _factor(self, description: NetworkDescription) -> HostArray | None:
        """What a demodulated network's output is multiplied by at each point."""
        return self._unshadowed_means if description.demodulated else None

    def _unit(self) -> np.ndarray | None:
        """Each point's scale of residuals: its unshadowed mean over the channels, if it is known."""
        if not self.settings.integrand.demodulated:
            return None
        return self._unshadowed_means.read().mean(axis=0)

    @functools.cached_property
    def _unshadowed_means(self) -> HostArray:
        return self.source.unshadowed_means()

    def _train(self, inputs: tuple[str, ...]) -> tuple[Network | None, Trainer | None]:
        """Draw training samples and fit a network; without one where training fails twice."""
        settings = self.settings
        preset = PRESETS[settings.preset]
        with self.watch("train"):
            description = preset.description(settings.integrand, inputs)
            factor = self._factor(description)
            start = Network.random(description, GridCube.around(self.scene.bounds), settings.seed)
            chosen, samples = settings.training_points(
                self.points.active, TRAINING_PASS, AUTO_TRAINING_SAMPLES
            )
        for slower in (1.0, 0.1):
            rate = preset.settings.rate * slower
            schedule = replace(
                preset.settings, rate=rate, final_rate=min(rate, preset.settings.final_rate)
            )
            network, trainer = self._fit(start, schedule, chosen, samples, factor)
            if network is not None:
                return network, trainer
        warnings.warn("training diverged; the image is rendered by plain Monte Carlo", stacklevel=5)
        return None, None

    def _fit(
        self,
        start: Network,
        schedule: TrainSettings,
        chosen: np.ndarray,
        samples: int,
        factor: HostArray | None,
    ) -> tuple[Network | None, Trainer]:
        """One attempt: the network, unless it diverged; leaves the training samples' own estimate."""
        points, settings = self.points, self.settings
        held = min(samples, max(TRAINING_PASS, TRAINING_SAMPLES_HELD // len(chosen)))
        rounds = [range(s, s + held) for s in range(0, samples - held + 1, held)]
        estimator = Estimator(self.device, points, settings.integrand.channels, chosen=chosen)
        with self.watch("train"):
            trainer = Trainer(self.device, start, points, schedule, chosen, held, settings.seed, factor)
            order = HostArray.of(self.device, chosen)
        losses = []
        for held_samples in rounds:
            for first in range(held_samples.start, held_samples.stop, TRAINING_PASS):
                part = range(first, min(first + TRAINING_PASS, held_samples.stop))
                for batch_points in self.source.batches(len(chosen)):
                    batch = self.source.draw(batch_points, part, Stream.TRAINING, order)
                    with self.watch("estimate"):
                        estimator.add(batch)
                    with self.watch("train"):
                        trainer.store(batch, part.start - held_samples.start)
                        self.device.queue.finish()
                estimator.finish_pass(len(part))
            with self.watch("train"):
                losses.append(trainer.fit(len(rounds)))
            if self.stop() or not np.isfinite(losses[-1]):
                break
        with self.watch("train"):
            network = trainer.network()
        diverged = not (
            np.isfinite(network.parameters).all()
            and np.isfinite(network.table).all()
            and losses[-1] < 2.0 * losses[0]
        )
        self.training = estimator.result()
        return None if diverged else network, trainer

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
        settings, active = self.settings, self.points.active
        everything = np.arange(active, dtype=np.uint32)
        if variate is not None and variate.density is not None and settings.allocates:
            return Allocation.of_counts(allocate(variate.density.magnitude, settings.spp))
        if settings.allocation == "pilot" and active:
            pilot = max(1, min(PILOT_SAMPLES, settings.spp // 4))
            self.training = self._pilot(Allocation.uniform(everything, pilot))
            deviation = np.sqrt(self.training.variance.sum(axis=0))
            # What the pilot did not see may still be there: no point is left to much fewer samples.
            fewest = 1 << (pilot.bit_length() - 1)
            counts = allocate(deviation, max(1, settings.spp - pilot), fewest)
            return Allocation.of_counts(counts)
        return Allocation.uniform(everything, settings.spp)

    def _pilot(self, allocation: Allocation) -> Estimate:
        estimator = Estimator(self.device, self.points, self.settings.integrand.channels)
        targets = [Target(estimator, allocation, Stream.TRAINING)]
        Passes(self.device, self.source, targets, RESIDUAL_PASS, None, self.watch).run("pilot")
        return estimator.result()

    def _estimate(
        self, allocation: Allocation, variate: _ControlVariate | None
    ) -> tuple[Estimate, Estimate | None]:
        """Estimates of f and, with a control variate, of f − g."""
        settings, points = self.settings, self.points
        folded, density = (variate.folded, variate.density) if variate else (None, None)
        estimator = Estimator(self.device, points, settings.integrand.channels, folded)
        targets = [Target(estimator, allocation, Stream.RESIDUAL)]
        if not points.active:
            return estimator.result(), None
        # Independent samples tell their variance themselves; others need points that are done twice.
        calibrated = settings.sampler != "independent"
        if calibrated:
            twice = points_done_twice(points.active, settings.seed)
            self.points_done_twice = len(twice)
            second = Estimator(self.device, points, settings.integrand.channels, folded, twice)
            restricted = allocation.restricted(twice, points.active)
            targets.append(Target(second, restricted, Stream.CALIBRATION))
        table = density.table if density is not None and settings.uses_density else None
        passes = Passes(self.device, self.source, targets, RESIDUAL_PASS, table, self.watch)
        passes.run("render", self.progress, self.stop)
        results = [estimator.result(quantity) for quantity in range(estimator.quantities)]
        if calibrated:
            prior = density.magnitude**2 if density is not None else None
            results = [
                calibrate(result, second.result(quantity), twice, prior)
                for quantity, result in enumerate(results)
            ]
        return results[0], results[1] if folded is not None else None
