"""What an exact integral costs: by the point, by the face and in inference samples; how that grows."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from integrate_networks import (
    FIRST_BIAS,
    MODULATED,
    Case,
    Inference,
    cornell_networks,
    disc_networks,
    interleaved_seconds,
    median_seconds,
    networks,
    some_points,
)

from ncv_cl.integration.integrator import INTEGRATION_METHODS, Integrator
from ncv_cl.opencl.device import Device

# Points and samples of one timing of inference.
INFERENCE_POINTS = INFERENCE_SAMPLES = 256


def speed_table(device: Device, quick: bool) -> list[dict]:
    """Cost of both methods a point and a face, next to inference on the same networks.

    Both methods and inference run in turn; times are medians, `best` the minimum, ratios the medians of
    each turn's ratio.
    """
    scale = 10 if quick else 1
    size, samples = (32, 16) if quick else (128, 64)
    cases = {
        "8x16 He": networks((2, 8, 16, 3), 100000 // scale, MODULATED, 1, False),
        "16x16 He": networks((2, 16, 16, 3), 100000 // scale, MODULATED, 2, False),
        "8x16 He, all lines cut": networks((2, 8, 16, 3), 100000 // scale, MODULATED, 1),
        "16x16 He, all lines cut": networks((2, 16, 16, 3), 100000 // scale, MODULATED, 2),
        "32x32 He, per-point bias 1": networks((2, 32, 32, 3), 20000 // scale, FIRST_BIAS, 3),
        "32x32 trained, disc": disc_networks((2, 32, 32, 3), 20000 // scale),
        "16x16 trained, disc": disc_networks((2, 16, 16, 3), 20000 // scale),
        "32x32 Cornell, slides": cornell_networks(device, "slides", size, samples),
        "16x16 Cornell, wide": cornell_networks(device, "wide", size, samples),
        "8x8 Cornell, default": cornell_networks(device, "default", size, samples),
    }
    rows = []
    print(
        f"\n{'networks':28}{'us a point':>11}{'best':>8}{'faces':>7}{'us a face':>11}{'full us':>9}"
        f"{'full/dec':>9}{'ns a sample':>12}{'= samples':>10}{'robust':>7}"
    )
    for name, network in cases.items():
        row = {"networks": name, **speed_row(device, network)}
        rows.append(row)
        numbers = [value for key, value in row.items() if key not in ("networks", "points")]
        print(
            "{:28}{:11.3f}{:8.3f}{:7.1f}{:11.4f}{:9.2f}{:9.1f}{:12.1f}{:10.0f}{:7d}".format(
                name, *numbers
            ),
            flush=True,
        )
    return rows


def speed_row(device: Device, network: tuple) -> dict:
    """One line of `speed_table`."""
    case = Case(device, network)
    decoupled, full = (case.integrator(method) for method in INTEGRATION_METHODS)
    statistics = decoupled()
    some = Case(device, some_points(network, INFERENCE_POINTS))
    samples = np.random.default_rng(0).uniform(size=(INFERENCE_SAMPLES, 2))
    inference, _ = Inference(some).at(samples)
    # As long as an integration: a short launch would slip between whatever else the machine does.
    once = np.median(interleaved_seconds([decoupled, inference], 3), axis=0)
    turns = max(1, round(once[0] / once[1]))
    times = interleaved_seconds([decoupled, full, lambda: [inference() for _ in range(turns)]], 9)
    times /= [case.points, case.points, some.points * INFERENCE_SAMPLES * turns]
    point, full_point, sample = np.median(times, axis=0)
    return {
        "points": case.points,
        "us_a_point": point * 1e6,
        "best_us_a_point": times[:, 0].min() * 1e6,
        "faces": statistics.faces / case.points,
        "us_a_face": point * case.points / statistics.faces * 1e6,
        "full_us_a_point": full_point * 1e6,
        "full_over_decoupled": float(np.median(times[:, 1] / times[:, 0])),
        "ns_a_sample": sample * 1e9,
        "samples_in_that_time": float(np.median(times[:, 0] / times[:, 2])),
        "robust_points": statistics.robust_points,
    }


def scaling_table(device: Device, quick: bool) -> list[dict]:
    """How the cost grows with width, depth and the number of points."""
    widths = (8, 16, 32) if quick else (8, 16, 32, 64, 128)
    shapes = {f"width {w}": ((2, w, w, 3), max(16, 1024 * 64 // w**2)) for w in widths}
    shapes |= {f"depth {k}": ((2, *[8] * k, 3), 2000) for k in range(1, 5)}
    counts = (100, 1000) if quick else (100, 1000, 10000, 100000)
    shapes |= {f"points {p}": ((2, 8, 16, 3), p) for p in counts}
    rows = []
    print(f"\n{'':16}{'decoupled us':>14}{'faces':>10}{'full us':>12}{'faces':>10}   (a point)")
    for name, (shape, points) in shapes.items():
        layers = len(shape) - 1
        case = Case(device, networks(shape, points, ((True,) * layers, (True,) * layers), 6))
        row: dict = {"case": name}
        for method in INTEGRATION_METHODS:
            seconds, statistics = case.seconds(method, 3)
            row[method] = seconds / points * 1e6, statistics.faces / points
        rows.append(row)
        (a, b), (c, d) = row["decoupled"], row["full"]
        print(f"{name:16}{a:14.2f}{b:10.1f}{c:12.2f}{d:10.1f}", flush=True)
    return rows


def memory_table(device: Device, quick: bool) -> list[dict]:
    """Scratch memory of the device against the number of points: it does not grow."""
    rows = []
    print(f"\n{'4x4 networks':>14}{'us a point':>12}{'scratch':>12}{'parameters':>13}   (bytes)")
    for points in (10**4,) if quick else (10**4, 10**6):
        # Enough different networks, repeated: drawing ten million would take longer than integrating.
        weights, biases = networks((2, 4, 4, 1), min(points, 10**4), MODULATED, 7)
        copies = points // len(biases[0])
        case = Case(
            device,
            (
                [np.tile(w, (copies, 1, 1)) if w.ndim == 3 else w for w in weights],
                [np.tile(b, (copies, 1)) for b in biases],
            ),
        )
        seconds, statistics = case.seconds("decoupled", 3)
        if statistics.points != points or statistics.uncertified_points:
            raise SystemExit(f"{points} points: {statistics}")
        rows.append(
            {
                "points": points,
                "us_a_point": seconds / points * 1e6,
                "scratch_bytes": statistics.scratch_bytes,
                "parameter_bytes": sum(a.nbytes for part in case.network for a in part),
            }
        )
        print("{:14d}{:12.3f}{:12d}{:13d}".format(*rows[-1].values()), flush=True)
    # The largest that a run can need: the shape alone says how large tables and arrangements are.
    largest = () if quick else ((2, 128, 128, 3), (2, 128, 128, 128, 128, 3))
    for widths in ((2, 32, 32, 3), *largest):
        scratch = {m: Integrator(device, widths, method=m).scratch_bytes for m in INTEGRATION_METHODS}
        rows.append({"widths": widths, **scratch})
        print(f"{'x'.join(map(str, widths[1:-1])):>20}: {scratch} bytes for any number of points")
    return rows


def edge_subdivision_table(device: Device, folder: Path, quick: bool) -> list[dict]:
    """The public edge-subdivision tool (Berzins 2023) on single networks, next to ours.

    It cuts by the output's zero set as well, so its cells are compared by the cell. `folder` holds the
    user's clone of arturs-berzins/relu_edge_subdivision; needs PyTorch.
    """
    sys.path.insert(0, str(folder))
    try:
        import torch
        from edge_subdivision import skeletal_subdivision
        from NN import Net
    except ImportError as error:
        raise SystemExit(f"--edge-subdivision {folder}: {error}") from None
    rows = []
    print(
        f"\n{'one network':16}{'its cells':>10}{'its us a cell':>15}{'our faces':>11}"
        f"{'full':>8}{'decoupled':>11}   (us a face)"
    )
    for width in (16, 32):
        weights, biases = disc_networks((2, width, width, 1), 256)
        theirs = Net([2, width, width, 1])
        with torch.no_grad():
            for layer, weight, bias in zip(theirs.fcs, weights, biases, strict=True):
                layer.weight.copy_(torch.from_numpy(weight))
                layer.bias.copy_(torch.from_numpy(bias[0] if bias.ndim == 2 else bias))

        def run(network: object = theirs) -> tuple:
            with torch.no_grad():
                return skeletal_subdivision(
                    network, bbox=(0, 1), device=torch.device("cpu"), verbose=False
                )

        vertices, edges = run()[:2]
        # Euler's formula for a planar subdivision of a square, without the outer face.
        cells = len(edges) - len(vertices) + 1
        seconds = median_seconds(run, 2 if quick else 5)
        case = Case(device, (weights, biases))
        full, statistics = case.seconds("full", 3)
        decoupled, _ = case.seconds("decoupled", 3)
        row = {
            "networks": f"trained {width}x{width}",
            "cells": cells,
            "us_a_cell": seconds / cells * 1e6,
            "faces": statistics.faces / case.points,
            "full_us_a_face": full / statistics.faces * 1e6,
            "decoupled_us_a_face": decoupled / statistics.faces * 1e6,
        }
        rows.append(row)
        print("{:16}{:10d}{:15.1f}{:11.1f}{:8.3f}{:11.3f}".format(*row.values()), flush=True)
    return rows
