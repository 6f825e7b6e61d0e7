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
from .opencl.program import KernelText
from .output.image import Image
from .rendering.estimate import Integrals, estimate
from .rendering.render import render
from .rendering.split import render_split
from .scene.build import build_scene
from .scene.load import load_scene
from .scene.model import Camera, Material, QuadLight, Scene, TriangleMesh
from .scene.table import SceneError
from .scene.textures.texture import Texture
from .settings.options import Files, Machine, Sampling, Stopping, Training

__all__ = [
    "AmbientOcclusion",
    "Camera",
    "Device",
    "DeviceError",
    "DirectLight",
    "Files",
    "GlobalIllumination",
    "Image",
    "Integrals",
    "Integrand",
    "IntegrandError",
    "KernelText",
    "Machine",
    "Material",
    "Network",
    "NetworkError",
    "QuadLight",
    "Sampling",
    "Scene",
    "SceneError",
    "Stopping",
    "Subdivision",
    "Texture",
    "Training",
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
