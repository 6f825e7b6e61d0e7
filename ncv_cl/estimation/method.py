"""The rule of method "auto": whether a control variate pays, from what is known before sampling."""

from __future__ import annotations

from ..sampling.problem import Problem
from ..settings.settings import Settings
from .tuning import NESTED_SAMPLES_THAT_PAY, SAMPLES_THAT_PAY


def choose_method(problem: Problem, settings: Settings) -> tuple[str, str]:
    """The method, "ncv" if the image has enough samples, else "mc"; and why, in words.

    Training takes about the same time for every image, and what it takes off grows with the samples.
    Thresholds are those that ``python bench/bench_method.py`` prints.
    """
    samples = float(settings.spp) * problem.points.active
    nested = settings.integrand.nested
    enough = NESTED_SAMPLES_THAT_PAY if nested else SAMPLES_THAT_PAY
    kind = "samples with paths behind them" if nested else "samples"
    side = "at least" if samples >= enough else "less than"
    return "ncv" if samples >= enough else "mc", f"{samples:.3g} {kind} are {side} {enough:.3g}"
