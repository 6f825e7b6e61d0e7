"""View factors between named surfaces of a scene, with partial obstruction by everything else."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..opencl.choose import choose_device
from ..opencl.device import Device
from ..points.patches import Patch, find_patch
from ..scene.load import Scene, load_scene
from ..scene.table import SceneError
from ..settings.options import MOST_CELLS, MOST_SAMPLES, checked_whole
from ..visibility.between import nothing_between
from ..visibility.exchange import exchange_area
from .patch_views import EXACT, RECIPROCAL, SCRAMBLES, measured

# Standard error of an exact factor, as a part of it: what rounding of coordinates may make of it.
ROUNDED = 2.0**-22


@dataclass(frozen=True)
class ViewFactors:
    """View factors between patches.

    Attributes
    ----------
    patches : tuple of str
        Their names.
    values, variance : ndarray
        float64 (patches, patches): [i, j] is the part of what leaves patch i evenly that reaches patch
        j, and the variance of this estimate.
    areas : ndarray
        float64 (patches,), square scene units.
    how : ndarray
        str (patches, patches): "exact" where nothing can be in the way, but for the rounding of
        coordinates; "lines" and "rays" where it was measured so; "reciprocal" where [j, i] was, and is
        multiplied by the ratio of areas.
    stats : dict
    """

    patches: tuple[str, ...]
    values: np.ndarray
    variance: np.ndarray
    areas: np.ndarray
    how: np.ndarray
    stats: dict[str, Any]

    @property
    def standard_error(self) -> np.ndarray:
        """The root of `variance`."""
        return np.sqrt(self.variance)

    @property
    def row_sums(self) -> np.ndarray:
        """The part of each patch's radiation that reaches any of the patches: 1 in a closed room."""
        return self.values.sum(axis=1)

    @property
    def reciprocity(self) -> np.ndarray:
        """A_i F_ij - A_j F_ji: 0 but for the errors."""
        exchange = self.areas[:, None] * self.values
        return exchange - exchange.T


def view_factors(
    scene: Scene | str | Path,
    patches: Sequence[str],
    *,
    points: int = 1024,
    lines: int = 16,
    seed: int = 0,
    device: Device | int | str | None = None,
    executor: Executor | None = None,
) -> ViewFactors:
    """View factors between named surfaces, which everything in the scene may obstruct.

    F_ij = 1 / A_i ∫_i ∫_j V cos cos / (π r²) dA_j dA_i. It is exact where nothing can be in the way.
    Else the outer integral is over Sobol points on patch i, and the inner one along lines on patch j, if
    that is made of at most 8 parallelograms: of each line the visible part is exact. Of other patches j,
    factors are those of the opposite direction, or, if patch i is no better, from rays.

    Parameters
    ----------
    scene : Scene, str or Path
        Surfaces have names by the key ``name`` of quads, polygons, boxes, spheres and meshes, or by
        `TriangleMesh.name`. All of a name are one patch.
    patches : list of str
        Names; "-wall" is the back of "wall" (the front is the side of edge1 × edge2 of a quad, of
        counter-clockwise corners of triangles, the outside of boxes and spheres).
    points : int
        Points on each patch in each of 16 scrambles; powers of two are best.
    lines : int
        Lines, or rays, for each point and patch.
    seed, device, executor
        As `render` takes them; workers draw lines, not rays.

    Raises
    ------
    SceneError
        If no surface has one of the names, or one that has has holes.
    ValueError
        For bad arguments.
    """
    started = time.perf_counter()
    points = checked_whole("points", points, MOST_CELLS)
    lines = checked_whole("lines", lines, MOST_SAMPLES)
    if isinstance(patches, str) or not all(isinstance(name, str) for name in patches):
        raise ValueError(f"patches must be names of surfaces, got {patches!r}")
    if not isinstance(scene, Scene):
        scene = load_scene(scene)
    device = choose_device(device)
    sides = [_whole_patch(scene, name) for name in patches]
    areas = np.array([side.area for side in sides])
    exact = _exact(scene, sides)
    means, how = measured(device, scene, sides, np.isnan(exact), points, lines, seed, executor)
    values, variance = means.mean(axis=2), means.var(axis=2, ddof=1) / SCRAMBLES
    # Where neither lines nor rays lead to the target, they lead back.
    ratio = areas[None, :] / areas[:, None]
    turned = how == RECIPROCAL
    values = np.where(turned, ratio * values.T, values)
    variance = np.where(turned, ratio**2 * variance.T, variance)
    is_exact = how == EXACT
    values = np.where(is_exact, exact, values)
    variance = np.where(is_exact, (ROUNDED * exact) ** 2, variance)
    stats = {
        "device": device.identity,
        "points_a_patch": SCRAMBLES * points,
        "lines_a_point": lines,
        "seconds": {"total": time.perf_counter() - started},
    }
    return ViewFactors(tuple(patches), values, variance, areas, how, stats)


def _whole_patch(scene: Scene, name: str) -> Patch:
    """The patch of a name, whose surfaces must be without holes."""
    found = find_patch(scene, name)
    for number in np.unique(scene.triangle_material[found.triangles]):
        material = scene.materials[number]
        if material.maps is not None and material.maps.opacity is not None:
            raise SceneError(
                f"{scene.name}: surface {name!r} has holes (the opacity of material {material.name!r}), "
                "which view factors do not know; take the opacity away"
            )
    return found


def _exact(scene: Scene, sides: list[Patch]) -> np.ndarray:
    """Factors that need no samples, float64 (patches, patches); NaN for the others."""
    found = np.full((len(sides), len(sides)), np.nan)
    for i, first in enumerate(sides):
        for j, second in enumerate(sides[: i + 1]):
            if i == j and first.is_flat:
                found[i, i] = 0.0
            elif nothing_between(scene, first, second):
                pairs = itertools.product(first.piece_corners, second.piece_corners)
                area = sum(exchange_area(*pair) for pair in pairs)
                found[i, j], found[j, i] = area / first.area, area / second.area
    return found
