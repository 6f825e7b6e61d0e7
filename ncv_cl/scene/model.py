"""What a scene is: camera, materials, lights and one merged triangle mesh.

`Camera`, `Material`, `TriangleMesh` and `QuadLight` are also what `build_scene` makes a scene of. It
takes any numbers for them, checks these, and keeps the arrays that are described here.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .geometry import SMALLEST_ROUGHNESS
from .lights.kinds import DiscLight, SphereLight, SpotLight
from .sky.environment import Environment
from .table import SceneError
from .textures.texture import Maps, Texture

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# The index of refraction of glass where none is given.
USUAL_IOR = 1.5


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    The picture's axes are right-handed: right = normalize(cross(forward, up)) with
    forward = target - position, so looking along +z with up +y the x axis points left.

    Attributes
    ----------
    position, target : float64 (3,)
    up : float64 (3,)
        Named where it is given; it need not be perpendicular to the view direction.
    vertical_fov : float
        Full vertical field of view in degrees, in (0, 180).
    """

    position: NDArray[np.float64]
    target: NDArray[np.float64]
    up: NDArray[np.float64] = field(default_factory=lambda: np.array([0.0, 1.0, 0.0]), kw_only=True)
    vertical_fov: float


@dataclass(frozen=True, eq=False)
class Material:
    """A two-sided opaque surface, Lambert plus an optional GGX lobe; or glass.

    Attributes
    ----------
    name : str
        Named where it is given.
    albedo : float32 (3,)
        Diffuse reflectance, linear RGB in [0, 1].
    reflectance : float32 (3,)
        Specular reflectance at normal incidence in [0, 1]; 0 means no specular lobe.
    roughness : float, optional
        In [0.01, 1]; the GGX alpha is roughness**2. 1 by default, and of glass 0.01, which is smooth.
    emission : float32 (3,)
        Radiance that the surface emits everywhere and in every direction, from both sides; linear RGB.
        It is light that is sampled, unless a texture or holes say where it is.
    maps : Maps, optional
        What varies over the surface: `albedo` and `roughness` are then factors.
    transmission : float32 (3,)
        More than 0 makes the surface glass, a dielectric interface: what it lets through is multiplied
        by this, what it reflects is not. Albedo and reflectance must be 0. The normal by the order of
        the corners points out of the glass.
    ior : float, optional
        Index of refraction behind the surface over that before it; 1.5 by default.
    thin : bool
        Whether the surface is a pane with air on both sides, which does not bend light; it is smooth.
    """

    name: str = field(default="", kw_only=True)
    albedo: NDArray[np.float32]
    reflectance: NDArray[np.float32] = field(default_factory=lambda: np.zeros(3, np.float32))
    # None stands for the usual one, which is then put in its place.
    roughness: float = None  # type: ignore[assignment]
    emission: NDArray[np.float32] = field(default_factory=lambda: np.zeros(3, np.float32))
    maps: Maps | None = None
    transmission: NDArray[np.float32] = field(default_factory=lambda: np.zeros(3, np.float32))
    ior: float | None = None
    thin: bool = False

    def __post_init__(self) -> None:
        if self.roughness is None:
            object.__setattr__(self, "roughness", SMALLEST_ROUGHNESS if self.is_glass else 1.0)
        if self.ior is None and self.is_glass:
            object.__setattr__(self, "ior", USUAL_IOR)

    @property
    def is_glass(self) -> bool:
        """Whether it lets light through."""
        try:
            return bool(np.any(np.asarray(self.transmission, np.float64) > 0))
        except (TypeError, ValueError):
            # What is no colour is refused where a scene is built of it.
            return False

    @property
    def has_lobe(self) -> bool:
        """Whether it reflects specularly anywhere."""
        metal = self.maps is not None and self.maps.metallic > 0
        return bool(np.any(self.reflectance > 0)) or metal or self.is_glass

    @property
    def tint(self) -> NDArray[np.float32]:
        """The albedo, or of glass its transmission."""
        return self.transmission if self.is_glass else self.albedo

    @property
    def facing(self) -> NDArray[np.float32]:
        """Reflectance at normal incidence, that of glass by Fresnel's equations."""
        if self.ior is None or not self.is_glass:
            return self.reflectance
        return np.full(3, ((self.ior - 1.0) / (self.ior + 1.0)) ** 2, np.float32)

    @property
    def signed_ior(self) -> float:
        """What kernels know glass by: its index of refraction, negative of panes; 0 of others."""
        if self.ior is None or not self.is_glass:
            return 0.0
        return -self.ior if self.thin else self.ior

    @property
    def textures(self) -> tuple[Texture, ...]:
        """The textures that need coordinates of the surface."""
        return () if self.maps is None else self.maps.textures


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles of one material, as `build_scene` takes them.

    Attributes
    ----------
    vertices : array (n_vertices, 3)
        World positions.
    triangles : array of integers (n_triangles, 3)
        Each triangle's three rows of `vertices`, counted from 0.
    material : str
        A key of the scene's materials.
    normals : array (n_vertices, 3), optional
        Shading normals of any length, to be interpolated. Triangles whose three are zero, and all where
        there are none, are shaded with their own.
    name : str, optional
        What surfaces are called, for `view_factors` and `bake`; several may share a name.
    uv : array (n_vertices, 2), optional
        Texture coordinates: (0, 0) is an image's lower left corner, (1, 1) its upper right one.
    colours : array (n_vertices, 3), optional
        Linear RGB in [0, 1], to be interpolated, that multiplies the material's albedo.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    material: str
    normals: NDArray[np.float64] | None = None
    name: str | None = None
    uv: NDArray[np.float64] | None = None
    colours: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class QuadLight:
    """A parallelogram that emits the same radiance everywhere and in every direction.

    Attributes
    ----------
    corner, edge1, edge2 : float32 (3,)
        Its points are corner + u * edge1 + v * edge2 with u, v in [0, 1].
    radiance : float32 (3,)
        Linear RGB.
    two_sided : bool
        Whether it emits from the back as well.
    """

    corner: NDArray[np.floating]
    edge1: NDArray[np.floating]
    edge2: NDArray[np.floating]
    radiance: NDArray[np.float32]
    two_sided: bool = False

    @property
    def normal(self) -> NDArray[np.float32]:
        """Unit normal of the emitting side, cross(edge1, edge2) normalised; float32 (3,)."""
        vector = self._vector_area()
        return (vector / np.linalg.norm(vector)).astype(np.float32)

    @property
    def area(self) -> float:
        """Area of one side, in square scene units."""
        return float(np.linalg.norm(self._vector_area()))

    def moved(self, origin: NDArray[np.float64]) -> QuadLight:
        """The same light about `origin`, in single precision."""
        return replace(self, corner=self.corner - origin).single()

    def single(self) -> QuadLight:
        """The same light in single precision."""
        vectors = {name: getattr(self, name).astype(np.float32) for name in ("corner", "edge1", "edge2")}
        return replace(self, **vectors)

    def _vector_area(self) -> NDArray[np.float64]:
        return np.cross(self.edge1.astype(np.float64), self.edge2.astype(np.float64))


# What `Scene.lights` holds. A `PointLight` becomes a `SphereLight`.
Light = QuadLight | DiscLight | SphereLight | SpotLight


@dataclass(frozen=True, eq=False)
class Scene:
    """All that is rendered: one merged triangle mesh, surfaces, lights, camera.

    The arrays are read-only. Every light is also part of the mesh, as its last triangles. Positions are
    relative to `origin`, which scene/place.py chooses, those of lights and camera too.

    Attributes
    ----------
    name : str
    path : Path or None
        The file the scene was read from; None where there was none.
    camera : Camera
    materials : tuple of Material
        Those of the scene in order, then those of mesh files, then a black one for lights.
    lights : tuple of QuadLight, DiscLight, SphereLight or SpotLight
        May be empty: ambient occlusion needs none.
    vertices : float32 (n_vertices, 3)
    vertex_normals : float32 (n_vertices, 3)
        Shading normals, to be interpolated and normalised; all zero where the triangle's own normal is
        to be used.
    triangles : uint32 (n_triangles, 3)
    triangle_material : int32 (n_triangles,)
        Index into `materials`.
    triangle_light : int32 (n_triangles,)
        Index into `lights`, or -1.
    warnings : tuple of str
        What was put right, such as dropped triangles.
    origin : float64 (3,)
        World position of this scene's origin: 0 unless the scene lies far from the world's.
    named : tuple of (str, range)
        Names of surfaces, and the triangles of each; a name may occur several times.
    vertex_uv : float32 (n_vertices, 2), optional
        Texture coordinates; None where no material has a texture.
    vertex_colours : float32 (n_vertices, 3), optional
        Linear RGB that multiplies the albedo; None where no mesh has colours.
    environment : Environment, optional
        What surrounds the scene, and its suns; None where that is black.
    """

    name: str
    path: Path | None
    camera: Camera
    materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    vertices: NDArray[np.float32]
    vertex_normals: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    triangle_material: NDArray[np.int32]
    triangle_light: NDArray[np.int32]
    warnings: tuple[str, ...]
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    named: tuple[tuple[str, range], ...] = ()
    vertex_uv: NDArray[np.float32] | None = None
    vertex_colours: NDArray[np.float32] | None = None
    environment: Environment | None = None

    @property
    def coordinates(self) -> NDArray[np.float32]:
        """`vertex_uv` of a scene that has textures, which is then never None."""
        if self.vertex_uv is None:
            raise SceneError(f"{self.name}: there are no texture coordinates, and no texture")
        return self.vertex_uv

    @cached_property
    def has_holes(self) -> bool:
        """Whether rays pass surfaces where the opacity of a texture is too small."""
        return any(one.maps is not None and one.maps.opacity is not None for one in self.materials)

    @cached_property
    def has_glass(self) -> bool:
        """Whether some surface lets light through; materials that no surface has do not count."""
        return any(self.materials[k].is_glass for k in np.unique(self.triangle_material))

    @cached_property
    def has_panes(self) -> bool:
        """Whether shadow rays pass some surfaces, tinted."""
        return any(one.is_glass and one.thin for one in self.materials)

    @property
    def has_gaps(self) -> bool:
        """Whether a shadow ray may pass a triangle that it meets."""
        return self.has_holes or self.has_panes

    def surface_of(self, name: str) -> NDArray[np.int64]:
        """The triangles of the surfaces of a name, int64.

        Raises
        ------
        SceneError
            If there are none.
        """
        ranges = [found for own, found in self.named if own == name]
        if not ranges:
            known = ", ".join(sorted({own for own, _ in self.named})) or "none"
            raise SceneError(f"{self.name}: no surface is called {name!r}; named surfaces: {known}")
        return np.concatenate([np.arange(one.start, one.stop) for one in ranges])

    @cached_property
    def bounds(self) -> NDArray[np.float32]:
        """Smallest and largest coordinates about `origin`, float32 (2, 3)."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def world_bounds(self) -> NDArray[np.float64]:
        """`bounds` in the world, float64 (2, 3)."""
        return self.bounds.astype(np.float64) + self.origin

    @cached_property
    def digest(self) -> str:
        """SHA-256, in hex, of everything that affects the image; names and paths do not."""
        digest = hashlib.sha256()
        parts: list[DataclassInstance] = [self.camera, *self.materials, *self.lights, self]
        if self.environment is not None:
            parts += [self.environment, *self.environment.suns]
        for part in parts:
            _add_to(digest, part)
        return digest.hexdigest()


def _add_to(digest: Any, part: DataclassInstance) -> None:
    """What a part of a scene holds that affects the image; what is None leaves no trace."""
    digest.update(type(part).__name__.encode())
    opaque = isinstance(part, Material) and not part.is_glass
    for entry in fields(part):
        if opaque and entry.name in ("transmission", "ior", "thin"):
            continue
        value = getattr(part, entry.name)
        if isinstance(value, (float, np.ndarray)):
            array = np.asarray(value)
            digest.update(f"{entry.name}{array.dtype}{array.shape}".encode())
            digest.update(array.tobytes())
        elif isinstance(value, bool) or entry.name == "wrap":
            digest.update(f"{entry.name}{value}".encode())
        elif isinstance(value, (Maps, Texture)):
            digest.update(entry.name.encode())
            _add_to(digest, value)
