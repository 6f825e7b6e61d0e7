"""Images on surfaces: look-ups against loops in plain Python, decoding, and what scenes say of them."""

from __future__ import annotations

import functools
import math
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mesh_files import write_image
from reference import bare_kernel, light_corners, polygon_irradiance

import ncv_cl as ncv
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import surface_defines
from ncv_cl.points.textures import Textures, all_textures, texture_defines, texture_index
from ncv_cl.scene.textures import image_file
from ncv_cl.scene.textures.image_file import ImageFiles
from ncv_cl.scene.textures.texture import WRAPS, Maps, Texture

SCENE = """
[camera]
position = [0, 0, 4]
target = [0, 0, 0]
vertical_fov = 28.072487
[materials.paper]
albedo = { file = "t.png"%s }
[[quads]]
corner = [-1, -1, 0]
edge1 = [2, 0, 0]
edge2 = [0, 2, 0]
material = "paper"
"""
LIGHT = """
[[lights]]
corner = [-2, -3, 4.5]
edge1 = [0, 6, 0]
edge2 = [6, 0, 0]
radiance = [3, 2, 1]
"""


def decoded(value: float) -> float:
    """The sRGB curve (IEC 61966-2-1)."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def texel(index: int, size: int, wrap: str) -> int:
    """Which of an image's texels a texel of the plane around it is."""
    if wrap == "clamp":
        return min(max(index, 0), size - 1)
    if wrap == "repeat" or (index // size) % 2 == 0:
        return index % size
    return size - 1 - index % size


def looked_up(image: np.ndarray, u: float, v: float, wrap: tuple[str, str], nearest: bool) -> np.ndarray:
    """An image (height, width, channels), the uppermost row first, at one point."""
    height, width = image.shape[:2]
    x, y = u * width - 0.5, v * height - 0.5
    if nearest:
        x, y = math.floor(x + 0.5), math.floor(y + 0.5)
    total = np.zeros(image.shape[2])
    for i, share in ((math.floor(x), 1 - x % 1), (math.floor(x) + 1, x % 1)):
        for j, other in ((math.floor(y), 1 - y % 1), (math.floor(y) + 1, y % 1)):
            row = height - 1 - texel(j, height, wrap[1])
            total += share * other * image[row, texel(i, width, wrap[0])]
    return total


def halves(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Random numbers that half precision holds."""
    return np.random.default_rng(seed).random(shape).astype(np.float16).astype(np.float64)


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("wrap_v", WRAPS)
@pytest.mark.parametrize("wrap_u", WRAPS)
@given(u=st.floats(-3, 3), v=st.floats(-3, 3), height=st.integers(1, 5), width=st.integers(1, 5))
def test_a_texture_is_its_image_interpolated(wrap_u, wrap_v, nearest, u, v, height, width):
    image = halves((height, width, 3))
    texture = Texture.of(image, (wrap_u, wrap_v), nearest)
    near = [abs(c * n - round(c * n)) < 1e-9 for c, n in ((u, width), (v, height))]
    if nearest and any(near):
        # On the border of two texels rounding decides.
        return
    expected = looked_up(image, u, v, (wrap_u, wrap_v), nearest)
    np.testing.assert_allclose(texture.at(np.array([[u, v]]))[0, :3], expected, atol=1e-12)


def test_centres_of_texels_have_their_colours_and_the_first_row_is_above():
    image = halves((2, 3, 4))
    u, v = np.meshgrid((np.arange(3) + 0.5) / 3, [0.75, 0.25])
    found = Texture.of(image).at(np.stack([u, v], -1).reshape(-1, 2))
    np.testing.assert_allclose(found.reshape(2, 3, 4), image, atol=1e-12)


@pytest.mark.parametrize(
    "image, options, said",
    [
        (np.zeros((2, 2, 2)), {}, "with 3 or 4 channels behind, got float64 (2, 2, 2)"),
        (np.zeros((0, 2)), {}, "no pixels"),
        ([["a"]], {}, "numbers"),
        (np.full((1, 1), np.nan), {}, "not finite"),
        (np.full((1, 1), 1e6), {}, "beyond 65504"),
        (np.zeros((1, 1)), {"wrap": "tile"}, "repeat, mirror, clamp"),
        (np.zeros((1, 1)), {"wrap": ("repeat",)}, "or two of them"),
    ],
)  # fmt: skip
def test_what_is_no_image_is_refused(image, options, said):
    with pytest.raises(ValueError) as caught:
        Texture.of(image, **options)
    assert said in str(caught.value)


def test_placed_coordinates_mean_the_same_near_zero():
    texture = Texture.of(halves((3, 5)), ("repeat", "mirror"))
    maps = Maps(texture, placement=(2.0, 0.5, 4001.25, -1.0, 3.0, -2000.5))
    uv = np.random.default_rng(1).random((50, 2))
    moved = uv @ np.array([[2.0, 0.5], [-1.0, 3.0]]).T + [4001.25, -2000.5]
    placed = maps.placed(uv)
    assert np.abs(placed).max() < 6
    np.testing.assert_allclose(texture.at(placed), texture.at(moved), atol=1e-9)
    clamped = Maps(replace(texture, wrap=("clamp", "mirror")), placement=(1.0, 0.0, 7.0, 0.0, 1.0, 7.0))
    # Where an image does not go on, nothing is moved.
    assert (clamped.placed(uv)[:, 0] == uv[:, 0] + 7).all()
    assert np.abs(clamped.placed(uv)[:, 1]).max() < 2
    assert np.isfinite(maps.placed(np.array([[np.nan, np.inf], [1e300, -np.inf]]))).all()


# ------------------------------------------------------------------------------------- on the device

KERNEL = """
kernel void bare_texture(const uint count, const int texture, global const uint *textures,
                         global const half *texels, global const float *uv, global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const whole own = (whole)texture + TO_WHOLE(LANE_NUMBER & (bits)0u);
  const triple found = texture_at(textures, texels, own, LOAD(uv + first), LOAD(uv + count + first));
  STORE(found.x, result + first);
  STORE(found.y, result + count + first);
  STORE(found.z, result + 2 * count + first);
}
"""


@functools.cache
def texture_kernel(device):
    defines = {**surface_defines(), **texture_defines(), "HAS_SPECULAR": 0}
    return bare_kernel(
        device, ("common", "surface", "bsdf", "textures"), defines, KERNEL, "bare_texture"
    )


def on_device(device, scene, index, uv):
    """Colours (n, 3) of the device for coordinates (n, 2), n a multiple of 16."""
    textures = Textures.of(device, scene)
    result = HostArray(device, (3, len(uv)), np.float32)
    texture_kernel(device)(
        len(uv) // device.vector_width,
        count=len(uv),
        texture=index,
        textures=textures.records,
        texels=textures.texels,
        uv=HostArray.of(device, np.ascontiguousarray(uv.T, np.float32)),
        result=result,
    )
    return result.read().T


def scene_of(*materials):
    """A scene that has these materials."""
    camera = ncv.Camera((0, 0, 4), (0, 0, 0), 40)
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
    meshes = [
        ncv.TriangleMesh(square, [[0, 1, 2]], f"m{i}", uv=np.zeros((3, 2)))
        for i in range(len(materials))
    ]
    return ncv.build_scene(camera, {f"m{i}": one for i, one in enumerate(materials)}, meshes)


def test_the_device_looks_up_what_the_host_does(device):
    generator = np.random.default_rng(2)
    textures = [
        Texture.of(halves((*generator.integers(1, 9, 2), 3), seed), wrap, nearest)
        for seed, (wrap, nearest) in enumerate(
            ((u, v), nearest) for u in WRAPS for v in WRAPS for nearest in (False, True)
        )
    ]
    scene = scene_of(*(ncv.Material(one) for one in textures))
    assert [t.wrap for t in all_textures(scene)] == [t.wrap for t in textures]
    # An odd number of parts: no coordinate is between two texels of the nearest kind.
    uv = generator.integers(-3 * 4097, 3 * 4097, (4096, 2)) / 4097
    edges = [0, 1, -1, 2, 1 - 2**-24, -(2**-30), 2**-30, 1 + 2**-23, 1e5, -1e5, -(2**-24), 2 - 2**-23]
    for index, texture in enumerate(textures):
        found = on_device(device, scene, index, uv)
        np.testing.assert_allclose(found, texture.at(uv.astype(np.float32))[:, :3], atol=1e-4)
        assert np.abs(found - texture.at(uv.astype(np.float32))[:, :3]).mean() < 1e-6
        corners = np.array(np.meshgrid([*edges, *[0.3] * 4], [*edges, *[0.7] * 4])).reshape(2, -1).T
        if not texture.nearest:
            expected = texture.at(corners.astype(np.float32))[:, :3]
            np.testing.assert_allclose(on_device(device, scene, index, corners), expected, atol=1e-4)
        else:
            assert np.isfinite(on_device(device, scene, index, corners)).all()


def test_where_there_is_no_texture_the_factor_is_one(device):
    scene = scene_of(ncv.Material(Texture.of(halves((4, 4)))), ncv.Material(0.5))
    assert texture_index(scene, "colour").tolist() == [0, -1]
    assert (on_device(device, scene, -1, np.zeros((16, 2))) == 1).all()


def test_images_that_textures_share_are_kept_once(one_device):
    texture = Texture.of(halves((4, 5)))
    other = replace(texture, nearest=True)
    textures = Textures.of(one_device, scene_of(*(ncv.Material(t) for t in (texture, other, texture))))
    assert textures.records.shape[0] == 2 and textures.texels.shape == (20, 4)


# ---------------------------------------------------------------------------------------- image files


def test_every_value_of_eight_bits_is_decoded_by_the_curve(tmp_path):
    values = np.arange(256, dtype=np.uint8).reshape(16, 16)
    write_image(tmp_path / "t.png", np.repeat(values[:, :, None], 3, 2))
    for encoding in ("auto", "srgb", "linear"):
        texels = ImageFiles().texels(tmp_path / "t.png", encoding)
        exact = [v / 255 if encoding == "linear" else decoded(v / 255) for v in range(256)]
        expected = np.array(exact).reshape(16, 16)[::-1].astype(np.float16)
        assert (texels[:, :, :3] == expected[:, :, None]).all() and (texels[:, :, 3] == 1).all()


@pytest.mark.parametrize(
    "name, kind, channels",
    [("t.png", "uint8", 1), ("t.png", "uint8", 2), ("t.png", "uint16", 3), ("t.png", "uint8", 4),
     ("t.exr", "half", 3), ("t.exr", "float", 4), ("t.tif", "uint16", 4), ("t.hdr", "float", 3)],
)  # fmt: skip
def test_formats_are_read(tmp_path, name, kind, channels):
    pixels = halves((3, 4, channels)).astype(np.float32)
    pixels[:, :, -1] = np.maximum(pixels[:, :, -1], 0.25)
    write_image(tmp_path / name, pixels, kind)
    texels = ImageFiles().texels(tmp_path / name)[::-1].astype(np.float64)
    colours = pixels[:, :, [0, 0, 0] if channels < 3 else [0, 1, 2]].astype(np.float64)
    is_float = kind in ("half", "float")
    steps = {"uint8": 255, "uint16": 65535}.get(kind)
    expected = colours if is_float else np.vectorize(decoded)(np.round(colours * steps) / steps)
    # Radiance files have eight bits of the largest channel.
    loose = 0.01 if name == "t.hdr" else 2e-3
    np.testing.assert_allclose(texels[:, :, :3], expected, atol=loose if name == "t.hdr" else 6e-4)
    alpha = pixels[:, :, -1] if channels in (2, 4) else np.ones((3, 4))
    np.testing.assert_allclose(texels[:, :, 3], alpha, atol=loose)


def test_an_image_is_decoded_once(tmp_path, monkeypatch):
    write_image(tmp_path / "t.png", halves((2, 2, 3)).astype(np.float32))
    images = ImageFiles()
    first = images.texture(tmp_path / "t.png")
    monkeypatch.setattr(image_file, "_decode", None)
    assert images.texture(tmp_path / "." / "t.png", nearest=True).texels is first.texels


# ---------------------------------------------------------------------------------------- in a scene


def load(folder: Path, text: str) -> ncv.Scene:
    (folder / "x.toml").write_text(text)
    return ncv.load_scene(folder / "x.toml")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with t.png, eight by eight random pixels."""
    pixels = np.random.default_rng(5).integers(0, 256, (8, 8, 3)).astype(np.uint8)
    np.save(tmp_path / "pixels.npy", np.vectorize(decoded)(pixels / 255).astype(np.float16))
    write_image(tmp_path / "t.png", pixels)
    return tmp_path


def test_a_picture_of_a_square_is_its_texture(folder, device):
    """The camera's pixels are the image's: whatever the light is, the albedo is the texel's."""
    image = ncv.render(load(folder, SCENE % ""), "ao", "mc", spp=1, size=(8, 8), device=device)
    np.testing.assert_allclose(image.layers["albedo"], np.load(folder / "pixels.npy"), atol=2e-5)


def test_a_textured_square_under_a_light_has_a_closed_form(folder, device):
    """Radiance is the texture's colour times Lambert's irradiance of a polygon over pi."""
    scene = load(folder, SCENE % "" + LIGHT)
    options = {"method": "mc", "sampler": "independent", "visibility": "points", "device": device}
    image = ncv.render(scene, "direct", spp=512, size=(16, 16), **options)
    at = (np.arange(16) + 0.5) / 8 - 1
    light = scene.lights[0]
    irradiance = np.array(
        [
            [
                polygon_irradiance(light_corners(light), np.array([x, y, 0]), np.array([0, 0, 1]))
                for x in at
            ]
            for y in at[::-1]
        ]
    )
    u, v = np.meshgrid((at + 1) / 2, (at[::-1] + 1) / 2)
    texels = np.load(folder / "pixels.npy").astype(float)
    colours = np.array(
        [
            looked_up(texels, a, b, ("repeat", "repeat"), False)
            for a, b in zip(u.flat, v.flat, strict=True)
        ]
    )
    expected = colours.reshape(16, 16, 3) * irradiance[..., None] / np.pi * np.array([3, 2, 1])
    z = (image.pixels - expected) / np.sqrt(image.variance)
    # Channels err together.
    assert np.mean(z**2) < 1 + 5 * np.sqrt(2 / 256) and np.abs(z).max() < 5


@pytest.mark.parametrize(
    "keys, uv",
    [
        (", scale = 2", lambda u, v: (2 * u, 2 * v)),
        (", scale = [3, -1], offset = [0.25, 0.5]", lambda u, v: (3 * u + 0.25, 0.5 - v)),
        (', wrap = "mirror", scale = 3', lambda u, v: (3 * u, 3 * v)),
        (
            ', wrap = ["clamp", "repeat"], scale = 2, offset = 0.01, filter = "nearest"',
            lambda u, v: (2 * u + 0.01, 2 * v + 0.01),
        ),
    ],
)  # fmt: skip
def test_keys_of_a_texture(folder, one_device, keys, uv):
    scene = load(folder, SCENE % keys)
    image = ncv.render(scene, "ao", "mc", spp=1, size=(11, 11), device=one_device)
    at = (np.arange(11) + 0.5) / 11
    texture = scene.materials[0].maps.colour
    texels = np.load(folder / "pixels.npy").astype(float)
    for row, v in enumerate(at[::-1]):
        for column, u in enumerate(at):
            expected = looked_up(texels, *uv(u, v), texture.wrap, texture.nearest)
            np.testing.assert_allclose(image.layers["albedo"][row, column], expected, atol=1e-4)


def test_a_factor_and_an_encoding(folder, one_device):
    text = SCENE % ', factor = [0.5, 1, 0], encoding = "linear", scale = 1'
    image = ncv.render(load(folder, text), "ao", "mc", spp=1, size=(8, 8), device=one_device)
    encoded = np.vectorize(lambda x: 12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055)
    expected = encoded(np.load(folder / "pixels.npy").astype(float)) * [0.5, 1, 0]
    np.testing.assert_allclose(image.layers["albedo"], expected, atol=2e-3)


def test_roughness_may_be_an_image(folder, one_device):
    text = SCENE.replace(
        'albedo = { file = "t.png"%s }',
        'albedo = 0.2\nreflectance = 0.5\nroughness = { file = "t.png", factor = 0.5 }',
    )
    scene = load(folder, text + LIGHT)
    texture = scene.materials[0].maps.surface
    assert scene.materials[0].roughness == 0.5 and scene.materials[0].maps.colour is None
    # The image is not encoded as colours are.
    stored = ImageFiles().texels(folder / "t.png", "linear")
    assert (texture.texels == stored).all()


def test_emission_may_be_an_image_of_any_brightness(folder, one_device):
    write_image(folder / "hot.exr", np.full((2, 2, 3), 3.0, np.float32), "half")
    glow = 'albedo = 0\nemission = { file = "hot.exr", factor = [2, 1, 0] }'
    scene = load(folder, SCENE.replace('albedo = { file = "t.png"%s }', glow))
    image = ncv.render(scene, "gi", "mc", spp=1, size=(4, 4), device=one_device)
    np.testing.assert_allclose(image.pixels, np.broadcast_to([6, 3, 0], (4, 4, 3)))


def test_boxes_and_spheres_have_coordinates(folder, one_device):
    """Each side of a box shows the image upright as seen from outside; a sphere's seam is not seen."""
    box = (
        SCENE[: SCENE.index("[[quads]]")] % ""
        + '[[boxes]]\nmin = [-1, -1, -2]\nmax = [1, 1, 0]\nmaterial = "paper"\n'
    )
    for position, up in (
        ("[0, 0, 4]", "[0, 1, 0]"), ("[0, 0, -6]", "[0, 1, 0]"), ("[5, 0, -1]", "[0, 1, 0]"),
        ("[-5, 0, -1]", "[0, 1, 0]"), ("[0, 5, -1]", "[0, 0, -1]"), ("[0, -5, -1]", "[0, 0, 1]"),
    ):  # fmt: skip
        view = box.replace("position = [0, 0, 4]", f"position = {position}\nup = {up}")
        view = view.replace("target = [0, 0, 0]", "target = [0, 0, -1]")
        image = ncv.render(load(folder, view), "ao", "mc", spp=1, size=(8, 8), device=one_device)
        np.testing.assert_allclose(image.layers["albedo"], np.load(folder / "pixels.npy"), atol=1e-4)
    ball = box.replace("boxes", "spheres").replace(
        "min = [-1, -1, -2]\nmax = [1, 1, 0]", "center = [0, 0, 0]\nradius = 1"
    )
    scene = load(folder, ball)
    points = scene.vertices[scene.triangles].mean(axis=1)
    u, v = scene.vertex_uv[scene.triangles].mean(axis=1).T
    longitude = np.arctan2(points[:, 0], points[:, 2]) / (2 * np.pi) + 0.5
    assert np.abs((u - longitude + 0.5) % 1 - 0.5).max() < 0.1
    assert (
        np.abs(v - np.arcsin(points[:, 1] / np.linalg.norm(points, axis=1)) / np.pi - 0.5).max() < 0.02
    )
    # No triangle goes the wrong way around.
    assert np.ptp(scene.vertex_uv[scene.triangles][..., 0], axis=1).max() < 0.4


def test_a_texture_in_python_is_that_of_a_file(folder):
    image = np.load(folder / "pixels.npy")
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    mesh = ncv.TriangleMesh(square, [[0, 1, 2], [0, 2, 3]], "paper", uv=[[0, 0], [1, 0], [1, 1], [0, 1]])
    camera = ncv.Camera((0, 0, 4), (0, 0, 0), 28.072487)
    built = ncv.build_scene(camera, {"paper": ncv.Material(ncv.Texture.of(image))}, [mesh])
    loaded = load(folder, SCENE % "")
    assert built.digest == loaded.digest
    again = ncv.build_scene(camera, {"paper": loaded.materials[0]}, [mesh])
    assert again.digest == loaded.digest
    for other in (image * 0.5, image[:, ::-1]):
        changed = ncv.build_scene(camera, {"paper": ncv.Material(ncv.Texture.of(other))}, [mesh])
        assert changed.digest != loaded.digest
    clamped = ncv.Material(ncv.Texture.of(image, "clamp"))
    assert ncv.build_scene(camera, {"paper": clamped}, [mesh]).digest != loaded.digest


def test_coordinates_survive_where_triangles_are_cut(folder, one_device):
    """A plane to the horizon is cut into many triangles, whose image stays where it was."""
    plain = (
        SCENE
        % ", scale = 1000"
        + "[[quads]]\ncorner = [-1e3, -1, 1e3]\nedge1 = [2e3, 0, 0]\nedge2 = [0, 0, -2e3]\n"
        'material = "paper"\n'
    )
    plain = plain.replace("corner = [-1, -1, 0]\nedge1 = [2", "corner = [-1, -1, 9]\nedge1 = [2")
    scene = load(folder, plain)
    assert len(scene.triangles) > 50
    image = ncv.render(scene, "ao", "mc", spp=1, size=(16, 16), device=one_device)
    texels = np.load(folder / "pixels.npy").astype(float)
    tangent = np.tan(np.radians(28.072487 / 2))
    for row in (15, 13):
        for column in range(16):
            x, y = ((column + 0.5) / 8 - 1) * tangent, (1 - (row + 0.5) / 8) * tangent
            distance = -1 / y
            u, v = (distance * x + 1e3) / 2, (1e3 - (4 - distance)) / 2
            expected = looked_up(texels, u, v, ("repeat", "repeat"), False)
            np.testing.assert_allclose(image.layers["albedo"][row, column], expected, atol=0.02)


# -------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    "keys, place, said",
    [
        (', scale = "x"', "materials.paper.albedo.scale[0]", "expected a number"),
        (", scale = [1, 2, 3]", "materials.paper.albedo.scale", "a number or 2 numbers"),
        (", scale = 0", "materials.paper.albedo.scale", "is zero"),
        (', wrap = "tile"', "materials.paper.albedo.wrap", "repeat, mirror, clamp"),
        (', wrap = ["clamp"]', "materials.paper.albedo.wrap", "or two of them"),
        (', filter = "cubic"', "materials.paper.albedo.filter", "one of linear, nearest"),
        (', encoding = "log"', "materials.paper.albedo.encoding", "one of auto, srgb, linear"),
        (", factor = 2", "materials.paper.albedo", "from 0 to 1"),
        (", scales = 2", "materials.paper.albedo.scales", "did you mean 'scale'"),
    ],
)
def test_wrong_keys_are_named(folder, keys, place, said):
    with pytest.raises(ncv.SceneError) as caught:
        load(folder, SCENE % keys)
    assert str(caught.value).startswith(f"{folder / 'x.toml'}: {place}: ") and said in str(caught.value)


def test_wrong_images_are_named(folder, monkeypatch):
    place = "x.toml: materials.paper.albedo"
    for name, said in (
        ("none.png", f"{place}.file: the image none.png does not exist"),
        ("pixels.npy", f"{place}.file: pixels.npy cannot be read as an image"),
        ("hdr.exr", rf"{place}: the image holds values outside \[0, 1\]"),
        (".", f"{place}.file: the image .* does not exist"),
    ):
        write_image(folder / "hdr.exr", np.full((2, 2, 3), 1.5, np.float32), "half")
        with pytest.raises(ncv.SceneError, match=said):
            load(folder, (SCENE % "").replace("t.png", name))
    monkeypatch.setattr(image_file, "LARGEST_SIDE", 4)
    with pytest.raises(ncv.SceneError, match=r"t\.png: an image of 8 × 8 pixels is too large"):
        load(folder, SCENE % "")
    monkeypatch.setattr(image_file, "LARGEST_SIDE", 8)
    monkeypatch.setattr(image_file, "MOST_TEXELS", 60)
    with pytest.raises(ncv.SceneError, match="more than 60 pixels in all"):
        load(folder, SCENE % "")


def test_surfaces_without_coordinates_are_named(folder):
    head = SCENE[: SCENE.index("[[quads]]")] % ""
    polygon = '[[polygons]]\nvertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]\nmaterial = "paper"\n'
    (folder / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    mesh = '[[meshes]]\nfile = "m.obj"\nmaterial = "paper"\n'
    for text, place in ((polygon, "polygons[0].vertices"), (mesh, "meshes[0].file: m.obj")):
        with pytest.raises(ncv.SceneError) as caught:
            load(folder, head + text)
        assert f"{place}: has no texture coordinates" in str(caught.value) and "paper" in str(
            caught.value
        )


def test_two_textures_lie_alike(folder):
    rough = ' }\nroughness = { file = "t.png", scale = 2'
    with pytest.raises(ncv.SceneError, match=r"materials\.paper\.roughness: its scale .* of albedo's"):
        load(folder, SCENE % rough)
    assert load(folder, SCENE % (", scale = 2" + rough)).materials[0].maps.placement[0] == 2


@pytest.mark.parametrize(
    "arguments, place, said",
    [
        ({"uv": np.zeros((3, 2))}, "meshes[0].uv", "as many as vertices, 4, are 3"),
        ({"uv": np.zeros((4, 3))}, "meshes[0].uv", "numbers (n, 2), got float64 (4, 3)"),
        ({"colours": np.full((4, 3), 1.5)}, "meshes[0].colours", "outside [0, 1]"),
        ({"colours": np.full((4, 3), np.nan)}, "meshes[0].colours[0][0]", "not a finite"),
    ],
)
def test_wrong_arrays_are_named(arguments, place, said):
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    mesh = ncv.TriangleMesh(square, [[0, 1, 2], [0, 2, 3]], "m", **arguments)
    with pytest.raises(ncv.SceneError) as caught:
        ncv.build_scene(ncv.Camera((0, 0, 4), (0, 0, 0), 40), {"m": ncv.Material(0.5)}, [mesh])
    assert str(caught.value).startswith(f"build_scene: {place}: ") and said in str(caught.value)


# ------------------------------------------------------------------------------------ the shipped room


def test_the_shipped_images_are_what_the_script_draws(scenes, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["draw.py", str(tmp_path)])
    runpy.run_path(str(scenes / "images" / "draw.py"), run_name="__main__")
    drawn = sorted(path.name for path in tmp_path.glob("*.png"))
    assert drawn == sorted(path.name for path in (scenes / "images").glob("*.png"))
    for name in drawn:
        one, other = (ImageFiles().texels(folder / name) for folder in (tmp_path, scenes / "images"))
        # A rounding of the machine's own sine may change a texel by a step.
        assert np.abs(one.astype(float) - other).max() < 0.02


def test_the_shipped_room_loads_and_renders(scenes, one_device):
    scene = ncv.load_scene(scenes / "textured_room.toml")
    assert scene.warnings == () and len(scene.lights) == 2 and len(all_textures(scene)) == 10
    assert scene.vertex_colours is not None
    image = ncv.render(scene, ncv.GlobalIllumination(3), "mc", spp=4, size=(32, 24), device=one_device)
    assert 0.05 < image.pixels.mean() < 1 and image.layers["depth"].min() > 0
