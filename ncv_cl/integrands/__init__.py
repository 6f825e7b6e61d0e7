"""What is integrated: f(u, v) at a shading point, and the ray that decides its visibility."""

from __future__ import annotations

from .ao import AmbientOcclusion
from .base import Integrand, IntegrandError
from .direct import DirectLight
from .gi import GlobalIllumination

INTEGRANDS: dict[str, type[Integrand]] = {
    integrand.name: integrand for integrand in (AmbientOcclusion, DirectLight, GlobalIllumination)
}

__all__ = [
    "INTEGRANDS",
    "AmbientOcclusion",
    "DirectLight",
    "GlobalIllumination",
    "Integrand",
    "IntegrandError",
]
