"""What the training benchmarks share: a scene ready to be trained on, and one measured training run."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ncv_cl.integrands import INTEGRANDS
from ncv_cl.learning.train import Trainer
from ncv_cl.network.encode import GridCube, varying_inputs
from ncv_cl.network.fold import FoldedNetwork
from ncv_cl.network.network import Network
from ncv_cl.opencl.device import Device
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import find_points
from ncv_cl.points.sampler import Stream
from ncv_cl.points.trace import Tracer
from ncv_cl.sampling.accumulate import Accumulator
from ncv_cl.sampling.samples import SampleSource
from ncv_cl.scene.load import load_scene
from ncv_cl.settings.presets import Preset

SCENES = Path(__file__).parent.parent / "scenes"
CASES = (("cornell_box", "direct"), ("occluders", "direct"), ("occluders", "ao"), ("knot", "ao"))
SAMPLES_A_PASS = 16
TEST_SAMPLES = 32


@dataclass(frozen=True)
class Outcome:
    """One training run.

    Attributes
    ----------
    residual : float
        Variance of f − g over variance of f, both averaged over points, on fresh samples.
    seconds : float
        Training alone: neither drawing its samples nor folding the network.
    nanoseconds_a_sample : float
        `seconds` over the number of times a sample was used.
    """

    residual: float
    seconds: float
    nanoseconds_a_sample: float


class TrainingCase:
    """A scene and integrand at one size, with independent samples."""

    def __init__(self, device: Device, scene: str, integrand: str, size: int) -> None:
        self.device = device
        self.scene = load_scene(SCENES / f"{scene}.toml")
        self.integrand = INTEGRANDS[integrand]()
        tracer = Tracer(self.scene)
        emitters = self.integrand.emitters_active
        self.points = find_points(device, self.scene, tracer, size, size, 1, emitters)
        self.source = SampleSource(
            device, self.scene, tracer, self.points, self.integrand, "independent", 1, TEST_SAMPLES
        )
        self.inputs = varying_inputs(self.points, self.integrand.inputs)

    def run(self, preset: Preset, samples: int, fraction: float = 1.0, seed: int = 0) -> Outcome:
        """Train on `samples` of each of a `fraction` of the points, then measure the residual."""
        points, source = self.points, self.source
        description = preset.description(self.integrand, self.inputs)
        factor = source.unshadowed_means() if description.demodulated else None
        start = Network.random(description, GridCube.around(self.scene.world_bounds), seed)
        count = max(1, round(points.active * fraction))
        chosen = np.linspace(0, points.active, count, endpoint=False).astype(np.uint32)
        trainer = Trainer(self.device, start, points, preset.schedule, chosen, samples, seed, factor)
        order = HostArray.of(self.device, chosen)
        for first in range(0, samples, SAMPLES_A_PASS):
            part = range(first, min(first + SAMPLES_A_PASS, samples))
            for batch_points in source.batches(count):
                trainer.store(source.draw(batch_points, part, Stream.TRAINING, order), first)
        self.device.queue.finish()
        began = time.perf_counter()
        trainer.fit()
        seconds = time.perf_counter() - began
        folded = FoldedNetwork(self.device, trainer.network(), points, factor)
        uses = count * samples * preset.schedule.epochs
        return Outcome(self._residual(folded), seconds, seconds / uses * 1e9)

    def _residual(self, folded: FoldedNetwork) -> float:
        accumulator = Accumulator(self.device, self.points, self.integrand.channels, folded)
        for batch_points in self.source.batches():
            accumulator.add(self.source.draw(batch_points, range(TEST_SAMPLES), Stream.RESIDUAL))
        accumulator.finish_pass(TEST_SAMPLES)
        return float(accumulator.result(1).variance.mean() / accumulator.result(0).variance.mean())
