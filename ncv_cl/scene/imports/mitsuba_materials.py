"""Materials of Mitsuba as a scene file's, the nearest where we have no such.

Reflection is Lambert's and a GGX lobe with Schlick's Fresnel term, from both sides. So conductors,
plastic and what is not GGX are near, not the same, which is said by kind and count.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..geometry import SMALLEST_ROUGHNESS
from ..meshes.common import FALLBACK_ALBEDO, Notes
from .mitsuba_texture import FLOATS, Textures
from .mitsuba_xml import Plugin

# Indices of refraction that files name, as Mitsuba has them (its src/include/mitsuba/render/ior.h).
_INDICES = {
    "vacuum": 1.0, "helium": 1.00004, "hydrogen": 1.00013, "air": 1.00028, "carbon dioxide": 1.00045,
    "water": 1.333, "acetone": 1.36, "ethanol": 1.361, "carbon tetrachloride": 1.461,
    "glycerol": 1.4729, "benzene": 1.501, "silicone oil": 1.52045, "bromine": 1.661,
    "water ice": 1.31, "fused quartz": 1.458, "pyrex": 1.47, "acrylic glass": 1.49,
    "polypropylene": 1.49, "bk7": 1.5046, "sodium chloride": 1.544, "amber": 1.55, "pet": 1.575,
    "diamond": 2.419,
}  # fmt: skip
_BACK = "materials whose back is black in Mitsuba reflect from both sides"
_NEAR = "materials of the kind {} become the nearest of ours"
_DIELECTRICS = ("dielectric", "roughdielectric", "thindielectric")
_WRAPPERS = ("twosided", "mask", "normalmap", "bumpmap", "blendbsdf")
Table = dict[str, Any]


class Materials:
    """Turns plugins of the category "bsdf" into tables of materials, each once.

    Attributes
    ----------
    tables : dict of str to dict
        A scene file's ``materials``.
    """

    def __init__(self, textures: Textures, notes: Notes) -> None:
        self.tables: dict[str, Table] = {}
        self._textures = textures
        self._notes = notes
        self._names: dict[tuple[object, ...], str | None] = {}
        self._keep: list[Plugin | None] = []

    def name_of(
        self, bsdf: Plugin | None, downwards: bool, emission: tuple[float, ...] | None = None
    ) -> str | None:
        """The material of a surface; None if it cannot be seen.

        Parameters
        ----------
        bsdf : Plugin or None
        downwards : bool
            Whether the v of the surface's texture coordinates is Mitsuba's, from an image's upper side.
        emission : tuple of three floats, optional
            Radiance that the surface emits.
        """
        key = (id(bsdf), downwards and self._has_texture(bsdf), emission)
        if key not in self._names:
            # An id stays one plugin's as long as that is kept.
            self._keep.append(bsdf)
            self._textures.downwards = downwards
            table = self._table(bsdf, one_sided=True)
            if table is not None and emission is not None:
                table = table | {"emission": list(emission)}
            self._names[key] = None if table is None else self._added(bsdf, table)
        return self._names[key]

    def reflects(self, bsdf: Plugin | None) -> bool:
        """Whether a surface reflects anything; those of lights often do not."""
        while bsdf is not None and bsdf.kind == "twosided":
            bsdf = next(iter(bsdf.parts("bsdf")), None)
        if bsdf is not None and bsdf.kind == "diffuse":
            return bool(np.any(self._textures.mean(bsdf.values.get("reflectance", 0.5))))
        return bsdf is None or bsdf.kind != "null"

    def _has_texture(self, bsdf: Plugin | None) -> bool:
        if bsdf is None:
            return False
        values = [v for v in bsdf.values.values() if isinstance(v, Plugin)]
        return any(v.category == "texture" or self._has_texture(v) for v in values + bsdf.children)

    def _added(self, bsdf: Plugin | None, table: Table) -> str:
        name = "default" if bsdf is None else next((n for n in _names(bsdf) if n), bsdf.kind)
        if any(one == table and known == name for known, one in self.tables.items()):
            return name
        number, free = 2, name
        while free in self.tables:
            free, number = f"{name}.{number}", number + 1
        self.tables[free] = table
        return free

    def _table(self, bsdf: Plugin | None, one_sided: bool) -> Table | None:
        if bsdf is None:
            return {"albedo": 0.5}
        if bsdf.kind == "null":
            return None
        if bsdf.kind in _WRAPPERS:
            return self._wrapper(bsdf, one_sided)
        opaque = bsdf.kind not in (*_DIELECTRICS, "principledthin")
        opaque = opaque and not np.any(bsdf.values.get("spec_trans", 0.0))
        if one_sided and opaque:
            self._notes.look(_BACK, self._label(bsdf))
        read = getattr(self, f"_{bsdf.kind}", None)
        if bsdf.kind in _DIELECTRICS:
            return self._glass(bsdf)
        if read is None:
            kind = f"materials of the kind {bsdf.kind} are not read, and are grey ({FALLBACK_ALBEDO:g})"
            self._notes.look(kind, bsdf.name)
            return {"albedo": FALLBACK_ALBEDO}
        return read(bsdf)

    def _label(self, bsdf: Plugin) -> str:
        return bsdf.name or bsdf.kind

    # ---- materials of materials ----------------------------------------------------------------------

    def _wrapper(self, bsdf: Plugin, one_sided: bool) -> Table | None:
        inner = bsdf.parts("bsdf")
        if not inner:
            raise ValueError(f"the material {self._label(bsdf)} ({bsdf.kind}) has no material in it")
        chosen = inner[0]
        if bsdf.kind == "blendbsdf" and len(inner) > 1:
            weight = self._textures.mean(bsdf.values.get("weight", 0.5))
            chosen = inner[int(np.mean(weight) > 0.5)]
            self._notes.look("blends of materials, of which the larger part is taken", bsdf.name)
        elif bsdf.kind == "twosided" and len(inner) > 1:
            self._notes.look("materials of two sides, of which the front is taken for both", bsdf.name)
        table = self._table(chosen, one_sided and bsdf.kind != "twosided")
        if table is None or bsdf.kind in ("twosided", "blendbsdf"):
            return table
        if bsdf.kind == "bumpmap":
            self._notes.look("bump maps are not read", self._label(bsdf))
            return table
        if bsdf.kind == "mask":
            return self._masked(bsdf, table)
        texture = next((v for v in (*bsdf.values.values(), *bsdf.children) if _is_bitmap(v)), None)
        normal = None if texture is None else self._textures.table(texture, "linear")
        if normal is None:
            self._notes.look("normal maps that are no images are left out", self._label(bsdf))
            return table
        return table | {"normal": normal}

    def _masked(self, bsdf: Plugin, table: Table) -> Table | None:
        opacity = bsdf.values.get("opacity", 0.5)
        if _is_bitmap(opacity):
            found = self._textures.table(opacity, "linear")
            if found is not None:
                self._notes.look(
                    "opacities of images: there is a hole where it is below a half", self._label(bsdf)
                )
                drop = ("encoding", "factor")
                return table | {"opacity": {k: v for k, v in found.items() if k not in drop}}
        share = float(np.mean(self._textures.mean(opacity)))
        if 0.0 < share < 1.0:
            kind = "opacities below a half are none, others whole"
            self._notes.look(kind, self._label(bsdf))
        return table if share >= 0.5 else None

    # ---- materials -----------------------------------------------------------------------------------

    def _diffuse(self, bsdf: Plugin) -> Table:
        return {"albedo": self._colour(bsdf, "reflectance", 0.5)}

    def _roughdiffuse(self, bsdf: Plugin) -> Table:
        self._near(bsdf)
        return self._diffuse(bsdf)

    def _plastic(self, bsdf: Plugin) -> Table:
        """Lambert below a coating: what comes out of it after inner reflections is an albedo.

        Of diffuse light the share ``inner`` is reflected back inside (Mitsuba's plastic.cpp):
        albedo = ρ (1 / η²) / (1 − ρ' inner), with ρ' = ρ if `nonlinear`, else 1. Our (1 − F)(1 − F) is
        Mitsuba's.
        """
        self._near(bsdf)
        eta = self._eta(bsdf, 1.49, 1.000277)
        diffuse = self._colour(bsdf, "diffuse_reflectance", 0.5)
        inner = inner_reflection(eta)
        if isinstance(diffuse, dict):
            # An image's texels are only multiplied; its mean stands in the denominator.
            mean = self._textures.mean(bsdf.values["diffuse_reflectance"])
            scale = _coated(np.mean(mean), inner, eta, bsdf) / max(float(np.mean(mean)), 1e-6)
            factor = np.minimum(scale * np.asarray(diffuse.get("factor", 1.0)), 1.0)
            albedo: Any = diffuse | {"factor": _listed(factor)}
        else:
            albedo = _listed(np.clip(_coated(np.asarray(diffuse), inner, eta, bsdf), 0.0, 1.0))
        specular = np.asarray(self._mean(bsdf, "specular_reflectance", 1.0))
        return {
            "albedo": albedo,
            "reflectance": _listed(np.clip(specular * ((eta - 1.0) / (eta + 1.0)) ** 2, 0.0, 1.0)),
            "roughness": self._roughness(bsdf) if bsdf.kind == "roughplastic" else SMALLEST_ROUGHNESS,
        }

    _roughplastic = _plastic

    def _conductor(self, bsdf: Plugin) -> Table:
        self._near(bsdf)
        tint = np.asarray(self._mean(bsdf, "specular_reflectance", 1.0))
        return {
            "albedo": 0.0,
            "reflectance": _listed(np.clip(tint * self._metal(bsdf), 0.0, 1.0)),
            "roughness": SMALLEST_ROUGHNESS if bsdf.kind == "conductor" else self._roughness(bsdf),
        }

    _roughconductor = _conductor

    def _metal(self, bsdf: Plugin) -> np.ndarray:
        """Reflectance of a metal at normal incidence, (3,) or ()."""
        name = bsdf.values.get("material", "none" if "eta" not in bsdf.values else "")
        if name == "none":
            return np.array(1.0)
        if name:
            eta, k = (self._textures.metal(name, part) for part in ("eta", "k"))
        else:
            eta, k = (np.asarray(self._mean(bsdf, key, d)) for key, d in (("eta", 0.0), ("k", 1.0)))
        return ((eta - 1.0) ** 2 + k**2) / ((eta + 1.0) ** 2 + k**2)

    def _glass(self, bsdf: Plugin) -> Table:
        tint = self._mean(bsdf, "specular_transmittance", 1.0)
        if np.any(np.asarray(self._mean(bsdf, "specular_reflectance", 1.0)) != 1.0):
            self._notes.look("tints of what glass reflects are not read", self._label(bsdf))
        table = {
            "albedo": 0.0,
            "transmission": _listed(np.clip(np.asarray(tint), 0.0, 1.0)),
            "ior": self._eta(bsdf, 1.5046, 1.000277),
            "roughness": SMALLEST_ROUGHNESS,
        }
        if bsdf.kind == "thindielectric":
            return table | {"thin": True}
        return table | ({"roughness": self._roughness(bsdf)} if bsdf.kind == "roughdielectric" else {})

    def _principled(self, bsdf: Plugin) -> Table:
        self._near(bsdf)
        values = bsdf.values
        for key in ("clearcoat", "sheen", "flatness", "anisotropic", "spec_tint", "diff_trans"):
            if np.any(self._mean(bsdf, key, 0.0)):
                self._notes.look(f"{key} of principled materials is not read", self._label(bsdf))
        metallic = float(np.mean(self._mean(bsdf, "metallic", 0.0)))
        rough = values.get("roughness", 0.5)
        if _is_bitmap(rough):
            roughness: Any = self._textures.table(rough, "linear") or 0.5
        else:
            roughness = _rough(float(np.mean(self._textures.mean(rough))))
        eta = float(np.mean(self._mean(bsdf, "eta", 0.0)))
        specular = float(np.mean(self._mean(bsdf, "specular", 0.5)))
        dielectric = ((eta - 1.0) / (eta + 1.0)) ** 2 if eta else 0.08 * specular
        if float(np.mean(self._mean(bsdf, "spec_trans", 0.0))) > 0.5:
            # Mitsuba's own: a specular of 0.5 is an index of 1.5.
            root = math.sqrt(min(dielectric, 0.9))
            tint = np.sqrt(np.asarray(self._mean(bsdf, "base_color", 0.5)))
            return {
                "albedo": 0.0,
                "transmission": _listed(np.clip(tint, 0.0, 1.0)),
                "ior": (1.0 + root) / (1.0 - root),
                "roughness": roughness if not isinstance(roughness, dict) else 0.5,
            }
        if metallic > 0.0:
            base = np.clip(np.asarray(self._mean(bsdf, "base_color", 0.5)), 0.0, 1.0)
            if _is_bitmap(values.get("base_color")):
                kind = "images of metals' colours are not read, their mean stands for them"
                self._notes.look(kind, self._label(bsdf))
            return {
                "albedo": _listed(base * (1.0 - metallic)),
                "reflectance": _listed(dielectric * (1.0 - metallic) + base * metallic),
                "roughness": roughness,
            }
        albedo = self._colour(bsdf, "base_color", 0.5)
        return {"albedo": albedo, "reflectance": dielectric, "roughness": roughness}

    def _principledthin(self, bsdf: Plugin) -> Table:
        table = self._principled(bsdf)
        if "transmission" not in table:
            return table
        self._notes.look("rough panes are smooth", self._label(bsdf))
        return table | {"thin": True, "roughness": SMALLEST_ROUGHNESS}

    # ---- numbers -------------------------------------------------------------------------------------

    def _near(self, bsdf: Plugin) -> None:
        self._notes.look(_NEAR.format(bsdf.kind), bsdf.name)

    def _colour(self, bsdf: Plugin, key: str, default: float) -> Any:
        """A reflectance in [0, 1]: a number, a list of three, or an image's table."""
        value = bsdf.values.get(key, default)
        if _is_bitmap(value):
            found = self._textures.table(value, "auto")
            if found is not None:
                return found
        colour = np.asarray(self._textures.mean(value), dtype=np.float64)
        if not (colour.min() >= 0.0 and colour.max() <= 1.0):
            self._notes.look("materials with colours outside [0, 1], which are clamped", bsdf.name)
        return _listed(np.clip(colour, 0.0, 1.0))

    def _mean(self, bsdf: Plugin, key: str, default: float) -> Any:
        return self._textures.mean(bsdf.values.get(key, default))

    def _roughness(self, bsdf: Plugin) -> float:
        """The root of GGX's alpha."""
        values = bsdf.values
        if values.get("distribution", "beckmann") != "ggx":
            self._notes.look("lobes that are not GGX become GGX of the same alpha", self._label(bsdf))
        if _is_bitmap(values.get("alpha")):
            kind = "images of roughness are not read, their mean stands for them"
            self._notes.look(kind, self._label(bsdf))
        u, v = (
            float(np.mean(self._mean(bsdf, k, np.mean(self._mean(bsdf, "alpha", 0.1)))))
            for k in ("alpha_u", "alpha_v")
        )
        if u != v:
            self._notes.look("anisotropy is not read", self._label(bsdf))
        return _rough(max(u * v, 0.0) ** 0.25)

    def _eta(self, bsdf: Plugin, inside: float, outside: float) -> float:
        """The relative index of refraction."""
        numbers = []
        for key, default in (("int_ior", inside), ("ext_ior", outside)):
            value = bsdf.values.get(key, default)
            if isinstance(value, str):
                if value.lower() not in _INDICES:
                    raise ValueError(f"the material {self._label(bsdf)} names the unknown {value!r}")
                value = _INDICES[value.lower()]
            numbers.append(float(np.mean(self._textures.mean(value))))
        if not (min(numbers) > 0.0 and np.isfinite(numbers).all()):
            raise ValueError(f"the material {self._label(bsdf)} has an index of refraction of 0")
        return numbers[0] / numbers[1]


def inner_reflection(eta: float) -> float:
    """The share of diffuse light inside of a smooth dielectric that its surface reflects back.

    By the reciprocity of Fresnel's equations 1 − (1 − outer) / η², with the diffuse reflectance from
    outside, ``outer``: the integral of F(cos) 2 cos over cos.
    """
    nodes, weights = np.polynomial.legendre.leggauss(64)
    cosine = 0.5 * (nodes + 1.0)
    inside = np.sqrt(np.maximum(1.0 - (1.0 - cosine**2) / eta**2, 0.0))
    across = (cosine - eta * inside) / (cosine + eta * inside)
    along = (inside - eta * cosine) / (inside + eta * cosine)
    outer = float(np.sum(weights * 0.5 * (across**2 + along**2) * cosine))
    return 1.0 - (1.0 - outer) / eta**2


def _coated(diffuse: Any, inner: float, eta: float, bsdf: Plugin) -> Any:
    base = diffuse if bsdf.values.get("nonlinear", False) else 1.0
    return diffuse / (eta**2 * (1.0 - base * inner))


def _is_bitmap(value: object) -> bool:
    return isinstance(value, Plugin) and value.kind == "bitmap"


def _names(bsdf: Plugin) -> list[str]:
    """Ids of a material and of those in it, the outermost first."""
    return [bsdf.name] + [name for one in bsdf.parts("bsdf") for name in _names(one)]


def _rough(value: float) -> float:
    return min(max(value, SMALLEST_ROUGHNESS), 1.0)


def _listed(values: Any) -> Any:
    """Numbers as a scene file has them."""
    return np.round(np.asarray(values, dtype=FLOATS), 9).tolist()
