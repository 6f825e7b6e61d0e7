"""Integrands over primary sample space: each is one module here and one kernel file in cl/."""

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
