"""What kernels are compared with: plain numpy in float64, scenes from arrays, and recorded rays."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from ncv_cl.integrands import Integrand
from ncv_cl.integrands.tuning import SMALL_LIGHT
from ncv_cl.opencl.device import Device
from ncv_cl.opencl.program import Kernel, device_defines, option_list, source
from ncv_cl.output.image import Image
from ncv_cl.output.resolve import resolve_image
from ncv_cl.points.points import ShadingPoints, find_points
from ncv_cl.points.trace import Hits, Tracer
from ncv_cl.sampling.accumulate import Accumulator
from ncv_cl.sampling.paths import sample_source
from ncv_cl.sampling.samples import SEEN, Batch, SampleSource
from ncv_cl.sampling.warp import DENSITY_BINS, EDGE_UNITS
from ncv_cl.scene.load import Camera, Material, QuadLight, Scene
from ncv_cl.settings.settings import Settings
from ncv_cl.visibility.hierarchy import Hierarchy
from ncv_cl.visibility.shaft import MOST_OCCLUDERS, Occluders
from ncv_cl.visibility.slices import Slices
from ncv_cl.visibility.trace import DeviceTracer
from ncv_cl.visibility.tuning import MOST_ON_LINES


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) in float64, normalised."""
    vectors = np.asarray(vectors, np.float64)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


# ---------------------------------------------------------------------------------------- sampler


def philox(counter: np.ndarray, key: tuple[int, int]) -> np.ndarray:
    """Philox-4x32-10 (Salmon et al. 2011): counters and results are integers (4, n)."""
    x = [np.asarray(word, np.uint64) for word in counter]
    low = np.uint64(0xFFFFFFFF)
    key0, key1 = key
    for _ in range(10):
        first, second = x[0] * np.uint64(0xD2511F53), x[2] * np.uint64(0xCD9E8D57)
        x = [
            (second >> np.uint64(32)) ^ x[1] ^ np.uint64(key0),
            second & low,
            (first >> np.uint64(32)) ^ x[3] ^ np.uint64(key1),
            first & low,
        ]
        key0, key1 = (key0 + 0x9E3779B9) & 0xFFFFFFFF, (key1 + 0xBB67AE85) & 0xFFFFFFFF
    return np.stack(np.broadcast_arrays(*x)).astype(np.uint32)


def reverse_bits(words: np.ndarray) -> np.ndarray:
    octets = np.asarray(words, ">u4")[..., None].view(np.uint8)
    bits = np.unpackbits(octets, axis=-1)[..., ::-1]
    return np.packbits(bits, axis=-1).view(">u4")[..., 0].astype(np.uint32)


def owen_hash(words: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Burley 2020 with Vegdahl's constants, on bit-reversed words; uint32."""
    x = words.astype(np.uint32)
    x = x ^ (x * np.uint32(0x3D20ADEA))
    x = x + seed
    x = x * ((seed >> np.uint32(16)) | np.uint32(1))
    x = x ^ (x * np.uint32(0x05526C56))
    return x ^ (x * np.uint32(0x53A22864))


def sobol_second(index: np.ndarray) -> np.ndarray:
    """The second Sobol dimension as 32-bit words, from its direction numbers (Sobol' 1967)."""
    result, direction = np.zeros_like(index), np.uint32(1 << 31)
    for bit in range(32):
        result = result ^ np.where((index >> np.uint32(bit)) & np.uint32(1), direction, np.uint32(0))
        direction = direction ^ (direction >> np.uint32(1))
    return result


def square_samples(sampler: str, points: range, samples: range, seed: int, stream: int) -> np.ndarray:
    """u and v as the package defines them: float32 (2, points, samples)."""
    key = seed & 0xFFFFFFFF, seed >> 32
    point = np.arange(points.start, points.stop, dtype=np.uint32)[:, None]
    index = np.arange(samples.start, samples.stop, dtype=np.uint64).astype(np.uint32)[None]
    if sampler == "independent":
        words = philox([index, point, np.uint32(stream), np.uint32(0)], key)[:2]
    else:
        scramble = philox([np.uint32(0), point, np.uint32(stream), np.uint32(1)], key)
        sobol = index, reverse_bits(sobol_second(index))
        words = [reverse_bits(owen_hash(sobol[d], scramble[d])) ^ scramble[2 + d] for d in (0, 1)]
    return (np.stack(words) >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


# --------------------------------------------------------------------------------------- geometry


def camera_directions(camera: Camera, width: int, height: int, supersample: int = 1) -> np.ndarray:
    """Unit directions through the centres of all sub-pixels in row-major order, float64 (cells, 3)."""
    forward = unit(camera.target - camera.position)
    right = unit(np.cross(forward, camera.up))
    up = np.cross(right, forward)
    tangent = np.tan(np.radians(camera.vertical_fov) / 2)
    x = (np.arange(width * supersample) + 0.5) / (width * supersample) * 2 - 1
    y = 1 - (np.arange(height * supersample) + 0.5) / (height * supersample) * 2
    grid_y, grid_x = np.meshgrid(y * tangent, x * tangent * width / height, indexing="ij")
    return unit(forward + grid_x.reshape(-1, 1) * right + grid_y.reshape(-1, 1) * up)


def intersect(
    scene: Scene, origins: np.ndarray, directions: np.ndarray, slack: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Closest hits by brute force (Möller and Trumbore 1997): triangle (-1: none), u, v, distance.

    Triangles grow by `slack` (barycentric): what two slacks agree on is no matter of rounding.
    """
    corners = scene.vertices[scene.triangles].astype(np.float64)
    origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    triangle = np.full(len(origins), -1)
    u, v, distance = np.zeros((3, len(origins)))
    distance += np.inf
    for index, (corner, second, third) in enumerate(corners):
        edge1, edge2 = second - corner, third - corner
        across = np.cross(directions, edge2)
        start = origins - corner
        around = np.cross(start, edge1)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / (across @ edge1)
            a = np.einsum("ij,ij->i", start, across) * inverse
            b = np.einsum("ij,ij->i", directions, around) * inverse
            t = (around @ edge2) * inverse
            inside = (a >= -slack) & (b >= -slack) & (a + b <= 1 + slack) & (t > 0)
        closer = inside & (t < distance)
        triangle[closer], distance[closer] = index, t[closer]
        u[closer], v[closer] = a[closer], b[closer]
    return triangle, u, v, distance


def tangent_frame(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Duff et al. 2017, listing 3, for one unit normal (3,)."""
    x, y, z = normal
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangent = np.array([1.0 + sign * x * x * a, sign * b, -sign * x])
    return tangent, np.array([b, sign + y * y * a, -y])


# ------------------------------------------------------------------------------------------ light


def schlick(f0: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    return f0 + (1 - f0) * np.clip(1 - cosine, 0, 1) ** 5


def scattering(
    normal: np.ndarray,
    outgoing: np.ndarray,
    incident: np.ndarray,
    albedo: np.ndarray,
    reflectance: np.ndarray,
    roughness: float,
) -> np.ndarray:
    """f_r of bsdf.cl: directions (n, 3), colours (3,), result (n, 3)."""
    normal, outgoing, incident = unit(normal), unit(outgoing), unit(incident)
    cosine_i, cosine_o = np.sum(normal * incident, -1), np.atleast_1d(outgoing @ normal)
    half = unit(incident + outgoing)
    alpha2 = roughness**4
    sine2_h = np.sum(np.cross(normal, half) ** 2, -1)
    slope = sine2_h + alpha2 * np.sum(normal * half, -1) ** 2
    masking_i = cosine_o * np.sqrt(alpha2 + (1 - alpha2) * cosine_i**2)
    masking_o = cosine_i * np.sqrt(alpha2 + (1 - alpha2) * cosine_o**2)
    lobe = (alpha2 / (np.pi * slope**2) * 0.5 / (masking_i + masking_o))[:, None]
    reflectance = np.asarray(reflectance, np.float64)
    shiny = reflectance > 0
    below_i = 1 - shiny * schlick(reflectance, cosine_i[:, None])
    below_o = 1 - shiny * schlick(reflectance, cosine_o[:, None])
    specular = shiny * schlick(reflectance, np.sum(half * outgoing, -1)[:, None]) * lobe
    value = np.asarray(albedo) / np.pi * below_i * below_o + specular
    return np.where(cosine_i[:, None] > 0, value, 0.0)


def polygon_irradiance(corners: np.ndarray, position: np.ndarray, normal: np.ndarray) -> float:
    """Irradiance at a point from a polygon of radiance 1 wholly above its horizon (Lambert 1760).

    E = 1/2 Σ θ_i (n · γ_i), θ_i the angle that edge i subtends and γ_i the unit normal of its plane
    with the point.
    """
    towards = unit(np.asarray(corners, np.float64) - position)
    following = np.roll(towards, -1, axis=0)
    across = np.cross(towards, following)
    angle = np.arctan2(np.linalg.norm(across, axis=1), np.sum(towards * following, axis=1))
    return abs(0.5 * np.sum(angle * (unit(across) @ np.asarray(normal, np.float64))))


# ------------------------------------------------------------------------------ scenes and renders


def camera_at(position: object, target: object, fov: float = 40.0, up: object = (0, 1, 0)) -> Camera:
    position, target, up = (np.asarray(vector, np.float64) for vector in (position, target, up))
    return Camera(position, target, fov, up=up)


def grey(albedo: object = 0.5, reflectance: object = 0.0, roughness: float = 1.0) -> Material:
    colours = (np.array(np.broadcast_to(colour, 3), np.float32) for colour in (albedo, reflectance))
    return Material(*colours, roughness, name="grey")


def light_at(corner: object, edge1: object, edge2: object, radiance: object = 1.0, two_sided=False):
    vectors = (np.asarray(vector, np.float32) for vector in (corner, edge1, edge2))
    return QuadLight(*vectors, np.array(np.broadcast_to(radiance, 3), np.float32), two_sided)


def mesh_scene(
    triangles: np.ndarray,
    camera: Camera,
    lights: tuple[QuadLight, ...] = (),
    materials: tuple[Material, ...] = (),
    normals: np.ndarray | None = None,
    material: np.ndarray | None = None,
) -> Scene:
    """A scene of triangles (n, 3, 3) with vertex normals (n, 3, 3); the lights join its mesh."""
    triangles = np.asarray(triangles, np.float64).reshape(-1, 3, 3)
    own = len(triangles)
    for one in lights:
        triangles = np.concatenate([triangles, quad(one.corner, one.edge1, one.edge2)])
    count = len(triangles)
    vertex_normals = np.zeros((count, 3, 3), np.float32)
    vertex_normals[:own] = 0.0 if normals is None else normals
    triangle_material = np.zeros(count, np.int32)
    triangle_material[:own] = 0 if material is None else material
    triangle_light = np.full(count, -1, np.int32)
    triangle_light[own:] = np.repeat(np.arange(len(lights)), 2)
    return Scene(
        "test", None, camera, tuple(materials) or (grey(),), tuple(lights),
        triangles.reshape(-1, 3).astype(np.float32), vertex_normals.reshape(-1, 3),
        np.arange(3 * count, dtype=np.uint32).reshape(-1, 3), triangle_material, triangle_light, (),
    )  # fmt: skip


def quad(corner: object, edge1: object, edge2: object) -> np.ndarray:
    """A parallelogram's two triangles, float64 (2, 3, 3)."""
    corner, edge1, edge2 = (np.asarray(vector, np.float64) for vector in (corner, edge1, edge2))
    return np.array(
        [
            [corner, corner + edge1, corner + edge1 + edge2],
            [corner, corner + edge1 + edge2, corner + edge2],
        ]
    )


def light_corners(light: QuadLight) -> np.ndarray:
    corner, edge1, edge2 = (vector.astype(float) for vector in (light.corner, light.edge1, light.edge2))
    return corner + np.array([0 * edge1, edge1, edge1 + edge2, edge2])


def light_samples(
    light: QuadLight, position: np.ndarray, u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where (u, v) of a light's square are on it, float64 (n, 3), and what solid angle each stands for.

    By cylindrical coordinates about the axis through `position` along edge2: the angle about it and the
    sine of the angle along it, each stretched to [0, 1]; small lights by area, along their edges.
    """
    corner, edge1, edge2 = (vector.astype(float) for vector in (light.corner, light.edge1, light.edge2))
    normal = unit(np.cross(edge1, edge2))
    middle = corner + (edge1 + edge2) / 2 - position
    if edge1 @ edge1 + edge2 @ edge2 <= SMALL_LIGHT**2 * (middle @ middle):
        ends = corner + u[:, None] * edge1 + v[:, None] * edge2
        distance = np.linalg.norm(ends - position, axis=1)
        return ends, np.abs((ends - position) @ normal) / distance**3 * light.area
    along = unit(edge2)
    across = np.cross(along, normal)
    z, x0, width = abs((corner - position) @ normal), (corner - position) @ across, edge1 @ across
    first, last = np.arctan2(x0, z), np.arctan2(x0 + width, z)
    x = z * np.tan(first + u * (last - first))
    s = (x - x0) / width
    begin = (corner - position) @ along + s * (edge1 @ along)
    radius = np.hypot(x, z)
    low, high = (y / np.hypot(radius, y) for y in (begin, begin + np.linalg.norm(edge2)))
    h = low + v * (high - low)
    t = (radius * h / np.sqrt(1 - h**2) - begin) / np.linalg.norm(edge2)
    return corner + s[:, None] * edge1 + t[:, None] * edge2, (last - first) * (high - low)


class RayRecorder:
    """Stands where a `Tracer` stands and keeps what it was asked."""

    def __init__(self, tracer: Tracer) -> None:
        self.tracer = tracer

    def visible(
        self, origins: np.ndarray, directions: np.ndarray, distances: np.ndarray, out: np.ndarray
    ) -> None:
        self.tracer.visible(origins, directions, distances, out)
        self.origins, self.directions = origins.copy(), directions.copy()
        self.distances, self.answers = distances.copy(), out.copy()

    def closest(self, origins: np.ndarray, directions: np.ndarray, out: Hits | None = None) -> Hits:
        return self.tracer.closest(origins, directions, out)

    def closest_and_visible(self, *arrays: np.ndarray | Hits) -> None:
        self.tracer.closest_and_visible(*arrays)


def sampling(
    device: Device,
    scene: Scene,
    integrand: Integrand,
    size: tuple[int, int],
    samples: int,
    sampler: str = "sobol",
    seed: int = 1,
    with_occluders: bool = False,
    shadows_tested: bool = False,
    lines: bool = False,
    sliced: bool = False,
    most: int | None = None,
    on_device: bool = False,
) -> tuple[ShadingPoints, SampleSource, RayRecorder]:
    """Shading points of a small picture and a source of samples whose rays are recorded.

    Occluders are listed of points that have no more than `most`; `on_device` kernels trace the rays,
    which are not recorded then.
    """
    recorder = RayRecorder(Tracer(scene, threads=2))
    rays = DeviceTracer(device, Hierarchy(device, scene)) if on_device else recorder
    points = find_points(device, scene, recorder.tracer, *size, 1, integrand.emitters_active)
    occluders = None
    if with_occluders or lines:
        usual = MOST_ON_LINES if lines else MOST_OCCLUDERS
        most = usual if most is None else most
        occluders = Occluders(device, scene, points, integrand, most)
    samples_of = sample_source(
        device, scene, rays, points, integrand, sampler, seed, samples, occluders,
        lines=lines, slices=Slices(device, scene) if sliced else None, shadows_tested=shadows_tested,
    )  # fmt: skip
    return points, samples_of, recorder


def batch_arrays(batch: Batch, channels: int) -> dict[str, np.ndarray]:
    """A batch's content without padding: u, v, slot (points, samples), value (channels, ...)."""
    points, stride = len(batch.points), batch.stride
    arrays = {
        name: getattr(batch, name).read().ravel()[: points * stride].reshape(points, stride)
        for name in ("u", "v", "slot")
    }
    value = batch.value.read().ravel()[: channels * points * stride]
    arrays["value"] = value.reshape(channels, points, stride)
    return {name: array[..., : batch.samples] for name, array in arrays.items()}


def shadowed_values(batch: Batch, channels: int) -> np.ndarray:
    """Values with their traced visibility, float64 (channels, points, samples)."""
    arrays, visible = batch_arrays(batch, channels), batch.visible.read()
    traced = arrays["slot"] < SEEN
    seen = (arrays["slot"] == SEEN).astype(np.float64)
    seen[traced] = visible[arrays["slot"][traced]]
    return arrays["value"].astype(np.float64) * seen


def render_plain(
    device: Device,
    scene: Scene,
    integrand: Integrand,
    size: tuple[int, int],
    spp: int,
    sampler: str = "sobol",
    seed: int = 1,
) -> tuple[Image, ShadingPoints]:
    """Plain Monte Carlo through the package's stages, without `render`."""
    points, source_, _ = sampling(device, scene, integrand, size, 64, sampler, seed)
    accumulator = Accumulator(device, points, integrand.channels)
    for first in range(0, spp, 64):
        samples = range(first, min(first + 64, spp))
        for part in source_.batches():
            accumulator.add(source_.draw(part, samples, 0))
        accumulator.finish_pass(len(samples))
    settings = Settings(integrand, "mc", spp, size, seed)
    return resolve_image(scene, settings, points, accumulator.result()), points


def bare_kernel(device: Device, files: tuple[str, ...], defines: dict, text: str, name: str) -> Kernel:
    """A kernel of a test's own, joined after shipped files, to reach their functions."""
    options = [*option_list({**device_defines(device), **defines}), "-cl-kernel-arg-info"]
    program = cl.Program(device.context, f'{source(files)}\n#line 1 "test"\n{text}').build(options)
    return Kernel(device, cl.Kernel(program, name))


# ------------------------------------------------------------------------------------------- warp


def unpack_records(records: np.ndarray) -> np.ndarray:
    """Cells' probabilities that records of warp.cl stand for, float64 (records, DENSITY_BINS²)."""
    rows = np.ascontiguousarray(records, np.uint32).reshape(-1, DENSITY_BINS + 1, 2)
    shifts = np.arange(0, 32, 8, dtype=np.uint32)
    inner = ((rows[..., None] >> shifts) & np.uint32(255)).reshape(*rows.shape[:2], 8)
    ends = np.zeros((*rows.shape[:2], DENSITY_BINS + 1))
    ends[..., 1:-1], ends[..., -1] = inner[..., : DENSITY_BINS - 1], EDGE_UNITS
    share = np.diff(ends, axis=2) / EDGE_UNITS
    return (share[:, 0, :, None] * share[:, 1:]).reshape(-1, DENSITY_BINS**2)
