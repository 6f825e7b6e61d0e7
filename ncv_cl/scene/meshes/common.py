"""What the readers of mesh files share: their results, and notes on what they left out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..textures.image_file import ImageFiles
from ..textures.texture import Maps

Vectors = NDArray[np.float64]
Indices = NDArray[np.int64]
Colour = tuple[float, float, float]

# Base reflectance of a dielectric in the metallic-roughness model.
DIELECTRIC_REFLECTANCE = 0.04
# Stands for a colour that a file does not give or that cannot be read.
FALLBACK_ALBEDO = 0.5
# So many names are listed in a warning.
_LISTED = 5


@dataclass(frozen=True)
class FileMaterial:
    """A material found in a mesh file, in the renderer's terms; colours are linear RGB.

    Where it has `maps`, its other numbers are factors, as in `Material`.
    """

    name: str
    albedo: Colour
    reflectance: Colour
    roughness: float
    emission: Colour = (0.0, 0.0, 0.0)
    maps: Maps | None = None
    transmission: Colour = (0.0, 0.0, 0.0)
    ior: float | None = None
    thin: bool = False


@dataclass(frozen=True, eq=False)
class FileGeometry:
    """Triangles of one material as they stand in a mesh file.

    Attributes
    ----------
    vertices : float64 (n_vertices, 3)
    triangles : int64 (n_triangles, 3)
    normals : float64 (n_vertices, 3) or None
        The file's vertex normals of any length, zero where it gives none; None if it has none at all.
    material : FileMaterial or None
    transform : float64 (4, 4)
        From these coordinates to the file's world, for column vectors.
    name : str
        Where the triangles come from, for messages; may be empty.
    uv : float64 (n_vertices, 2) or None
        Texture coordinates, (0, 0) in an image's lower left corner.
    colours : float64 (n_vertices, 3) or None
        Linear RGB that multiplies the albedo.
    """

    vertices: Vectors
    triangles: Indices
    normals: Vectors | None = None
    material: FileMaterial | None = None
    transform: Vectors = field(default_factory=lambda: np.eye(4))
    name: str = ""
    uv: Vectors | None = None
    colours: Vectors | None = None


@dataclass(frozen=True)
class Asked:
    """What the scene gives the readers, and asks of them.

    Attributes
    ----------
    images : ImageFiles
    coordinates : bool
        Whether the scene gives the mesh a material with a texture, which needs texture coordinates.
    """

    images: ImageFiles
    coordinates: bool


class Notes:
    """What a reader left out or replaced, counted by kind and name, and what it found beside surfaces.

    Attributes
    ----------
    geometry, looks : dict of str to dict of str to int
        For every kind, a clause, how often each name was met. Looks are those of the file's
        materials: they do not matter where a scene gives the mesh a material of its own.
    smoothing : bool
        Whether the file asks for smooth shading without giving normals.
    lights : list of dict
        Tables of a scene's ``lights``, in the file's world.
    """

    def __init__(self) -> None:
        self.smoothing = False
        self.lights: list[dict[str, Any]] = []
        self.geometry: dict[str, dict[str, int]] = {}
        self.looks: dict[str, dict[str, int]] = {}

    def shape(self, kind: str, name: str, count: int = 1) -> None:
        """Note something about the geometry."""
        _count(self.geometry, kind, name, count)

    def look(self, kind: str, name: str, count: int = 1) -> None:
        """Note something about a material."""
        _count(self.looks, kind, name, count)


def _count(notes: dict[str, dict[str, int]], kind: str, name: object, count: int) -> None:
    # A malformed file may have a number for a name.
    names = notes.setdefault(kind, {})
    names[str(name)] = names.get(str(name), 0) + count


def sentences(notes: dict[str, dict[str, int]]) -> list[str]:
    """One sentence a kind: how many there were and the first of their names."""
    found = []
    for kind, names in notes.items():
        # A lone name's count is the total.
        listed = [
            name if n == 1 or len(names) == 1 else f"{name} × {n}" for name, n in names.items() if name
        ][:_LISTED]
        if len(names) > _LISTED:
            listed.append(f"{len(names) - _LISTED} more")
        where = f" ({', '.join(listed)})" if listed else ""
        found.append(f"{kind}: {sum(names.values())}{where}")
    return found


def check_triangles(vertices: Vectors, triangles: Indices, what: str) -> None:
    """Raise `ValueError` if an index is out of range or a vertex in use is not finite."""
    outside = np.flatnonzero(((triangles < 0) | (triangles >= len(vertices))).any(axis=1))
    if outside.size:
        raise ValueError(
            f"{what}: triangle {outside[0]} refers to the vertices {triangles[outside[0]].tolist()}, "
            f"but there are {len(vertices)}, counted from 0"
        )
    usable = np.isfinite(vertices).all(axis=1)
    if not usable.all():
        bad = np.intersect1d(np.flatnonzero(~usable), triangles)
        if bad.size:
            raise ValueError(f"{what}: vertex {bad[0]} is not finite: {vertices[bad[0]].tolist()}")


def three(values: object) -> Colour:
    """A colour as three floats; one number stands for all of them."""
    red, green, blue = (float(c) for c in np.broadcast_to(np.asarray(values, dtype=np.float64), 3))
    return red, green, blue


def metallic_model(base: object, metallic: float) -> tuple[Colour, Colour]:
    """Albedo and reflectance of a base colour between a dielectric (0) and a metal (1)."""
    colour = np.asarray(base, dtype=np.float64)
    reflectance = DIELECTRIC_REFLECTANCE * (1.0 - metallic) + colour * metallic
    return three(colour * (1.0 - metallic)), three(reflectance)


def constant_or_varying(colours: Vectors, triangles: Indices) -> tuple[Colour | None, Vectors | None]:
    """Colours of vertices (n, 3) in use: one for all of them, or else their rows in [0, 1]."""
    used = colours[np.unique(triangles)]
    if np.ptp(used, axis=0).max() <= 1e-6:
        return three(used.mean(axis=0)), None
    return None, np.clip(np.nan_to_num(colours), 0.0, 1.0)
