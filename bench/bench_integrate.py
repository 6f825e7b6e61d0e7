"""Exact integration: correctness on hard networks, speed, and what quadrature would do instead.

Validates first and stops if anything is wrong. Quadrature evaluates the network by the
renderer's own inference kernel (cl/mlp.cl, `evaluate`); only the kernel's time is charged to it,
neither the samples nor the sums.

    python bench/bench_integrate.py [--quick] [--json FILE] [--plot FILE.png]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.stats import qmc

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "tests")]

from rational import (  # noqa: E402
    Network,
    hard_networks,
    point_network,
    random_network,
    relative_errors,
    trained_network,
)

from ncv_cl.choose import choose_device  # noqa: E402
from ncv_cl.device import Device, HostArray  # noqa: E402
from ncv_cl.encode import Encoding  # noqa: E402
from ncv_cl.integrate import integrate  # noqa: E402
from ncv_cl.integrator import METHODS, Integrator, Statistics  # noqa: E402
from ncv_cl.network import NetworkDescription  # noqa: E402
from ncv_cl.program import build  # noqa: E402

LIMIT = {"float32": 1e-6, "float64": 1e-13}
# Weights and biases that carry a points axis: all but the middle weights, and only the first bias.
MODULATED = (True, False, True), (True, True, True)
FIRST_BIAS = (False, False, False), (True, False, False)


def median_seconds(work: Callable[[], object], repeats: int) -> float:
    """Median wall clock of `work`, after one call that warms up."""
    work()
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        work()
        times.append(time.perf_counter() - begun)
    return float(np.median(times))


def stress_table(device: Device) -> list[dict]:
    """Errors against rational arithmetic; raises if one is beyond its limit."""
    rows = []
    precisions = [p for p in LIMIT if p == "float32" or device.has_float64]
    print(
        f"{'network':24}"
        + "".join(f"{p[5:] + ' ' + m:>16}{'robust':>8}" for p in precisions for m in METHODS)
    )
    for name, network in hard_networks().items():
        row: dict = {"network": name}
        for precision in precisions:
            for method in METHODS:
                values, statistics = integrate(
                    *network, method=method, precision=precision, device=device, return_stats=True
                )
                errors = [relative_errors(g, *point_network(network, p)) for p, g in enumerate(values)]
                row[f"{precision} {method}"] = float(np.max(errors)), statistics.robust_points
                if np.max(errors) > LIMIT[precision] or statistics.uncertified_points:
                    raise SystemExit(f"{name}: {method} in {precision} is off by {np.max(errors):.1e}")
        rows.append(row)
        print(f"{name:24}" + "".join(f"{e:16.1e}{r:8d}" for e, r in list(row.values())[1:]), flush=True)
    return rows


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


def trained_points(widths: tuple[int, ...], points: int) -> Network:
    """A trained network, with first-layer biases that move it about from point to point."""
    weights, biases = trained_network(widths, seed=1, steps=2000)
    shift = np.random.default_rng(2).uniform(-0.1, 0.1, size=(points, 2))
    biases[0] = (biases[0] - shift @ weights[0].T).astype(np.float32)
    return weights, biases


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
        w, b = case.weights, case.biases
        self.parameters = [w[0], b[0], w[1], b[1], w[2], b[2]]

    def run(self, samples: np.ndarray, repeats: int) -> tuple[np.ndarray, float]:
        """Means over the samples (points, channels), and seconds; all points share `samples` (n, 2)."""
        case, count = self.case, len(samples)
        u, v = (
            HostArray.of(case.device, np.tile(x.astype(np.float32), (case.points, 1))) for x in samples.T
        )
        value = HostArray(case.device, (case.widths[-1], case.points, count), np.float32)
        items = case.points * count // case.device.vector_width

        def work() -> None:
            self.kernel(items, 0, case.points, count, u, v, *self.parameters, value)
            case.device.queue.finish()

        seconds = median_seconds(work, repeats)
        return value.read().mean(-1, dtype=np.float64).T, seconds


def speed_table(device: Device, quick: bool) -> list[dict]:
    """Cost of both methods a point and a face, next to inference on the same networks."""
    scale = 10 if quick else 1
    cases = {
        "8x16 He": networks((2, 8, 16, 3), 100000 // scale, MODULATED, 1, False),
        "16x16 He": networks((2, 16, 16, 3), 100000 // scale, MODULATED, 2, False),
        "8x16 He, all lines cut": networks((2, 8, 16, 3), 100000 // scale, MODULATED, 1),
        "16x16 He, all lines cut": networks((2, 16, 16, 3), 100000 // scale, MODULATED, 2),
        "32x32 He, per-point bias 1": networks((2, 32, 32, 3), 20000 // scale, FIRST_BIAS, 3),
        "32x32 trained": trained_points((2, 32, 32, 3), 20000 // scale),
        "16x16 trained": trained_points((2, 16, 16, 3), 20000 // scale),
    }
    rows = []
    print(
        f"\n{'networks':28}{'us a point':>11}{'faces':>7}{'us a face':>11}{'full us':>9}{'full/dec':>9}"
        f"{'ns a sample':>12}{'= samples':>10}{'robust':>7}"
    )
    for name, network in cases.items():
        case = Case(device, network)
        seconds, statistics = case.seconds("decoupled", 9)
        full, _ = case.seconds("full", 3)
        some = Case(
            device, tuple([a[:256] if a.ndim > 2 - k else a for a in network[k]] for k in (0, 1))
        )
        _, inference = Inference(some).run(np.random.default_rng(0).uniform(size=(256, 2)), 9)
        point, sample = seconds / case.points, inference / (some.points * 256)
        row = {
            "networks": name,
            "points": case.points,
            "us_a_point": point * 1e6,
            "faces": statistics.faces / case.points,
            "us_a_face": seconds / statistics.faces * 1e6,
            "full_us_a_point": full / case.points * 1e6,
            "full_over_decoupled": full / seconds,
            "ns_a_sample": sample * 1e9,
            "samples_in_that_time": point / sample,
            "robust_points": statistics.robust_points,
        }
        rows.append(row)
        numbers = [value for key, value in row.items() if key not in ("networks", "points")]
        print(
            "{:28}{:11.3f}{:7.1f}{:11.4f}{:9.2f}{:9.1f}{:12.1f}{:10.0f}{:7d}".format(name, *numbers),
            flush=True,
        )
    return rows


def quadrature_table(device: Device, quick: bool) -> dict[str, list[tuple[str, int, float, float]]]:
    """Error (of the mean square, relative to the scale of G) against time a point."""
    results = {}
    largest = 64 if quick else 128
    for name, network in {
        "trained 32x32": trained_points((2, 32, 32, 3), 64),
        "trained 16x16": trained_points((2, 16, 16, 3), 64),
        "random 16x16": networks((2, 16, 16, 3), 64, MODULATED, 4),
    }.items():
        case = Case(device, network)
        truth = integrate(
            *network, precision="float64" if device.has_float64 else "float32", device=device
        )
        size = np.sqrt((truth**2).mean())
        print(f"\n{name}: relative error, us a point")
        rows = []
        for method in METHODS:
            seconds, _ = case.seconds(method, 9)
            error = float(np.sqrt(((case.out.read() - truth) ** 2).mean()) / size)
            rows.append((method, 0, error, seconds / case.points * 1e6))
        inference = Inference(case)
        side = 8
        while side <= largest:
            centres = (np.arange(side) + 0.5) / side
            grid = np.stack(np.meshgrid(centres, centres), -1).reshape(-1, 2)
            sobol = qmc.Sobol(2, scramble=True, seed=5).random(side * side)
            for rule, samples in (("midpoint", grid), ("Sobol", sobol)):
                values, seconds = inference.run(samples, 5)
                error = float(np.sqrt(((values - truth) ** 2).mean()) / size)
                rows.append((rule, side * side, error, seconds / case.points * 1e6))
            side *= 2
        for rule, samples, error, microseconds in rows:
            print(f"  {rule:12}{samples or '':>7}{error:12.1e}{microseconds:12.2f}", flush=True)
        results[name] = rows
        report_equal(rows)
    return results


def report_equal(rows: list[tuple[str, int, float, float]]) -> None:
    """Quadrature's error in our time and its time for our error, from a log-log fit."""
    _, _, our_error, our_time = rows[0]
    for rule in ("midpoint", "Sobol"):
        errors, times = np.log([row[2:] for row in rows if row[0] == rule]).T
        slope, offset = np.polyfit(times, errors, 1)
        equal_time = np.exp(np.polyval((slope, offset), np.log(our_time)))
        equal_error = np.exp((np.log(max(our_error, 1e-9)) - offset) / slope)
        print(
            f"  {rule}: error {equal_time:.1e} in decoupled's {our_time:.2f} us; "
            f"{equal_error:.1e} us for decoupled's {our_error:.1e} (extrapolated)"
        )


def scaling_table(device: Device, quick: bool) -> list[dict]:
    """How the cost grows with width, depth and the number of points."""
    widths = (8, 16, 32, 64) if quick else (8, 16, 32, 64, 128)
    shapes = {f"width {w}": ((2, w, w, 3), max(16, 1024 * 64 // w**2)) for w in widths}
    shapes |= {f"depth {k}": ((2, *[8] * k, 3), 2000) for k in range(1, 5)}
    counts = (100, 1000, 10000) if quick else (100, 1000, 10000, 100000, 1000000)
    shapes |= {f"points {p}": ((2, 8, 16, 3), p) for p in counts}
    rows = []
    print(f"\n{'':16}{'decoupled us':>14}{'faces':>10}{'full us':>12}{'faces':>10}   (a point)")
    for name, (shape, points) in shapes.items():
        layers = len(shape) - 1
        case = Case(device, networks(shape, points, ((True,) * layers, (True,) * layers), 6))
        row: dict = {"case": name}
        for method in METHODS:
            seconds, statistics = case.seconds(method, 3)
            row[method] = seconds / points * 1e6, statistics.faces / points
        rows.append(row)
        (a, b), (c, d) = row["decoupled"], row["full"]
        print(f"{name:16}{a:14.2f}{b:10.1f}{c:12.2f}{d:10.1f}", flush=True)
    return rows


def edge_subdivision_table(device: Device, folder: Path, quick: bool) -> list[dict]:
    """The public edge-subdivision tool (Berzins 2023) on single networks, next to ours.

    It cuts by the output's zero set as well, so its cells are compared by the cell. `folder` holds the
    user's clone of arturs-berzins/relu_edge_subdivision; needs PyTorch.
    """
    sys.path.insert(0, str(folder))
    try:
        import torch
        from edge_subdivision import skeletal_subdivision
        from NN import Net
    except ImportError as error:
        raise SystemExit(f"--edge-subdivision {folder}: {error}") from None
    rows = []
    print(
        f"\n{'one network':16}{'its cells':>10}{'its us a cell':>15}{'our faces':>11}"
        f"{'full':>8}{'decoupled':>11}   (us a face)"
    )
    for width in (16, 32):
        weights, biases = trained_points((2, width, width, 1), 256)
        theirs = Net([2, width, width, 1])
        with torch.no_grad():
            for layer, weight, bias in zip(theirs.fcs, weights, biases, strict=True):
                layer.weight.copy_(torch.from_numpy(weight))
                layer.bias.copy_(torch.from_numpy(bias[0] if bias.ndim == 2 else bias))

        def run(network: object = theirs) -> tuple:
            with torch.no_grad():
                return skeletal_subdivision(
                    network, bbox=(0, 1), device=torch.device("cpu"), verbose=False
                )

        vertices, edges = run()[:2]
        # Euler's formula for a planar subdivision of a square, without the outer face.
        cells = len(edges) - len(vertices) + 1
        seconds = median_seconds(run, 2 if quick else 5)
        case = Case(device, (weights, biases))
        full, statistics = case.seconds("full", 3)
        decoupled, _ = case.seconds("decoupled", 3)
        faces = statistics.faces / case.points
        row = {
            "networks": f"trained {width}x{width}",
            "cells": cells,
            "us_a_cell": seconds / cells * 1e6,
            "faces": faces,
            "full_us_a_face": full / statistics.faces * 1e6,
            "decoupled_us_a_face": decoupled / statistics.faces * 1e6,
        }
        rows.append(row)
        print("{:16}{:10d}{:15.1f}{:11.1f}{:8.3f}{:11.3f}".format(*row.values()), flush=True)
    return rows


def plot(
    results: dict[str, list[tuple[str, int, float, float]]], scaling: list[dict], path: Path
) -> None:
    """Error against time, and cost against width, depth and points; needs matplotlib."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError:
        raise SystemExit("--plot needs matplotlib: pip install 'ncv_cl[bench]'") from None
    figure, axes = pyplot.subplots(2, 3, figsize=(15, 8))
    for axis, (name, rows) in zip(axes[0], results.items(), strict=True):
        for rule in dict.fromkeys(row[0] for row in rows):
            errors, times = np.array([row[2:] for row in rows if row[0] == rule]).T
            axis.loglog(times, errors, marker="o", label=rule)
        axis.set(title=name, xlabel="µs a point", ylabel="relative error")
        axis.legend()
    for axis, kind in zip(axes[1], ("width", "depth", "points"), strict=True):
        chosen = [row for row in scaling if row["case"].startswith(kind)]
        numbers = [int(row["case"].split()[1]) for row in chosen]
        for method in METHODS:
            axis.loglog(numbers, [row[method][0] for row in chosen], marker="o", label=method)
        axis.set(xlabel=kind, ylabel="µs a point")
        axis.legend()
    figure.tight_layout()
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer points; under two minutes")
    parser.add_argument("--device", help="index or name, as in `ncv-cl devices`")
    parser.add_argument("--json", type=Path, help="write all numbers to this file")
    parser.add_argument("--plot", type=Path, help="draw error against time (needs matplotlib)")
    parser.add_argument(
        "--edge-subdivision", type=Path, metavar="PATH", help="a clone of relu_edge_subdivision"
    )
    options = parser.parse_args()
    device = choose_device(options.device)
    print(device.describe())
    results = {
        "device": device.identity,
        "stress": stress_table(device),
        "speed": speed_table(device, options.quick),
        "quadrature": quadrature_table(device, options.quick),
        "scaling": scaling_table(device, options.quick),
    }
    if options.edge_subdivision:
        results["edge_subdivision"] = edge_subdivision_table(
            device, options.edge_subdivision, options.quick
        )
    if options.json:
        options.json.write_text(json.dumps(results, indent=1), encoding="utf-8")
    if options.plot:
        plot(results["quadrature"], results["scaling"], options.plot)


if __name__ == "__main__":
    main()
