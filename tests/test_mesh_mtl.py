"""Materials of MTL files: what the renderer has is taken over, the rest is said and nearly right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from mesh_files import load, obj_text, own_materials, png_bytes

from ncv_cl.scene.load import Material

TRIANGLE = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
# sRGB (128, 32, 32), in linear light.
OPAQUE = "materials that let light through are drawn opaque: 1 (m)"
UNREAD = "textures are not read, the surface is as without them: "
NO_NUMBERS = "keys of materials whose values are no numbers, as if they were absent: "
BROWN = [0.21586, 0.014444, 0.014444]


def read(folder: Path, text: str) -> tuple[Material, list[str]]:
    """The material `m` of a library, and what was said."""
    (folder / "m.mtl").write_text(f"newmtl m\n{text}\n")
    (folder / "m.obj").write_text("mtllib m.mtl\nusemtl m\n" + obj_text([TRIANGLE]))
    (material,), said = own_materials(folder, "m.obj")
    return material, said


def alpha(exponent: float) -> float:
    return (2.0 / (exponent + 2.0)) ** 0.5


@pytest.mark.parametrize(
    ("text", "albedo", "reflectance", "ggx_alpha", "emission"),
    [
        ("Kd 0.1 0.2 0.3", [0.1, 0.2, 0.3], 0, 1, 0),
        ("Kd 0.4", 0.4, 0, 1, 0),
        ("\tKD\t0.4 0.4 0.4\t# grey\r", 0.4, 0, 1, 0),
        ("Kd 0.4\nKs 0.05 0.06 0.07\nNs 30", 0.4, [0.05, 0.06, 0.07], alpha(30), 0),
        # Model 1 has no highlights, whatever Ks says; 2 and 3 have.
        ("Kd 0.4\nKs 1 1 1\nNs 500\nillum 1", 0.4, 0, alpha(500), 0),
        ("Kd 0.4\nKs 1 1 1\nNs 500\nillum 2", 0.4, 1, alpha(500), 0),
        ("illum 3\nKd 0.4\nKs 1 1 1\nNs 500", 0.4, 1, alpha(500), 0),
        ("Kd 0.4\nPr 0.5", 0.4, 0, 0.25, 0),
        ("Kd 0.4\nKs 0.3\nNs 30\nPm 0\nPr 0.5", 0.4, 0.04, 0.25, 0),
        ("Kd 0.4\nPm 1\nPr 0.5", 0, 0.4, 0.25, 0),
        ("Kd 0.4 0.2 0\nPm 0.5\nPr 0.5", [0.2, 0.1, 0], [0.22, 0.12, 0.02], 0.25, 0),
        ("Kd 0.4\nKe 0 0 0\nd 1\nTr 0\nTf 1 1 1\nNi 1.45\nKa 1 1 1\nsharpness 60\nPc 0", 0.4, 0, 1, 0),
    ],
)
def test_what_is_read_without_a_word(
    tmp_path: Path, text: str, albedo: object, reflectance: object, ggx_alpha: float, emission: object
) -> None:
    material, said = read(tmp_path, text)
    assert said == []
    assert np.allclose(material.albedo, albedo) and np.allclose(material.reflectance, reflectance)
    assert material.roughness**2 == pytest.approx(ggx_alpha)
    assert np.allclose(material.emission, emission)


def test_emission_is_taken_over_and_said(tmp_path: Path) -> None:
    material, said = read(tmp_path, "Kd 0 0 0\nKe 5 4 3")
    assert material.emission.tolist() == [5.0, 4.0, 3.0] and not material.albedo.any()
    assert said == ["materials that emit, which integrand gi renders and direct refuses: 1 (m)"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("d 0.5", OPAQUE),
        ("d -halo 0.5", OPAQUE),
        ("Tr 0.5", OPAQUE),
        ("illum 4\nTf 0.5 0.5 0.5", OPAQUE),
        ("illum 0", "materials of constant colour (illum 0) are lit as others are: 1 (m)"),
        ("Pc 0.5", "clear coat is not read: 1 (m)"),
        ("Ps 0.5", "sheen is not read: 1 (m)"),
        ("foo 1 2\nbar", "keys of materials that are not known: 2 (foo of m, bar of m)"),
        ("map_Bump -bm 0.5 b.png", UNREAD + "1 (map_bump b.png of m)"),
        ("map_d a.png\nnorm n.png", UNREAD + "2 (map_d a.png of m, norm n.png of m)"),
        ("illum abc", NO_NUMBERS + "1 (illum abc of m)"),
        ("Ns abc", NO_NUMBERS + "1 (ns abc of m)"),
        ("Ks spectral file.rfl 1", NO_NUMBERS + "1 (ks spectral file.rfl 1 of m)"),
    ],
)
def test_what_is_left_out_is_said(tmp_path: Path, text: str, sentence: str) -> None:
    material, said = read(tmp_path, f"Kd 0.4\n{text}")
    assert said == [sentence]
    assert np.allclose(material.albedo, 0.4) and not material.reflectance.any()


@pytest.mark.parametrize("text", ["", "Kd nan 1 1", "Kd 0,5 0,5 0,5", "Kd 0.1 0.2"])
def test_a_material_without_a_readable_colour_is_grey_and_named(tmp_path: Path, text: str) -> None:
    material, said = read(tmp_path, text)
    assert np.allclose(material.albedo, 0.5)
    assert "materials without Kd, whose albedo is 0.5: 1 (m)" in said


def test_colours_beyond_one_are_clamped_and_named(tmp_path: Path) -> None:
    material, said = read(tmp_path, "Kd 255 0.5 0\nKs -1 0 0")
    assert material.albedo.tolist() == [1.0, 0.5, 0.0] and not material.reflectance.any()
    assert said == ["materials with colours outside [0, 1], which are clamped: 1 (m)"]


@pytest.mark.parametrize(
    ("text", "albedo"),
    [
        ("Kd 1 1 1\nmap_Kd brown.png", BROWN),
        ("map_Kd brown.png", BROWN),
        ("Kd 0.5 1 1\nmap_Kd -s 2 2 -o 0.5 -clamp on brown.png", [BROWN[0] / 2, *BROWN[1:]]),
        ("map_Kd -mm 0 1 sub\\Brown.PNG", BROWN),
    ],
)
def test_the_mean_of_a_texture_stands_for_it(tmp_path: Path, text: str, albedo: list[float]) -> None:
    (tmp_path / "brown.png").write_bytes(png_bytes(128, 32, 32))
    material, said = read(tmp_path, text)
    assert np.allclose(material.albedo, albedo, atol=1e-5)
    (sentence,) = said
    assert sentence.startswith("textures are not read, their mean colour stands for them: 1 (map_Kd ")
    assert sentence.lower().endswith("brown.png of m)")


@pytest.mark.parametrize(
    ("name", "channels", "expected"),
    [
        ("t.exr", 3, [0.25, 2.5, 0.0]),
        ("t.png", 4, [0.4 * 0.21404, 0.4, 0.0]),
        ("t.png", 3, [0.5 * 0.21404, 0.5, 0.0]),
        ("t.png", 1, [0.5 * 0.21404] * 3),
        ("t.tif", 3, [0.5 * 0.21404, 0.5, 0.0]),
    ],
)
def test_means_are_taken_in_linear_light(
    tmp_path: Path, name: str, channels: int, expected: list[float]
) -> None:
    """Integers are sRGB, floats linear. One of two pixels is black, with 3 / 2 of the alpha."""
    bright = [0.5, 5.0 if name == "t.exr" else 1.0, 0.0, 0.4][:channels]
    pixels = np.array([[bright, [0.0, 0.0, 0.0, 0.6][:channels]]], dtype=np.float32)
    kind = {"t.exr": "half", "t.png": "uint16", "t.tif": "uint16"}[name]
    output = oiio.ImageOutput.create(str(tmp_path / name))
    spec = oiio.ImageSpec(2, 1, channels, kind)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    assert output.open(str(tmp_path / name), spec)
    assert output.write_image(pixels) and output.close()
    material, said = read(tmp_path, f"Ke 1 1 1\nKd 0\nmap_Ke {name}")
    assert np.allclose(material.emission, expected, rtol=0.01)
    assert f"map_Ke {name} of m" in said[0]


def test_a_black_factor_does_not_hide_a_texture(tmp_path: Path) -> None:
    (tmp_path / "brown.png").write_bytes(png_bytes(128, 32, 32))
    material, said = read(tmp_path, "Kd 0 0 0\nmap_Kd brown.png")
    assert np.allclose(material.albedo, BROWN, atol=1e-5)
    assert said == [
        "materials with a black Kd beside a texture, which is taken for white: 1 (m)",
        "textures are not read, their mean colour stands for them: 1 (map_Kd brown.png of m)",
    ]


@pytest.mark.parametrize("content", [None, b"no image"])
def test_a_texture_that_cannot_be_read_is_half_its_factor(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "t.png").write_bytes(content)
    material, said = read(tmp_path, "Kd 1 0.8 0.6\nmap_Kd t.png")
    assert np.allclose(material.albedo, [0.5, 0.4, 0.3])
    assert said == [
        "textures that are missing or cannot be read, in whose place 0.5 stands: 1 (map_Kd t.png of m)"
    ]


def test_under_a_metal_texture_the_surface_is_no_metal(tmp_path: Path) -> None:
    material, said = read(tmp_path, "Kd 0.4\nPm 1\nPr 0.5\nmap_Pm metal.png\nmap_Pr rough.png")
    assert np.allclose(material.albedo, 0.4) and np.allclose(material.reflectance, 0.04)
    assert material.roughness == pytest.approx(0.5)
    assert said == [
        "textures are not read, the surface is as without them: 2 "
        "(map_pm metal.png of m, map_pr rough.png of m)"
    ]


def test_emission_and_highlights_have_textures_too(tmp_path: Path) -> None:
    (tmp_path / "brown.png").write_bytes(png_bytes(128, 32, 32))
    material, said = read(tmp_path, "Kd 0.4\nmap_Ks brown.png\nKe 10 10 10\nmap_Ke brown.png")
    assert np.allclose(material.reflectance, BROWN, atol=1e-5)
    assert np.allclose(material.emission, 10 * np.array(BROWN), atol=1e-4)
    assert said[0].startswith("textures are not read, their mean colour stands for them: 2 (map_Ks ")


def test_many_names_are_counted_and_the_first_are_listed(tmp_path: Path) -> None:
    names = [f"glass{i}" for i in range(7)]
    (tmp_path / "m.mtl").write_text("".join(f"newmtl {n}\nKd 0.4\nd 0.1\n" for n in names))
    used = "".join(f"usemtl {name}\nf 1 2 3\n" for name in names)
    points = "".join("v {} {} {}\n".format(*p) for p in TRIANGLE)
    (tmp_path / "m.obj").write_text("mtllib m.mtl\n" + points + used)
    _, said = own_materials(tmp_path, "m.obj")
    assert said == [
        "materials that let light through are drawn opaque: 7 "
        "(glass0, glass1, glass2, glass3, glass4, 2 more)"
    ]


def test_looks_do_not_matter_under_a_material_of_the_scene(tmp_path: Path) -> None:
    read(tmp_path, "Kd 9\nKe 5 5 5\nd 0.5\nmap_Kd none.png\nfoo")
    scene = load(tmp_path, "m.obj")
    assert scene.warnings == () and [m.name for m in scene.materials] == ["grey"]


def test_materials_that_no_face_uses_are_not_mentioned(tmp_path: Path) -> None:
    (tmp_path / "m.mtl").write_text("newmtl m\nKd 0.4\nnewmtl other\nKd 2\nmap_Kd none.png\n")
    (tmp_path / "m.obj").write_text("mtllib m.mtl\nusemtl other\nusemtl m\n" + obj_text([TRIANGLE]))
    materials, said = own_materials(tmp_path, "m.obj")
    assert [m.name for m in materials] == ["m.obj:m"] and said == []
