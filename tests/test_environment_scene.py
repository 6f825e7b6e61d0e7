"""The environment in scene files and in Python: what is read, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_files import write_image

import ncv_cl as ncv
from ncv_cl.scene.about import describe
from ncv_cl.scene.sky.environment import SUN_DIAMETER

BEGIN = """
[camera]
position = [0, 1, 3]
target = [0, 0, 0]
vertical_fov = 40
[materials.m]
albedo = 0.5
[[quads]]
corner = [-5, 0, -5]
edge1 = [0, 0, 10]
edge2 = [10, 0, 0]
material = "m"
"""


@pytest.fixture
def load(tmp_path):
    def load(text: str) -> ncv.Scene:
        (tmp_path / "scene.toml").write_text(BEGIN + text, encoding="utf-8")
        return ncv.load_scene(tmp_path / "scene.toml")

    return load


def test_a_constant_one_and_its_sun(load):
    scene = load(
        "[environment]\nradiance = [1, 2, 3]\n[environment.sun]\ndirection = [0, 2, 0]\nirradiance = 5\n"
    )
    found = scene.environment
    assert found.texels.shape == (1, 1, 3) and found.texels[0, 0].tolist() == [1, 2, 3]
    (sun,) = found.suns
    assert (sun.towards.tolist(), sun.irradiance.tolist()) == ([0, 1, 0], [5, 5, 5])
    assert sun.angular_diameter == SUN_DIAMETER
    assert load("").environment is None


def test_elevation_and_azimuth_are_those_of_the_image(load):
    sky = "[environment]\nradiance = 1\nrotation = {}\nup = {}\n[environment.sun]\nirradiance = 1\n{}"
    for azimuth, wanted in ((0, [0, 0, -1]), (90, [1, 0, 0]), (180, [0, 0, 1])):
        (sun,) = load(sky.format(0, [0, 1, 0], f"elevation = 0\nazimuth = {azimuth}")).environment.suns
        assert sun.towards == pytest.approx(wanted, abs=1e-12)
    (sun,) = load(sky.format(90, [0, 1, 0], "elevation = 0\nazimuth = 90")).environment.suns
    assert sun.towards == pytest.approx([0, 0, -1], abs=1e-12)
    (sun,) = load(sky.format(0, [0, 0, 1], "elevation = 90")).environment.suns
    assert sun.towards == pytest.approx([0, 0, 1], abs=1e-12)


def test_an_image_is_scaled_and_keeps_its_range(load, tmp_path):
    pixels = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    pixels[1, 2] = 1e6
    write_image(tmp_path / "sky.exr", pixels, "float")
    scene = load('[environment]\nfile = "sky.exr"\nscale = 2\nrotation = 10\n')
    np.testing.assert_array_equal(scene.environment.texels, 2 * pixels)
    assert scene.warnings == ()
    assert ncv.Environment.read(tmp_path / "sky.exr", 2).texels[1, 2, 0] == 2e6


def test_an_odd_shape_is_a_warning(load, tmp_path):
    write_image(tmp_path / "sky.exr", np.ones((3, 4, 3), np.float32), "float")
    with pytest.warns(UserWarning, match="4 × 3 pixels"):
        load('[environment]\nfile = "sky.exr"\n')


def test_directional_lights_are_suns(load):
    scene = load('[[lights]]\nkind = "directional"\ndirection = [0, -1, 0]\nirradiance = 2\nangle = 1\n')
    (sun,) = scene.environment.suns
    assert sun.towards.tolist() == [0, 1, 0] and sun.angular_diameter == 1
    assert not scene.environment.texels.any() and scene.lights == ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[environment]\n", "environment: give radiance"),
        ("[environment]\nradiance = -1\n", "radiance: -1 is out of range"),
        ("[environment]\nradiance = inf\n", "not a finite"),
        ('[environment]\nradiance = 1\nsky = "clear"\n', "cannot be combined"),
        ('[environment]\nfile = "missing.exr"\n', "missing.exr: cannot read the image: there is no"),
        ('[environment]\nfile = "bad.exr"\n', "row 1, column 2"),
        ('[environment]\nfile = "bad.exr"\nscale = -1\n', "scale: -1"),
        ('[environment]\nfile = "scene.toml"\n', "cannot read the image"),
        ("[environment]\nradiance = 1\nscale = 2\n", "scale: is for file"),
        ("[environment]\nradiance = 1\nzenith = 2\n", "zenith: is for sky"),
        ("[environment]\nradiance = 1\nrotation = 2\n", "rotation: turns an image"),
        ("[environment]\nradiance = 1\nup = [0, 0, 0]\n", "up: has no length"),
        ('[environment]\nsky = "blue"\n', "expected one of overcast, clear"),
        ('[environment]\nsky = "clear"\n', "environment.sun"),
        (
            '[environment]\nsky = "clear"\n[environment.sun]\nelevation = -3\nirradiance = 1\n',
            "below the horizon",
        ),
        ("[environment.sun]\nirradiance = 1\n", "environment.sun.elevation: is missing"),
        ("[environment.sun]\nirradiance = 1\ndirection = [0, 0, 0]\n", "has no length"),
        (
            "[environment.sun]\nirradiance = 1\ndirection = [0, 1, 0]\nazimuth = 3\n",
            "cannot be combined",
        ),
        (
            "[environment.sun]\nirradiance = 1\ndirection = [0, 1, 0]\nangular_diameter = 0\n",
            "angular_diameter: 0 is out of range",
        ),
        ("[environment]\nradiance = 1\ncolour = 2\n", "did you mean"),
        ('[[lights]]\nkind = "directional"\ndirection = [0, 1, 0]\n', "irradiance: is missing"),
        (17 * '[[lights]]\nkind = "directional"\ndirection = [0, 1, 0]\nirradiance = 1\n', "at most 16"),
    ],
)
def test_errors_say_what_and_where(load, tmp_path, text, message):
    pixels = np.ones((2, 4, 3), np.float32)
    pixels[1, 2, 0] = -2
    write_image(tmp_path / "bad.exr", pixels, "float")
    with pytest.raises(ncv.SceneError, match=message) as error:
        load(text)
    assert "scene.toml" in str(error.value)


def built(environment: object) -> ncv.Scene:
    camera = ncv.Camera((0, 1, 3), (0, 0, 0), 40.0)
    mesh = ncv.TriangleMesh(np.eye(3), np.array([[0, 1, 2]]), "m")
    return ncv.build_scene(camera, {"m": ncv.Material(0.5)}, [mesh], environment=environment)


def test_python_takes_what_files_have(load, tmp_path):
    assert built(ncv.Environment([1, 2, 3])).environment.texels.tolist() == [[[1, 2, 3]]]
    found = built(ncv.Environment(2.0, suns=(ncv.Sun([0, 1, 0], 1.0),))).environment
    assert found.texels.tolist() == [[[2, 2, 2]]] and found.suns[0].irradiance.tolist() == [1, 1, 1]
    pixels = np.ones((2, 4, 3))
    assert built(ncv.Environment(pixels)).environment.texels.dtype == np.float32
    for radiance, message in (
        (np.ones((2, 4)), "must be"),
        ([1, -2, 3], "negative"),
        ([1, np.nan, 3], "nan"),
        (np.ones((2, 3, 3)), None),
    ):
        if message is None:
            with pytest.warns(UserWarning, match="3 × 2"):
                built(ncv.Environment(radiance))
        else:
            with pytest.raises(ncv.SceneError, match=message):
                built(ncv.Environment(radiance))
    for wrong, message in (
        (3, "expected an Environment"),
        (ncv.Environment([1, 1, 1], up=(0, 0, 0)), "up"),
        (ncv.Environment([1, 1, 1], suns=(3,)), "expected a Sun"),
        (ncv.Environment([1, 1, 1], suns=(ncv.Sun((0, 0, 0), 1.0),)), "no length"),
        (ncv.Environment([1, 1, 1], suns=(ncv.Sun((0, 1, 0), -1.0),)), "out of range"),
    ):
        with pytest.raises(ncv.SceneError, match=message):
            built(wrong)


def test_it_is_part_of_the_digest():
    scenes = [
        built(one)
        for one in (
            None,
            ncv.Environment([1, 1, 1]),
            ncv.Environment([1, 1, 2]),
            ncv.Environment([1, 1, 1], 10.0),
            ncv.Environment([1, 1, 1], suns=(ncv.Sun((0, 1, 0), 1.0),)),
            ncv.Environment([1, 1, 1], suns=(ncv.Sun((0, 1, 0), 1.0, 1.0),)),
        )
    ]
    assert len({scene.digest for scene in scenes}) == len(scenes)
    assert built(ncv.Environment([1, 1, 1])).digest == scenes[1].digest


def test_info_names_it(load, tmp_path):
    load('[environment]\nsky = "clear"\n[environment.sun]\nelevation = 30\nirradiance = 2\n')
    said = describe(tmp_path / "scene.toml")
    assert "outside   an image of 1024 × 512" in said and "sun 0.533° wide" in said
    load("[environment]\nradiance = [1, 2, 3]\n")
    assert "outside   radiance (1, 2, 3)" in describe(tmp_path / "scene.toml")


def test_the_example_loads(scenes):
    scene = ncv.load_scene(scenes / "sky_room.toml")
    assert scene.warnings == () and len(scene.environment.suns) == 1


def test_a_black_one_is_none(load):
    assert load("[environment]\nradiance = 0\n").environment is None
    sun = '[[lights]]\nkind = "directional"\ndirection = [0, 1, 0]\nirradiance = 0\n'
    assert load(sun).environment is None
