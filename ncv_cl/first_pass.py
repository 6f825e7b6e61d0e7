"""What a first pass of plain Monte Carlo says of the image that is to come."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from .auto import FIRST_SAMPLES, NESTED_FIRST_SAMPLES, Prediction, predict, too_short
from .device import Device
from .estimate import Estimator
from .estimation import Estimation
from .learn import training_budget
from .sampler import Stream
from .samples import SampleSource
from .settings import RenderSettings, Stopwatch
from .shaft import Occluders


def first_samples(settings: RenderSettings) -> int:
    """Samples a point of a first pass."""
    return NESTED_FIRST_SAMPLES if settings.guides else FIRST_SAMPLES


def predict_without(
    device: Device, points: int, occluders: Occluders | None, settings: RenderSettings
) -> Prediction | None:
    """Plain Monte Carlo where a first pass of `points` points has nothing to decide; else None."""
    if settings.guides:
        return None
    known = points - occluders.unknown if occluders is not None else 0
    return too_short(device, known * settings.spp, (points - known) * settings.spp)


def predict_from_first_pass(
    device: Device,
    source: SampleSource,
    settings: RenderSettings,
    estimation: Estimation,
    watch: Stopwatch,
    progress: bool = False,
) -> Prediction:
    """Run the first pass of `estimation`, time it, and choose a method from what it found."""
    with watch("compile"):
        _compile_plain(device, source, settings)
    started = time.perf_counter()
    estimation.passes.run("first pass", progress, last=1)
    seconds = time.perf_counter() - started
    active = source.points.active
    first = estimation.first_estimate()
    training, nested_rays = 0.0, None
    if settings.guides:
        drawn = float(first.samples.mean()) * (active + len(estimation.twice))
        nested_rays = (source.rays.traced + source.rays.on_device) / drawn
        training = sum(part.count for part in training_budget(settings, active).rounds) / active
    differences = estimation.differences()
    occluders = 0.0
    if source.occluders is not None:
        errors, chosen = first.variance, np.arange(active)
        if differences is not None:
            errors, chosen = differences**2, estimation.twice
        weights = errors.sum(axis=0)
        if weights.any():
            occluders = float(np.average(source.occluders.counts(chosen), weights=weights))
    return predict(device, first, differences, seconds, settings.spp, nested_rays, training, occluders)


def _compile_plain(device: Device, source: SampleSource, settings: RenderSettings) -> None:
    """Compile what the first pass runs, or compilation would be taken for what samples cost."""
    rays = replace(source.rays)
    estimator = Estimator(device, source.points, settings.integrand.channels)
    estimator.add(source.draw(range(1), range(1), Stream.TRAINING))
    device.queue.finish()
    source.rays = rays
