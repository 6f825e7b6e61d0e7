"""The slides' 2-D experiments: control variates of all kinds, on integrands whose integrals are known.

Every method is validated first (unbiased by Student's t; where g can be evaluated, its integral by
quadrature) and left out if it fails. Then all learn from the same training samples and get the same
number of samples: the variance reduction is the variance of plain Monte Carlo with as many independent
samples over the mean square error, the median over fits. Equal time counts training, and charges each
value of f what is said above its column. PyTorch trains on one thread and evaluates on all cores.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

from peers import methods as all_methods
from peers.interface import Method
from planar import FAMILIES, INTEGRANDS, Family
from planar_measure import Sizes, equal_samples, equal_time, validate
from planar_plot import plot

from ncv_cl.opencl.choose import choose_device

# Nanoseconds that a value of f is charged: none, and about a sample's shadow ray and shading.
COSTS = (0.0, 1000.0)
QUICK_INTEGRANDS = ("disk", "smooth", "thin line")
PACKAGES = ("numpy", "scipy", "torch", "zuko", "pyopencl")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--quick", action="store_true", help="few integrands, short schedules, one family"
    )
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--plot", metavar="FILE", help="write a plot here (needs matplotlib)")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    options = parser.parse_args()
    report = run(options.quick, options.device)
    if options.json:
        Path(options.json).write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    if options.plot:
        plot(report, options.plot)


def run(quick: bool, device: str | int | None = None) -> dict:
    """Measure, and print tables on the way.

    Returns
    -------
    dict
        "device", "machine", "packages"; "sizes", as `planar_measure.Sizes`, of integrands alone and in
        families; "missing" (methods left out, and why); "validation",
        "equal_samples" and "equal_time", lists of rows; "losses", one line for each integrand on which
        another method beats ours.
    """
    chosen = choose_device(device)
    print(chosen.identity)
    methods, missing = [], {}
    for method in all_methods(chosen):
        if method.missing:
            missing[method.name] = f"needs {', '.join(method.missing)}"
            print(f"{method.name} is left out: {missing[method.name]}")
        else:
            methods.append(method)
    if quick:
        alone, many = Sizes(2048, 1024, 32, 1, 0.5, 1 << 12), Sizes(16, 64, 2, 1, 0.5, 1 << 8)
        budgets, names, families = (2.0,), QUICK_INTEGRANDS, ("disks",)
    else:
        alone, many = Sizes(4096, 1024, 64, 2, 2.0, 1 << 14), Sizes(64, 64, 4, 2, 2.0, 1 << 10)
        budgets, names, families = (4.0,), tuple(INTEGRANDS), tuple(FAMILIES)
    problems = [(INTEGRANDS[name].family(), alone) for name in names]
    problems += [(FAMILIES[name](256 if quick else 1024), many) for name in families]
    report: dict[str, object] = {
        "device": chosen.identity,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "packages": {name: _version(name) for name in PACKAGES},
        "quick": quick,
        "sizes": {"alone": asdict(alone), "family": asdict(many)},
        "missing": missing,
        "validation": [],
        "equal_samples": [],
        "equal_time": [],
    }
    sound = _validated(methods, problems, report)
    for family, sizes in problems:
        rows, fitted = equal_samples(sound[family.name], family, sizes)
        timed = equal_time(fitted, family, sizes, rows, budgets, COSTS)
        report["equal_samples"] += rows
        report["equal_time"] += timed
        _print_table(family, rows, timed)
    report["losses"] = losses(report["equal_samples"])
    print("\nWhere others win (equal samples):", *report["losses"] or ["nowhere"], sep="\n  ")
    return report


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _validated(
    methods: list[Method], problems: list[tuple[Family, Sizes]], report: dict
) -> dict[str, list[Method]]:
    """The methods that pass: on the first integrand, and on the first family."""
    first = {family.points > 1: (family, sizes) for family, sizes in reversed(problems)}
    passed = {}
    for several, (family, sizes) in sorted(first.items()):
        passed[several] = []
        for method in methods:
            result = validate(method, family, sizes)
            report["validation"].append(result)
            if result["valid"]:
                passed[several].append(method)
            else:
                print(f"{method.name} FAILED its validation and is left out: {result}")
    print(f"validated: {', '.join(method.name for method in passed[False])}")
    return {family.name: passed[family.points > 1] for family, _ in problems}


def losses(rows: list[dict]) -> list[str]:
    """Lines on the integrands where the best of ours is not the best of all."""
    lines = []
    for name in dict.fromkeys(row["integrand"] for row in rows):
        best = {True: None, False: None}
        for row in (row for row in rows if row["integrand"] == name):
            ours = is_ours(row["method"])
            if best[ours] is None or row["variance_reduction"] > best[ours]["variance_reduction"]:
                best[ours] = row
        other, own = best[False], best[True]
        if own and other and other["variance_reduction"] > own["variance_reduction"]:
            lines.append(
                f"{name}: {other['method']} ({other['sampler']}) {other['variance_reduction']:.3g}, "
                f"ours at best {own['variance_reduction']:.3g} ({own['method']}, {own['sampler']})"
            )
    return lines


def is_ours(method: str) -> bool:
    return method.startswith(("ours", "ncv_cl"))


def _print_table(family: Family, rows: list[dict], timed: list[dict]) -> None:
    columns = list(dict.fromkeys((row["seconds"], row["ns_a_value"]) for row in timed))
    first = rows[0]
    several = f"{family.points} integrals, " if family.points > 1 else ""
    trained = max(row["training_samples"] for row in rows)
    print(f"\n{family.name}: {several}{trained} training samples, {first['samples']} samples each")
    heads = "".join(f"{f'{s:g} s, f {c / 1000:g} us':>17}" for s, c in columns)
    print(f"{'':36}{'variance reduction':>26}{'train s':>9}{'ns/sample':>10}  in equal time:{heads}")
    for row in rows:
        low, high = row["variance_reduction_range"]
        cells = []
        for seconds, cost in columns:
            cell = next(
                one
                for one in timed
                if (one["method"], one["sampler"], one["seconds"], one["ns_a_value"])
                == (row["method"], row["sampler"], seconds, cost)
            )
            value = cell["variance_reduction"]
            text = "no time" if value is None else f"{'>' if cell['at_least'] else ''}{value:.3g}"
            cells.append(f"{text:>17}")
        reduction = f"{row['variance_reduction']:.4g} [{low:.3g}, {high:.3g}]"
        print(
            f"{row['method']:24}{row['sampler']:12}{reduction:>26}{row['training_seconds']:9.3f}"
            f"{row['ns_a_sample']:10.0f}{'':16}{''.join(cells)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
