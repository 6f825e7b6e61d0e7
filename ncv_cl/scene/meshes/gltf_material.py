"""Materials of glTF in the renderer's terms."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..textures.texture import AS_IT_IS, Maps, Placement, Texture
from .common import (
    DIELECTRIC_REFLECTANCE,
    FALLBACK_ALBEDO,
    Asked,
    Colour,
    FileMaterial,
    Notes,
    three,
)
from .glass import gltf_glass
from .gltf_buffers import Container
from .textures import (
    HALF_OPAQUE,
    MEAN_OF_OTHERS,
    MISSING,
    NO_METAL,
    NO_NORMALS,
    NOT_PLACED_ALIKE,
    Image,
    colour_texture,
    mean_colour,
)

_READ = {
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_specular",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_transmission",
    "KHR_materials_volume",
    # Other looks of the same file, which has one by default.
    "KHR_materials_variants",
}
# Keys of textures' tables, by the names of `Maps`.
_COLOUR = ("baseColorTexture", "diffuseTexture")
_SURFACE = "metallicRoughnessTexture"
_TRANSFORM = "KHR_texture_transform"
_WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
_NEAREST = 9728


def read_material(
    container: Container, index: int, tint: Colour | None, name: str, notes: Notes, asked: Asked
) -> FileMaterial:
    """Material `index` with its base colour times `tint`; notes what it has that is not read.

    A `tint` of None is one that varies over the surface.
    """
    reader = _Reader(container, container.entry("materials", index), name, notes, asked)
    return reader.material(tint)


def coordinate_set(container: Container, index: int) -> int:
    """The number of the texture coordinates that material `index` takes."""
    return next((_set_of(info) for info in _infos(container.entry("materials", index))), 0)


def _infos(material: dict[str, Any]) -> list[dict[str, Any]]:
    """The tables of a material's textures that are read, the one of its colour first."""
    other = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    table = material.get("pbrMetallicRoughness", {}) if other is None else other
    found = [table[key] for key in (*_COLOUR, _SURFACE) if key in table]
    return found + [material[key] for key in ("emissiveTexture", "normalTexture") if key in material]


def _set_of(info: dict[str, Any]) -> int:
    transform = info.get("extensions", {}).get(_TRANSFORM, {})
    return int(transform.get("texCoord", info.get("texCoord", 0)))


def _placement(info: dict[str, Any]) -> Placement:
    """The placement of a texture by KHR_texture_transform, for v upwards from an image's lower side.

    The file's v goes downwards: (u, v) -> offset + R scale (u, v), with R counter-clockwise as seen.
    """
    transform = info.get("extensions", {}).get(_TRANSFORM)
    if transform is None:
        return AS_IT_IS
    (offset_u, offset_v), (scale_u, scale_v) = (
        (float(a), float(b))
        for a, b in (transform.get("offset", (0.0, 0.0)), transform.get("scale", (1.0, 1.0)))
    )
    angle = float(transform.get("rotation", 0.0))
    sine, cosine = math.sin(angle), math.cos(angle)
    return (
        cosine * scale_u, -sine * scale_v, offset_u + sine * scale_v,
        sine * scale_u, cosine * scale_v, 1.0 - offset_v - cosine * scale_v,
    )  # fmt: skip


def material_name(container: Container, index: int) -> str:
    """A material's name, or its place in the file if it has none."""
    return str(container.entry("materials", index).get("name") or f"materials[{index}]")


class _Reader:
    def __init__(
        self, container: Container, material: dict[str, Any], name: str, notes: Notes, asked: Asked
    ) -> None:
        self._container = container
        self._material = material
        self._extensions: dict[str, Any] = material.get("extensions", {})
        self._name = name
        self._notes = notes
        self._images = asked.images
        infos = _infos(material)
        self._placed = (_set_of(infos[0]), _placement(infos[0])) if infos else (0, AS_IT_IS)

    def material(self, tint: Colour | None) -> FileMaterial:
        other_model = self._extensions.get("KHR_materials_pbrSpecularGlossiness")
        if other_model is None:
            found = self._metallic_roughness(tint)
        else:
            found = self._specular_glossiness(other_model, tint)
        self._note_what_is_not_read()
        emission, texture = self._emission()
        if texture is not None:
            maps = found.maps or Maps(placement=self._placed[1])
            found = replace(found, maps=replace(maps, emission=texture))
        normal = self._normal()
        if normal is not None:
            maps = found.maps or Maps(placement=self._placed[1])
            scale = float(self._material["normalTexture"].get("scale", 1.0))
            found = replace(found, maps=replace(maps, normal=normal, normal_scale=scale))
        found = replace(found, emission=emission)
        return self._glass(found, tint) or found

    def _glass(self, material: FileMaterial, tint: Colour | None) -> FileMaterial | None:
        """The material as glass, if it is that."""
        table = self._material.get("pbrMetallicRoughness", {})
        metallic = min(max(float(table.get("metallicFactor", 1.0)), 0.0), 1.0)
        base = np.multiply(
            table.get("baseColorFactor", [1.0] * 3)[:3], (1.0,) * 3 if tint is None else tint
        )
        return gltf_glass(material, three(base), metallic, self._extensions, self._notes)

    def _metallic_roughness(self, tint: Colour | None) -> FileMaterial:
        table = self._material.get("pbrMetallicRoughness", {})
        base, colour = self._base(table, "baseColorTexture", "baseColorFactor", tint)
        metallic = min(max(float(table.get("metallicFactor", 1.0)), 0.0), 1.0)
        roughness = float(table.get("roughnessFactor", 1.0))
        surface = self._surface(table)
        if _SURFACE in table and surface is None:
            metallic = 0.0
        dielectric = np.array(self._dielectric())
        if tint is None or colour is not None or surface is not None:
            opacity, cutoff = self._opacity(colour, table.get("baseColorFactor"))
            maps = Maps(
                colour,
                surface,
                opacity=opacity,
                metallic=metallic,
                cutoff=cutoff,
                placement=self._placed[1],
            )
            return FileMaterial(self._name, three(base), three(dielectric), roughness, maps=maps)
        return FileMaterial(
            self._name,
            three(base * (1.0 - metallic)),
            three(dielectric * (1.0 - metallic) + base * metallic),
            roughness,
        )

    def _base(
        self, table: dict[str, Any], key: str, factor_key: str, tint: Colour | None
    ) -> tuple[NDArray[np.float64], Texture | None]:
        """Base colour, and the texture that multiplies it."""
        factor = np.multiply(
            table.get(factor_key, [1.0, 1.0, 1.0])[:3], (1.0,) * 3 if tint is None else tint
        )
        if key not in table:
            return factor, None
        label = f"{key} of {self._name}"
        image, wrap, nearest = self._image(table[key])
        texture = colour_texture(self._images, image, label, self._notes, wrap, nearest)
        if texture is None:
            self._notes.look(MISSING.format(f"{FALLBACK_ALBEDO:g}"), label)
            factor = factor * FALLBACK_ALBEDO
        return factor, texture

    def _opacity(
        self, colour: Texture | None, factor: list[float] | None
    ) -> tuple[Texture | None, float]:
        """The texture whose alpha makes holes, if any does, and below which alpha."""
        mode = self._material.get("alphaMode", "OPAQUE")
        if colour is None or mode == "OPAQUE":
            return None, 0.5
        cutoff = 0.5
        if mode == "MASK":
            opacity = float((factor or [1.0] * 4)[3])
            cutoff = float(self._material.get("alphaCutoff", 0.5)) / max(opacity, 1e-6)
        lowest = float(colour.texels[:, :, 3].min())
        if mode == "BLEND" and lowest < 1.0:
            self._notes.look(HALF_OPAQUE, self._name)
        return (colour, cutoff) if lowest < cutoff else (None, cutoff)

    def _surface(self, table: dict[str, Any]) -> Texture | None:
        """The texture of roughness and metal; None, and noted, where it cannot be read."""
        if _SURFACE not in table:
            return None
        info = table[_SURFACE]
        if (_set_of(info), _placement(info)) != self._placed:
            self._notes.look(NOT_PLACED_ALIKE, self._name)
            return None
        image, wrap, nearest = self._image(info)
        found = None if image is None else self._images.texture(image, "linear", wrap, nearest)
        if found is None:
            self._notes.look(NO_METAL, f"{_SURFACE} of {self._name}")
        return found

    def _dielectric(self) -> Colour:
        """Reflectance at normal incidence of what is no metal."""
        ior = float(self._extensions.get("KHR_materials_ior", {}).get("ior", 1.5))
        # The extension's own convention: an index of 0 reflects all.
        base = 1.0 if ior == 0.0 else ((ior - 1.0) / (ior + 1.0)) ** 2
        base = DIELECTRIC_REFLECTANCE if ior == 1.5 else base
        specular = self._extensions.get("KHR_materials_specular", {})
        for key in ("specularTexture", "specularColorTexture"):
            if key in specular:
                self._notes.look(
                    "textures are not read, the surface is as without them", f"{key} of {self._name}"
                )
        colour = np.array(specular.get("specularColorFactor", [1.0, 1.0, 1.0]))
        return three(np.minimum(base * colour, 1.0) * float(specular.get("specularFactor", 1.0)))

    def _specular_glossiness(self, table: dict[str, Any], tint: Colour | None) -> FileMaterial:
        diffuse, colour = self._base(table, "diffuseTexture", "diffuseFactor", tint)
        specular = three(table.get("specularFactor", [1.0, 1.0, 1.0]))
        if "specularGlossinessTexture" in table:
            kind = "textures of specular and glossiness are not read, the surface is no metal"
            self._notes.look(kind, self._name)
            specular = three(DIELECTRIC_REFLECTANCE)
        roughness = 1.0 - float(table.get("glossinessFactor", 1.0))
        maps = None
        if colour is not None:
            opacity, cutoff = self._opacity(colour, table.get("diffuseFactor"))
            maps = Maps(colour, opacity=opacity, cutoff=cutoff, placement=self._placed[1])
        albedo = three(diffuse * (1.0 - max(specular)))
        return FileMaterial(self._name, albedo, specular, roughness, maps=maps)

    def _emission(self) -> tuple[Colour, Texture | None]:
        """What the surface emits, and the texture that multiplies it."""
        factor = three(self._material.get("emissiveFactor", [0.0, 0.0, 0.0]))
        extension = self._extensions.get("KHR_materials_emissive_strength", {})
        strength = float(extension.get("emissiveStrength", 1.0))
        factor = three(np.multiply(factor, strength))
        if not any(factor) or "emissiveTexture" not in self._material:
            return factor, None
        info = self._material["emissiveTexture"]
        image, wrap, nearest = self._image(info)
        texture = None if image is None else self._images.texture(image, "auto", wrap, nearest)
        if texture is not None and (_set_of(info), _placement(info)) == self._placed:
            return factor, texture
        label = f"emissiveTexture of {self._name}"
        self._notes.look(MISSING.format("0") if texture is None else MEAN_OF_OTHERS, label)
        mean = mean_colour(self._images, image) or three(0.0)
        return three(np.multiply(factor, mean)), None

    def _normal(self) -> Texture | None:
        """The texture of normals; None, and noted, where it cannot be shown."""
        if "normalTexture" not in self._material:
            return None
        info = self._material["normalTexture"]
        image, wrap, nearest = self._image(info)
        alike = (_set_of(info), _placement(info)) == self._placed
        found = self._images.texture(image, "linear", wrap, nearest) if alike and image else None
        if found is None:
            self._notes.look(NO_NORMALS, f"normalTexture of {self._name}")
        return found

    def _image(self, info: dict[str, Any]) -> tuple[Image, tuple[str, str], bool]:
        """An image, how it goes on beyond its sides, and whether its texels are rectangles."""
        texture = self._container.entry("textures", info.get("index"))
        sampler = self._container.entry("samplers", texture["sampler"]) if "sampler" in texture else {}
        wrap_u, wrap_v = (_WRAPS.get(sampler.get(key, 0), "repeat") for key in ("wrapS", "wrapT"))
        nearest = sampler.get("magFilter") == _NEAREST
        sources = [texture.get("source")]
        sources += [e.get("source") for e in texture.get("extensions", {}).values()]
        index = next((source for source in sources if source is not None), None)
        return self._container.image(index), (wrap_u, wrap_v), nearest

    def _note_what_is_not_read(self) -> None:
        look, name = self._notes.look, self._name
        if "occlusionTexture" in self._material:
            look("occlusion textures are not read", name)
        table = self._material.get("pbrMetallicRoughness", {})
        opacity = (table.get("baseColorFactor", [1.0]) + [1.0] * 3)[3]
        mode = self._material.get("alphaMode", "OPAQUE")
        if mode != "OPAQUE" and opacity < 1.0 and not (mode == "MASK" and "baseColorTexture" in table):
            look("materials that let light through are drawn opaque", name)
        for extension in self._extensions:
            if extension not in _READ:
                look(f"{extension} is not read", name)
