"""Mitsuba's scene files become our tables: cameras, shapes, materials, lights, and what is said."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from mesh_files import png_bytes
from mitsuba_files import CAMERA, rectangle, scene

import ncv_cl as ncv
from ncv_cl.host.reach import Reach
from ncv_cl.scene.imports import read_tables
from ncv_cl.scene.imports.mitsuba_materials import inner_reflection
from ncv_cl.scene.textures.image_file import ImageFiles


def test_without_mitsuba_the_error_says_what_to_install(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    (tmp_path / "x.xml").write_text(scene(rectangle()))
    with pytest.raises(ncv.SceneError, match=r"x\.xml: .*pip install 'ncv_cl\[mitsuba\]'"):
        ncv.load_scene(tmp_path / "x.xml")


mitsuba = pytest.importorskip("mitsuba", reason="mitsuba is not installed")
pytest.importorskip("defusedxml", reason="defusedxml is not installed")


@pytest.fixture
def read(tmp_path: Path):
    """The tables of a scene file's text, and what is said of it."""

    def reader(text: str, camera: str | None = None) -> tuple[dict, str]:
        (tmp_path / "x.xml").write_text(text)
        found = read_tables(tmp_path / "x.xml", ImageFiles(Reach(tmp_path)), camera)
        return found.tables, "\n".join(found.said)

    return reader


def material(read, content: str) -> tuple[dict | None, str]:
    tables, said = read(scene(rectangle(content)))
    return tables["materials"].get(tables["quads"][0]["material"]) if "quads" in tables else None, said


# ---- dialects, safety ------------------------------------------------------------------------------


def test_dialects_say_the_same(read) -> None:
    new = scene(
        rectangle('<bsdf type="diffuse"><rgb name="reflectance" value="1 0.5 0.25"/></bsdf>'),
        camera='<sensor type="perspective"><float name="fov" value="40"/><string name="fov_axis" '
        'value="smaller"/><transform name="to_world"><lookat origin="0 0 5" target="0 0 0" up="0 1 0"/>'
        "</transform></sensor>",
    )
    old = new.replace('version="3.0.0"', 'version="0.6.0"')
    old = old.replace("fov_axis", "fovAxis").replace("to_world", "toWorld").replace("lookat", "lookAt")
    older = (
        old.replace("sensor", "camera")
        .replace("0.6.0", "0.5.0")
        .replace(
            '<rgb name="reflectance" value="1 0.5 0.25"/>',
            '<spectrum name="reflectance" value="1, 0.5, 0.25"/>',
        )
    )
    first, _ = read(new)
    assert first["materials"]["diffuse"]["albedo"] == [1, 0.5, 0.25]
    assert read(old)[0] == first and read(older)[0] == first


@pytest.mark.parametrize(
    "element, expected",
    [
        ('<srgb name="reflectance" value="0.5, 1, 0"/>', [0.21404114, 1, 0]),
        ('<rgb name="reflectance" value="#80ff00"/>', [0.21586050, 1, 0]),
        ('<rgb name="reflectance" value="0.3"/>', [0.3] * 3),
        ('<spectrum name="reflectance" value="0.3"/>', [0.3] * 3),
        ('<float name="reflectance" value="0.3"/>', [0.3] * 3),
        ('<rgb name="reflectance" value="2 0.5 -1"/>', [1, 0.5, 0]),
    ],
)
def test_colours(read, element: str, expected: list[float]) -> None:
    table, _ = material(read, f'<bsdf type="diffuse">{element}</bsdf>')
    np.testing.assert_allclose(np.broadcast_to(table["albedo"], 3), expected, atol=1e-6)


def test_a_spectrum_of_a_reflectance_is_its_colour(read) -> None:
    element = '<spectrum name="reflectance" value="400:0.2, 500:0.2, 600:0.6, 700:0.6"/>'
    table, _ = material(read, f'<bsdf type="diffuse">{element}</bsdf>')
    red, green, blue = table["albedo"]
    assert red > green > blue > 0.1 and red < 1


def test_parameters_and_includes_are_put_in(read, tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "b.xml").write_text(
        '<scene version="3.0.0"><bsdf type="diffuse" id="b"><float name="reflectance" value="$grey"/>'
        "</bsdf></scene>"
    )
    text = '<default name="grey" value="0.25"/><include filename="parts/b.xml"/>' + rectangle(
        '<ref id="b"/>'
    )
    tables, _ = read(scene(text))
    assert tables["materials"] == {"b": {"albedo": 0.25}}


def test_includes_that_include_each_other_are_an_error(read, tmp_path: Path) -> None:
    (tmp_path / "y.xml").write_text(scene('<include filename="x.xml"/>'))
    with pytest.raises(ncv.SceneError, match="do they include each other"):
        read(scene('<include filename="y.xml"/>'))


@pytest.mark.parametrize(
    "text, said",
    [
        ('<!DOCTYPE scene [<!ENTITY a "b">]><scene version="3.0.0">&a;</scene>', "document type or an"),
        ('<!DOCTYPE scene SYSTEM "file:///etc/hostname"><scene version="3.0.0"/>', "a document type"),
        (scene('<include filename="../y.xml"/>'), "outside of the scene's folder"),
        (scene('<include filename="z.xml"/>'), "which does not exist"),
        ("<scene", "cannot be read as XML"),
        ("<svg/>", "its root is <svg>, not <scene>"),
        (scene("<bsdf type='twosided'>" * 70 + "</bsdf>" * 70), "nested deeper"),
        (scene("<wrong/>"), "unsupported XML element: <wrong>"),
        (scene(rectangle('<ref id="none"/>')), "none"),
        (scene('<bsdf type="twosided" id="a"><ref id="a"/></bsdf>' + rectangle()), "circular reference"),
        ('<scene version="3.0.0"/>', "has no camera"),
        (scene(rectangle('<bsdf type="conductor"><string name="material" value="Xx"/></bsdf>')), "'Xx'"),
        (scene('<shape type="obj"><string name="filename" value="no.obj"/></shape>'), "'no.obj' of a"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_an_error(read, tmp_path: Path, text: str, said: str) -> None:
    (tmp_path.parent / "y.xml").write_text(scene(""))
    with pytest.raises(ncv.SceneError, match=said) as caught:
        read(text)
    assert str(caught.value).startswith(f"{tmp_path / 'x.xml'}: ")


def test_the_variant_of_others_stays(read) -> None:
    before = mitsuba.variant()
    read(scene(rectangle()))
    assert mitsuba.variant() == before


# ---- cameras ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", ["x", "y", "diagonal", "smaller", "larger"])
@pytest.mark.parametrize("size", [(64, 48), (48, 64)])
def test_fields_of_view(read, axis: str, size: tuple[int, int]) -> None:
    camera = CAMERA.replace('value="y"', f'value="{axis}"').replace(
        "</sensor>",
        f'<film type="hdrfilm"><integer name="width" value="{size[0]}"/>'
        f'<integer name="height" value="{size[1]}"/></film></sensor>',
    )
    tables, _ = read(scene(rectangle(), camera=camera))
    width, height = size
    across = {
        "x": width, "y": height, "diagonal": np.hypot(width, height),
        "smaller": min(size), "larger": max(size),
    }[axis]  # fmt: skip
    expected = 2 * np.degrees(np.arctan(np.tan(np.radians(20)) * height / across))
    assert tables["camera"]["vertical_fov"] == pytest.approx(expected)


def test_a_focal_length_is_of_35_mm_film(read) -> None:
    camera = '<sensor type="perspective"><string name="focal_length" value="50mm"/></sensor>'
    tables, _ = read(scene(rectangle(), camera=camera))
    # The diagonal's, on a film of 4 by 3.
    half = np.hypot(36, 24) / 2 / 50 * 3 / 5
    assert tables["camera"]["vertical_fov"] == pytest.approx(2 * np.degrees(np.arctan(half)))


def test_cameras_are_chosen_by_name(read) -> None:
    second = CAMERA.replace("<sensor ", '<sensor id="side" ').replace('"0, 0, 5"', '"5, 0, 0"')
    flat = '<sensor type="orthographic" id="flat"/>'
    text = scene(rectangle(), camera=CAMERA + flat + second)
    assert read(text)[0]["camera"]["position"] == [0, 0, 5]
    assert read(text, "side")[0]["camera"]["position"] == [5, 0, 0]
    with pytest.raises(ncv.SceneError, match="the camera flat is of the kind orthographic"):
        read(text, "flat")
    with pytest.raises(ncv.SceneError, match=r"no camera 'none'; its cameras: .*flat, side"):
        read(text, "none")


def test_what_a_camera_cannot_do_is_said(read) -> None:
    lens = CAMERA.replace('"perspective"', '"thinlens"').replace("<lookat", '<scale x="-1"/><lookat')
    said = read(scene(rectangle(), camera=lens))[1]
    assert "lenses are pinholes" in said and "mirror the picture" in said


def test_instances_are_shapes_of_their_group(read) -> None:
    group = '<shape type="shapegroup" id="g"><shape type="sphere"/><shape type="rectangle"/></shape>'
    moved = '<transform name="to_world"><scale value="2"/><translate x="3"/></transform>'
    tables, _ = read(scene(f'{group}<shape type="instance"><ref id="g"/>{moved}</shape>'))
    assert tables["spheres"][0]["center"] == [3, 0, 0] and tables["spheres"][0]["radius"] == 2
    assert tables["quads"][0]["corner"] == [1, -2, 0]


def test_what_is_left_out_is_said_by_kind(read) -> None:
    content = (
        '<shape type="hair"/><shape type="sdfgrid"/><shape type="hair" id="a"/><emitter type="sunsky"/>'
    )
    said = read(scene(rectangle() + content))[1]
    assert "shapes of the kind hair are left out: 2 (a)" in said
    assert "shapes of the kind sdfgrid are left out: 1" in said
    assert "emitters of the kind sunsky are left out: 1" in said


# ---- materials -------------------------------------------------------------------------------------

GREY = '<bsdf type="diffuse"><float name="reflectance" value="0.4"/></bsdf>'


def test_two_sided_diffuse_is_exact_and_nothing_is_said(read) -> None:
    assert material(read, f'<bsdf type="twosided">{GREY}</bsdf>') == ({"albedo": 0.4}, "")
    assert "reflect from both sides: 1 (diffuse)" in material(read, GREY)[1]


def test_an_absent_material_is_mitsubas(read) -> None:
    assert material(read, "")[0] == {"albedo": 0.5}


def test_metals(read) -> None:
    gold = material(read, '<bsdf type="roughconductor"><string name="material" value="Au"/></bsdf>')[0]
    # Gold at normal incidence, in linear sRGB (Mitsuba's own numbers).
    np.testing.assert_allclose(gold["reflectance"], [0.967, 0.802, 0.324], atol=2e-3)
    assert gold["albedo"] == 0 and gold["roughness"] == pytest.approx(np.sqrt(0.1))
    given = (
        '<bsdf type="conductor"><rgb name="eta" value="0.2 0.9 1.5"/><rgb name="k" value="3 2 2"/>'
        '<float name="specular_reflectance" value="0.5"/></bsdf>'
    )
    eta, k = np.array([0.2, 0.9, 1.5]), np.array([3.0, 2, 2])
    expected = 0.5 * ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
    table, said = material(read, given)
    np.testing.assert_allclose(table["reflectance"], expected, atol=1e-6)
    assert table["roughness"] == 0.01 and "of the kind conductor become the nearest of ours" in said
    mirror = material(read, '<bsdf type="conductor"><string name="material" value="none"/></bsdf>')[0]
    assert mirror["reflectance"] == 1


@pytest.mark.parametrize("nonlinear", [False, True])
def test_plastic_reflects_as_much_as_mitsubas(read, scalar, nonlinear: bool) -> None:
    """Its diffuse part at normal incidence, where our Fresnel term is exact too."""
    text = (
        '<bsdf type="plastic"><rgb name="diffuse_reflectance" value="0.2 0.5 0.8"/>'
        f'<boolean name="nonlinear" value="{str(nonlinear).lower()}"/></bsdf>'
    )
    table, _ = material(read, text)
    eta = 1.49 / 1.000277
    assert table["reflectance"] == pytest.approx(((eta - 1) / (eta + 1)) ** 2)
    plugin = scalar.load_string(text.replace("<bsdf ", '<bsdf version="3.0.0" '))
    interaction = scalar.SurfaceInteraction3f()
    interaction.wi = [0, 0, 1]
    there = np.array(plugin.eval(scalar.BSDFContext(), interaction, scalar.Vector3f(0, 0, 1)))
    here = np.array(table["albedo"]) / np.pi * (1 - table["reflectance"]) ** 2
    np.testing.assert_allclose(here, there, rtol=2e-3)


def test_inner_reflection_is_walters_and_krivaneks() -> None:
    # A glass of 1.5 reflects 9.2 % of diffuse light from outside, and 59.6 % from inside.
    assert inner_reflection(1.5) == pytest.approx(0.596, abs=1e-3)
    assert inner_reflection(1.000001) == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize(
    "text, expected",
    [
        ('<bsdf type="dielectric"/>', {"transmission": 1, "ior": 1.5046 / 1.000277}),
        ('<bsdf type="dielectric"><string name="int_ior" value="water"/>'
         '<float name="ext_ior" value="1"/></bsdf>', {"ior": 1.333}),
        ('<bsdf type="thindielectric"><rgb name="specular_transmittance" value="1 0.5 0"/></bsdf>',
         {"transmission": [1, 0.5, 0], "thin": True}),
        ('<bsdf type="roughdielectric"><float name="alpha" value="0.25"/></bsdf>', {"roughness": 0.5}),
        ('<bsdf type="principled"><float name="spec_trans" value="1"/><float name="eta" value="1.4"/>'
         '<rgb name="base_color" value="0.25 1 1"/><float name="roughness" value="0.2"/></bsdf>',
         {"transmission": [0.5, 1, 1], "ior": 1.4, "roughness": 0.2, "albedo": 0}),
        ('<bsdf type="principled"><float name="metallic" value="1"/>'
         '<rgb name="base_color" value="1 0.5 0"/></bsdf>',
         {"albedo": [0, 0, 0], "reflectance": [1, 0.5, 0], "roughness": 0.5}),
        ('<bsdf type="principled"><float name="specular" value="0.5"/></bsdf>',
         {"albedo": 0.5, "reflectance": 0.04}),
    ],
)  # fmt: skip
def test_glass_and_principled(read, text: str, expected: dict) -> None:
    table, _ = material(read, text)
    for key, value in expected.items():
        np.testing.assert_allclose(table[key], value, atol=1e-6)


def test_masks(read, tmp_path: Path) -> None:
    (tmp_path / "t.png").write_bytes(png_bytes(10, 20, 30))
    for share, seen in ((0.7, True), (0.3, False)):
        table, said = material(
            read, f'<bsdf type="mask"><float name="opacity" value="{share}"/>{GREY}</bsdf>'
        )
        assert (table is not None) == seen and "opacities below a half are none" in said
    image = '<texture type="bitmap" name="opacity"><string name="filename" value="t.png"/></texture>'
    table, _ = material(read, f'<bsdf type="mask">{image}{GREY}</bsdf>')
    assert table["opacity"] == {"file": "t.png", "scale": [1, -1], "offset": [0, 1]}
    assert material(read, '<bsdf type="null"/>')[0] is None


def test_normal_maps_and_bump_maps(read, tmp_path: Path) -> None:
    (tmp_path / "t.png").write_bytes(png_bytes(128, 128, 255))
    image = (
        '<texture type="bitmap" name="n"><string name="filename" value="t.png"/>'
        '<boolean name="raw" value="true"/></texture>'
    )
    table, _ = material(read, f'<bsdf type="normalmap">{image}{GREY}</bsdf>')
    assert table["normal"]["file"] == "t.png" and table["albedo"] == 0.4
    assert "bump maps are not read: 1" in material(read, f'<bsdf type="bumpmap">{image}{GREY}</bsdf>')[1]


def test_unknown_materials_are_grey_and_said(read) -> None:
    table, said = material(read, '<bsdf type="measured" id="m"/>')
    assert table == {"albedo": 0.5} and "materials of the kind measured are not read" in said


def test_a_missing_image_is_said(read) -> None:
    image = (
        '<texture type="bitmap" name="reflectance"><string name="filename" value="no.png"/></texture>'
    )
    table, said = material(read, f'<bsdf type="diffuse">{image}</bsdf>')
    assert table == {"albedo": 0.5} and "missing or cannot be read" in said and "no.png" in said


# ---- lights ----------------------------------------------------------------------------------------

AREA = '<emitter type="area"><rgb name="radiance" value="1 2 3"/></emitter>'


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("mirror", [1, -1])
def test_a_rectangle_shines_from_mitsubas_side(read, scalar, flip: bool, mirror: int) -> None:
    flag = f'<boolean name="flip_normals" value="{str(flip).lower()}"/>'
    tables, _ = read(scene(rectangle(flag + AREA, f'<scale x="{mirror}" y="2"/><translate z="1"/>')))
    (light,) = tables["lights"]
    normal = np.cross(light["edge1"], light["edge2"])
    shape = scalar.load_dict(
        {
            "type": "rectangle", "flip_normals": flip,
            "to_world": scalar.ScalarTransform4f().translate([0, 0, 1]).scale([mirror, 2, 1]),
        }
    )  # fmt: skip
    theirs = np.array(shape.sample_position(0.0, [0.5, 0.5]).n)
    np.testing.assert_allclose(normal / np.linalg.norm(normal), theirs, atol=1e-6)
    assert np.linalg.norm(normal) == pytest.approx(8) and light["radiance"] == [1, 2, 3]


def test_discs_and_spheres_shine(read) -> None:
    moved = '<transform name="to_world"><scale value="2"/><translate x="1"/></transform>'
    shapes = "".join(f'<shape type="{kind}">{moved}{AREA}</shape>' for kind in ("disk", "sphere"))
    tables, said = read(scene(rectangle() + shapes))
    disc, sphere = tables["lights"]
    expected = {"kind": "disc", "centre": [1, 0, 0], "normal": [0, 0, 1], "radius": 2}
    assert disc == expected | {"radiance": [1, 2, 3]}
    assert sphere == {"kind": "sphere", "centre": [1, 0, 0], "radius": 2, "radiance": [1, 2, 3]}
    assert "surfaces of lights reflect nothing: 2" in said


def test_other_shapes_that_shine_have_a_material_that_does(read) -> None:
    black = '<bsdf type="diffuse"><float name="reflectance" value="0"/></bsdf>'
    tables, said = read(scene(f'<shape type="cube">{black}{AREA}</shape>'))
    assert [one["emission"] for one in tables["materials"].values()] == [[1, 2, 3]]
    assert "meshes that emit do so from both sides: 1" in said


def test_punctual_lights(read) -> None:
    turned = '<transform name="to_world"><rotate y="1" angle="90"/><translate z="2"/></transform>'
    lights = (
        '<emitter type="point"><point name="position" x="1" y="2" z="3"/>'
        '<rgb name="intensity" value="1 2 3"/></emitter>'
        f'<emitter type="spot">{turned}<float name="cutoff_angle" value="40"/></emitter>'
        '<emitter type="directional"><vector name="direction" x="0" y="-2" z="0"/>'
        '<float name="irradiance" value="5"/></emitter>'
    )
    point, spot, sun = read(scene(rectangle() + lights))[0]["lights"]
    assert point == {"kind": "point", "position": [1, 2, 3], "intensity": [1, 2, 3]}
    assert spot["inner_angle"] == 30 and spot["outer_angle"] == 40 and spot["position"] == [0, 0, 2]
    np.testing.assert_allclose(spot["direction"], [1, 0, 0], atol=1e-12)
    assert sun == {"kind": "directional", "direction": [0, -1, 0], "irradiance": [5, 5, 5]}


def test_environments(read, tmp_path: Path) -> None:
    constant = '<emitter type="constant"><rgb name="radiance" value="1 2 3"/></emitter>'
    assert read(scene(rectangle() + constant))[0]["environment"] == {"radiance": [1, 2, 3]}
    (tmp_path / "sky.png").write_bytes(png_bytes(10, 20, 30))
    image = (
        '<emitter type="envmap"><string name="filename" value="sky.png"/><float name="scale" value="2"/>'
        '<transform name="to_world">{}</transform></emitter>'
    )
    turned, _ = read(scene(rectangle() + image.format('<rotate y="1" angle="30"/>')))
    assert turned["environment"] == {"file": "sky.png", "scale": 2, "rotation": pytest.approx(30)}
    # z upwards, as Blender's exporter writes it: y is turned to z the shortest way.
    up, _ = read(scene(rectangle() + image.format('<rotate x="1" angle="90"/>')))
    assert up["environment"]["up"] == pytest.approx([0, 0, 1]) and "rotation" not in up["environment"]
