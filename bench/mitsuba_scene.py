"""A loaded scene in Mitsuba 3: meshes, materials, lights and camera rays as near as they can be.

What is the same: triangles and vertex normals; Lambert (Mitsuba's own); GGX over Lambert (`bsdf.cl`'s
formula as a BSDF plugin, since none of Mitsuba's has it; `llvm` variants only); textures and colours of
vertices of Lambert surfaces; glass, smooth, rough and thin, without textures; black-body, one-sided area
lights; the camera's rays, which go through the same sub-pixel centres.

What is not:

- Two-sided lights are two one-sided ones, back to back, a hair's breadth apart, and so are surfaces
  that emit.
- Points and spots are Mitsuba's, without size; discs and spheres are exact in both, but for what rays
  of ours meet.
- Where an interpolated normal turns away from the viewer (silhouettes of coarse smooth meshes) ours
  takes the triangle's normal, Mitsuba the surface's other side. Global illumination of knot and
  occluders is 0.1 % brighter with ours; without vertex normals in either it agrees within 0.03 %.
- Shadow rays: ours leave and end a few roundings off the surfaces, Mitsuba's by epsilons of its own.
- Suns are points, infinitely far away: shadows have no penumbra.
- A mesh's light from below its geometric normal: ours is zero, Mitsuba's is up to the shadow ray.
"""

from __future__ import annotations

import functools
import os
import re
import subprocess
import sys
from types import ModuleType

import numpy as np
from mitsuba_surface import glass, lambert, register, rgb

from ncv_cl.scene.lights.kinds import SphereLight, SpotLight
from ncv_cl.scene.lights.mesh import disc_axes
from ncv_cl.scene.load import Material, QuadLight, Scene
from ncv_cl.scene.model import Light
from ncv_cl.scene.sky.environment import Environment

# An older LLVM lacks instructions that Mitsuba's compiler emits, and aborts the process.
OLDEST_LLVM = 16
# By how much the two halves of a two-sided light stand apart, over the light's largest coordinate.
_HALF_GAP = 4e-6
_PROBE = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
film = {"type": "hdrfilm", "width": 4, "height": 4}
scene = {"type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant"}}
print(mi.render(mi.load_dict({**scene, "sensor": {"type": "perspective", "film": film}}), spp=1))
"""


@functools.cache
def import_mitsuba() -> ModuleType | None:
    """Mitsuba with a variant chosen, or None where it is not installed.

    The variant is ``llvm_ad_rgb`` where an LLVM works, else ``scalar_rgb``.
    """
    path = _llvm_path()
    if path is not None:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", path)
    try:
        import mitsuba
    except ImportError:
        return None
    # In a process of its own: an LLVM that does not suit ends the process.
    probe = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, check=False)
    mitsuba.set_variant("scalar_rgb" if probe.returncode else "llvm_ad_rgb")
    return mitsuba


def _llvm_path() -> str | None:
    """The newest LLVM library that the system's loader knows, if it is new enough."""
    try:
        listed = subprocess.run(["ldconfig", "-p"], capture_output=True, text=True, check=False).stdout
    except OSError:
        return None
    found = re.findall(r"libLLVM(?:-|\.so\.)(\d+)\S* .*=> (\S+)", listed)
    return max(((int(v), path) for v, path in found if int(v) >= OLDEST_LLVM), default=(0, None))[1]


class MitsubaScene:
    """A scene in Mitsuba's hands.

    Parameters
    ----------
    mitsuba : module
        As `import_mitsuba` gives it.
    scene : Scene
    white_under_sky : bool
        Every surface Lambert of albedo 1, no light but a sky of radiance 1 that the camera does not see:
        radiance after one bounce is then ambient occlusion.

    Attributes
    ----------
    llvm : bool
        Whether rays are traced by the wavefront.

    Raises
    ------
    NotImplementedError
        For glossy materials in a ``scalar`` variant, for smooth meshes that emit and textures of what
        they emit, and for textures of glossy surfaces.
    """

    def __init__(self, mitsuba: ModuleType, scene: Scene, white_under_sky: bool = False) -> None:
        self.mitsuba, self.source = mitsuba, scene
        self.llvm = mitsuba.variant().startswith("llvm")
        self.white_under_sky = white_under_sky
        items: dict[str, object] = {"type": "scene"}
        if white_under_sky:
            items["sky"] = {"type": "constant", "radiance": rgb(np.ones(3))}
        items |= self._meshes()
        for number, light in enumerate(scene.lights):
            items |= self._light(number, light)
        if scene.environment is not None and not white_under_sky:
            items |= self._environment(scene.environment)
        self.scene = mitsuba.load_dict(items)

    def _meshes(self) -> dict[str, object]:
        """One mesh for each material, flat and smooth triangles apart."""
        scene = self.source
        smooth = np.any(scene.vertex_normals[scene.triangles] != 0, axis=(1, 2))
        found: dict[str, object] = {}
        for index, material in enumerate(scene.materials):
            own = (scene.triangle_material == index) & (scene.triangle_light < 0)
            for is_smooth in (False, True):
                triangles = scene.triangles[own & (smooth == is_smooth)]
                if len(triangles):
                    name = f"mesh{index}{'smooth' if is_smooth else 'flat'}"
                    found[name] = self._mesh(name, triangles, is_smooth, material)
                    if material.emission.any() and not self.white_under_sky:
                        found[f"{name}back"] = self._back(f"{name}back", triangles, material)
        return found

    def _back(self, name: str, triangles: np.ndarray, material: Material) -> object:
        """The other side of triangles that emit, which Mitsuba's do towards their normals."""
        if self.source.vertex_normals[triangles].any():
            raise NotImplementedError("smooth meshes that emit from both sides are not compared")
        corners = self.source.vertices[triangles].astype(float)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        corners -= normals[:, None] * np.abs(corners).max() * _HALF_GAP
        turned = corners[:, ::-1].reshape(-1, 3).astype(np.float32)
        mesh = self.mitsuba.Mesh(name, len(turned), len(triangles), props=self._properties(material))
        parameters = self.mitsuba.traverse(mesh)
        parameters["vertex_positions"] = turned.ravel()
        parameters["faces"] = np.arange(len(turned), dtype=np.uint32)
        parameters.update()
        return mesh

    def _properties(self, material: Material, coloured: bool = False) -> object:
        mi, properties = self.mitsuba, self.mitsuba.Properties()
        properties["mesh_bsdf"] = mi.load_dict(self._bsdf(material, coloured))
        if material.emission.any() and not self.white_under_sky:
            emitter = {"type": "area", "radiance": rgb(material.emission)}
            properties["mesh_emitter"] = mi.load_dict(emitter)
        return properties

    def _mesh(self, name: str, triangles: np.ndarray, smooth: bool, material: Material) -> object:
        mi, scene = self.mitsuba, self.source
        used, faces = np.unique(triangles, return_inverse=True)
        coloured = scene.vertex_colours is not None and bool(np.any(scene.vertex_colours[used] != 1))
        mesh = mi.Mesh(
            name,
            len(used),
            len(triangles),
            has_vertex_normals=smooth,
            has_vertex_texcoords=bool(material.textures),
            props=self._properties(material, coloured),
        )
        if coloured:
            colours = material.albedo * scene.vertex_colours[used]
            mesh.add_attribute("vertex_color", 3, colours.astype(np.float32).ravel())
        parameters = mi.traverse(mesh)
        if material.textures:
            parameters["vertex_texcoords"] = scene.vertex_uv[used].ravel()
        parameters["vertex_positions"] = scene.vertices[used].ravel()
        if smooth:
            parameters["vertex_normals"] = scene.vertex_normals[used].ravel()
        parameters["faces"] = faces.astype(np.uint32).ravel()
        parameters.update()
        return mesh

    def _bsdf(self, material: Material, coloured: bool = False) -> dict[str, object]:
        if self.white_under_sky:
            return lambert(np.ones(3))
        if material.is_glass and not coloured and material.maps is None:
            return glass(material)
        if coloured or material.maps is not None:
            return self._varying(material, coloured)
        if not np.any(material.reflectance):
            return lambert(material.albedo)
        if not self.llvm:
            raise NotImplementedError("GGX over Lambert takes an llvm variant of Mitsuba")
        register(self.mitsuba)
        return {
            "type": "ggx_over_lambert",
            "albedo": rgb(material.albedo),
            "reflectance": rgb(material.reflectance),
            "roughness": material.roughness,
        }

    def _varying(self, material: Material, coloured: bool) -> dict[str, object]:
        """Lambert whose albedo is that of a texture, or of colours of vertices."""
        texture = material.maps.colour if material.maps is not None else None
        others = material.textures[texture is not None :]
        if material.has_lobe or others or (coloured and texture is not None):
            raise NotImplementedError(
                "only textures of colour are compared, on Lambert without colours of vertices"
            )
        if texture is None:
            return lambert({"type": "mesh_attribute", "name": "vertex_color"})
        if len(set(texture.wrap)) > 1:
            raise NotImplementedError("Mitsuba's images go on alike along both axes")
        # Its first row is at v = 0, as of texels.
        texels = material.albedo * texture.texels[:, :, :3].astype(np.float32)
        image = {
            "type": "bitmap",
            "bitmap": self.mitsuba.Bitmap(np.ascontiguousarray(texels)),
            "raw": True,
            "filter_type": "nearest" if texture.nearest else "bilinear",
            "wrap_mode": texture.wrap[0],
        }
        return lambert(image)

    def _light(self, number: int, light: Light) -> dict[str, object]:
        """Emitting and black, or white without light under the sky."""
        if not isinstance(light, QuadLight):
            if self.white_under_sky or getattr(light, "two_sided", False):
                raise NotImplementedError(
                    "round lights are compared in pictures of their own light only"
                )
            return {f"light{number}": self._round(light)}
        corners = np.abs(light.corner) + np.abs(light.edge1) + np.abs(light.edge2)
        gap = light.normal.astype(float) * float(corners.max()) * _HALF_GAP
        sides = {"front": (light.edge1, light.edge2, gap * light.two_sided)}
        if light.two_sided:
            sides["back"] = (light.edge2, light.edge1, -gap)
        found = {}
        for side, (edge1, edge2, shift) in sides.items():
            item: dict[str, object] = {
                "type": "rectangle",
                "to_world": self._parallelogram(light.corner + shift, edge1, edge2),
                "bsdf": lambert(np.full(3, float(self.white_under_sky))),
            }
            if not self.white_under_sky:
                item["emitter"] = {"type": "area", "radiance": rgb(light.radiance)}
            found[f"light{number}{side}"] = item
        return found

    def _environment(self, environment: Environment) -> dict[str, object]:
        """The image, whose function between pixels is the same, and suns as points infinitely far away.

        Mitsuba's first and last row are the poles themselves, ours the middles of rows.
        """
        texels = environment.texels
        height = texels.shape[0]
        at = np.clip(np.arange(2 * height + 1) / 2 - 0.5, 0, height - 1)
        upper = np.minimum(at.astype(int), max(height - 2, 0))
        part = (at - upper)[:, None, None].astype(np.float32)
        rows = (1 - part) * texels[upper] + part * texels[np.minimum(upper + 1, height - 1)]
        # Fewer columns than two cannot be interpolated there.
        rows = np.ascontiguousarray(np.repeat(rows, 2 if rows.shape[1] == 1 else 1, axis=1))
        matrix = np.eye(4)
        matrix[:3, :3] = environment.axes.T
        to_world = self.mitsuba.ScalarTransform4f(matrix)
        found: dict[str, object] = {}
        if texels.any():
            found["sky"] = {
                "type": "envmap",
                "bitmap": self.mitsuba.Bitmap(rows),
                "to_world": to_world,
            }
        for number, sun in enumerate(environment.suns):
            found[f"sun{number}"] = {
                "type": "directional",
                "direction": [float(x) for x in -sun.towards],
                "irradiance": rgb(sun.irradiance),
            }
        return found

    def _round(self, light: Light) -> dict[str, object]:
        """A spot without size, or a black disc or sphere that emits."""
        if isinstance(light, SpotLight):
            end = [float(x) for x in light.position + light.direction]
            begin = [float(x) for x in light.position]
            up = [float(x) for x in disc_axes(light.direction)[0]]
            return {
                "type": "spot",
                "to_world": self.mitsuba.ScalarTransform4f().look_at(begin, end, up),
                "intensity": rgb(light.intensity),
                "cutoff_angle": light.outer_angle,
                "beam_width": light.inner_angle,
            }
        item = {
            "emitter": {"type": "area", "radiance": rgb(light.radiance)},
            "bsdf": lambert(np.zeros(3)),
        }
        if isinstance(light, SphereLight):
            centre = [float(x) for x in light.centre]
            return {"type": "sphere", "center": centre, "radius": light.radius, **item}
        edges = [2 * light.radius * axis for axis in disc_axes(light.normal)]
        corner = light.centre - (edges[0] + edges[1]) / 2
        return {"type": "disk", "to_world": self._parallelogram(corner, *edges), **item}

    def _parallelogram(self, corner: np.ndarray, edge1: np.ndarray, edge2: np.ndarray) -> object:
        """What maps Mitsuba's rectangle, [-1, 1]² in z = 0, to corner + u edge1 + v edge2."""
        corner, edge1, edge2 = (np.asarray(vector, float) for vector in (corner, edge1, edge2))
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1] = edge1 / 2, edge2 / 2
        normal = np.cross(edge1, edge2)
        matrix[:3, 2] = normal / np.linalg.norm(normal)
        matrix[:3, 3] = corner + edge1 / 2 + edge2 / 2
        return self.mitsuba.ScalarTransform4f(matrix)

    def sensor(self, size: tuple[int, int], sampler: str = "independent", spp: int = 1) -> object:
        """The camera, with a film of `size` pixels and a box filter."""
        camera = self.source.camera
        look = self.mitsuba.ScalarTransform4f().look_at(
            *([float(x) for x in vector] for vector in (camera.position, camera.target, camera.up))
        )
        film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}}
        return self.mitsuba.load_dict(
            {
                "type": "perspective",
                "fov": camera.vertical_fov,
                "fov_axis": "y",
                "to_world": look,
                # Nothing is nearer to the eye; the clipping planes must not cut anything.
                "near_clip": 1e-4 * self._extent(),
                "far_clip": 1e2 * self._extent(),
                "film": film | {"pixel_format": "rgb", "component_format": "float32"},
                "sampler": {"type": sampler, "sample_count": spp},
            }
        )

    def _extent(self) -> float:
        camera = np.asarray(self.source.camera.position)
        return float(np.abs(self.source.bounds - camera).max())

    def radiance(
        self,
        integrator: dict[str, object],
        size: tuple[int, int],
        supersample: int,
        spp: int,
        seed: int,
        sampler: str = "independent",
    ) -> np.ndarray:
        """An image by rays through sub-pixel centres, float64 (height, width, 3).

        `spp` samples of each of the `supersample`² rays of a pixel, whose mean is the pixel.
        """
        mi = self.mitsuba
        columns, rows = (n * supersample for n in size)
        method, sensor = mi.load_dict(integrator), self.sensor(size, sampler, spp)
        cells = self._wavefront if self.llvm else self._one_by_one
        radiance = cells(method, sensor, columns, rows, spp, seed)
        blocks = radiance.reshape(size[1], supersample, size[0], supersample, 3)
        return blocks.mean(axis=(1, 3))

    def _wavefront(self, method, sensor, columns: int, rows: int, spp: int, seed: int) -> np.ndarray:
        import drjit as dr

        mi, cells = self.mitsuba, columns * rows
        sampler = sensor.sampler().clone()
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed, cells * spp)
        cell = dr.arange(mi.UInt32, cells * spp) // spp
        at = mi.Point2f(
            (mi.Float(cell % columns) + 0.5) / columns, (mi.Float(cell // columns) + 0.5) / rows
        )
        # What Mitsuba's own loop would take for the position in the pixel.
        sampler.next_2d()
        ray, _ = sensor.sample_ray_differential(0.0, 0.5, at, mi.Point2f(0.5))
        value, valid, _ = method.sample(self.scene, sampler, ray)
        # Rays that miss are not valid to the direct integrator, even where they see the environment.
        if self.source.environment is None:
            value = dr.select(valid, value, 0.0)
        sums = [np.array(dr.block_sum(channel, spp), np.float64) for channel in value]
        return np.stack(sums, axis=-1) / spp

    def _one_by_one(self, method, sensor, columns: int, rows: int, spp: int, seed: int) -> np.ndarray:
        mi = self.mitsuba
        sampler = sensor.sampler().clone()
        sampler.seed(seed)
        found = np.zeros((columns * rows, 3))
        for cell in range(columns * rows):
            at = [(cell % columns + 0.5) / columns, (cell // columns + 0.5) / rows]
            ray, _ = sensor.sample_ray_differential(0.0, 0.5, at, [0.5, 0.5])
            for _ in range(spp):
                value, valid, _ = method.sample(self.scene, sampler, mi.RayDifferential3f(ray))
                if valid or self.source.environment is not None:
                    found[cell] += np.array(value)
                sampler.advance()
        return found / spp
