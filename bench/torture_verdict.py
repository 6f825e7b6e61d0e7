"""What came of tortured networks: verdicts, their sums, and tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from torture_families import FAMILIES

# Which of the names of `Statistics` the table shows.
REDONE = "robust_points"
FAILURES_SHOWN = 20


@dataclass(frozen=True)
class Shape:
    """Of a network with two inputs and one output; `slope` is leaky relu's below zero."""

    hidden: tuple[int, ...]
    slope: float = 0.0

    def __str__(self) -> str:
        return "x".join(map(str, self.hidden)) + (f" leaky {self.slope}" if self.slope else "")

    @property
    def widths(self) -> tuple[int, ...]:
        return (2, *self.hidden, 1)

    def options(self) -> dict:
        """As `integrate` takes it."""
        return {"activation": "leaky_relu", "negative_slope": self.slope} if self.slope else {}


@dataclass(frozen=True)
class Program:
    """What one worker integrates with; `device_shape` is (vector width, lanes)."""

    shape: Shape
    precision: str
    method: str
    device_shape: tuple[int, int]

    def __str__(self) -> str:
        return f"{self.shape}, {self.column}, {self.device}"

    @property
    def column(self) -> str:
        """Of the tables."""
        return f"{self.precision} {self.method}"

    @property
    def device(self) -> str:
        """The shape of device in words."""
        vector_width, lanes = self.device_shape
        return f"{lanes} lanes" if lanes > 1 else f"vectors of {vector_width}"


@dataclass
class Verdict:
    """What came of networks of a family: of a batch, or of many together.

    Attributes
    ----------
    networks : int
        Integrated: neither refused nor lost.
    worst : float
        The largest error.
    beyond, bound_broken : int
        Networks whose error is beyond the limit; beyond what the package itself said.
    refused, lost : int
        Networks that the package says it cannot integrate; that crash on their own.
    crashed : int
        Batches that crashed or hung.
    redone : Counter
        Points that needed more than the arrangement, by the names of `Statistics`.
    failures : list
        (error, what it is) of all that makes it fail.
    """

    networks: int = 0
    worst: float = 0.0
    beyond: int = 0
    bound_broken: int = 0
    refused: int = 0
    lost: int = 0
    crashed: int = 0
    redone: Counter = field(default_factory=Counter)
    failures: list[tuple[float, str]] = field(default_factory=list)

    def __add__(self, other: Verdict) -> Verdict:
        summed = {name: getattr(self, name) + getattr(other, name) for name in vars(self)}
        return Verdict(**summed | {"worst": max(self.worst, other.worst)})

    @property
    def failed(self) -> bool:
        return bool(self.beyond or self.bound_broken or self.lost or self.crashed)

    def numbers(self) -> dict[str, int | float]:
        """All but the failures, flat, for JSON."""
        plain = {name: value for name, value in vars(self).items() if name not in ("redone", "failures")}
        return plain | dict(self.redone)


Verdicts = dict[tuple[Program, str], Verdict]


def total(verdicts: Iterable[Verdict]) -> Verdict:
    """The sum of verdicts; none leave an empty one."""
    return sum(verdicts, Verdict())


def brief(verdict: Verdict) -> str:
    """A verdict's numbers in one line, without those that are 0 and that nobody expects."""
    parts = [f"{verdict.networks} networks", f"worst {verdict.worst:.1e}", f"{verdict.beyond} beyond"]
    expected = {"crashed", "networks", "worst", "beyond"}
    parts.append(f"{verdict.crashed} crashed batches")
    parts += [f"{v} {n}" for n, v in verdict.numbers().items() if v and n not in expected]
    return ", ".join(parts)


def report(verdicts: Verdicts) -> dict:
    """Print what came of each family, each kind of program, and the worst failures; all for JSON."""
    columns = list(dict.fromkeys(program.column for program, _ in verdicts))
    print(f"\n{'worst, beyond, redone':24}" + "".join(f"{column:>26}" for column in columns))
    families = []
    for family in FAMILIES:
        row: dict = {"family": family}
        for column in columns:
            same = [v for (p, f), v in verdicts.items() if (p.column, f) == (column, family)]
            row[column] = total(same).numbers()
        families.append(row)
        cells = (row[column] for column in columns)
        texts = (f"{c['worst']:12.1e}{c['beyond']:6d}{c.get(REDONE, 0):8d}" for c in cells)
        print(f"{family:24}" + "".join(texts))
    print()
    summary = []
    for device, column in dict.fromkeys((program.device, program.column) for program, _ in verdicts):
        same = total(v for (p, _), v in verdicts.items() if (p.device, p.column) == (device, column))
        summary.append({"device shape": device, "program": column, **same.numbers()})
        print(f"{device + ', ' + column:40}{brief(same)}")
    everything = total(verdicts.values())
    failures = [text for _, text in sorted(everything.failures, reverse=True)]
    for failure in failures[:FAILURES_SHOWN]:
        print(failure)
    if len(failures) > FAILURES_SHOWN:
        print(f"... and {len(failures) - FAILURES_SHOWN} more")
    print("FAILED" if everything.failed else "all within the limits")
    return {
        "failed": everything.failed,
        "summary": summary,
        "families": families,
        "failures": failures,
    }
