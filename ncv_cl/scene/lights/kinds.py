"""Lights that are no parallelograms, as `build_scene` takes them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

# Subdivisions of the icosahedron that rays see where a sphere shines: some hundred triangles a side.
SPHERE_SUBDIVISIONS = 3


@dataclass(frozen=True, eq=False)
class DiscLight:
    """A disc that emits the same radiance everywhere and in every direction.

    Attributes
    ----------
    centre, normal : float32 (3,)
        `normal`, of any length, points to where it emits.
    radius : float
    radiance : float32 (3,)
        Linear RGB.
    two_sided : bool
        Whether it emits from the back as well.
    """

    centre: NDArray[np.floating]
    normal: NDArray[np.floating]
    radius: float
    radiance: NDArray[np.float32]
    two_sided: bool = False

    @property
    def area(self) -> float:
        """Area of one side, in square scene units."""
        return float(np.pi * self.radius**2)

    def moved(self, origin: NDArray[np.float64]) -> DiscLight:
        """The same light about `origin`, in single precision."""
        centre = (self.centre - origin).astype(np.float32)
        return replace(self, centre=centre, normal=self.normal.astype(np.float32))


@dataclass(frozen=True, eq=False)
class SphereLight:
    """A sphere that emits the same radiance everywhere and in every direction, outwards.

    Attributes
    ----------
    centre : float32 (3,)
    radius : float
    radiance : float32 (3,)
        Linear RGB.
    subdivisions : int
        Of the icosahedron that rays meet, which has the sphere's area; shadows are those of the sphere.
    """

    centre: NDArray[np.floating]
    radius: float
    radiance: NDArray[np.float32]
    subdivisions: int = SPHERE_SUBDIVISIONS

    @property
    def area(self) -> float:
        """Area of the disc that it is seen as from afar, in square scene units."""
        return float(np.pi * self.radius**2)

    def moved(self, origin: NDArray[np.float64]) -> SphereLight:
        """The same light about `origin`, in single precision."""
        return replace(self, centre=(self.centre - origin).astype(np.float32))


@dataclass(frozen=True, eq=False)
class PointLight:
    """A light that is so small that only its intensity matters: a `SphereLight` of that intensity.

    Attributes
    ----------
    position : array (3,)
    intensity : array (3,)
        Radiant intensity, power per solid angle; linear RGB.
    radius : float, optional
        By default a thousandth of the diagonal of the scene's bounds, or half the way to the nearest
        surface where that is less.
    """

    position: NDArray[np.float64]
    intensity: NDArray[np.float32]
    radius: float | None = None


@dataclass(frozen=True, eq=False)
class SpotLight:
    """A small sphere of which a cone of directions is lit.

    Towards directions up to `inner_angle` from the axis its intensity is as given. It falls to nothing
    at `outer_angle`, linearly with the angle, as Mitsuba's spot does.

    Attributes
    ----------
    position : array (3,)
    intensity : array (3,)
        Radiant intensity on the axis, power per solid angle; linear RGB.
    direction : array (3,)
        Of the axis, of any length.
    outer_angle, inner_angle : float
        Half-angles in degrees; the inner one is three quarters of the outer one by default.
    radius : float, optional
        As `PointLight` has it.
    """

    position: NDArray[np.floating]
    intensity: NDArray[np.float32]
    direction: NDArray[np.float64] = field(kw_only=True)
    outer_angle: float = field(kw_only=True)
    # None leaves the choice to the scene, whose lights have both.
    inner_angle: float = field(default=None, kw_only=True)  # type: ignore[assignment]
    radius: float = None  # type: ignore[assignment]

    @property
    def area(self) -> float:
        """Area of the disc that it is seen as, in square scene units."""
        return float(np.pi * self.radius**2)

    @property
    def radiance(self) -> NDArray[np.float32]:
        """On the axis, float32 (3,)."""
        return (self.intensity / self.area).astype(np.float32)

    def moved(self, origin: NDArray[np.float64]) -> SpotLight:
        """The same light about `origin`, in single precision."""
        return replace(self, position=(self.position - origin).astype(np.float32))
