"""The same scenes in Mitsuba 3: do the images agree, and who is faster.

Agreement: images through the same sub-pixel centres, several seeds each; per channel the difference of
the images' means with its standard error, and the relative mean square error of the mean images beside
what their noise alone would give. `mitsuba_scene` says what cannot be matched.

Speed (Cornell box, direct light, one shadow ray a sample): seconds of an image of as many samples, in
turn, medians. Counted are both renderers' whole calls, `ncv_cl.render` and `mitsuba.render`, on loaded
scenes with compiled kernels; ours commits its scene to embree in every call. A sample is one shadow ray
at a shaded point. Ours finds shading points once and then draws all samples at them. Mitsuba's usual way
is one camera ray a sample; its direct integrator can also draw several samples at each camera ray's hit,
which is faster. Both are measured, in passes of whichever size was fastest, with the box filter, which
Mitsuba has a fast path for (its default filter took about five times as long).

Time to an error: that of Mitsuba's image of 256 samples, by the spread of images over seeds; ours is
interpolated in logarithms between measured numbers of samples, and never extrapolated.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from types import ModuleType

import mitsuba_speed
import numpy as np
from mitsuba_scene import MitsubaScene, import_mitsuba

import ncv_cl as ncv
from ncv_cl import integrands
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device
from ncv_cl.output.image import error_metrics
from ncv_cl.scene.load import Scene

SCENES = Path(__file__).parent.parent / "scenes"
CASES = (
    ("cornell_box", "direct"),
    ("occluders", "direct"),
    ("knot", "direct"),
    ("interior", "direct"),
    ("cornell_box", "ao"),
    ("occluders", "ao"),
    ("cornell_box", "gi"),
    ("occluders", "gi"),
    ("knot", "gi"),
    ("interior", "gi"),
)
# Most edges of a path from the camera to a light; both renderers count so, and 2 is direct light.
GI_DEPTH = 6
DIRECT = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
SKY = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1, "hide_emitters": True}
PATH = {"type": "path", "max_depth": GI_DEPTH, "rr_depth": GI_DEPTH}
# Images agree if their means differ by less than this share.
TOLERANCE = 0.005


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small images, few samples and repeats")
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    parser.add_argument("--threads", type=int, default=2, help="threads for either (default 2)")
    options = parser.parse_args(argv)
    report = run(options.quick, options.device, options.threads)
    if report is None:
        print("Mitsuba is not installed: pip install mitsuba")
        return 2
    if options.json:
        Path(options.json).write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0


def run(quick: bool, device: Device | int | str | None = None, threads: int = 2) -> dict | None:
    """All of it; None where Mitsuba is not installed.

    Keys `samples_per_second_ratio` and `time_to_error_ratio` are ours over Mitsuba's, above 1 where ours
    is better, against Mitsuba's usual way (independent samples, one camera ray each); those ending in
    `_best` against the best of its ways. They are None without an llvm variant, or if never reached.
    """
    limit_threads(threads)
    mitsuba = import_mitsuba()
    if mitsuba is None:
        return None
    device = choose_device(device)
    report: dict = {
        "mitsuba": mitsuba.__version__,
        "variant": mitsuba.variant(),
        "device": device.identity,
        "threads": threads,
    }
    print(f"Mitsuba {mitsuba.__version__} {mitsuba.variant()}, {threads} threads\n{device.identity}")
    report["agreement"] = [agreement(mitsuba, device, *case, quick) for case in CASES]
    scene = ncv.load_scene(SCENES / "cornell_box.toml")
    return report | mitsuba_speed.run(mitsuba, device, scene, threads, quick)


def limit_threads(threads: int) -> None:
    """Leave both renderers as many cores and threads; call it before either is started."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    os.environ.setdefault("POCL_MAX_PTHREAD_COUNT", str(threads))
    if (mitsuba := import_mitsuba()) is not None and mitsuba.variant().startswith("llvm"):
        import drjit

        drjit.set_thread_count(threads)


# ---- agreement -------------------------------------------------------------------------------------


def our_integrand(name: str) -> integrands.Integrand | None:
    """The integrand whose image Mitsuba can make; None where this version has none."""
    if name == "ao":
        return integrands.AmbientOcclusion(mapping="cosine")
    if name == "direct":
        return integrands.DirectLight()
    kind = getattr(integrands, "GlobalIllumination", None)
    return kind and kind(max_depth=GI_DEPTH)


def agreement(
    mitsuba: ModuleType,
    device: Device,
    name: str,
    integrand: str,
    quick: bool,
    size: tuple[int, int] | None = None,
    supersample: int = 2,
    batches: int | None = None,
    spp: int | None = None,
) -> dict:
    """Compare one scene's images; a row with `skipped` says why there are none."""
    row: dict = {"scene": name, "integrand": integrand}
    own = our_integrand(integrand)
    if own is None:
        return _skip(row, "this version of ncv_cl has no global illumination")
    scene = ncv.load_scene(SCENES / f"{name}.toml")
    try:
        theirs = MitsubaScene(mitsuba, scene, white_under_sky=integrand == "ao")
    except NotImplementedError as error:
        return _skip(row, str(error))
    small, nested = quick or not theirs.llvm, integrand == "gi"
    size = size or ((32, 32) if small else (64, 64) if nested else (96, 96))
    spp = spp or (32 if small else 64)
    batches = batches or (6 if quick else 8)
    method = {"direct": DIRECT, "ao": SKY, "gi": PATH}[integrand]
    other = np.stack([theirs.radiance(method, size, supersample, spp, seed) for seed in range(batches)])
    ours = np.stack([_our_image(scene, own, size, supersample, spp, s, device) for s in range(batches)])
    row |= compare(ours, other, spp)
    show(row)
    return row


def _skip(row: dict, why: str) -> dict:
    print(f"{row['scene']:12} {row['integrand']:7} skipped: {why}")
    return row | {"skipped": why}


def _our_image(
    scene: Scene,
    integrand: integrands.Integrand,
    size: tuple[int, int],
    supersample: int,
    spp: int,
    seed: int,
    device: Device,
) -> np.ndarray:
    image = ncv.render(
        scene, integrand, "mc", spp=spp, size=size, supersample=supersample, seed=seed, device=device
    )
    return image.pixels.astype(np.float64)


def compare(ours: np.ndarray, theirs: np.ndarray, spp: int) -> dict:
    """What two stacks of images (batches, height, width, 3) say of each other.

    `difference` is that of the images' means over Mitsuba's, per channel, `standard_error` is its own;
    `relmse_of_noise` is what the spread between batches alone leads one to expect for `relmse`.
    """
    batches = len(ours)
    means = [stack.mean(axis=(1, 2)) for stack in (ours, theirs)]
    mean_ours, mean_theirs = (mean.mean(axis=0) for mean in means)
    error = np.sqrt(sum(mean.var(axis=0, ddof=1) for mean in means) / batches)
    reference = theirs.mean(axis=0)
    noise = sum(stack.var(axis=0, ddof=1) for stack in (ours, theirs)) / batches
    row = {
        "spp": spp,
        "batches": batches,
        "mean_ours": mean_ours.tolist(),
        "mean_mitsuba": mean_theirs.tolist(),
        "difference": (mean_ours / mean_theirs - 1).tolist(),
        "standard_error": (error / mean_theirs).tolist(),
        "relmse": error_metrics(ours.mean(axis=0), reference)["relmse"],
        "relmse_of_noise": float(np.mean(noise / (reference**2 + 1e-2 * reference.mean() ** 2))),
    }
    row["agrees"] = bool(np.all(np.abs(row["difference"]) <= TOLERANCE))
    return row


def show(row: dict) -> None:
    """Print a row of `agreement`."""
    differences = "  ".join(
        f"{100 * difference:+.3f} ± {100 * error:.3f} %"
        for difference, error in zip(row["difference"], row["standard_error"], strict=True)
    )
    print(
        f"{row['scene']:12} {row['integrand']:7} ours over Mitsuba's, RGB: {differences}; "
        f"relMSE {row['relmse']:.2e} (noise {row['relmse_of_noise']:.2e})"
        f"{'' if row['agrees'] else '  DISAGREES'}",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
