"""Light between textured surfaces: against a path tracer, and against surfaces of many small parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference import camera_at, intersect, light_at, sampling, shadowed_values, unit

import ncv_cl as ncv
from ncv_cl import DirectLight, GlobalIllumination, Material, Texture, TriangleMesh
from ncv_cl.scene.textures.texture import Maps

CAMERA = camera_at([1.5, 1, 2], [-0.5, -0.7, -1], 50)
LIGHTS = (light_at([-1, 1.5, -1], [2, 0, 0], [0, 0, 2], (5, 4, 3)),)
# Corner and edges of a floor, two walls and a shelf.
QUADS = [
    ([-2, -1, -2], [0, 0, 4], [4, 0, 0]),
    ([-2, -1, -2], [4, 0, 0], [0, 3, 0]),
    ([-2, -1, -2], [0, 3, 0], [0, 0, 4]),
    ([-1, 0.2, -1.8], [1.5, 0, 0], [0, 0, 1.5]),
]
TWO = [[0, 1, 2], [0, 2, 3]]
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
GENERATOR = np.random.default_rng(11)
IMAGES = [GENERATOR.random((3, 4, 3)).astype(np.float16) for _ in QUADS]
# Green is roughness, blue the metallic share.
SURFACES = [GENERATOR.uniform(0.3, 1, (3, 4, 3)).astype(np.float16) for _ in QUADS]


def corners_of(corner, edge1, edge2):
    corner, edge1, edge2 = (np.asarray(vector, float) for vector in (corner, edge1, edge2))
    return np.stack([corner + u * edge1 + v * edge2 for u, v in SQUARE])


def built(materials, meshes):
    return ncv.build_scene(CAMERA, materials, meshes, LIGHTS)


def textured(wrap="mirror", nearest=False, maps=lambda i, colour: Maps(colour), scale=1.7, **material):
    """The room with an image on each quad."""
    found = {}
    for index, image in enumerate(IMAGES):
        colour = Texture.of(image, wrap, nearest)
        found[f"m{index}"] = Material(albedo=(1.0, 0.9, 0.8), maps=maps(index, colour), **material)
    meshes = [
        TriangleMesh(corners_of(*one), TWO, f"m{i}", uv=scale * SQUARE) for i, one in enumerate(QUADS)
    ]
    return built(found, meshes)


def tessellated(metallic=0.0, rough=1.0, reflectance=0.0, surfaces=None):
    """The room with a small quad of its own material for every texel."""
    materials, meshes = {}, []
    for index, (corner, edge1, edge2) in enumerate(QUADS):
        corner, edge1, edge2 = (np.asarray(vector, float) for vector in (corner, edge1, edge2))
        for row in range(3):
            for column in range(4):
                base = np.array([1.0, 0.9, 0.8]) * IMAGES[index][2 - row, column].astype(float)
                metal, roughness = metallic, rough
                if surfaces is not None:
                    roughness *= float(surfaces[index][2 - row, column, 1])
                    metal *= float(surfaces[index][2 - row, column, 2])
                name = f"m{index}.{row}.{column}"
                materials[name] = Material(
                    base * (1 - metal), reflectance * (1 - metal) + base * metal, roughness
                )
                start = corner + column / 4 * edge1 + row / 3 * edge2
                meshes.append(TriangleMesh(corners_of(start, edge1 / 4, edge2 / 3), TWO, name))
    return built(materials, meshes)


def interpolated(scene, rows, triangle, u, v):
    first, second, third = (rows[scene.triangles[triangle, i]].astype(float) for i in range(3))
    return (1 - u - v)[:, None] * first + u[:, None] * second + v[:, None] * third


def colour_of(scene, triangle, u, v):
    """Albedos (n, 3), texel by texel from the images."""
    albedo = np.ones((len(triangle), 3))
    if scene.vertex_colours is not None:
        albedo *= interpolated(scene, scene.vertex_colours, triangle, u, v)
    material = scene.triangle_material[triangle]
    for index, one in enumerate(scene.materials):
        here = np.flatnonzero(material == index)
        albedo[here] *= one.albedo
        if not len(here) or one.maps is None:
            continue
        uv = interpolated(scene, scene.vertex_uv, triangle[here], u[here], v[here])
        image = one.maps.colour.texels[:, :, :3].astype(float)
        size = np.array(image.shape[1::-1])
        place = uv * size - 0.5
        low = np.floor(place).astype(int)
        share = place - low
        total = np.zeros((len(here), 3))
        for dx in (0, 1):
            for dy in (0, 1):
                weight = np.abs(1 - dx - share[:, 0]) * np.abs(1 - dy - share[:, 1])
                at = (low + np.array([dx, dy])) % (2 * size)
                at = np.where(at < size, at, 2 * size - 1 - at)
                total += weight[:, None] * image[at[:, 1], at[:, 0]]
        albedo[here] *= total
    return albedo


def traced(scene, points, depth, paths, generator):
    """Radiance by matte paths that meet lights by chance alone: means, their variances (3, points)."""
    count = points.active
    eye = np.asarray(scene.camera.position, float)
    seen = points.rows("position").T[:count].astype(float)
    triangle, u, v, _ = intersect(scene, np.broadcast_to(eye, seen.shape), unit(seen - eye))
    albedo = np.repeat(colour_of(scene, triangle, u, v), paths, 0)
    position = np.repeat(seen, paths, 0)
    normal = np.repeat(points.rows("normal").T[:count].astype(float), paths, 0)
    throughput, radiance = np.ones((count * paths, 3)), np.zeros((count * paths, 3))
    alive = np.arange(count * paths)
    for _ in range(depth - 1):
        direction = unit(normal + unit(generator.normal(size=normal.shape)))
        throughput[alive] *= albedo
        triangle, u, v, _ = intersect(scene, position + 1e-5 * normal, direction)
        light = np.where(triangle >= 0, scene.triangle_light[triangle], -2)
        met = (light == 0) & (direction @ scene.lights[0].normal.astype(float) < 0)
        radiance[alive[met]] += throughput[alive[met]] * scene.lights[0].radiance
        on = light == -1
        triangle, u, v = triangle[on], u[on], v[on]
        corners = scene.vertices[scene.triangles[triangle]].astype(float)
        edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        position = corners[:, 0] + u[:, None] * edge1 + v[:, None] * edge2
        normal = unit(np.cross(edge1, edge2))
        normal *= -np.sign(np.sum(normal * direction[on], 1))[:, None]
        albedo = colour_of(scene, triangle, u, v)
        alive = alive[on]
    each = radiance.reshape(count, paths, 3)
    return each.mean(1).T, (each.var(1) / paths).T


def estimates(device, scene, integrand, samples, size=(4, 3)):
    """The samples' means and their variances, (3, points), and the points."""
    points, source, _ = sampling(device, scene, integrand, size, samples, "independent")
    values = shadowed_values(source.draw(range(points.active), range(samples), 0), 3)
    return values.mean(2), values.var(2) / samples, points


def assert_same(first, second, variance):
    z = ((first - second) / np.sqrt(np.maximum(variance, 1e-30)))[variance > 0]
    # Channels err together: a third of the numbers are independent.
    assert z.size and np.mean(z**2) < 1 + 5 * np.sqrt(2 / (z.size / 3)), np.mean(z**2)
    assert np.abs(z).max() < 5


@pytest.mark.parametrize("depth", [2, 3, 4])
@pytest.mark.parametrize("coloured", [False, True])
def test_textured_rooms_match_an_independent_path_tracer(device, depth, coloured):
    scene = textured()
    if coloured:
        colours = np.random.default_rng(4).random((len(scene.vertices), 3)).astype(np.float32)
        scene = replace(scene, vertex_colours=colours)
    mean, variance, points = estimates(device, scene, GlobalIllumination(depth), 1000)
    other, others = traced(scene, points, depth, 10000, np.random.default_rng(depth))
    assert_same(mean, other, variance + others)


def test_a_difference_of_textures_is_seen(one_device):
    """The test above would fail if bounces took another texture than the one that is there."""
    scene = textured()
    mean, variance, _ = estimates(one_device, scene, GlobalIllumination(4, direct=False), 4000)
    dull = replace(
        scene,
        materials=tuple(
            one if one.maps is None else replace(one, maps=Maps(Texture.of(IMAGES[i][::-1], "mirror")))
            for i, one in enumerate(scene.materials)
        ),
    )
    other, others, _ = estimates(one_device, dull, GlobalIllumination(4, direct=False), 4000)
    with pytest.raises(AssertionError):
        assert_same(mean, other, variance + others)


METALS = {
    "matte": ({}, {}),
    "gloss": ({"reflectance": 0.2, "roughness": 0.4}, {"reflectance": 0.2, "rough": 0.4}),
    "metal": (
        {"reflectance": 0.04, "roughness": 0.5, "maps": lambda i, colour: Maps(colour, metallic=0.7)},
        {"reflectance": 0.04, "rough": 0.5, "metallic": 0.7},
    ),
    "maps": (
        {
            "reflectance": 0.04, "roughness": 0.8,
            "maps": lambda i, colour: Maps(colour, Texture.of(SURFACES[i], nearest=True), metallic=0.9),
        },
        {"reflectance": 0.04, "rough": 0.8, "metallic": 0.9, "surfaces": SURFACES},
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", METALS)
@pytest.mark.parametrize("integrand", [DirectLight(), GlobalIllumination(4)])
def test_texels_are_as_good_as_small_surfaces(device, kind, integrand):
    one, many = METALS[kind]
    scene = textured("repeat", True, scale=1.0, **one)
    size = (7, 5)
    mean, variance, points = estimates(device, scene, integrand, 1000, size)
    other, others, parts = estimates(device, tessellated(**many), integrand, 1000, size)
    for name in ("albedo", "reflectance", "roughness"):
        np.testing.assert_allclose(points.rows(name), parts.rows(name), atol=2e-6)
    assert np.ptp(points.rows("albedo"), axis=1).min() > 0.1
    assert_same(mean, other, variance + others)


@pytest.mark.parametrize("depth", [2, 3])
def test_images_that_glow_are_as_good_as_small_surfaces(device, depth):
    """Seen by the camera, and by rays behind it."""
    one = textured("repeat", True, scale=1.0, maps=lambda i, colour: Maps(emission=colour), emission=2.0)
    many = tessellated()
    materials = []
    for material in many.materials:
        base = np.asarray(material.albedo, np.float32)
        glow = base / np.float32([1.0, 0.9, 0.8]) * 2
        plain = np.float32([1.0, 0.9, 0.8])
        is_light = material.name == "light"
        materials.append(material if is_light else replace(material, albedo=plain, emission=glow))
    many = replace(many, materials=tuple(materials))
    options = {"method": "mc", "sampler": "independent", "spp": 512, "size": (8, 6), "device": device}
    first = ncv.render(one, GlobalIllumination(depth), seed=1, **options)
    second = ncv.render(many, GlobalIllumination(depth), seed=2, **options)
    assert np.ptp(first.pixels) > 1
    known = first.variance + second.variance > 1e-10
    z = ((first.pixels - second.pixels) / np.sqrt(first.variance + second.variance + 1e-12))[known]
    assert np.mean(z**2) < 1 + 5 * np.sqrt(2 / (z.size / 3)) and np.abs(z).max() < 5


def test_the_network_sees_the_points_own_albedo(one_device):
    """Albedo is an input where it varies, and both methods agree."""
    scene = textured()
    options = {"size": (12, 10), "device": one_device, "sampler": "independent"}
    for integrand in ("direct", GlobalIllumination(3)):
        plain = ncv.render(scene, integrand, "mc", spp=512, seed=1, **options)
        other = ncv.render(scene, integrand, "ncv", spp=256, train_spp=16, seed=2, **options)
        assert "albedo" not in other.stats["skipped"]["inputs"]
        z = (plain.pixels - other.pixels) / np.sqrt(plain.variance + other.variance + 1e-12)
        assert np.abs(z.mean()) < 5 / np.sqrt(z.shape[0] * z.shape[1]) and np.mean(z**2) < 2
        assert np.ptp(other.layers["albedo"][other.layers["depth"] > 0], axis=0).min() > 0.2


def test_scenes_without_textures_get_no_look_up(one_device):
    scene = built({"m": Material(0.5)}, [TriangleMesh(corners_of(*QUADS[0]), TWO, "m", uv=SQUARE)])
    assert scene.vertex_uv is None and scene.vertex_colours is None
    plain = built({"m": Material(0.5)}, [TriangleMesh(corners_of(*QUADS[0]), TWO, "m")])
    assert plain.digest == scene.digest
