"""Shadow rays of scenes of few triangles, each tested against all of them instead of traced."""

from __future__ import annotations

import numpy as np

from ..opencl.layout import Record
from ..scene.load import Scene

# What is kept of a triangle, about the centre: its plane, and of each edge the Pluecker coordinates.
CASTER = Record(
    "CASTER",
    {
        "normal": 3,
        "distance": 1,
        **{f"{part}_{edge}": 3 for edge in range(3) for part in ("edge", "moment")},
    },
)
# Floats of the centre, which comes before the first triangle.
CENTRE_FLOATS = 4


def shadow_casters(scene: Scene) -> np.ndarray:
    """What shadow.cl reads of a scene, float32 (CENTRE_FLOATS + triangles * CASTER.size,)."""
    corners = scene.vertices[scene.triangles].astype(np.float64)
    # The scene's origin is near what is seen (scene/place.py), its middle may be far away.
    centre = np.clip(np.float32(0), *scene.bounds)
    corners -= centre
    following = np.roll(corners, -1, axis=1)
    edges, moments = following - corners, np.cross(corners, following)
    # Scaled before the cross product, whose squared length is very small for small triangles.
    sides = edges[:, :2] / np.abs(edges[:, :2]).max(axis=(1, 2), keepdims=True)
    normals = np.cross(sides[:, 0], sides[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    records = CASTER.pack(
        normal=normals,
        distance=np.sum(normals * corners[:, 0], axis=1),
        **{f"edge_{k}": edges[:, k] for k in range(3)},
        **{f"moment_{k}": moments[:, k] for k in range(3)},
    )
    before = np.append(centre, np.zeros(CENTRE_FLOATS - 3))
    return np.concatenate([before.astype(np.float32), records.ravel()])


def shadow_defines(casters: int) -> dict[str, int | str]:
    """The `-D` constants of shadow.cl; with 0 casters, shadow rays are to be traced."""
    return {
        "CASTERS": f"{casters}u",
        **CASTER.defines(),
        "CENTRE_FLOATS": f"{CENTRE_FLOATS}u",
    }
