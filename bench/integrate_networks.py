"""What the benchmarks of integration share: networks on the device, and how they are timed."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from training import SCENES, TrainingCase

# The exact oracle and the hard networks are the tests' own.
sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from rational import Network, random_network, trained_network

from ncv_cl.integration.integrator import Integrator, Statistics
from ncv_cl.network.encode import Encoding
from ncv_cl.network.fold import FoldedNetwork
from ncv_cl.network.network import Network as TrainedNetwork
from ncv_cl.network.network import NetworkDescription
from ncv_cl.opencl.device import Device
from ncv_cl.opencl.memory import HostArray
from ncv_cl.opencl.program import build
from ncv_cl.rendering.render import render

# Weights and biases that carry a points axis: all but the middle weights, and only the first bias.
MODULATED = (True, False, True), (True, True, True)
FIRST_BIAS = (False, False, False), (True, False, False)


def interleaved_seconds(works: list[Callable[[], object]], repeats: int) -> np.ndarray:
    """Wall clock of each of `works` in turn, (repeats, works), after one call each that warms up.

    What else the machine does slows neighbours in a row alike, so ratios belong within rows.
    """
    for work in works:
        work()
    times = np.empty((repeats, len(works)))
    for row in times:
        for k, work in enumerate(works):
            begun = time.perf_counter()
            work()
            row[k] = time.perf_counter() - begun
    return times


def median_seconds(work: Callable[[], object], repeats: int) -> float:
    """Median wall clock of `work`, after one call that warms up."""
    return float(np.median(interleaved_seconds([work], repeats)))


def networks(
    widths: tuple[int, ...],
    points: int,
    flags: tuple[tuple[bool, ...], tuple[bool, ...]],
    seed: int,
    every_line_cuts: bool = True,
) -> Network:
    """He networks whose first-layer lines all cut the square, or fall as PyTorch's biases let them."""
    weights, biases = random_network(widths, points, seed)
    weights = [w if keep else w[0] for w, keep in zip(weights, flags[0], strict=True)]
    biases = [b if keep else b[0] for b, keep in zip(biases, flags[1], strict=True)]
    generator = np.random.default_rng(seed)
    shape = (points, widths[1])
    if every_line_cuts:
        through = generator.uniform(size=(*shape, 2))
        biases[0] = -(weights[0] * through).sum(-1).astype(np.float32)
    else:
        biases[0] = generator.uniform(-(0.5**0.5), 0.5**0.5, shape).astype(np.float32)
    return weights, biases


def disc_networks(widths: tuple[int, ...], points: int) -> Network:
    """A network trained on an occluded disc; first-layer biases move it about from point to point."""
    weights, biases = trained_network(widths, seed=1, steps=2000)
    shift = np.random.default_rng(2).uniform(-0.1, 0.1, size=(points, 2))
    biases[0] = (biases[0] - shift @ weights[0].T).astype(np.float32)
    return weights, biases


def cornell_networks(device: Device, preset: str, size: int, samples: int) -> Network:
    """Networks of all shading points of the Cornell box, trained on its direct light by a preset."""
    case = TrainingCase(device, "cornell_box", "direct", size)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network.npz"
        render(
            SCENES / "cornell_box.toml",
            sampler="independent",
            spp=1,
            train_spp=samples,
            size=(size, size),
            preset=preset,
            save_network=path,
            device=device,
        )
        trained = TrainedNetwork.load(path)
    factor = case.source.unshadowed_means() if trained.description.demodulated else None
    weights, biases = FoldedNetwork(device, trained, case.points, factor).layers()
    return [array.read() for array in weights], [array.read() for array in biases]


def some_points(network: Network, count: int) -> Network:
    """The networks of the first `count` points."""
    weights, biases = network
    return (
        [w[:count] if w.ndim == 3 else w for w in weights],
        [b[:count] if b.ndim == 2 else b for b in biases],
    )


class Case:
    """Networks on the device, ready to be integrated again and again."""

    def __init__(self, device: Device, network: Network) -> None:
        self.device = device
        self.network = network
        self.weights, self.biases = ([HostArray.of(device, a) for a in part] for part in network)
        self.widths = (2, *(b.shape[-1] for b in network[1]))
        self.points = max(b.shape[0] for b in network[1] if b.ndim == 2)
        self.out = HostArray(device, (self.points, self.widths[-1]), np.float32)

    def integrator(self, method: str) -> Callable[[], Statistics]:
        per_point = [a.ndim == 3 for a in self.network[0]], [a.ndim == 2 for a in self.network[1]]
        integrator = Integrator(self.device, self.widths, *per_point, method=method)
        return lambda: integrator.run(self.weights, self.biases, self.out)

    def seconds(self, method: str, repeats: int) -> tuple[float, Statistics]:
        run = self.integrator(method)
        statistics = run()
        return median_seconds(run, repeats), statistics


class Inference:
    """g at given samples, by the renderer's kernel; two hidden layers only."""

    def __init__(self, case: Case) -> None:
        self.case = case
        weights, biases = case.network
        groups = {"W1": weights[0], "B1": biases[0], "B2": biases[1], "W3": weights[2], "B3": biases[2]}
        core = {"W1": 2, "B1": 1, "B2": 1, "W3": 2, "B3": 1}
        modulated = tuple(name for name, array in groups.items() if array.ndim > core[name])
        description = NetworkDescription(
            Encoding(("position",)), case.widths[-1], case.widths[1:-1], modulated=modulated
        )
        self.kernel = build(case.device, ("common", "mlp"), description.defines()).kernel("evaluate")
        layers = zip(case.weights, case.biases, strict=True)
        self.parameters = {
            f"{kind}{k}": array
            for k, pair in enumerate(layers, 1)
            for kind, array in zip("wb", pair, strict=True)
        }

    def at(self, samples: np.ndarray) -> tuple[Callable[[], None], HostArray]:
        """What evaluates all points' networks at the same `samples` (n, 2), and where the values go."""
        case, count = self.case, len(samples)
        u, v = (
            HostArray.of(case.device, np.tile(x.astype(np.float32), (case.points, 1))) for x in samples.T
        )
        value = HostArray(case.device, (case.widths[-1], case.points, count), np.float32)
        items = case.points * count // case.device.vector_width

        def work() -> None:
            self.kernel(
                items,
                first_point=0,
                point_count=case.points,
                stride=count,
                u=u,
                v=v,
                **self.parameters,
                value=value,
            )
            case.device.queue.finish()

        return work, value
