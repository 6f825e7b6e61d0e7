"""Exact integration: correctness on hard networks, speed, and what quadrature would do instead.

Validates first and stops if anything is wrong. Quadrature evaluates the network by the
renderer's own inference kernel (cl/network/mlp.cl, `evaluate`); only the kernel's time is charged to it,
neither the samples nor the sums.

    python bench/bench_integrate.py [--quick] [--json FILE] [--plot FILE.png]

With `--torture` it only integrates networks that are made to break it, 13,000 a precision (see
torture.py), and fails if anything that is certified is wrong, or crashes:

    python bench/bench_integrate.py --torture [--quick] [--seeds A,B,C] [--per-family N] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from integrate_quadrature import quadrature_table
from integrate_speed import edge_subdivision_table, memory_table, scaling_table, speed_table
from rational import hard_networks, point_network, relative_errors
from torture import LIMIT, torture

from ncv_cl.integration.integrate import integrate
from ncv_cl.integration.integrator import INTEGRATION_METHODS
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device


def stress_table(device: Device) -> list[dict]:
    """Errors against rational arithmetic; raises if one is beyond its limit."""
    rows = []
    precisions = [p for p in LIMIT if p == "float32" or device.has_float64]
    print(
        f"{'network':24}"
        + "".join(f"{p[5:] + ' ' + m:>16}{'robust':>8}" for p in precisions for m in INTEGRATION_METHODS)
    )
    for name, network in hard_networks().items():
        row: dict = {"network": name}
        for precision in precisions:
            for method in INTEGRATION_METHODS:
                values, statistics = integrate(
                    *network, method=method, precision=precision, device=device, return_stats=True
                )
                errors = [relative_errors(g, *point_network(network, p)) for p, g in enumerate(values)]
                row[f"{precision} {method}"] = float(np.max(errors)), statistics.robust_points
                if np.max(errors) > LIMIT[precision] or statistics.uncertified_points:
                    raise SystemExit(f"{name}: {method} in {precision} is off by {np.max(errors):.1e}")
        rows.append(row)
        print(f"{name:24}" + "".join(f"{e:16.1e}{r:8d}" for e, r in list(row.values())[1:]), flush=True)
    return rows


def plot(results: dict, path: Path) -> None:
    """Error against time, and cost against width, depth and points; needs matplotlib."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError:
        raise SystemExit("--plot needs matplotlib: pip install 'ncv_cl[bench]'") from None
    figure, axes = pyplot.subplots(2, 3, figsize=(13, 7))
    for axis, (name, rows) in zip(axes[0], results["quadrature"].items(), strict=True):
        for rule in dict.fromkeys(row[0] for row in rows):
            errors, times = np.array([row[2:] for row in rows if row[0] == rule]).T
            axis.loglog(times, errors, marker="o", label=rule)
        axis.set(title=name, xlabel="µs a point", ylabel="relative error")
    for axis, kind in zip(axes[1], ("width", "depth", "points"), strict=True):
        chosen = [row for row in results["scaling"] if row["case"].startswith(kind)]
        numbers = [int(row["case"].split()[1]) for row in chosen]
        for method in INTEGRATION_METHODS:
            axis.loglog(numbers, [row[method][0] for row in chosen], marker="o", label=method)
        axis.set(xlabel=kind, ylabel="µs a point")
        if kind != "points":
            axis.set_xticks(numbers, numbers)
            axis.minorticks_off()
    for axis in axes.flat:
        axis.legend()
        axis.grid(True, alpha=0.3)
    figure.suptitle(results["device"], fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer points; under two minutes")
    parser.add_argument("--device", help="index or name, as in `ncv-cl devices`")
    parser.add_argument("--json", type=Path, help="write all numbers to this file")
    parser.add_argument(
        "--plot", type=Path, help="draw error against time, and cost against size (needs matplotlib)"
    )
    parser.add_argument(
        "--edge-subdivision", type=Path, metavar="PATH", help="a clone of relu_edge_subdivision"
    )
    parser.add_argument("--torture", action="store_true", help="only networks that break integration")
    parser.add_argument(
        "--seeds", type=_integers, metavar="A,B,C", help="with --torture: other seeds of its networks"
    )
    parser.add_argument(
        "--per-family", type=int, metavar="N", help="with --torture: networks a family, shape and seed"
    )
    options = parser.parse_args()
    device = choose_device(options.device)
    print(device.describe())
    if options.torture:
        found = torture(device, options.quick, options.seeds, options.per_family)
        if options.json:
            _write(options.json, {"device": device.identity, "torture": found})
        raise SystemExit(int(found["failed"]))
    results = {
        "device": device.identity,
        "stress": stress_table(device),
        "speed": speed_table(device, options.quick),
        "quadrature": quadrature_table(device, options.quick),
        "scaling": scaling_table(device, options.quick),
        "memory": memory_table(device, options.quick),
    }
    if options.edge_subdivision:
        results["edge_subdivision"] = edge_subdivision_table(
            device, options.edge_subdivision, options.quick
        )
    if options.json:
        _write(options.json, results)
    if options.plot:
        plot(results, options.plot)


def _integers(text: str) -> list[int]:
    return [int(one) for one in text.split(",")]


def _write(path: Path, results: dict) -> None:
    path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
