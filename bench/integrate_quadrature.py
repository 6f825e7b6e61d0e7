"""What quadrature by many cheap evaluations does in the time of an exact integral, and what it needs."""

from __future__ import annotations

import numpy as np
from integrate_networks import MODULATED, Case, Inference, disc_networks, median_seconds, networks
from scipy.stats import qmc

from ncv_cl.integration.integrate import integrate
from ncv_cl.integration.integrator import INTEGRATION_METHODS
from ncv_cl.opencl.device import Device

Row = tuple[str, int, float, float]


def quadrature_table(device: Device, quick: bool) -> dict[str, list[Row]]:
    """Error (of the mean square, relative to the scale of G) against time a point."""
    results = {}
    largest = 64 if quick else 128
    for name, network in {
        "trained 32x32": disc_networks((2, 32, 32, 3), 64),
        "trained 16x16": disc_networks((2, 16, 16, 3), 64),
        "random 16x16": networks((2, 16, 16, 3), 64, MODULATED, 4),
    }.items():
        case = Case(device, network)
        truth = integrate(
            *network, precision="float64" if device.has_float64 else "float32", device=device
        )
        size = np.sqrt((truth**2).mean())
        print(f"\n{name}: relative error, us a point")
        rows: list[Row] = []
        for method in INTEGRATION_METHODS:
            seconds, _ = case.seconds(method, 9)
            error = float(np.sqrt(((case.out.read() - truth) ** 2).mean()) / size)
            rows.append((method, 0, error, seconds / case.points * 1e6))
        inference = Inference(case)
        side = 8
        while side <= largest:
            centres = (np.arange(side) + 0.5) / side
            grid = np.stack(np.meshgrid(centres, centres), -1).reshape(-1, 2)
            sobol = qmc.Sobol(2, scramble=True, seed=5).random(side * side)
            for rule, samples in (("midpoint", grid), ("Sobol", sobol)):
                work, out = inference.at(samples)
                seconds = median_seconds(work, 5)
                values = out.read().mean(-1, dtype=np.float64).T
                error = float(np.sqrt(((values - truth) ** 2).mean()) / size)
                rows.append((rule, side * side, error, seconds / case.points * 1e6))
            side *= 2
        for rule, samples, error, microseconds in rows:
            print(f"  {rule:12}{samples or '':>7}{error:12.1e}{microseconds:12.2f}", flush=True)
        results[name] = rows
        report_equal(rows)
    return results


def report_equal(rows: list[Row]) -> None:
    """Quadrature's error in our time and its time for our error, from a log-log fit."""
    _, _, our_error, our_time = rows[0]
    for rule in ("midpoint", "Sobol"):
        errors, times = np.log([row[2:] for row in rows if row[0] == rule]).T
        slope, offset = np.polyfit(times, errors, 1)
        equal_time = np.exp(np.polyval((slope, offset), np.log(our_time)))
        equal_error = np.exp((np.log(max(our_error, 1e-9)) - offset) / slope)
        print(
            f"  {rule}: error {equal_time:.1e} in decoupled's {our_time:.2f} us; "
            f"{equal_error:.1e} us for decoupled's {our_error:.1e} (extrapolated)"
        )
