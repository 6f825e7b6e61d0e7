"""View factors with known values: ours, raystrack's and pyviewfactor's errors and seconds."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import ncv_cl as ncv
from ncv_cl.opencl.device import Device

Corners = tuple[tuple[float, float, float], ...]
# Unit squares; a face is seen from the side on which its corners go round counter-clockwise.
FLOOR: Corners = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0))
CEILING: Corners = ((0, 0, 1), (0, 1, 1), (1, 1, 1), (1, 0, 1))
WALL: Corners = ((0, 0, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1))
# Half-way up, over the half of the floor with x < 1/2.
BAFFLE: Corners = ((0, 0, 0.5), (0.5, 0, 0.5), (0.5, 1, 0.5), (0, 1, 0.5))
# Nodes along an axis of the reference's quadrature: its integrand is smooth.
NODES = 64
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True)
class Case:
    """From the floor to `other`, with `between` in the way."""

    name: str
    other: Corners
    exact: float
    between: tuple[Corners, ...] = ()


def to_rectangle(x: np.ndarray, y: np.ndarray, left: np.ndarray) -> np.ndarray:
    """The part of what leaves a point (x, y, 0) upwards that reaches [left, 1] x [0, 1] one unit above.

    The sum of four right-angled corners; Howell, A Catalog of Radiation Heat Transfer Configuration
    Factors, B-3.
    """

    def corner(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        by_a, by_b = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
        return (a / by_a * np.arctan(b / by_a) + b / by_b * np.arctan(a / by_b)) / (2 * np.pi)

    return (corner(1 - x, 1 - y) - corner(left - x, 1 - y)) - (corner(1 - x, -y) - corner(left - x, -y))


def past_the_baffle() -> float:
    """Floor to ceiling past the baffle: from x the ceiling is seen from 1 - x on."""
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    nodes, weights = (nodes + 1) / 2, weights / 2
    x, y = np.meshgrid(nodes, nodes, indexing="ij")
    return float(weights @ to_rectangle(x, y, 1 - x) @ weights)


CASES = (
    # Howell, C-11 and C-14.
    Case("opposite squares", CEILING, 0.19982489569838746),
    Case("squares with a common edge", WALL, 0.20004377607540316),
    Case("opposite squares, a baffle between", CEILING, past_the_baffle(), (BAFFLE,)),
)


def rows(device: Device, quick: bool) -> list[dict]:
    """A row for each case and each peer that is installed."""
    found = []
    for case in CASES:
        ours, own_error, own_seconds = best_of(lambda case=case: by_us(case, device, quick))
        for name, work in (("raystrack", by_raystrack), ("pyviewfactor", by_pyviewfactor)):
            if name == "pyviewfactor" and case.between:
                # It has no partial obstruction: a facet sees another or does not.
                continue
            try:
                theirs, error, seconds = best_of(lambda case=case, work=work: work(case, quick))
            except ImportError:
                print(f"{name} is not installed")
                continue
            errors = f"ours {ours - case.exact:+.1e}, {name} {theirs - case.exact:+.1e}"
            note = f"known value {case.exact:.7f}: {errors}"
            found.append(
                {
                    "peer": name,
                    "scene": case.name,
                    "quantity": "view factor",
                    "ours": ours,
                    "theirs": theirs,
                    "ratio": ours / theirs,
                    "standard_error": float(np.hypot(own_error, error)) / theirs,
                    "seconds_ours": own_seconds,
                    "seconds_theirs": seconds,
                    "note": note,
                }
            )
    return found


def best_of(work: Callable[[], tuple[float, float]], times: int = 3) -> tuple[float, float, float]:
    """What `work` returns, and the least processor seconds of several runs after a first."""
    work()
    seconds = []
    for _ in range(times):
        began = time.process_time()
        value, error = work()
        seconds.append(time.process_time() - began)
    return value, error, min(seconds)


def by_us(case: Case, device: Device, quick: bool) -> tuple[float, float]:
    """The view factor and its standard error."""
    named = {"floor": FLOOR, "other": case.other} | {
        f"between{k}": c for k, c in enumerate(case.between)
    }
    meshes = [
        ncv.TriangleMesh(np.array(corners, float), TRIANGLES, "matte", name=name)
        for name, corners in named.items()
    ]
    camera = ncv.Camera((0.5, 0.5, 3), (0.5, 0.5, 0), 40)
    scene = ncv.build_scene(camera, {"matte": ncv.Material(0.5)}, meshes)
    points = 64 if quick else 1024
    found = ncv.view_factors(scene, ["floor", "other"], points=points, device=device)
    return float(found.values[0, 1]), float(found.standard_error[0, 1])


def by_raystrack(case: Case, quick: bool) -> tuple[float, float]:
    """The same by its rays, until it takes the standard error for 1e-4."""
    from raystrack import Accuracy, Channel, Mesh, Query, Sampling, Scene, SolveOptions, Solver

    named = {"floor": FLOOR, "other": case.other} | {
        f"between{k}": c for k, c in enumerate(case.between)
    }
    scene = Scene.from_meshes(
        {
            name: Mesh(np.array(corners, np.float32), TRIANGLES.astype(np.int32))
            for name, corners in named.items()
        }
    )
    options = SolveOptions(
        sampling=Sampling(seed=1), accuracy=Accuracy(100, 1e-2 if quick else 1e-4, min_replicates=5)
    )
    channel = Channel("surface", "other", "front")
    with Solver(scene, device="cpu", bvh="builtin") as solver:
        result = solver.solve(Query.pair("floor", "other"), options)
        return float(result.value("floor", channel)), float(result.error("floor", channel))


def by_pyviewfactor(case: Case, quick: bool) -> tuple[float, float]:
    """The same by its quadrature along edges, which states no error."""
    import pyvista
    from pyviewfactor import compute_viewfactor

    del quick
    floor = pyvista.PolyData(np.array(FLOOR, float), faces=[4, 0, 1, 2, 3])
    other = pyvista.PolyData(np.array(case.other, float), faces=[4, 0, 1, 2, 3])
    return float(compute_viewfactor(other, floor)), 0.0
