"""Surfaces in Mitsuba's hands; `bsdf.cl` as a BSDF of its own: GGX over Lambert, Schlick's Fresnel term.

f_r = albedo / π (1 − F(cos_i)) (1 − F(cos_o)) + D G2 F(h · o) / (4 cos_i cos_o), two-sided. Written anew
from the formula, in Mitsuba's arrays; directions are drawn from a cosine lobe and from the visible
normals' lobe, half of them each.
"""

from __future__ import annotations

import functools
from types import ModuleType

import numpy as np

from ncv_cl.scene.geometry import SMALLEST_ROUGHNESS
from ncv_cl.scene.load import Material


@functools.cache
def register(mitsuba: ModuleType) -> None:
    """Make ``ggx_over_lambert`` known to Mitsuba's loader, once."""
    mitsuba.register_bsdf("ggx_over_lambert", lambda properties: _surface(mitsuba)(properties))


@functools.cache
def _surface(mi: ModuleType) -> type:
    """The class, which can be defined only once a variant is chosen."""
    import drjit as dr

    class GgxOverLambert(mi.BSDF):
        def __init__(self, properties):
            super().__init__(properties)
            colours = (mi.Color3f(properties[name]) for name in ("albedo", "reflectance"))
            self.albedo, self.reflectance = colours
            self.alpha = properties["roughness"] ** 2
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [
                mi.BSDFFlags.DiffuseReflection | sides,
                mi.BSDFFlags.GlossyReflection | sides,
            ]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def _lobe(self):
            return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha, True)

        @staticmethod
        def _facing(si, direction):
            """A direction on the side that is seen: all below is symmetric about the surface."""
            return mi.Vector3f(direction.x, direction.y, dr.mulsign(direction.z, si.wi.z))

        def sample(self, ctx, si, sample1, sample2, active=True):
            wi = self._facing(si, si.wi)
            half, _ = self._lobe().sample(wi, sample2)
            glossy = sample1 < 0.5
            wo = dr.select(glossy, mi.reflect(wi, half), mi.warp.square_to_cosine_hemisphere(sample2))
            outwards = self._facing(si, wo)
            found = dr.zeros(mi.BSDFSample3f)
            found.wo, found.eta = outwards, 1.0
            found.pdf = self.pdf(ctx, si, outwards, active)
            found.sampled_component = dr.select(glossy, mi.UInt32(1), mi.UInt32(0))
            found.sampled_type = dr.select(
                glossy,
                mi.UInt32(+mi.BSDFFlags.GlossyReflection),
                mi.UInt32(+mi.BSDFFlags.DiffuseReflection),
            )
            active = active & (found.pdf > 0.0) & (wo.z > 0.0)
            weight = self.eval(ctx, si, outwards, active) / found.pdf
            return found, dr.select(active, weight, 0.0)

        def eval(self, ctx, si, wo, active=True):
            """f_r times the cosine of `wo`."""
            wi, wo = self._facing(si, si.wi), self._facing(si, wo)
            active = active & (wi.z > 0.0) & (wo.z > 0.0)
            f0, albedo = self.reflectance, self.albedo
            has_lobe = dr.select(f0 > 0.0, 1.0, 0.0)

            def schlick(cosine):
                return has_lobe * (f0 + (1.0 - f0) * dr.clip(1.0 - cosine, 0.0, 1.0) ** 5)

            half = dr.normalize(wi + wo)
            alpha2 = self.alpha**2
            slope = half.x**2 + half.y**2 + alpha2 * half.z**2
            masking = wo.z * dr.sqrt(alpha2 + (1.0 - alpha2) * wi.z**2)
            masking += wi.z * dr.sqrt(alpha2 + (1.0 - alpha2) * wo.z**2)
            lobe = alpha2 / (dr.pi * slope**2) * 0.5 / masking
            value = albedo / dr.pi * (1.0 - schlick(wi.z)) * (1.0 - schlick(wo.z))
            value += schlick(dr.dot(half, wi)) * lobe
            return dr.select(active, value * wo.z, 0.0)

        def pdf(self, ctx, si, wo, active=True):
            wi, wo = self._facing(si, si.wi), self._facing(si, wo)
            half = dr.normalize(wi + wo)
            glossy = self._lobe().pdf(wi, half) / (4.0 * dr.dot(wo, half))
            both = 0.5 * (glossy + mi.warp.square_to_cosine_hemisphere_pdf(wo))
            return dr.select(active & (wi.z > 0.0) & (wo.z > 0.0), both, 0.0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self):
            return f"GgxOverLambert[alpha={self.alpha}]"

    return GgxOverLambert


def rgb(colour: np.ndarray) -> dict[str, object]:
    """Mitsuba's unbounded colour; its ``rgb`` clamps and is for reflectances."""
    return {"type": "rgb", "value": [float(x) for x in colour]}


def glass(material: Material) -> dict[str, object]:
    """A dielectric, its outside air."""
    common = {
        "int_ior": material.ior,
        "ext_ior": 1.0,
        "specular_transmittance": rgb(material.transmission),
    }
    if material.thin:
        return {"type": "thindielectric", **common}
    if material.roughness <= SMALLEST_ROUGHNESS:
        return {"type": "dielectric", **common}
    return {"type": "roughdielectric", "distribution": "ggx", "alpha": material.roughness**2, **common}


def lambert(albedo: np.ndarray | dict[str, object]) -> dict[str, object]:
    """Of an albedo or of a texture of Mitsuba's."""
    reflectance = albedo if isinstance(albedo, dict) else rgb(albedo)
    lambert = {"type": "diffuse", "reflectance": reflectance}
    return {"type": "twosided", "material": lambert}
