"""Global illumination: throughput of paths, the slides' finding, and time to equal error.

1. Throughput: rays a second of plain path tracing, all in, beside what embreex alone reaches on the same
   rays: they are recorded, and traced again by the same threads in the same chunks.
2. The slides' finding, as a table: the slides' network learns the field of radiance and yet brings
   little, since the residual keeps the noise of the nested estimate. That noise is measured by
   estimating each sample twice, with the same (u, v) and other paths. It takes the slides' number of
   training samples a point, 1024, so the images are small; the share of f that is noise says what a
   network without error would bring.
3. What lowers it, one thing at a time, at equal samples: mean square error, rays, and their product.
4. Seconds that "ncv" and "auto" take to the error of plain Monte Carlo with Sobol points, and from how
   many samples on they are ahead.

Mean square errors are halved squared differences of two renders with different seeds, which needs no
reference. Before anything is timed, plain Monte Carlo and the control variate are tested to agree.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from bench_curves import stages
from crossover import Curve, crossover

import ncv_cl as ncv
from ncv_cl.host.clock import Run
from ncv_cl.integrands import GlobalIllumination
from ncv_cl.learning.learn import learn
from ncv_cl.network.fold import FoldedNetwork
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device
from ncv_cl.points.points import find_points
from ncv_cl.points.sampler import Stream
from ncv_cl.points.trace import Hits, Tracer
from ncv_cl.sampling.accumulate import Accumulator
from ncv_cl.sampling.paths import PathSource
from ncv_cl.sampling.problem import Problem
from ncv_cl.settings.options import Sampling, Training
from ncv_cl.settings.settings import Settings
from ncv_cl.visibility.shaft import Occluders

SCENES = Path(__file__).parent.parent / "scenes"
NAMES = ("cornell_box", "interior")
# Presets and training samples a point of the slides' finding, and pixels a side.
FINDINGS = (("slides", 64), ("slides", 1024), ("default", 64), ("default", 512))
FINDING_SIZE = 64
VARIANTS = {
    "Sobol": {"method": "mc"},
    "Sobol, pilot allocation": {"method": "mc", "allocation": "pilot"},
    "slides": {"method": "ncv", "preset": "slides", "train_spp": 16},
    "ncv, unguided": {"method": "ncv", "guided": False},
    "ncv, no density": {"method": "ncv", "density": "none"},
    "ncv, by magnitude": {"method": "ncv", "allocation": "magnitude"},
    "ncv, relative": {"method": "ncv", "allocation": "relative"},
    "ncv": {"method": "ncv"},
    "ncv, one part": {"method": "ncv", "split_direct": "off"},
}


# Those of which seconds to equal error are told, beside "auto"; the others are held against the first.
TIMED = ("Sobol", "ncv", "ncv, one part")
SPPS, QUICK_SPPS = (8, 32, 128, 512), (16, 64)


class Recorder:
    """Stands where a `Tracer` stands, and keeps what it was asked for."""

    def __init__(self, tracer: Tracer) -> None:
        self._tracer = tracer
        self.asked: list[tuple[str, list[np.ndarray]]] = []

    def _ask(self, name: str, *arrays: np.ndarray | Hits | None) -> Hits | None:
        self.asked.append((name, [_kept(one) for one in arrays]))
        return getattr(self._tracer, name)(*arrays)

    def closest(self, *arrays: np.ndarray | Hits) -> Hits:
        return self._ask("closest", *arrays)

    def visible(self, *arrays: np.ndarray) -> None:
        self._ask("visible", *arrays)

    def closest_and_visible(self, *arrays: np.ndarray | Hits) -> None:
        self._ask("closest_and_visible", *arrays)

    def again(self) -> None:
        """Trace all of it once more, and nothing else."""
        for name, arrays in self.asked:
            getattr(self._tracer, name)(*arrays)


def _kept(one: np.ndarray | Hits) -> np.ndarray | Hits:
    if isinstance(one, Hits):
        return Hits(*(_kept(getattr(one, part.name)) for part in fields(Hits)))
    return np.ascontiguousarray(one).copy()


class Case:
    """A scene at one size."""

    def __init__(self, device: Device, name: str, size: int) -> None:
        self.device, self.name, self.size = device, name, (size, size)
        self.scene = ncv.load_scene(SCENES / f"{name}.toml")

    def render(self, spp: int, seed: int, guided: bool = True, **options: object) -> ncv.Image:
        integrand = GlobalIllumination(guided=guided)
        return ncv.render(
            self.scene, integrand, spp=spp, size=self.size, seed=seed, device=self.device,
            **options,
        )  # fmt: skip

    def source(
        self, tracer: Tracer | Recorder, sampler: str, samples: int, visibility: str = "auto"
    ) -> PathSource:
        """As a render makes it."""
        points = find_points(self.device, self.scene, Tracer(self.scene), *self.size)
        integrand = GlobalIllumination()
        tested, occluders = visibility == "auto", None
        if tested:
            occluders = Occluders(self.device, self.scene, points, integrand)
        return PathSource(
            self.device, self.scene, tracer, points, integrand, sampler, 1, samples, occluders,
            shadows_tested=tested,
        )  # fmt: skip

    def validate(self) -> None:
        """Plain Monte Carlo and the control variate agree, or nothing is timed."""
        plain, other = self.render(32, 1, method="mc"), self.render(32, 2, method="ncv")
        # Whole rows: single pixels' variances are estimates, too.
        difference = (plain.pixels.astype(float) - other.pixels).mean(axis=(0, 1))
        pixels = self.size[0] * self.size[1]
        deviation = np.sqrt((plain.variance + other.variance).mean(axis=(0, 1)) / pixels)
        if (np.abs(difference) > 6 * deviation).any():
            raise SystemExit(
                f"{self.scene.name}: mc and ncv disagree by {difference / deviation} deviations"
            )

    def error(self, spp: int, repeats: int = 1, **options: object) -> dict[str, Any]:
        """Mean square error, seconds and those of stages, samples and rays a point of renders."""
        images = [self.render(spp, 10 + k, **options) for k in range(2 * repeats)]
        pairs = zip(images[::2], images[1::2], strict=True)
        mse = np.mean([np.mean((a.pixels.astype(float) - b.pixels) ** 2) / 2 for a, b in pairs])
        stats = [image.stats for image in images]
        parts = [stages(one["seconds"]) for one in stats]
        return {
            "spp": spp,
            "mse": float(mse),
            "seconds": float(np.median([one["seconds"]["total"] for one in stats])),
            "stages": {name: float(np.median([one[name] for one in parts])) for name in parts[0]},
            "samples": float(np.mean([one["samples_per_point"] for one in stats])),
            "rays": float(
                np.mean([(one["rays_traced"] + one["rays_on_device"]) / one["points"] for one in stats])
            ),
        }


def throughput(case: Case, samples: int, repeats: int = 3) -> dict[str, float]:
    """Rays a second that embreex alone traces, and that paths have answered, all in.

    Twice: every ray traced, and as a render does it, which answers some without the ray tracer.
    """
    tracer = Tracer(case.scene)
    recorder = Recorder(tracer)
    recorded = case.source(recorder, "sobol", samples, "embree")
    _draw_all(recorded, samples)
    rays = recorded.rays.traced
    sources = {name: case.source(tracer, "sobol", samples, name) for name in ("embree", "auto")}
    seconds: dict[str, list[float]] = {"alone": [], **{name: [] for name in sources}}
    for _ in range(repeats):
        for name, source in sources.items():
            began = time.perf_counter()
            _draw_all(source, samples)
            seconds[name].append(time.perf_counter() - began)
        began = time.perf_counter()
        recorder.again()
        seconds["alone"].append(time.perf_counter() - began)
    rate = {name: rays / np.median(times) / 1e6 for name, times in seconds.items()}
    return {
        "rays": rays,
        "traced": sources["auto"].rays.traced / (repeats * rays),
        "million_rays_a_second": rate["auto"],
        "all_traced_million_rays_a_second": rate["embree"],
        "embreex_million_rays_a_second": rate["alone"],
        "ratio": rate["auto"] / rate["alone"],
        "all_traced_ratio": rate["embree"] / rate["alone"],
    }


def _draw_all(source: PathSource, samples: int) -> None:
    for points in source.batches():
        source.draw(points, range(samples), Stream.RESIDUAL)


def finding(case: Case, train_spp: int, preset: str, samples: int) -> dict[str, float]:
    """The slides' finding: errors of a trained network, and how much of them is nested noise.

    All are means over points and channels of single, independent samples' squares.
    """
    tracer, device = Tracer(case.scene), case.device
    integrand, training = GlobalIllumination(), Training(preset=preset, train_spp=train_spp)
    settings = Settings(
        integrand, "ncv", samples, case.size, 1, Sampling(sampler="independent"), training
    )
    source = case.source(tracer, "independent", samples)
    points = source.points
    problem = Problem(device, points, source, case.scene.world_bounds, integrand.inputs)
    learned = learn(problem, settings, Run())
    if learned.network is None:
        raise SystemExit(f"{case.scene.name}: training diverged")
    accumulator = Accumulator(device, points, 3, FoldedNetwork(device, learned.network, points))
    noise = weight = 0.0
    for part in source.batches():
        first = source.draw(part, range(samples), Stream.RESIDUAL)
        accumulator.add(first)
        count = len(part) * first.stride
        once = first.value.read().ravel()[: 3 * count].astype(float)
        # The same points of the square, other paths.
        again = source.draw(part, range(samples), Stream.RESIDUAL, paths=Stream.RESIDUAL_AGAIN)
        twice = again.value.read().ravel()[: 3 * count]
        noise += float(((once - twice) ** 2).sum()) / 2
        weight += 3 * len(part) * samples
    accumulator.finish_pass(samples)
    plain, residual = accumulator.result(0).variance.mean(), accumulator.result(1)
    nested = noise / weight
    # E[(f − g)²] is the network's squared error plus the noise of f.
    square = float((residual.variance + residual.mean**2).mean())
    return {
        "variance of f": float(plain),
        "variance of f - g": float(residual.variance.mean()),
        "nested noise": nested,
        "share of f": nested / float(plain),
        "share of f - g": nested / float(residual.variance.mean()),
        "network error": square - nested,
        "relative network error": (square - nested) / max(float(plain) - nested, 1e-30),
    }


def finding_table(case: Case) -> list[dict[str, float | str]]:
    """Print `finding` of each of FINDINGS, and return the rows."""
    small = Case(case.device, case.name, min(FINDING_SIZE, case.size[0]))
    rows = []
    for preset, train_spp in FINDINGS:
        found = finding(small, train_spp, preset, 16)
        gain = found["variance of f"] / found["variance of f - g"]
        row = {"preset": preset, "training samples": train_spp, **found}
        row |= {"gain": gain, "most gain": 1 / found["share of f"]}
        if not rows:
            print("  " + "  ".join(row))
        cells = (f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values())
        print(
            "  " + "  ".join(f"{one:>{len(name)}}" for name, one in zip(row, cells, strict=True)),
            flush=True,
        )
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small images and few samples")
    parser.add_argument("--size", type=int, help="pixels a side (default 80; quick: 24)")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument(
        "--times-only", action="store_true", help="throughput and seconds to equal error, nothing else"
    )
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    options = parser.parse_args()
    device = choose_device(options.device)
    size = options.size or (24 if options.quick else 80)
    spps = QUICK_SPPS if options.quick else SPPS
    print(f"{device.identity}\n{size} x {size} points")
    results = {}
    for name in NAMES:
        case = Case(device, name, size)
        case.validate()
        print(f"{name}: mc and ncv agree", flush=True)
        results[name] = measure(case, spps, options.quick, options.repeats, options.times_only)
    if options.json:
        text = json.dumps({"device": device.identity, "size": size, "cases": results}, indent=1)
        Path(options.json).write_text(text + "\n", encoding="utf-8")


def measure(
    case: Case, spps: tuple[int, ...], quick: bool, repeats: int, times_only: bool
) -> dict[str, object]:
    speed = throughput(case, 8 if quick else 16)
    print(
        f"  paths {speed['million_rays_a_second']:.2f} M rays a second, embreex alone "
        f"{speed['embreex_million_rays_a_second']:.2f}: {speed['ratio']:.3f} with {speed['traced']:.2f} "
        f"of the rays traced, {speed['all_traced_ratio']:.3f} with all", flush=True,
    )  # fmt: skip
    findings = [] if times_only else finding_table(case)
    runs = {}
    for name, options in VARIANTS.items():
        if times_only and name not in TIMED:
            continue
        # Kernels are compiled outside the clock.
        case.render(8, 1, **options)
        wanted = spps if name in TIMED else spps[-1:]
        runs[name] = [case.error(spp, repeats, **options) for spp in wanted]
        last, base = runs[name][-1], runs["Sobol"][-1]
        gain = base["mse"] * base["samples"] / (last["mse"] * last["samples"])
        by_rays = base["mse"] * base["rays"] / (last["mse"] * last["rays"])
        print(
            f"  {name:24} MSE {last['mse']:.3e} of {last['samples']:.0f} samples, {last['rays']:.0f} "
            f"rays, {last['seconds']:.2f} s; less variance by {gain:.2f} at equal samples, "
            f"{by_rays:.2f} at equal rays", flush=True,
        )  # fmt: skip
    case.render(max(8, spps[0] // 8), 1, method="auto")
    runs["auto"] = [case.error(spp, repeats, method="auto") for spp in spps]
    target, plain = runs["Sobol"][-1], Curve.of(runs["Sobol"])
    speedups, crossovers = {}, {}
    for name in (*TIMED[1:], "auto"):
        ours = Curve.of(runs[name])
        speedups[name] = target["seconds"] / float(ours.seconds_to(target["mse"])[0])
        crossovers[name] = crossover(plain, ours).as_dict()
    print(
        f"  error of {spps[-1]} Sobol samples, {target['seconds']:.2f} s; seconds of Sobol over seconds "
        "of: " + ", ".join(f"{name} {ratio:.2f}" for name, ratio in speedups.items()), flush=True,
    )  # fmt: skip
    return {
        "throughput": speed, "finding": findings, "runs": runs, "speedups": speedups,
        "crossovers": crossovers,
    }  # fmt: skip


if __name__ == "__main__":
    main()
