"""Neural control variates for light transport, in OpenCL.

One small ReLU network is trained for all the two-dimensional integrals of an image; its integral is
exact, and Monte Carlo estimates what it leaves.
"""

from __future__ import annotations

from .integrands import AmbientOcclusion, DirectLight, GlobalIllumination, Integrand, IntegrandError
from .integration.integrate import integrate
from .integration.subdivide import Subdivision, draw_subdivision, subdivide
from .network.network import Network, NetworkError
from .opencl.choose import choose_device, devices
from .opencl.device import Device, DeviceError
from .output.image import Image
from .rendering.estimate import Integrals, estimate
from .rendering.render import render
from .rendering.split import render_split
from .scene.load import Material, Scene, SceneError, load_scene

__all__ = [
    "AmbientOcclusion",
    "Device",
    "DeviceError",
    "DirectLight",
    "GlobalIllumination",
    "Image",
    "Integrals",
    "Integrand",
    "IntegrandError",
    "Material",
    "Network",
    "NetworkError",
    "Scene",
    "SceneError",
    "Subdivision",
    "choose_device",
    "devices",
    "draw_subdivision",
    "estimate",
    "integrate",
    "load_scene",
    "render",
    "render_split",
    "subdivide",
]
