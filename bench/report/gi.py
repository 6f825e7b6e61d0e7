"""What global illumination's numbers say: throughput, the slides' finding, equal error and crossover."""

from __future__ import annotations

from collections.abc import Iterator

from bench_curves import DEFAULT, SOBOL

from .curves import why
from .document import shown

# bench_gi's names of what the curves call SOBOL and DEFAULT.
PLAIN, OURS = "Sobol", "ncv"


def findings(data: dict) -> Iterator[str]:
    """Sentences on each scene."""
    for scene, case in data.get("cases", {}).items():
        yield _throughput(scene, case["throughput"])
        if case["finding"]:
            yield _finding(scene, case["finding"])
        yield _equal_error(scene, case)
        yield why(
            {
                "scene": scene,
                "integrand": "gi",
                "crossovers": {SOBOL: case["crossovers"][OURS]},
                "methods": {
                    SOBOL: {"points": case["runs"][PLAIN]}, DEFAULT: {"points": case["runs"][OURS]}
                },
            }
        )  # fmt: skip


def _throughput(scene: str, speed: dict) -> str:
    return (
        f"{scene} gi: plain path tracing answers {shown(speed['million_rays_a_second'])} million rays "
        f"a second, all in, {shown(speed['ratio'])} of what embreex alone traces of the same rays; "
        f"{shown(100 * speed['traced'])} % of them are traced; if all are, it is "
        f"{shown(speed['all_traced_ratio'])}."
    )


def _finding(scene: str, rows: list[dict]) -> str:
    """The slides' network with the most training samples."""
    row = max((r for r in rows if r["preset"] == "slides"), key=lambda r: r["training samples"])
    return (
        f"{scene} gi, the slides' finding: with {row['training samples']} training samples a point "
        f"their network's square error is {shown(row['relative network error'])} of the field's "
        f"variance, but {shown(100 * row['share of f'])} % of f's variance is noise of the nested "
        f"estimate, which no network takes away: variance falls by {shown(row['gain'])}, and by "
        f"{shown(row['most gain'])} with a network without error."
    )


def _equal_error(scene: str, case: dict) -> str:
    target = case["runs"][PLAIN][-1]
    ratios = ", ".join(f"{name} {shown(ratio)}" for name, ratio in case["speedups"].items())
    return (
        f"{scene} gi: {shown(target['samples'])} Sobol samples take {shown(target['seconds'])} s; those "
        f"over the seconds to the same error of: {ratios}."
    )
