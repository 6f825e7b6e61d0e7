"""What a material's table says of glass: transmission, index of refraction, thin or not."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from .geometry import SMALLEST_ROUGHNESS
from .model import USUAL_IOR, Material
from .table import Table

GLASS_KEYS = ("transmission", "ior", "thin")
# Indices of refraction: from that of air in a dense glass to that of a dense crystal in air.
LEAST_IOR, LARGEST_IOR = 0.2, 5.0


class Glass(TypedDict, total=False):
    """What `Material` takes of glass, all of it or nothing."""

    transmission: NDArray[np.float32]
    ior: float
    thin: bool


def read_glass(table: Table) -> Glass:
    """The keys of a material that is glass, as `Material` takes them; empty if it is none.

    Raises
    ------
    SceneError
        If a key is out of range, or has no effect since the material is not glass.
    """
    transmission = table.colour("transmission", default=0.0, high=1.0)
    thin = bool(table.flag("thin", False))
    if not transmission.any():
        for key in ("ior", "thin"):
            if key in table and (key != "thin" or thin):
                raise table.error(
                    key, "has no effect without transmission, which makes a material glass"
                )
        return {}
    ior = table.number("ior", USUAL_IOR, LEAST_IOR, LARGEST_IOR)
    return {"transmission": transmission, "ior": ior, "thin": thin}


def check_glass(table: Table, material: Material) -> None:
    """Refuse what glass does not have.

    Raises
    ------
    SceneError
        If it has an albedo or a reflectance, or a pane is rough.
    """
    if not material.is_glass:
        return
    maps = material.maps
    for key, texture in (("albedo", maps and maps.colour), ("emission", maps and maps.emission)):
        if texture is not None:
            raise table.error(
                key, "glass takes no image for it; roughness, normal and opacity may have one"
            )
    for key in ("albedo", "reflectance"):
        if getattr(material, key).any():
            raise table.error(
                key, "glass has none: transmission tints what it lets through, ior says what it reflects"
            )
    if material.thin and (material.roughness > SMALLEST_ROUGHNESS or (maps and maps.surface)):
        raise table.error("roughness", "a thin pane is smooth: leave it out, or take thin away")
