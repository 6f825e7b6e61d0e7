"""Images in scenes: where they lie on surfaces, and what scene files and arrays say of them."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from mesh_files import write_image
from reference import light_corners, polygon_irradiance
from texture_reference import decoded, looked_up

import ncv_cl as ncv
from ncv_cl.points.textures import all_textures
from ncv_cl.scene.textures import image_file
from ncv_cl.scene.textures.image_file import ImageFiles

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
