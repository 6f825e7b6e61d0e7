"""The plan of a render, made from what is known before the first sample."""

from __future__ import annotations

from dataclasses import dataclass

from ..estimation.method import choose_method
from ..sampling.problem import Problem
from ..settings.settings import Settings


@dataclass(frozen=True)
class Plan:
    """A method, and why.

    Attributes
    ----------
    settings : Settings
        Their method is "ncv" or "mc".
    reason : str
        In words.
    """

    settings: Settings
    reason: str

    def as_dict(self) -> dict[str, object]:
        """For statistics."""
        return {"method": self.settings.method, "reason": self.reason}


def make_plan(problem: Problem, settings: Settings, wants_network: bool = False) -> Plan:
    """Plan a render of these points.

    Parameters
    ----------
    wants_network : bool
        Whether a network is given, or is to be saved.
    """
    if not problem.points.active:
        return Plan(settings.planned("mc"), "no point is lit")
    if settings.method != "auto":
        return Plan(settings, "asked for")
    if wants_network:
        return Plan(settings.planned("ncv"), "a network is given or wanted")
    method, reason = choose_method(problem, settings)
    return Plan(settings.planned(method), reason)
