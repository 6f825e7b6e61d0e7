"""What a tuned number does: other values of it, in whole renders of the shipped scenes.

Each name of a `tuning.py` is halved and doubled, or set to the values that `VALUES` lists, in turns with
the present value and with the same seeds. Printed is, for each value and scene, the mean variance of a
picture's pixels times the seconds of a render, over that of the present value: less is better. Seconds
are the processor time of the process, the least over the seeds; `--wall` takes elapsed time instead, for
a quiet machine or a GPU.

Numbers of which only the claimed variance depends are judged by it: printed is the mean of
log v + e² / v less that of the present value, v being a pixel's claimed variance and e its error as the
other seeds show it. Its expectation is least where v is the variance of e.

Differences of a few hundredths are noise; more seeds, points and samples tell them apart.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from types import ModuleType

import numpy as np
from bench_lights import hall
from training import SCENES

import ncv_cl as ncv
from ncv_cl.learning import density
from ncv_cl.opencl.choose import choose_device
from ncv_cl.sampling import guide
from ncv_cl.scene.load import Scene
from ncv_cl.settings.presets import PRESETS
from ncv_cl.settings.schedule import Schedule

FOLDERS = ("integrands", "visibility", "settings", "sampling", "learning", "estimation")
# Found by a script of their own.
KINDS = ("", "NOISY_", "LIGHT_")
PATHS_THAT_PAY = ("PATHS_THAT_PAY", "QUICK_PATHS_THAT_PAY")
ELSEWHERE = (*(f"{kind}SAMPLES_THAT_PAY" for kind in KINDS), "SLICES_THAT_PAY", *PATHS_THAT_PAY)
VALUES = {
    "HIDDEN": ((8, 8), (16, 8), (16, 16)),
    "WIDE_HIDDEN": ((8, 8), (16, 16), (24, 24)),
    "GRID_LEVELS": (4, 5, 6, 7),
    "AVERAGE_DECAY": (0.95, 0.99, 0.998),
    "BETA1": (0.8, 0.9, 0.95),
    "BETA2": (0.9, 0.99, 0.999),
    "TABLE_BETA2": (0.8, 0.9, 0.99),
    "WEIGHT_POWER": (0.0, 0.5, 1.0),
    "DENSITY_BETA1": (0.8, 0.9, 0.95),
    "DENSITY_BETA2": (0.9, 0.99, 0.999),
    "MAGNITUDE_POWER": (0.7, 0.8, 0.9, 1.0),
    "OWN_SHARE": (0.1, 0.3, 0.5),
    "LOBE_SHARES": ((0.0, 0.5), (0.0, 0.5, 0.875), (0.0, 0.25, 0.5, 0.75, 0.875)),
    "ROULETTE": ((1, 2.0), (2, 1.0), (2, 2.0), (2, 4.0), (3, 2.0)),
    "GUIDED_ROULETTE": ((1, 6.0), (2, 3.0), (2, 4.0), (2, 6.0), (2, 9.0)),
    "LEAST_SURVIVE": (0.02, 0.05, 0.1),
    "BRANCHES": (1, 2, 3),
    "MEMBERS": (1, 4, 8, 16),
    "GROUP_WINDOW": (4, 8, 16),
    "MOST_OWN": (0.2, 0.35, 0.5, 1.0),
    "MOST_SURVIVE": (0.95, 0.99, 0.995),
    "GUIDE_UNIFORM_SHARE": (0.1, 0.2, 0.3, 0.5),
    "LOCAL_RADIUS": (1, 2, 3, 5),
}


@dataclass(frozen=True)
class Trial:
    """What is rendered to see a number's effect, and by what it is judged."""

    cases: tuple[tuple[str, str], ...] = (
        ("cornell_box", "direct"),
        ("occluders", "direct"),
        ("knot", "ao"),
    )
    size: int = 96
    spp: int = 64
    options: dict[str, object] = field(default_factory=lambda: {"method": "ncv"})
    of_variance: bool = False


PATHS = (("cornell_box", "gi"), ("interior", "gi"))
APART = Trial(
    (("interior", "gi"), ("occluders", "gi"), ("veach_plates", "gi")), options={"method": "mc"}
)
GLOSS = (("veach_plates", "direct"), ("interior", "direct"))
SKY = Trial((("sky_room", "direct"), ("sky_room", "gi")), options={"method": "mc"})
LIGHTS = (("cornell_box", "direct"), ("interior", "direct"), ("occluders", "direct"))
PLAIN = {"method": "mc"}
ON_LINES = {"method": "mc", "visibility": "lines"}
OCCLUSION = (("occluders", "ao"), ("knot", "ao"))
# Where visibility "auto" has a choice.
SLICED = Trial((("cornell_box", "ao"), *OCCLUSION), spp=256, options=PLAIN)
PILOT = {"method": "mc", "allocation": "pilot"}
VARIANCE = Trial(size=64, spp=16, of_variance=True)
# What is not seen in the trial that suits most.
TRIALS = {
    "SMALL_LIGHT": Trial(LIGHTS, options=PLAIN),
    "EQUAL_PART": Trial((("interior", "direct"), ("interior", "gi")), options=PLAIN),
    "SKY_EQUAL_PART": SKY,
    "SKY_LEAST_WEIGHT": SKY,
    "LOBE_SHARES": Trial(GLOSS, options=PLAIN),
    "LOBE_GAIN": Trial(GLOSS, options=PLAIN),
    "LOBE_NEED": Trial(GLOSS, options=PLAIN),
    "MOST_TRAINING_SAMPLES": Trial(spp=2048),
    "HELD_OUT_SHARE": Trial(size=48, spp=256),
    "USE_COST": Trial(spp=512),
    "RAY_COST": Trial(OCCLUSION, spp=256),
    "GAIN": Trial(spp=512),
    "UNDECIDED_SAMPLES": Trial(PATHS, spp=128),
    "FEWEST_STEPS": Trial(size=24, spp=256),
    "FEWEST_STEPS_OF_ONE_BATCH": Trial(size=12, spp=1024),
    "MOST_EPOCHS": Trial(size=8, spp=64),
    "WIDE_HIDDEN": Trial(options={"method": "ncv", "preset": "wide"}),
    "PILOT_SAMPLES": Trial(spp=512, options=PILOT),
    "PILOT_SHARE": Trial(spp=32, options=PILOT),
    "TWICE_SHARE": replace(VARIANCE, size=128),
    "FEWEST_TWICE": VARIANCE,
    "MOST_TWICE": replace(VARIANCE, size=384),
    "LARGEST_TWICE_SHARE": replace(VARIANCE, size=24),
    "VALUES_A_CLASS": VARIANCE,
    "MOST_CLASSES": replace(VARIANCE, size=128),
    "PRIOR_SAMPLES": VARIANCE,
    "LOCAL_RADIUS": replace(VARIANCE, options=PLAIN),
    "OWN_SHARE": replace(VARIANCE, options=PLAIN),
    "MOST_LIGHTS": Trial((("hall of 4", "direct"), ("hall of 8", "direct"), ("hall of 16", "direct"))),
    "BLOCKS_A_ITEM": Trial(LIGHTS, options=PLAIN, spp=512),
    "MOST_GAPS": Trial(LIGHTS, options=ON_LINES, spp=256),
    "LINE_BLOCKS": Trial(LIGHTS, options=ON_LINES, spp=256),
    "SORTED_FROM": Trial(LIGHTS, options=ON_LINES, spp=256),
    "MOST_ON_LINES": Trial(LIGHTS, options=ON_LINES, spp=256),
    "OCCLUDERS_A_LINE": Trial(LIGHTS, options=PLAIN, spp=16),
    "MOST_BLOCKED": Trial(OCCLUSION, options=ON_LINES),
    "SAMPLED_TRIANGLES": Trial(OCCLUSION, options=ON_LINES),
    "RAYS_A_SLICE": SLICED,
    "RAYS_A_LEAF": SLICED,
    "FEWEST_SLICES": replace(SLICED, spp=16),
    "MOST_REFUSED": SLICED,
    "MOST_RAYS_A_SLICE": replace(SLICED, options={"method": "mc", "sampler": "independent"}),
    "SAMPLES_A_TRIANGLE": SLICED,
    "MANY_TRIANGLES": replace(SLICED, spp=16),
    "LEAST_RAYS_OF_MANY": replace(SLICED, spp=16),
    "LIGHTS_OF_A_NETWORK": Trial((("lit_mesh", "gi"),), spp=256, options={"method": "auto"}),
    "LOBES_OF_A_NETWORK": Trial((("veach_plates", "gi"),), spp=512, options={"method": "auto"}),
    "MOST_CASTERS": Trial((("cornell_box cut", "gi"),), options=PLAIN),
    "DIRECT_SAMPLES": APART,
    "DIRECT_ERROR": APART,
    "MOST_DIRECT": APART,
    "ROULETTE": Trial(PATHS, options=PLAIN),
    "GUIDED_ROULETTE": ((1, 6.0), (2, 3.0), (2, 4.0), (2, 6.0), (2, 9.0)),
    "LEAST_SURVIVE": Trial(PATHS),
    "BRANCHES": Trial(PATHS),
    "MOST_SURVIVE": Trial(PATHS),
    "GUIDE_SIDE": Trial(PATHS),
    "GUIDE_UNIFORM_SHARE": Trial(PATHS),
    "GUIDE_PRIOR_SAMPLES": Trial(PATHS),
    "MEMBERS": Trial(PATHS),
    "GROUP_WINDOW": Trial(PATHS),
    "MOST_OWN": Trial((*PATHS, ("veach_plates", "gi"), ("occluders", "gi"))),
    # With "auto" two uses are the most.
    "EPOCHS": Trial(options={"method": "ncv", "train_spp": 16}),
}


def module_of(name: str) -> ModuleType:
    """The `tuning.py` that a number is in."""
    for folder in FOLDERS:
        module = importlib.import_module(f"ncv_cl.{folder}.tuning")
        if hasattr(module, name):
            return module
    raise SystemExit(f"no tuning.py has a {name}; there are {', '.join(names())}")


def names() -> list[str]:
    """Of all numbers that can be varied here."""
    modules = (importlib.import_module(f"ncv_cl.{folder}.tuning") for folder in FOLDERS)
    return [n for module in modules for n in vars(module) if n.isupper() and n not in ELSEWHERE]


def values_of(name: str) -> tuple:
    """Values to try, the present one among them."""
    present = getattr(module_of(name), name)
    if name in VALUES:
        return tuple(dict.fromkeys([*VALUES[name], present]))
    kind = type(present)
    return kind(present / 2), present, kind(present * 2)


@contextmanager
def set_to(name: str, value: object) -> Iterator[None]:
    """While the block lasts, a number has another value, defaults and presets made of it too."""
    module, kept, settings = module_of(name), dict(PRESETS), density.DensitySettings
    present, cells = getattr(module, name), guide.GUIDE_CELLS
    setattr(module, name, value)
    if name == "GUIDE_SIDE":
        guide.GUIDE_CELLS = 6 * value**3
    own, shared = name.lower(), [one.name for one in fields(Schedule)]
    changed = {own.removeprefix("wide_"): value}
    if module.__name__ == "ncv_cl.settings.tuning":
        for preset in ("wide",) if own.startswith("wide_") else ("default",):
            old = PRESETS[preset]
            if own in shared:
                PRESETS[preset] = replace(old, schedule=replace(old.schedule, **changed))
            else:
                PRESETS[preset] = replace(old, **changed)
    if own.startswith("density_"):
        one = {"density_epochs": "most_epochs"}.get(own, own.removeprefix("density_"))
        density.DensitySettings = functools.partial(settings, **{one: value})
    try:
        yield
    finally:
        setattr(module, name, present)
        PRESETS.update(kept)
        density.DensitySettings, guide.GUIDE_CELLS = settings, cells


def scene_of(name: str) -> Scene:
    """A shipped scene, one whose triangles are each cut into four, or a hall of so many lamps."""
    if name.startswith("hall of "):
        with tempfile.TemporaryDirectory() as folder:
            return hall(int(name.removeprefix("hall of ")), folder)
    scene = ncv.load_scene(SCENES / f"{name.removesuffix(' cut')}.toml")
    if not name.endswith(" cut"):
        return scene
    a, b, c = scene.vertices[scene.triangles].swapaxes(0, 1)
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    corners = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return replace(
        scene,
        vertices=corners,
        vertex_normals=np.zeros_like(corners),
        triangles=np.arange(len(corners), dtype=np.uint32).reshape(-1, 3),
        triangle_material=np.repeat(scene.triangle_material, 4),
        triangle_light=np.repeat(scene.triangle_light, 4),
    )


def measure(
    name: str, trial: Trial, seeds: int, device: ncv.Device, clock: Callable[[], float]
) -> dict[object, list[float]]:
    """For each value, its figure in each case: error times seconds, or the score of its variances."""
    found: dict[object, list[float]] = {value: [] for value in values_of(name)}
    for scene_name, integrand in trial.cases:
        scene = scene_of(scene_name)
        runs: dict[object, list[tuple[float, np.ndarray, np.ndarray]]] = {value: [] for value in found}
        for seed in range(seeds):
            for value, own in runs.items():
                with set_to(name, value):
                    began = clock()
                    image = ncv.render(
                        # Anew, since what is found of a scene's lights is kept with it.
                        replace(scene),
                        integrand,
                        spp=trial.spp,
                        size=(trial.size, trial.size),
                        seed=seed,
                        device=device,
                        **trial.options,
                    )
                    own.append((clock() - began, image.pixels, image.variance))
        for value, own in runs.items():
            seconds, pixels, variance = (np.array(part, np.float64) for part in zip(*own, strict=True))
            if trial.of_variance:
                found[value].append(score(pixels, variance))
            else:
                found[value].append(seconds.min() * float(np.var(pixels, axis=0, ddof=1).mean()))
    return found


def score(pixels: np.ndarray, variance: np.ndarray) -> float:
    """Mean of log v + e² / v, of pictures and their claimed variances (seeds, height, width, 3)."""
    seeds = len(pixels)
    squares = (pixels - pixels.mean(axis=0)) ** 2 * seeds / (seeds - 1)
    known = np.isfinite(variance)
    # What is far below the image's own is nothing that anybody sees, however wrong a claim of it is.
    v = np.where(known, variance, 1.0) + 1e-3 * squares.mean()
    return float((np.log(v) + squares / v)[known].mean())


def show(name: str, trial: Trial, found: dict[object, list[float]]) -> None:
    """Print one line a value, the present one marked."""
    present = getattr(module_of(name), name)
    figure = (
        "log v + e² / v, less the present" if trial.of_variance else "error x seconds over the present"
    )
    print(f"{name}: {figure} ({', '.join(' '.join(case) for case in trial.cases)}; mean)")
    for value, own in found.items():
        if trial.of_variance:
            cells = np.subtract(own, found[present])
            mean = cells.mean()
        else:
            cells = np.divide(own, found[present])
            mean = np.exp(np.log(cells).mean())
        mark = "   <- present" if value == present else ""
        row = " ".join(f"{cell:7.3f}" for cell in cells)
        print(f"  {value!s:>10} {row} {mean:7.3f}{mark}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="of tuning.py files; default: all")
    parser.add_argument("--seeds", type=int, default=4, help="renders of each (default %(default)s)")
    parser.add_argument("--size", type=int, help="points a side, instead of the trial's own")
    parser.add_argument("--spp", type=int, help="samples a point, instead of the trial's own")
    parser.add_argument("--wall", action="store_true", help="elapsed time, not that of processors")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    options = parser.parse_args()
    device = choose_device(options.device)
    print(device.identity)
    for name in options.names or names():
        trial = TRIALS.get(name, Trial())
        trial = replace(trial, size=options.size or trial.size, spp=options.spp or trial.spp)
        clock = time.perf_counter if options.wall else time.process_time
        show(name, trial, measure(name, trial, options.seeds, device, clock))


if __name__ == "__main__":
    main()
