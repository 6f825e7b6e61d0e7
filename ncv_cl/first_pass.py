"""What a first pass of plain Monte Carlo says of the image that is to come."""

from __future__ import annotations

import time
from dataclasses import replace

from .auto import Prediction, predict
from .device import Device
from .estimate import Estimator
from .estimation import Estimation
from .learn import training_budget
from .sampler import Stream
from .samples import Batches
from .settings import RenderSettings, Stopwatch


def predict_from_first_pass(
    device: Device,
    source: Batches,
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
    return predict(
        device,
        first,
        estimation.differences(),
        seconds,
        settings.spp,
        nested_rays,
        training,
    )


def _compile_plain(device: Device, source: Batches, settings: RenderSettings) -> None:
    """Compile what the first pass runs, or compilation would be taken for what samples cost."""
    rays = replace(source.rays)
    estimator = Estimator(device, source.points, settings.integrand.channels)
    estimator.add(source.draw(range(1), range(1), Stream.TRAINING))
    device.queue.finish()
    source.rays = rays
