"""Materials of glTF in the renderer's terms."""

from __future__ import annotations

from typing import Any

import numpy as np

from .common import (
    DIELECTRIC_REFLECTANCE,
    FALLBACK_ALBEDO,
    Colour,
    FileMaterial,
    Notes,
    three,
)
from .gltf_buffers import Container
from .textures import mean_colour

_READ = {
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_specular",
    "KHR_materials_pbrSpecularGlossiness",
    # Other looks of the same file, which has one by default.
    "KHR_materials_variants",
}
_TEXTURES = {"normalTexture": "normal", "occlusionTexture": "occlusion"}


def read_material(
    container: Container, index: int, tint: Colour, name: str, notes: Notes
) -> FileMaterial:
    """Material `index` with its base colour times `tint`; notes what it has that is not read."""
    return _Reader(container, container.entry("materials", index), name, notes).material(tint)


def material_name(container: Container, index: int) -> str:
    """A material's name, or its place in the file if it has none."""
    return str(container.entry("materials", index).get("name") or f"materials[{index}]")


class _Reader:
    def __init__(self, container: Container, material: dict[str, Any], name: str, notes: Notes) -> None:
        self._container = container
        self._material = material
        self._extensions: dict[str, Any] = material.get("extensions", {})
        self._name = name
        self._notes = notes

    def material(self, tint: Colour) -> FileMaterial:
        other_model = self._extensions.get("KHR_materials_pbrSpecularGlossiness")
        if other_model is None:
            albedo, reflectance, roughness = self._metallic_roughness(tint)
        else:
            albedo, reflectance, roughness = self._specular_glossiness(other_model, tint)
        self._note_what_is_not_read()
        return FileMaterial(self._name, albedo, reflectance, roughness, self._emission())

    def _metallic_roughness(self, tint: Colour) -> tuple[Colour, Colour, float]:
        table = self._material.get("pbrMetallicRoughness", {})
        factor = three(table.get("baseColorFactor", [1.0, 1.0, 1.0])[:3])
        base = np.multiply(self._textured(table, "baseColorTexture", factor, FALLBACK_ALBEDO), tint)
        metallic = float(table.get("metallicFactor", 1.0))
        roughness = float(table.get("roughnessFactor", 1.0))
        if "metallicRoughnessTexture" in table:
            kind = "textures of metal and roughness are not read, the surface is no metal"
            self._notes.look(kind, self._name)
            metallic = 0.0
        metallic = min(max(metallic, 0.0), 1.0)
        dielectric = np.array(self._dielectric())
        return (
            three(base * (1.0 - metallic)),
            three(dielectric * (1.0 - metallic) + base * metallic),
            roughness,
        )

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

    def _specular_glossiness(self, table: dict[str, Any], tint: Colour) -> tuple[Colour, Colour, float]:
        factor = three(table.get("diffuseFactor", [1.0, 1.0, 1.0])[:3])
        diffuse = np.multiply(self._textured(table, "diffuseTexture", factor, FALLBACK_ALBEDO), tint)
        specular = three(table.get("specularFactor", [1.0, 1.0, 1.0]))
        if "specularGlossinessTexture" in table:
            kind = "textures of metal and roughness are not read, the surface is no metal"
            self._notes.look(kind, self._name)
            specular = three(DIELECTRIC_REFLECTANCE)
        roughness = 1.0 - float(table.get("glossinessFactor", 1.0))
        return three(diffuse * (1.0 - max(specular))), specular, roughness

    def _emission(self) -> Colour:
        factor = three(self._material.get("emissiveFactor", [0.0, 0.0, 0.0]))
        extension = self._extensions.get("KHR_materials_emissive_strength", {})
        strength = float(extension.get("emissiveStrength", 1.0))
        if not any(factor):
            return factor
        return three(
            np.multiply(self._textured(self._material, "emissiveTexture", factor, 0.0), strength)
        )

    def _textured(self, table: dict[str, Any], key: str, factor: Colour, fallback: float) -> Colour:
        """A colour times the mean of its texture."""
        if key not in table:
            return factor
        label = f"{key} of {self._name}"
        mean = mean_colour(self._image(table[key]))
        if mean is None:
            kind = f"textures that are missing or cannot be read, in whose place {fallback:g} stands"
            mean = three(fallback)
        else:
            kind = "textures are not read, their mean colour stands for them"
        self._notes.look(kind, label)
        return three(np.multiply(factor, mean))

    def _image(self, info: dict[str, Any]) -> object:
        texture = self._container.entry("textures", info.get("index"))
        sources = [texture.get("source")]
        sources += [e.get("source") for e in texture.get("extensions", {}).values()]
        index = next((source for source in sources if source is not None), None)
        return self._container.image(index)

    def _note_what_is_not_read(self) -> None:
        look, name = self._notes.look, self._name
        for key, what in _TEXTURES.items():
            if key in self._material:
                look(f"{what} textures are not read", name)
        table = self._material.get("pbrMetallicRoughness", {})
        opacity = (table.get("baseColorFactor", [1.0]) + [1.0] * 3)[3]
        mode = self._material.get("alphaMode", "OPAQUE")
        if mode != "OPAQUE" and (opacity < 1.0 or "baseColorTexture" in table):
            look("materials that let light through are drawn opaque", name)
        for extension in self._extensions:
            if extension not in _READ:
                look(f"{extension} is not read", name)
