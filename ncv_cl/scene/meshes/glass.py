"""What mesh files say of glass, in the renderer's terms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ..geometry import SMALLEST_ROUGHNESS
from ..glass import LARGEST_IOR, LEAST_IOR
from ..textures.texture import Maps
from .common import Colour, FileMaterial, Notes, three

# Models of MTL that let light through, bent and unbent.
_BENT, _UNBENT = (6, 7), (4, 9)
TRANSPARENT = (*_BENT, *_UNBENT)
# Less is taken for opaque: glTF mixes glass and an opaque surface.
_LEAST_FACTOR = 0.5


def as_glass(
    material: FileMaterial,
    transmission: Colour,
    ior: float,
    thin: bool,
    roughness: float,
    notes: Notes,
) -> FileMaterial:
    """A material made glass; notes what glass does not have."""
    name, maps = material.name, material.maps
    if maps is not None:
        if maps.colour is not None or maps.emission is not None:
            notes.look("textures of glass, of which those of colour and emission are not read", name)
        surface = None if thin else maps.surface
        maps = Maps(
            surface=surface,
            opacity=maps.opacity,
            normal=maps.normal,
            cutoff=maps.cutoff,
            normal_scale=maps.normal_scale,
            placement=maps.placement,
        )
        maps = maps if maps.textures else None
    if thin and roughness > SMALLEST_ROUGHNESS:
        notes.look("rough panes are drawn smooth", name)
        roughness = SMALLEST_ROUGHNESS
    within = min(max(ior, LEAST_IOR), LARGEST_IOR)
    if within != ior:
        kind = f"indices of refraction outside [{LEAST_IOR:g}, {LARGEST_IOR:g}], which are clamped"
        notes.look(kind, name)
    none = three(0.0)
    return replace(
        material,
        albedo=none,
        reflectance=none,
        roughness=roughness,
        maps=maps,
        transmission=transmission,
        ior=within,
        thin=thin,
    )


def mtl_glass(
    material: FileMaterial,
    model: int,
    filtered: Colour,
    index: float | None,
    opacity: float,
    roughness: float | None,
    notes: Notes,
) -> FileMaterial | None:
    """The glass of an MTL file's material, None where it is opaque.

    Models 6 and 7 refract. 4 and 9 let light through unbent where that is all that is said, which makes
    panes, and refract with an index of more than 1. Some exporters write model 4 for all materials: it
    is glass only where an index, an opacity or a filter says so.

    Parameters
    ----------
    model : int
        `illum`.
    filtered : Colour
        `Tf`.
    index : float, optional
        `Ni`.
    opacity : float
        `d`.
    roughness : float, optional
        `Pr`.
    """
    bends = model in _BENT or (index is not None and index > 1.0)
    told = bends or opacity < 1.0 or min(filtered) < 1.0
    if model not in TRANSPARENT or not told or not any(filtered):
        return None
    if index is None or index <= 0.0 or not bends:
        index = 1.5
    rough = SMALLEST_ROUGHNESS if roughness is None else roughness
    return as_glass(material, filtered, index, not bends, rough, notes)


def gltf_glass(
    material: FileMaterial,
    base: Colour,
    metallic: float,
    extensions: dict[str, dict[str, Any]],
    notes: Notes,
) -> FileMaterial | None:
    """The glass of KHR_materials_transmission, None where the material is opaque.

    Without a volume of some thickness (KHR_materials_volume) it is a pane.

    Parameters
    ----------
    base : Colour
        Base colour, which tints what goes through.
    extensions : dict
        The material's extensions by name.
    """
    table = extensions.get("KHR_materials_transmission")
    if table is None:
        return None
    name = material.name
    factor = float(table.get("transmissionFactor", 0.0)) * (1.0 - metallic)
    if "transmissionTexture" in table:
        notes.look("textures of transmission are not read, their factor stands for them", name)
    if 0.0 < factor < 1.0:
        kind = "materials of which a part lets light through: glass from a half on, else opaque"
        notes.look(kind, name)
    if factor < _LEAST_FACTOR or not any(base):
        return None
    volume = extensions.get("KHR_materials_volume", {})
    thin = not float(volume.get("thicknessFactor", 0.0)) > 0.0
    if "attenuationDistance" in volume:
        notes.look("absorption inside of glass is not read", name)
    ior = float(extensions.get("KHR_materials_ior", {}).get("ior", 1.5)) or 1.5
    tint = three([factor * channel for channel in base])
    return as_glass(material, tint, ior, thin, material.roughness, notes)
