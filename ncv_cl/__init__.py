"""Neural control variates for light transport, in OpenCL.

One small ReLU network is trained for all the two-dimensional integrals of an image; its integral is
exact, and Monte Carlo estimates what it leaves.
"""

from __future__ import annotations

from .integrands import AmbientOcclusion, DirectLight, GlobalIllumination, Integrand, IntegrandError
from .integration.integrate import integrate
from .integration.subdivide import Subdivision, draw_subdivision, subdivide
from .machines.crew import TaskError
from .machines.processes import Processes
from .machines.values import CannotTravel
from .network.network import Network, NetworkError
from .opencl.choose import choose_device, devices
from .opencl.device import Device, DeviceError
from .opencl.program import KernelText
from .output.compare import Comparison, compare
from .output.image import Image
from .output.vertex_colours import write_vertex_colours
from .points.arrays import PointError
from .rendering.estimate import Integrals, estimate
from .rendering.render import render
from .scene.build import build_scene
from .scene.lights.kinds import DiscLight, PointLight, SphereLight, SpotLight
from .scene.load import load_scene
from .scene.model import Camera, Material, QuadLight, Scene, TriangleMesh
from .scene.sky.environment import Environment, Sun
from .scene.table import SceneError
from .scene.textures.texture import Texture
from .scene.unwrap import unwrap
from .scene.uv_mesh import BakeError, UVMesh
from .sensing.bake import bake
from .sensing.bake_vertices import bake_vertices
from .sensing.point_estimate import PointValues
from .sensing.sense import ambient_occlusion, irradiance, radiance
from .sensing.view_factors import ViewFactors, view_factors
from .settings.options import Files, Machine, Sampling, Stopping, Training

__all__ = [
    "AmbientOcclusion",
    "BakeError",
    "Camera",
    "CannotTravel",
    "Comparison",
    "Device",
    "DeviceError",
    "DirectLight",
    "DiscLight",
    "Environment",
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
    "PointError",
    "PointLight",
    "PointValues",
    "Processes",
    "QuadLight",
    "Sampling",
    "Scene",
    "SceneError",
    "SphereLight",
    "SpotLight",
    "Stopping",
    "Subdivision",
    "Sun",
    "TaskError",
    "Texture",
    "Training",
    "TriangleMesh",
    "UVMesh",
    "ViewFactors",
    "ambient_occlusion",
    "bake",
    "bake_vertices",
    "build_scene",
    "choose_device",
    "compare",
    "devices",
    "draw_subdivision",
    "estimate",
    "integrate",
    "irradiance",
    "load_scene",
    "radiance",
    "render",
    "subdivide",
    "unwrap",
    "view_factors",
    "write_vertex_colours",
]
