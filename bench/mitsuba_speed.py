"""The second half of compare_mitsuba.py: samples a second, and time to the same error."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from mitsuba_scene import MitsubaScene

import ncv_cl as ncv
from ncv_cl.opencl.device import Device
from ncv_cl.scene.load import Scene

# Shadow rays a point whose error is to be reached.
TARGET_SAMPLES = 256
OUR_SAMPLES = (4, 8, 16, 32, 64, 128, 256, 512)


@dataclass(frozen=True)
class Way:
    """A way to make Mitsuba draw its samples.

    Attributes
    ----------
    sampler : str
        Mitsuba's plugin.
    a_hit : int
        Shadow rays at each camera ray's hit.
    """

    sampler: str
    a_hit: int

    @property
    def integrator(self) -> dict[str, object]:
        return {"type": "direct", "emitter_samples": self.a_hit, "bsdf_samples": 0}

    def __str__(self) -> str:
        return f"{self.sampler}, {self.a_hit} shadow ray{'s' if self.a_hit > 1 else ''} a camera ray"


# The first is what a scene without further settings gets.
WAYS = (Way("independent", 1), Way("independent", 16), Way("multijitter", 1), Way("ldsampler", 1))


def run(mitsuba: ModuleType, device: Device, scene: Scene, threads: int, quick: bool) -> dict:
    """Both comparisons; the keys of compare_mitsuba's report that they fill."""
    theirs = MitsubaScene(mitsuba, scene)
    if not theirs.llvm:
        print("speed skipped: timings need an llvm variant of Mitsuba")
        return {"samples_per_second_ratio": None, "time_to_error_ratio": None}
    race = _Race(theirs, device, threads, (128, 128) if quick else (256, 256), 3 if quick else 5)
    return race.throughput() | race.time_to_error()


class _Race:
    """Both renderers on one scene's direct light at one size.

    Parameters
    ----------
    size : (int, int)
    repeats : int
        Images of each kind, each with its own seed.
    """

    def __init__(
        self, theirs: MitsubaScene, device: Device, threads: int, size: tuple[int, int], repeats: int
    ) -> None:
        self._theirs, self._device, self._threads = theirs, device, threads
        self._size, self._repeats = size, repeats
        self._renderers = {way: self._fastest(way) for way in WAYS}

    # ---- what is timed -------------------------------------------------------------------------------

    def _ours(self, method: str, spp: int, seed: int) -> ncv.Image:
        return ncv.render(
            self._theirs.source,
            "direct",
            method,
            spp=spp,
            size=self._size,
            seed=seed,
            device=self._device,
            threads=self._threads,
        )

    def _fastest(self, way: Way) -> Callable[[int], object]:
        """A render of TARGET_SAMPLES, in passes of the size that a trial finds fastest."""
        whole = TARGET_SAMPLES // way.a_hit
        choices = [self._renderer(way, spp) for spp in {whole, min(whole, 64), min(whole, 16)}]
        for render in choices:
            render(0)
        return min(choices, key=lambda render: min(_seconds(render, seed) for seed in (1, 2)))

    def _renderer(self, way: Way, spp_a_pass: int) -> Callable[[int], object]:
        whole = TARGET_SAMPLES // way.a_hit
        return in_passes(self._theirs, way.integrator, way.sampler, self._size, whole, spp_a_pass)

    # ---- the two comparisons -------------------------------------------------------------------------

    def throughput(self) -> dict:
        """Samples a second of plain Monte Carlo."""
        works: dict[str, Callable[[int], object]] = {
            "ours": lambda seed: self._ours("mc", TARGET_SAMPLES, seed),
            **{str(way): self._renderers[way] for way in WAYS},
        }
        # Points that are lights or background have no samples in ours, so they count in neither.
        samples = self._ours("mc", TARGET_SAMPLES, 0).stats["points"] * TARGET_SAMPLES
        seconds = _interleaved(works, self._repeats)
        rates = {name: samples / np.median(own) for name, own in seconds.items()}
        print(
            f"\nMillion samples a second at {self._size[0]} x {self._size[1]}, {TARGET_SAMPLES} samples"
        )
        for name, own in seconds.items():
            spread = samples / np.array([max(own), min(own)]) / 1e6
            print(
                f"  {name:45} {rates[name] / 1e6:6.1f}  ({spread[0]:.1f} to {spread[1]:.1f})", flush=True
            )
        usual = rates[str(WAYS[0])]
        best = max(rates[str(way)] for way in WAYS)
        return {
            "samples_per_second": {name: float(rate) for name, rate in rates.items()},
            "samples_per_second_ratio": float(rates["ours"] / usual),
            "samples_per_second_ratio_best": float(rates["ours"] / best),
        }

    def time_to_error(self) -> dict:
        """Our seconds to the error of Mitsuba's 256 samples."""
        methods = ("mc", "auto")
        works = {str(way): self._renderers[way] for way in WAYS}
        for method in methods:
            for spp in OUR_SAMPLES:
                works[f"{method} {spp}"] = lambda seed, m=method, n=spp: self._ours(m, n, seed).pixels
        images: dict[str, list] = {}
        seconds = _interleaved(works, self._repeats, images)
        for way in WAYS:
            # The errors of the same integral as ours: camera rays through the pixels' centres.
            images[str(way)] = [
                self._theirs.radiance(
                    way.integrator, self._size, 1, TARGET_SAMPLES // way.a_hit, seed, way.sampler
                )
                for seed in range(self._repeats)
            ]
        error = {name: _spread(stack) for name, stack in images.items()}
        took = {name: float(np.median(own)) for name, own in seconds.items()}
        print(f"\nTime to the error of Mitsuba's {TARGET_SAMPLES} samples")
        for method in methods:
            for n in OUR_SAMPLES:
                name = f"{method} {n}"
                print(f"  ours, {name:9} {took[name]:7.3f} s  MSE {error[name]:.2e}")
        rows = [self._row(way, methods, took, error) for way in WAYS]
        reached = [row["auto"]["ratio"] for row in rows]
        return {
            "time_to_error": rows,
            "our_images": {
                name: {"seconds": took[name], "mse": error[name]}
                for name in took
                if name not in map(str, WAYS)
            },
            "time_to_error_ratio": reached[0],
            "time_to_error_ratio_best": None if None in reached else min(reached),
        }

    @staticmethod
    def _row(way: Way, methods: tuple[str, ...], took: dict, error: dict) -> dict:
        name = str(way)
        row: dict = {"way": name, "seconds": took[name], "mse": error[name]}
        line = f"  {name:45} {row['seconds']:7.3f} s  MSE {row['mse']:.2e}; ours:"
        for method in methods:
            keys = [f"{method} {n}" for n in OUR_SAMPLES]
            own = seconds_to([took[k] for k in keys], [error[k] for k in keys], error[name])
            ratio = None if own is None else row["seconds"] / own
            row[method] = {"seconds": own, "ratio": ratio}
            line += f" {method} " + ("not reached" if own is None else f"{own:.3f} s ({ratio:.1f} x)")
        print(line, flush=True)
        return row


def in_passes(
    theirs: MitsubaScene,
    method: dict[str, object],
    sampler: str,
    size: tuple[int, int],
    spp: int,
    spp_a_pass: int,
) -> Callable[[int], object]:
    """A render by a wavefront of `spp` samples in equal passes, given a seed; returns their sum."""
    import drjit

    mitsuba = theirs.mitsuba
    integrator, sensor = mitsuba.load_dict(method), theirs.sensor(size, sampler, spp_a_pass)
    passes = spp // spp_a_pass

    def render(seed: int) -> object:
        total = 0
        for number in range(passes):
            image = mitsuba.render(
                theirs.scene,
                sensor=sensor,
                integrator=integrator,
                spp=spp_a_pass,
                seed=seed * passes + number,
            )
            total = total + image
            drjit.eval(total)
        drjit.sync_thread()
        return total

    return render


def seconds_to(seconds: list[float], errors: list[float], target: float) -> float | None:
    """Seconds in which the error falls to `target`, in logarithms between what was measured.

    At least the shortest measured time; None where no error is as small.
    """
    for number, error in enumerate(errors):
        if error <= target:
            if number == 0:
                return seconds[0]
            x = np.log([errors[number], errors[number - 1]])
            y = np.log([seconds[number], seconds[number - 1]])
            return float(np.exp(np.interp(np.log(target), x, y)))
    return None


def _spread(images: list[np.ndarray]) -> float:
    """Mean variance over seeds: the mean square error of unbiased images, without a reference."""
    return float(np.var(np.stack(images), axis=0, ddof=1, dtype=np.float64).mean())


def _seconds(work: Callable[[int], object], seed: int) -> float:
    begun = time.perf_counter()
    work(seed)
    return time.perf_counter() - begun


def _interleaved(
    works: dict[str, Callable[[int], object]], repeats: int, images: dict[str, list] | None = None
) -> dict[str, list[float]]:
    """Seconds of each of `works`, run in turn after a warm-up of each; keeps what they return."""
    for work in works.values():
        work(0)
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for seed in range(1, repeats + 1):
        for name, work in works.items():
            begun = time.perf_counter()
            image = work(seed)
            seconds[name].append(time.perf_counter() - begun)
            if images is not None:
                images.setdefault(name, []).append(image)
    return seconds
