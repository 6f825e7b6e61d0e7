"""Baking into the vertices of a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..integrands import Integrand
from ..output.report import finite
from ..points.corners import find_corners
from ..points.hidden import inside
from ..points.trace import Tracer
from ..rendering.render import integrand_of
from ..scene.load import Scene, load_scene
from ..scene.uv_mesh import BakeError, Triangles, checked_triangles
from .bake import ALL_BACKS, check_on_scene
from .point_estimate import Asked, PointValues, estimate_at


def bake_vertices(
    scene: Scene | str | Path,
    mesh: Triangles,
    *,
    integrand: str | Integrand = "ao",
    **options: object,
) -> PointValues:
    """Ambient occlusion or light at the vertices of a mesh.

    A vertex has the mean over the corners of its triangles, weighed by their angles, each taken 1/64 of
    the way to the triangle's middle. Corners inside of something do not count; a vertex that has no
    other is zero, and counted.

    Parameters
    ----------
    scene : Scene, str or Path
        The mesh should be part of it.
    mesh : UVMesh, TriangleMesh
        Or anything with `vertices`, `triangles` and, if there are some, `normals`.
    integrand, **options
        As `bake` takes them: of light, irradiance over pi.

    Returns
    -------
    PointValues
        values and variance (vertices, 3), or (vertices, 1) for ambient occlusion.

    Raises
    ------
    BakeError
        As `bake` raises it.
    """
    if not isinstance(scene, Scene):
        scene = load_scene(scene)
    vertices, triangles, normals = checked_triangles(mesh)
    found = find_corners(vertices, triangles, normals)
    if not len(found.vertex):
        raise BakeError("triangles: none has an area")
    tracer, place = Tracer(scene), found.positions - scene.origin
    detached = check_on_scene(scene, tracer, place, found.normals)
    kept = np.flatnonzero(~inside(scene, tracer, place, found.normals))
    if not len(kept):
        raise BakeError(ALL_BACKS)
    asked = Asked(
        integrand_of(integrand), found.positions[kept], found.normals[kept], found.normals[kept], True
    )
    corners = estimate_at(scene, asked, options)
    vertex, weight, number = found.vertex[kept], found.weight[kept], len(vertices)
    total = np.bincount(vertex, weight, number)
    share = weight / total[vertex]
    values = [np.bincount(vertex, share * column, number) for column in corners.values.T]
    variance = [np.bincount(vertex, share**2 * column, number) for column in corners.variance.T]
    stats = corners.stats | {
        "corners_detached": detached,
        "corners_inside": len(found.vertex) - len(kept),
        "vertices_inside": int(np.count_nonzero(total[np.unique(triangles)] == 0)),
    }
    return PointValues(np.stack(values, axis=1), np.stack(variance, axis=1), finite(stats))
