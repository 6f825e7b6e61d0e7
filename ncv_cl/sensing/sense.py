"""Values at points of the user: irradiance of sensors, radiance of surfaces, ambient occlusion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..integrands import AmbientOcclusion, DirectLight, GlobalIllumination, Integrand, IntegrandError
from ..points.arrays import (
    checked_vectors,
    unit_vectors,
)
from ..rendering.render import integrand_of
from ..scene.load import Scene
from .point_estimate import Asked, PointValues, estimate_at


def irradiance(
    scene: Scene | str | Path,
    positions: np.ndarray,
    normals: np.ndarray,
    *,
    integrand: str | Integrand = "direct",
    both_sides: bool = False,
    **options: object,
) -> PointValues:
    """Irradiance of plane sensors, in the unit of the scene's radiance times steradian.

    E(x, n) = ∫ L(x, ω) max(n · ω, 0) dω over the directions ω that light comes from.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, or the path of its TOML file.
    positions : array (n, 3) or (rows, columns, 3)
        Where the sensors are, in the world. A sensor within 2^-16 of its largest coordinate (and 2^-20
        of the scene's) of a surface lies on it, on the side of its normal. Of sensors in rows and
        columns, neighbours are taken for neighbours in space, as in an image; of others it does not
        matter in which order they come, and fewer than 256 are estimated several times over, so that
        their errors are known.
    normals : array of the shape of positions
        Scaled to length 1.
    integrand : {"direct", "gi"} or Integrand
        Light that arrives straight from area lights, or all light.
    both_sides : bool
        Add the irradiance of the sensor's other side.
    **options
        `method`, `spp`, `seed`, `device`, `progress`, the groups `sampling`, `training`,
        `stopping` and `machine` and their single options as `render` takes them, but for `supersample`;
        and `target_error`: end when the root mean square standard error of the values is estimated to be
        this.

    Returns
    -------
    PointValues

    Raises
    ------
    PointError
        For arrays of wrong shapes, and numbers that are not finite or vectors of length zero, by index.
    ValueError, TypeError, DeviceError
        As `render` raises them.
    """
    chosen = integrand_of(integrand)
    if not isinstance(chosen, (DirectLight, GlobalIllumination)):
        raise IntegrandError(
            f"irradiance is of integrand direct or gi, not {chosen.name}; there are also "
            "ncv.ambient_occlusion and ncv.radiance"
        )
    at, normal = _place_and_normal(positions, normals)
    ask = Asked(chosen, at, normal, normal, is_sensor=True, factor=np.pi)
    if not both_sides:
        return estimate_at(scene, ask, options)
    # Another axis in front, so that a grid stays one.
    both = replace(ask, positions=np.concatenate([at, at]), normals=np.concatenate([normal, -normal]),
                   outgoing=np.concatenate([normal, -normal]), sides=2)  # fmt: skip
    return estimate_at(scene, both, options)


def radiance(
    scene: Scene | str | Path,
    positions: np.ndarray,
    normals: np.ndarray,
    directions: np.ndarray,
    *,
    integrand: str | Integrand = "gi",
    **options: object,
) -> PointValues:
    """Radiance that leaves points of the scene's surface, as a camera sees it.

    Parameters
    ----------
    scene, positions, **options
        As for `irradiance`; every position must lie on a surface, whose material counts.
    normals : array of the shape of positions
        Shading normals, scaled to length 1. The triangle's own normal is the scene's.
    directions : array of the shape of positions
        Towards the viewer, scaled to length 1.
    integrand : {"gi", "direct", "ao"}, str or Integrand
        As `render` takes it. What lights and materials emit is part of the radiance, as in an image.

    Returns
    -------
    PointValues
        Its values are those of a pixel whose camera ray hits the point.

    Raises
    ------
    PointError
        As `irradiance` raises it, and for positions that lie on no surface.
    """
    at, normal = _place_and_normal(positions, normals)
    outgoing = unit_vectors("directions", directions, at.shape)
    return estimate_at(scene, Asked(integrand_of(integrand), at, normal, outgoing), options)


def ambient_occlusion(
    scene: Scene | str | Path,
    positions: np.ndarray,
    normals: np.ndarray,
    *,
    radius: float = np.inf,
    mapping: str = "height",
    **options: object,
) -> PointValues:
    """The share of the hemisphere about each normal that is open, weighted by the cosine.

    Parameters
    ----------
    scene, positions, normals, **options
        As for `irradiance`.
    radius, mapping
        As `AmbientOcclusion` takes them. Without a radius this is the sky view factor.

    Returns
    -------
    PointValues
        Its arrays are (n,), or (rows, columns).
    """
    at, normal = _place_and_normal(positions, normals)
    asked = Asked(AmbientOcclusion(radius, mapping), at, normal, normal, is_sensor=True)
    found = estimate_at(scene, asked, options)
    return replace(found, values=found.values[..., 0], variance=found.variance[..., 0])


def _place_and_normal(positions: object, normals: object) -> tuple[np.ndarray, np.ndarray]:
    at = checked_vectors("positions", positions)
    return at, unit_vectors("normals", normals, at.shape)
