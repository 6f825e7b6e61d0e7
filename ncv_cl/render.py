"""The one place that orders the stages: scene to image."""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from tqdm import tqdm

from .choose import choose_device
from .device import Device, HostArray
from .encode import GridCube, varying_inputs
from .estimate import Estimate, Estimator
from .image import Image, error_metrics
from .integrands import INTEGRANDS, Integrand
from .integrator import Integrator
from .network import FoldedNetwork, Network, NetworkDescription
from .points import find_points
from .presets import PRESETS, Preset
from .resolve import resolve_image
from .sampler import Stream
from .samples import Batch, SampleSource
from .scene import Scene, load_scene
from .settings import RenderSettings, Stopwatch
from .trace import Tracer
from .train import Trainer, TrainSettings

# Samples a point drawn at a time; Ctrl-C and progress act between such passes.
RESIDUAL_PASS = 32
TRAINING_PASS = 16
# `train_spp` "auto": samples in all, since a network's need depends on the scene and not on pixels.
AUTO_TRAINING_SAMPLES = 1 << 20
# Training samples held at a time.
TRAINING_SAMPLES_HELD = 1 << 23


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
        Samples a shading point: of the residual for "ncv", of the integrand for "mc".
    train_spp : float or "auto"
        Training samples a shading point ("ncv"), on average: few samples a point are drawn as more of
        them at fewer points. "auto" draws about a million in all, at most `spp` / 4 a point. Their own
        estimate is combined with the residual's.
    size : (int, int)
        Width and height, pixels.
    supersample : int
        k makes k × k shading points a pixel, averaged by a box filter.
    seed : int
        From 0 to 2**64 − 1. Same seed, device and scene: the same image, bit for bit.
    preset : {"default", "slides"}
        The network and its schedule: what measured best, or the slides' own.
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
        integrand, method, sampler, spp, train_spp, size, supersample, seed, preset
    )
    # Fails for scenes that do not suit the integrand before anything is traced.
    integrand.data(scene)
    if network is not None and not isinstance(network, Network):
        network = Network.load(network)
    rendering = _Rendering(scene, settings, choose_device(device), threads, progress, stop)
    return rendering.run(network, save_network, reference, started)


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
            max(RESIDUAL_PASS, TRAINING_PASS),
        )

    def run(
        self,
        network: Network | None,
        save_network: str | Path | None,
        reference: np.ndarray | None,
        started: float,
    ) -> Image:
        settings, points = self.settings, self.points
        training = folded = integral = None
        if settings.method == "ncv" and points.active:
            inputs = varying_inputs(points, settings.integrand.inputs)
            if network is None:
                training, network = self._train(inputs)
            else:
                network.check_fits(settings.integrand.channels, inputs)
            if network is not None:
                if save_network is not None:
                    network.save(save_network)
                with self.watch("fold"):
                    factor = self._factor(network.description)
                    folded = FoldedNetwork(self.device, network, points, factor)
                integral = self._integrate(folded)
        estimator = Estimator(self.device, points, settings.integrand.channels, folded)
        if points.active:
            self._sample(estimator, range(settings.spp), RESIDUAL_PASS, Stream.RESIDUAL, "render")
        plain = estimator.result()
        residual = estimator.result(1) if folded is not None else None
        with self.watch("resolve"):
            image = resolve_image(
                self.scene, settings.integrand, points, settings.size, settings.supersample,
                plain, training, residual, integral,
            )  # fmt: skip
        self._describe(image, plain, training, residual, folded, reference, started)
        return image

    def _factor(self, description: NetworkDescription) -> HostArray | None:
        """What a demodulated network's output is multiplied by at each point."""
        return self._unshadowed_means if description.demodulated else None

    @functools.cached_property
    def _unshadowed_means(self) -> HostArray:
        return self.source.unshadowed_means()

    def _train(self, inputs: tuple[str, ...]) -> tuple[Estimate, Network | None]:
        """Draw training samples and fit a network; without one where training fails twice."""
        settings = self.settings
        preset = PRESETS[settings.preset]
        with self.watch("train"):
            description = preset.description(settings.integrand, inputs)
            factor = self._factor(description)
            start = Network.random(description, GridCube.around(self.scene.bounds), settings.seed)
            chosen, samples = self._plan_training(preset)
        for slower in (1.0, 0.1):
            rate = preset.settings.rate * slower
            schedule = replace(
                preset.settings, rate=rate, final_rate=min(rate, preset.settings.final_rate)
            )
            estimate, network = self._fit(start, schedule, chosen, samples, factor)
            if network is not None:
                return estimate, network
        warnings.warn("training diverged; the image is rendered by plain Monte Carlo", stacklevel=4)
        return estimate, None

    def _plan_training(self, preset: Preset) -> tuple[np.ndarray, int]:
        """Which points get training samples, and how many each."""
        active, spp = self.points.active, self.settings.train_spp
        if spp == "auto":
            spp = min(AUTO_TRAINING_SAMPLES / active, max(self.settings.spp / 4, 1.0))
        if not preset.subset or spp >= TRAINING_PASS:
            return np.arange(active, dtype=np.uint32), max(1, round(spp))
        count = min(active, max(1, round(active * spp / TRAINING_PASS)))
        # One point at random of each of `count` runs: spread over the image, without a pattern.
        edges = np.linspace(0, active, count + 1)
        generator = np.random.Generator(np.random.Philox([self.settings.seed, 2]))
        picks = edges[:-1] + generator.uniform(size=count) * np.diff(edges)
        samples = TRAINING_PASS if active * spp >= TRAINING_PASS else max(1, round(active * spp))
        return np.minimum(picks, active - 1).astype(np.uint32), samples

    def _fit(
        self,
        start: Network,
        schedule: TrainSettings,
        chosen: np.ndarray,
        samples: int,
        factor: HostArray | None,
    ) -> tuple[Estimate, Network | None]:
        """One attempt: the training samples' own estimate, and the network unless it diverged."""
        points, settings = self.points, self.settings
        held = min(samples, max(TRAINING_PASS, TRAINING_SAMPLES_HELD // len(chosen)))
        rounds = [range(s, s + held) for s in range(0, samples - held + 1, held)]
        estimator = Estimator(self.device, points, settings.integrand.channels, chosen=chosen)
        with self.watch("train"):
            trainer = Trainer(self.device, start, points, schedule, chosen, held, settings.seed, factor)
            order = HostArray.of(self.device, chosen)
        losses = []
        for held_samples in rounds:
            self._sample(
                estimator, held_samples, TRAINING_PASS, Stream.TRAINING, "train", order, trainer
            )
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
        return estimator.result(), None if diverged else network

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
                    stacklevel=4,
                )
            return integral.read().T

    def _sample(
        self,
        estimator: Estimator,
        samples: range,
        samples_a_pass: int,
        stream: Stream,
        label: str,
        order: HostArray | None = None,
        trainer: Trainer | None = None,
    ) -> None:
        """Draw `samples` of every point in passes; a pass is done for all points or not at all."""
        count = self.points.active if order is None else order.shape[0]
        batches = self.source.batches(count)
        passes = [
            samples[first : first + samples_a_pass] for first in range(0, len(samples), samples_a_pass)
        ]
        # tqdm's disable=None draws on terminals only.
        disable = None if self.progress else True
        with tqdm(total=len(samples) * count, unit="sample", unit_scale=True, desc=label,
                  disable=disable) as bar:  # fmt: skip
            for part in passes:
                for points in batches:
                    batch = self._draw(points, part, stream, order)
                    with self.watch("estimate"):
                        estimator.add(batch)
                        self.device.queue.finish()
                    if trainer is not None:
                        with self.watch("train"):
                            trainer.store(batch, part.start - samples.start)
                            self.device.queue.finish()
                    bar.update(len(points) * len(part))
                estimator.finish_pass(len(part))
                if trainer is None and self.stop():
                    break

    def _draw(self, points: range, samples: range, stream: Stream, order: HostArray | None) -> Batch:
        traced_before = self.source.rays.seconds
        started = time.perf_counter()
        batch = self.source.draw(points, samples, stream, order)
        tracing = self.source.rays.seconds - traced_before
        self.watch.add("trace", tracing)
        self.watch.add("sample", time.perf_counter() - started - tracing)
        return batch

    def _describe(
        self,
        image: Image,
        plain: Estimate,
        training: Estimate | None,
        residual: Estimate | None,
        folded: FoldedNetwork | None,
        reference: np.ndarray | None,
        started: float,
    ) -> None:
        """Statistics and metadata."""
        settings, points = self.settings, self.points
        # Means over the image's points; whole numbers where every point has the same.
        drawn = float(plain.samples.mean()) if points.active else 0.0
        trained = float(training.samples.mean()) if training else 0.0
        image.stats = {
            "seconds": {**self.watch.seconds, "total": time.perf_counter() - started},
            "rays_traced": self.source.rays.traced,
            "rays_skipped": self.source.rays.skipped,
            "points": points.active,
            "points_skipped": points.background + points.total - points.active,
            "samples_per_point": drawn + trained,
            "network_inputs": list(folded.network.description.encoding.inputs) if folded else [],
            "device": self.device.identity,
        }
        if residual is not None and plain.variance.any():
            image.stats["residual_variance_ratio"] = float(
                residual.variance.mean() / plain.variance.mean()
            )
        if reference is not None:
            image.stats |= error_metrics(image.pixels, reference)
        image.metadata = {
            "version": package_version(),
            "scene": self.scene.name,
            "scene_digest": self.scene.digest,
            "integrand": settings.integrand.name,
            "method": settings.method,
            "preset": settings.preset,
            "sampler": settings.sampler,
            "spp": drawn,
            "train_spp": trained,
            "supersample": settings.supersample,
            "seed": settings.seed,
            "device": self.device.identity,
        }


def package_version() -> str:
    """The installed version of ncv_cl."""
    try:
        return version("ncv_cl")
    except PackageNotFoundError:
        return "unpackaged"
