"""Global illumination as the sum of two images: direct light, and the rest."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

from ..integrands import DirectLight, GlobalIllumination, Integrand, IntegrandError
from ..output.image import Image
from ..output.report import about_values
from ..points.sampler import seed_words
from ..scene.load import Scene
from ..settings.options import GROUPS, gathered
from .render import reference_of, render

# Options of a single render, which two renders cannot share.
_ONE_RENDER = ("network", "save_network", "checkpoint", "resume", "target_mse")
# Share of a time limit for direct light; the other render gets what is left.
_DIRECT_SHARE = 0.5


def render_split(
    scene: Scene | str | Path, integrand: str | Integrand = "gi", **options: object
) -> Image:
    """Direct light by its own control variate, all other light by another, and their sum.

    Parameters
    ----------
    scene : Scene, str or Path
    integrand : "gi" or GlobalIllumination
        Its `direct` must be true.
    **options
        As `render` takes them, each for both images, but for a time limit, which is for both together.
        Networks, checkpoints and targets are options of a single render, and are errors.

    Returns
    -------
    Image
        Its pixels, variances, integrals of networks and seconds are sums; `stats["direct"]` and
        `stats["indirect"]` hold the two renders' own.

    Raises
    ------
    IntegrandError
        If the integrand has no direct part to split off.
    ValueError
        For options that one of two renders cannot have, and as `render` raises it.
    """
    whole = GlobalIllumination() if integrand == GlobalIllumination.name else integrand
    if not isinstance(whole, GlobalIllumination) or not whole.direct:
        raise IntegrandError("only integrand gi has direct light to split off")
    started = time.perf_counter()
    # Groups and single options become single options, of which each render gets its own.
    options = _single(options)
    for name in _ONE_RENDER:
        if options.get(name) is not None:
            raise ValueError(f"{name} is for one render, and split direct light makes two: leave it out")
    limit, seed = options.pop("time_limit"), int(options.pop("seed", 0))
    seed_words(seed)
    reference = reference_of(options.pop("reference"), options.get("size", (512, 512)))
    share = None if limit is None else _DIRECT_SHARE * limit
    direct = render(scene, DirectLight(), seed=seed, time_limit=share, **options)
    rest = GlobalIllumination(whole.max_depth, direct=False, clamp=whole.clamp, guided=whole.guided)
    # Another seed, since variances add only if the two errors are independent.
    left = None if limit is None else max(limit - (time.perf_counter() - started), 1e-6)
    indirect = render(scene, rest, seed=(seed + 2**63) % 2**64, time_limit=left, **options)
    image = _sum(direct, indirect)
    image.metadata |= {"direct": True, "split_direct": True, "seed": seed}
    about_values(image, reference)
    return image


def _single(options: dict[str, object]) -> dict[str, object]:
    """The options with those of groups by their own names."""
    groups = {name: options.pop(name, None) for name in GROUPS}
    own = {one.name for kind in GROUPS.values() for one in fields(kind)}
    chosen = gathered(groups, {name: options.pop(name) for name in own & options.keys()})
    for group in chosen.values():
        options |= {one.name: getattr(group, one.name) for one in fields(group)}
    return options


def _sum(direct: Image, indirect: Image) -> Image:
    """The sum of two images of one camera."""
    layers = dict(indirect.layers)
    for name in ("G", "residual"):
        parts = [one.layers[name] for one in (direct, indirect) if name in one.layers]
        if parts:
            layers[name] = sum(parts[1:], parts[0])
    first, second = direct.stats, indirect.stats
    stats = {**second, "direct": first, "indirect": second}
    stats["seconds"] = _added(first["seconds"], second["seconds"])
    for name in ("rays_traced", "rays_skipped", "samples_per_point"):
        stats[name] = first[name] + second[name]
    stats.pop("residual_variance_ratio", None)
    stats.pop("pixels_without_variance", None)
    return Image(
        direct.pixels + indirect.pixels, direct.variance + indirect.variance, layers, stats,
        dict(indirect.metadata),
    )  # fmt: skip


def _added(first: Mapping[str, float], second: Mapping[str, float]) -> dict[str, float]:
    return {stage: first.get(stage, 0.0) + second.get(stage, 0.0) for stage in {**first, **second}}
