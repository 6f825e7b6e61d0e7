"""Images on surfaces: look-ups on host and device against loops in plain Python, and decoding."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mesh_files import write_image
from reference import bare_kernel
from texture_reference import decoded, halves, looked_up

import ncv_cl as ncv
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import surface_defines
from ncv_cl.points.textures import Textures, all_textures, texture_defines, texture_index
from ncv_cl.scene.textures import image_file
from ncv_cl.scene.textures.image_file import ImageFiles
from ncv_cl.scene.textures.texture import WRAPS, Maps, Texture


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
