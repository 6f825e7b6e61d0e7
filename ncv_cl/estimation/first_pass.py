"""What a first pass of plain Monte Carlo says of the image that is to come."""

from __future__ import annotations

import time

import numpy as np

from ..host.clock import FIRST_SHARE, Clock
from ..learning.learn import training_budget
from ..opencl.device import Device
from ..sampling.samples import SampleSource
from ..settings.settings import RenderSettings, Stopwatch
from ..visibility.shaft import Occluders
from .auto import FIRST_SAMPLES, NESTED_FIRST_SAMPLES, Prediction, predict, too_short
from .image_estimate import ImageEstimate


def first_samples(settings: RenderSettings) -> int:
    """Samples a point of a first pass."""
    return NESTED_FIRST_SAMPLES if settings.guides else FIRST_SAMPLES


def predict_without(
    device: Device, points: int, occluders: Occluders | None, settings: RenderSettings, clock: Clock
) -> Prediction | None:
    """Plain Monte Carlo where a first pass of `points` points has nothing to decide; else None."""
    if settings.guides:
        return None
    known = points - occluders.unknown if occluders is not None else 0
    return too_short(device, known * settings.spp, (points - known) * settings.spp, clock.left())


def predict_from_first_pass(
    device: Device,
    source: SampleSource,
    settings: RenderSettings,
    image_estimate: ImageEstimate,
    watch: Stopwatch,
    clock: Clock,
    progress: bool = False,
) -> Prediction:
    """Run the first pass of `image_estimate`, time it, and choose a method from what it found.

    With a time limit for the samples that are expected to be drawn within it.
    """
    with watch("compile"):
        image_estimate.warm_up(source)
    started = time.perf_counter()
    passes = image_estimate.passes
    last = 1 if clock.limit is None else passes.up_to(first_samples(settings))
    passes.run("first pass", progress, lambda done: clock.over(FIRST_SHARE), last=last)
    seconds = time.perf_counter() - started
    active = source.points.active
    first = image_estimate.first_estimate()
    training, nested_rays = 0.0, None
    if settings.guides:
        drawn = float(first.samples.mean()) * (active + len(image_estimate.twice))
        nested_rays = (source.rays.traced + source.rays.on_device) / drawn
        training = sum(part.count for part in training_budget(settings, active).rounds) / active
    differences = image_estimate.differences()
    occluders = 0.0
    if source.occluders is not None:
        errors, chosen = first.variance, np.arange(active)
        if differences is not None:
            errors, chosen = differences**2, image_estimate.twice
        weights = errors.sum(axis=0)
        if weights.any():
            occluders = float(np.average(source.occluders.counts(chosen), weights=weights))
    affordable = max(clock.left(), 0.0) / seconds
    spp = min(float(settings.spp), float(first.samples.mean()) * (1.0 + affordable))
    return predict(device, first, differences, seconds, spp, nested_rays, training, occluders)
