"""Neural control variates for light transport, in OpenCL.

One small ReLU network is trained for all the two-dimensional integrals of an image; its integral is
exact, and Monte Carlo estimates what it leaves.
"""

from __future__ import annotations

from .choose import choose_device, devices
from .custom import Integrals, estimate
from .device import Device, DeviceError
from .image import Image
from .integrands import AmbientOcclusion, DirectLight, GlobalIllumination, Integrand, IntegrandError
from .integrate import integrate
from .network import Network, NetworkError
from .program import KernelText
from .render import render
from .scene import Camera, Material, QuadLight, Scene, SceneError, load_scene
from .scene_build import build_scene
from .scene_data import TriangleMesh
from .split import render_split
from .subdivide import Subdivision, draw_subdivision, subdivide

__all__ = [
    "AmbientOcclusion",
    "Camera",
    "Device",
    "DeviceError",
    "DirectLight",
    "GlobalIllumination",
    "Image",
    "Integrals",
    "Integrand",
    "IntegrandError",
    "KernelText",
    "Material",
    "Network",
    "NetworkError",
    "QuadLight",
    "Scene",
    "SceneError",
    "Subdivision",
    "TriangleMesh",
    "build_scene",
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
