"""What a user could take instead: other methods for integrals over the unit square, one a file.

They share `interface.Method`: training samples in, an estimator out. `methods` lists them.
"""

from __future__ import annotations

from ncv_cl.opencl.device import Device

from .automatic import AutomaticIntegration
from .flow import NormalizingFlow
from .interface import Method
from .ours import Ours, PublicEstimate
from .plain import Plain
from .polynomial import PolynomialRegression


def methods(device: Device) -> list[Method]:
    """All methods, plain Monte Carlo first."""
    return [
        Plain(),
        PolynomialRegression(),
        AutomaticIntegration(),
        NormalizingFlow(),
        Ours(device, density=False),
        Ours(device, density=True),
        PublicEstimate(device),
    ]
