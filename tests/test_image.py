"""Image files are exact and whole, and error metrics are what they say."""

import resource

import numpy as np
import OpenImageIO as oiio
import pytest

from ncv_cl.output.image import Image, check_output_path, error_metrics, read_reference

HEIGHT, WIDTH = 5, 7
METADATA = {
    "seed": 2**40 + 1,
    "samples": 64,
    "scene": "cornell_böx.toml",
    "radius": 0.1,
    "far": float("inf"),
    "note": "",
}


def random_array(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def full_image():
    rgb = (HEIGHT, WIDTH, 3)
    layers = {
        "albedo": np.abs(random_array(*rgb, seed=1)) % 1,
        "N": random_array(*rgb, seed=2),
        "depth": random_array(HEIGHT, WIDTH, seed=3) ** 2,
        "G": random_array(*rgb, seed=4),
        "residual": random_array(*rgb, seed=5),
    }
    layers["depth"][0, 0] = np.inf
    pixels = random_array(*rgb)
    pixels[0, 0] = 1e-42, -0.0, 3e38
    return Image(pixels, random_array(*rgb, seed=6) ** 2, layers, {}, dict(METADATA))


def write_floats(path, pixels, channels):
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], len(channels), oiio.FLOAT)
    spec.channelnames = channels
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(pixels) and output.close()


def same_bits(a, b):
    return a.dtype == b.dtype == np.float32 and a.tobytes() == b.tobytes() and a.shape == b.shape


def test_exr_returns_every_layer_and_metadata_bit_for_bit(tmp_path):
    image = full_image()
    image.write(tmp_path / "x.exr")
    back = Image.read(tmp_path / "x.exr")
    assert same_bits(back.pixels, image.pixels)
    assert same_bits(back.variance, image.variance)
    assert back.layers.keys() == image.layers.keys()
    for name, values in image.layers.items():
        assert same_bits(back.layers[name], values), name
    assert back.metadata == METADATA
    assert [type(value) for value in back.metadata.values()] == [int, int, str, float, float, str]


def test_exr_has_the_channel_names_and_attributes_that_other_tools_expect(tmp_path):
    full_image().write(tmp_path / "x.exr")
    spec = oiio.ImageInput.open(str(tmp_path / "x.exr")).spec()
    prefixed = [f"{p}.{c}" for p in ("variance", "albedo", "G", "residual") for c in "RGB"]
    assert set(spec.channelnames) == {*"RGB", *prefixed, "N.X", "N.Y", "N.Z", "depth.Z"}
    assert spec.getattribute("ncv_cl:samples") == 64
    assert spec.getattribute("ncv_cl:seed") == str(2**40 + 1)
    assert spec.getattribute("ncv_cl:scene") == "cornell_böx.toml"
    assert spec.getattribute("ncv_cl:radius") == pytest.approx(0.1)


def test_exr_albedo_is_clamped_to_what_denoisers_accept(tmp_path):
    image = full_image()
    image.layers = {"albedo": np.full((HEIGHT, WIDTH, 3), [-0.5, 0.25, 1.5], np.float32)}
    image.write(tmp_path / "x.exr")
    assert np.all(Image.read(tmp_path / "x.exr").layers["albedo"] == np.float32([0, 0.25, 1]))


def test_png_is_clamped_srgb_whatever_color_configuration_the_user_has(tmp_path, monkeypatch):
    monkeypatch.setenv("OCIO", str(tmp_path / "absent.ocio"))
    # IEC 61966-2-1: 255 (12.92 x) up to 0.0031308, then 255 (1.055 x^(1/2.4) - 0.055).
    expected = {
        -1.0: 0, 0.0: 0, 0.001: 3, 0.0031308: 10, 0.01: 25, 0.18: 118, 0.5: 188, 1.0: 255,
        2.0: 255, np.inf: 255, np.nan: 0,
    }  # fmt: skip
    pixels = np.repeat(np.float32(list(expected))[None, :, None], 3, axis=2)
    pixels[0, 1] = 0.5, 0.0, 1.0
    Image(pixels, np.zeros_like(pixels)).write(tmp_path / "x.png")
    written = oiio.ImageInput.open(str(tmp_path / "x.png")).read_image("uint8")
    assert written.dtype == np.uint8
    assert written[0, 1].tolist() == [188, 0, 255]
    assert np.delete(written[0, :, 0], 1).tolist() == np.delete(list(expected.values()), 1).tolist()


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("x.jpg", ValueError, r"x\.jpg.*\.exr or \.png"),
        ("x", ValueError, r"\.exr or \.png"),
        ("absent/x.exr", FileNotFoundError, "no folder .*absent"),
        ("file/x.exr", NotADirectoryError, "file is not a folder"),
        ("folder.exr", IsADirectoryError, r"folder\.exr: it is a folder"),
    ],
)
def test_bad_output_paths_are_refused_before_anything_is_written(tmp_path, name, error, message):
    (tmp_path / "file").touch()
    (tmp_path / "folder.exr").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(error, match=message):
        check_output_path(tmp_path / name)
    with pytest.raises(error, match=message):
        full_image().write(tmp_path / name)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("size", [2, 128])  # within the C library's buffer, and past it
@pytest.mark.parametrize("suffix", ["exr", "png"])
def test_a_write_that_fails_half_way_leaves_the_old_file(tmp_path, suffix, size):
    path = tmp_path / f"x.{suffix}"
    full_image().write(path)
    old = path.read_bytes()
    noise = np.abs(random_array(size, size, 3))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size**2, limits[1]))  # as a full disk does
    try:
        with pytest.raises(OSError, match=f"cannot write .*{path.name}"):
            Image(noise, noise).write(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]


def test_writing_replaces_an_older_image(tmp_path):
    image = full_image()
    image.write(tmp_path / "x.exr")
    image.pixels += 1
    image.write(tmp_path / "x.exr")
    assert same_bits(Image.read(tmp_path / "x.exr").pixels, image.pixels)


@pytest.mark.parametrize(
    ("layers", "metadata", "message"),
    [
        ({"depht": np.zeros((HEIGHT, WIDTH))}, {}, "unknown layer 'depht'.*depth"),
        ({"depth": np.zeros((HEIGHT, WIDTH, 3))}, {}, r"'depth' must be \(5, 7\), not \(5, 7, 3\)"),
        ({"N": np.zeros((WIDTH, HEIGHT, 3))}, {}, r"'N' must be \(5, 7, 3\), not \(7, 5, 3\)"),
        ({}, {"seed": [1]}, "metadata 'seed' must be"),
    ],
)
def test_bad_layers_and_metadata_are_named(tmp_path, layers, metadata, message):
    zeros = np.zeros((HEIGHT, WIDTH, 3))
    with pytest.raises(ValueError, match=message):
        Image(zeros, zeros, layers, {}, metadata).write(tmp_path / "x.exr")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), (HEIGHT, WIDTH, 4), (0, WIDTH, 3)])
def test_pixels_must_be_rgb(shape):
    with pytest.raises(ValueError, match="pixels must be"):
        Image(np.zeros(shape), np.zeros(shape))


def test_variance_must_have_the_shape_of_the_pixels():
    with pytest.raises(ValueError, match=r"\(1, 1, 3\).*\(2, 2, 3\)"):
        Image(np.zeros((2, 2, 3)), np.zeros((1, 1, 3)))


def test_reading_an_image_of_another_program_names_what_it_lacks(tmp_path):
    write_floats(tmp_path / "x.exr", np.ones((2, 2, 3), np.float32), ("R", "G", "B"))
    with pytest.raises(ValueError, match=r"not written by ncv_cl.*variance\.R"):
        Image.read(tmp_path / "x.exr")


def test_reading_an_image_cut_short_says_so(tmp_path):
    path = tmp_path / "x.exr"
    full_image().write(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"x\.exr"):
        Image.read(path)


@pytest.mark.parametrize("suffix", ["exr", "tif"])
def test_float_references_are_read_exactly(tmp_path, suffix):
    pixels = random_array(HEIGHT, WIDTH, 3)
    write_floats(tmp_path / f"r.{suffix}", pixels, ("R", "G", "B"))
    assert same_bits(read_reference(tmp_path / f"r.{suffix}", (HEIGHT, WIDTH)), pixels)


@pytest.mark.parametrize(("scale", "order"), [("-1.0", "<f4"), ("1.0", ">f4")])
def test_pfm_references_are_stored_from_bottom_to_top(tmp_path, scale, order):
    pixels = random_array(HEIGHT, WIDTH, 3)
    header = f"PF\n{WIDTH} {HEIGHT}\n{scale}\n".encode()
    (tmp_path / "r.pfm").write_bytes(header + pixels[::-1].astype(order).tobytes())
    assert same_bits(read_reference(tmp_path / "r.pfm", (HEIGHT, WIDTH)), pixels)


def test_a_reference_may_be_radiance_hdr_or_grey_or_ours(tmp_path):
    pixels = np.float32([[[0.5, 0.25, 1.0]] * 9])  # exact in shared-exponent RGBE
    write_floats(tmp_path / "r.hdr", pixels, ("R", "G", "B"))
    assert same_bits(read_reference(tmp_path / "r.hdr", (1, 9)), pixels)
    grey = random_array(HEIGHT, WIDTH, 1)
    write_floats(tmp_path / "grey.exr", grey, ("Y",))
    expected = np.repeat(grey, 3, axis=2)
    assert same_bits(read_reference(tmp_path / "grey.exr", (HEIGHT, WIDTH)), expected)
    full_image().write(tmp_path / "ours.exr")
    assert same_bits(read_reference(tmp_path / "ours.exr", (HEIGHT, WIDTH)), full_image().pixels)


def test_bad_references_are_refused_with_a_reason(tmp_path):
    def refused(name, error, message):
        with pytest.raises(error, match=message):
            read_reference(tmp_path / name, (2, 3))

    def write(name, pixels, channels=("R", "G", "B")):
        write_floats(tmp_path / name, pixels.astype(np.float32), channels)

    refused("absent.exr", FileNotFoundError, r"no image file .*absent\.exr")
    (tmp_path / "text.exr").write_text("not an image")
    refused("text.exr", ValueError, r"text\.exr is not an image")
    ones = np.ones((2, 3, 3))
    write("size.exr", np.ones((3, 2, 3)))
    refused("size.exr", ValueError, "is 2x3 pixels, but the image is 3x2")
    Image(ones, ones).write(tmp_path / "tone.png")
    refused("tone.png", ValueError, "tone-mapped")
    write("uv.exr", np.ones((2, 3, 2)), ("U", "V"))
    refused("uv.exr", ValueError, "no channels R, G, B; it has U, V")
    write("nan.exr", np.where(np.arange(18).reshape(2, 3, 3) == 10, np.nan, 1))
    refused("nan.exr", ValueError, r"1 of 18 values are NaN.*\(1, 0, 1\)")
    write("black.exr", ones * 0)
    refused("black.exr", ValueError, "black everywhere")


def test_metrics_on_numbers_computed_by_hand():
    reference = np.array([[[1.0, 2.0, 3.0]]])  # mean 2, so the offset is 0.01 * 4 = 0.04
    pixels = np.array([[[1.5, 2.0, 2.0]]])  # squared errors 1/4, 0, 1
    metrics = error_metrics(pixels, reference)
    assert metrics["mse"] == pytest.approx(1.25 / 3)
    assert metrics["relmse"] == pytest.approx((0.25 / 1.04 + 1 / 9.04) / 3)
    scaled = error_metrics(10 * pixels, 10 * reference)
    assert scaled["relmse"] == pytest.approx(metrics["relmse"])
    assert error_metrics(reference, reference) == {"mse": 0.0, "relmse": 0.0}


def test_metrics_refuse_what_has_no_answer():
    ones, bad = np.ones((2, 2, 3)), np.ones((2, 2, 3))
    bad[1, 0, 2], bad[1, 1, 0] = np.nan, np.inf
    with pytest.raises(ValueError, match=r"image \(2, 2, 3\) and reference \(2, 3, 3\)"):
        error_metrics(ones, np.ones((2, 3, 3)))
    with pytest.raises(ValueError, match=r"image: 2 of 12 values are NaN.*\(1, 0, 2\)"):
        error_metrics(bad, ones)
    with pytest.raises(ValueError, match="reference: 2 of 12"):
        error_metrics(ones, bad)
    with pytest.raises(ValueError, match="reference is black"):
        error_metrics(ones, 0 * ones)
