"""The rule of method "auto": whether a control variate pays, from what is known before sampling."""

from __future__ import annotations

import math

from ..integrands import Integrand
from ..integrands.environment import has_environment
from ..integrands.light_sources import light_sources
from ..points.points import ShadingPoints
from ..sampling.problem import Problem
from ..scene.load import Scene
from ..settings.settings import BY_RESIDUAL, Settings
from . import tuning


def noise_that_stays(scene: Scene, integrand: Integrand, points: ShadingPoints) -> str | None:
    """Why paths in a scene keep a noise that no function of (u, v) takes off, in words; or None.

    A control variate of paths takes twice the time of plain ones, so it must leave less than half of a
    sample's variance: it and the guide leave 0.07 to 0.1 in matte rooms, 0.4 in polished ones, 0.83 in
    `glass`. Many lights make a function of steps too narrow for a small network and for the cells of a
    density, and light from outside falls through whatever opening there is. Where lobes reflect more
    than matte parts do, most noise is that of highlights.
    """
    if not integrand.nested or not points.active:
        return None
    if scene.has_glass:
        return "paths through glass keep their noise"
    if has_environment(scene):
        return "paths keep the noise of light from outside"
    lights = len(light_sources(scene).lights.strip)
    if lights > tuning.LIGHTS_OF_A_NETWORK:
        return f"{lights} lights are more than {tuning.LIGHTS_OF_A_NETWORK}: paths keep their noise"
    albedo, lobes = (points.rows(name)[:, : points.active].mean() for name in ("albedo", "reflectance"))
    if lobes > tuning.LOBES_OF_A_NETWORK * albedo:
        return "lobes reflect more than matte parts do: paths keep the noise of highlights"
    return None


def kind_of(integrand: Integrand, sampler: str, sliced: bool = False, by_kernels: bool = False) -> str:
    """The name of the number in tuning.py from which on a control variate pays.

    Parameters
    ----------
    sliced : bool
        Whether samples are slices of the hemisphere.
    by_kernels : bool
        Whether paths are traced by kernels, and none by the host.

    Notes
    -----
    The error of independent samples, and of paths, which add noise of their own, falls no faster than by
    one over the number of samples: a smaller variance soon pays, and soonest that of paths, which take
    the most time. Sobol points do better, and best where rays end on the lights: testing these is cheap,
    and most points see all of a light or nothing of it. Paths that kernels trace take so little time
    that what a network costs at each point pays only with many of them at a point.
    The error of equidistant slices falls so fast that as many as a network trains on leave it nothing.
    """
    if integrand.nested:
        return "QUICK_PATHS_THAT_PAY" if by_kernels else "PATHS_THAT_PAY"
    if sampler == "independent":
        return "NOISY_SAMPLES_THAT_PAY"
    if sliced:
        return "SLICES_THAT_PAY"
    return "LIGHT_SAMPLES_THAT_PAY" if integrand.to_lights else "SAMPLES_THAT_PAY"


def choose_method(problem: Problem, settings: Settings) -> tuple[str, str]:
    """The method, "ncv" if the image has enough samples, else "mc"; and why, in words.

    Training takes about the same time for every image, and what it takes off grows with the samples.
    """
    if problem.no_network is not None:
        return "mc", problem.no_network
    asked = settings.allocation
    if settings.integrand.nested and asked in BY_RESIDUAL and problem.source.members > 1:
        # Paths are shared where samples are spread alike. In an office and in `interior` plain ones have
        # 0.74 and 0.91 of the relative error times seconds of a network's with "relative".
        return "mc", f"points share paths, which they would not with allocation {asked!r}"
    sampler = settings.sampling.sampler
    kind = kind_of(settings.integrand, sampler, problem.sliced, problem.source.by_kernels)
    enough = getattr(tuning, kind)
    if enough == math.inf:
        what = "ambient occlusion by slices" if problem.sliced else "direct light by Sobol points"
        return "mc", f"{what} has too little noise for a control variate to pay"
    samples = float(settings.spp) * problem.points.active
    words = {"NOISY_SAMPLES_THAT_PAY": "noisy samples", "PATHS_THAT_PAY": "paths"}.get(kind, "samples")
    if kind == "QUICK_PATHS_THAT_PAY":
        if settings.spp < enough:
            return "mc", f"{settings.spp} quick paths a point are less than {enough:.3g}"
        enough, words = tuning.NOISY_SAMPLES_THAT_PAY, "quick paths"
    side = "at least" if samples >= enough else "less than"
    return "ncv" if samples >= enough else "mc", f"{samples:.3g} {words} are {side} {enough:.3g}"
