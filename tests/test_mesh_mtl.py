"""Materials of MTL files: what the renderer has is taken over, the rest is said and nearly right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mesh_files import load, obj_text, own_materials, png_bytes, write_image

from ncv_cl.scene.load import Material
from ncv_cl.scene.textures.texture import AS_IT_IS

TRIANGLE = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
OPAQUE = "materials that let light through are drawn opaque: 1 (m)"
UNREAD = "textures are not read, the surface is as without them: "
NO_NUMBERS = "keys of materials whose values are no numbers, as if they were absent: "
# sRGB (128, 32, 32), in linear light. Texels are halves, so within 2^-11 of that.
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
    assert said == ["materials that emit, which light the scene: 1 (m)"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("d 0.5", OPAQUE),
        ("d -halo 0.5", OPAQUE),
        ("Tr 0.5", OPAQUE),
        ("illum 4\nTf 1 1 1", OPAQUE),
        ("illum 0", "materials of constant colour (illum 0) are lit as others are: 1 (m)"),
        ("Pc 0.5", "clear coat is not read: 1 (m)"),
        ("Ps 0.5", "sheen is not read: 1 (m)"),
        ("foo 1 2\nbar", "keys of materials that are not known: 2 (foo of m, bar of m)"),
        ("map_Bump -bm 0.5 b.png", UNREAD + "1 (map_bump b.png of m)"),
        ("map_Tr a.png\nbump n.png", UNREAD + "2 (map_tr a.png of m, bump n.png of m)"),
        (
            "norm n.png",
            "textures of normals that are missing or not placed as the colour is, which are left out: 1 "
            "(norm n.png of m)",
        ),
        (
            "map_d a.png",
            "textures of opacity that are missing or not placed as the colour is, the surface is "
            "opaque: 1 (map_d a.png of m)",
        ),
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


def textured(folder: Path, text: str) -> tuple[Material, list[str]]:
    """The material `m` of a library on a triangle with texture coordinates, and what was said."""
    (folder / "brown.png").write_bytes(png_bytes(128, 32, 32))
    (folder / "m.mtl").write_text(f"newmtl m\n{text}\n")
    corners = "vt 0 0\nvt 1 0\nvt 0 1\n" + "".join("v {} {} {}\n".format(*p) for p in TRIANGLE)
    (folder / "m.obj").write_text(f"mtllib m.mtl\nusemtl m\n{corners}f 1/1 2/2 3/3\n")
    (material,), said = own_materials(folder, "m.obj")
    return material, said


@pytest.mark.parametrize(
    ("text", "albedo", "placement", "wrap"),
    [
        ("Kd 1 1 1\nmap_Kd brown.png", 1, AS_IT_IS, "repeat"),
        ("map_Kd brown.png", 1, AS_IT_IS, "repeat"),
        (
            "Kd 0.5 1 1\nmap_Kd -s 2 3 -o 0.5 -clamp on brown.png",
            [0.5, 1, 1], (2, 0, 0.5, 0, 3, 0), "clamp",
        ),
        ("map_Kd -mm 0 1 -bm 2 -blendu on -texres 64 sub\\Brown.PNG", 1, AS_IT_IS, "repeat"),
    ],
)  # fmt: skip
def test_a_texture_of_kd_is_read(
    tmp_path: Path, text: str, albedo: object, placement: tuple[float, ...], wrap: str
) -> None:
    material, said = textured(tmp_path, text)
    assert said == [] and np.allclose(material.albedo, albedo)
    assert material.maps.placement == placement and material.maps.metallic == 0
    assert material.maps.colour.wrap == (wrap, wrap) and not material.maps.colour.nearest
    assert np.allclose(material.maps.colour.texels[0, 0], [*BROWN, 1], rtol=2**-11)


def test_a_mesh_without_coordinates_gets_the_mean_of_its_texture(tmp_path: Path) -> None:
    (tmp_path / "brown.png").write_bytes(png_bytes(128, 32, 32))
    material, said = read(tmp_path, "Kd 0.5 1 1\nmap_Kd brown.png")
    assert np.allclose(material.albedo, [BROWN[0] / 2, *BROWN[1:]], rtol=2**-11)
    assert material.textures == ()
    assert said == ["textures of meshes without texture coordinates, their mean stands for them: 1 (m)"]


@pytest.mark.parametrize("option", ["-mm 0.2 0.5", "-t 1 1 1", "-unknown 3"])
def test_options_that_change_an_image_and_are_not_read_are_named(tmp_path: Path, option: str) -> None:
    _, said = textured(tmp_path, f"map_Kd {option} brown.png")
    assert said == [f"options of textures that are not read: 1 ({option} of map_Kd brown.png of m)"]


def grey_image(folder: Path, name: str, rows: list[list[int]]) -> None:
    """A PNG of one channel; the uppermost row first."""
    write_image(folder / name, np.array(rows, np.uint8)[:, :, None])


def test_textures_of_roughness_and_metal_become_one(tmp_path: Path) -> None:
    grey_image(tmp_path, "rough.png", [[51, 102], [153, 204]])
    grey_image(tmp_path, "metal.png", [[255]])
    material, said = textured(tmp_path, "Kd 0.4\nPr 0.5\nmap_Pr rough.png\nmap_Pm metal.png")
    surface = material.maps.surface.texels.astype(float)
    assert said == [] and material.maps.metallic == 1 and material.roughness == 0.5
    assert np.allclose(surface[:, :, 1], [[0.6, 0.8], [0.2, 0.4]], rtol=2**-11)
    assert (surface[:, :, 2] == 1).all() and np.allclose(material.reflectance, 0.04)
    # The numbers are factors where there are images, and 1 by default.
    material, _ = textured(tmp_path, "Kd 0.4\nKs 0.3\nmap_Pr rough.png")
    assert material.maps.metallic == 0 and material.roughness == 1
    assert np.allclose(material.reflectance, 0.3)
    material, _ = textured(tmp_path, "Kd 0.4\nPm 0.25\nmap_Pm metal.png")
    assert material.maps.metallic == 0.25


def test_packed_textures_have_their_channels(tmp_path: Path) -> None:
    material, _ = textured(tmp_path, "Kd 0.4\nmap_ORM brown.png")
    assert np.allclose(material.maps.surface.texels[0, 0, 1:3], 32 / 255, rtol=2**-11)
    material, _ = textured(tmp_path, "Kd 0.4\nmap_RMA brown.png")
    assert np.allclose(material.maps.surface.texels[0, 0, 1:3], [128 / 255, 32 / 255], rtol=2**-11)


def test_a_texture_of_opacity_makes_holes(tmp_path: Path) -> None:
    grey_image(tmp_path, "holes.png", [[0, 255]])
    material, said = textured(tmp_path, "Kd 0.4\nmap_d -s 2 2 holes.png")
    assert material.maps.opacity.texels[0, :, 3].tolist() == [0, 1] and material.maps.cutoff == 0.5
    assert material.maps.placement[0] == 2 and material.maps.colour is None
    assert said == [
        "materials that blend are opaque, with holes where their opacity is below a half: 1 "
        "(map_d holes.png of m)"
    ]


@pytest.mark.parametrize("key", ["norm", "map_Kn"])
def test_a_texture_of_normals_is_read(tmp_path: Path, key: str) -> None:
    material, said = textured(tmp_path, f"Kd 0.4\n{key} -s 2 2 brown.png")
    assert said == [] and material.maps.placement[0] == 2
    # Normals are no colours: they are not decoded.
    expected = np.array([128, 32, 32]) / 255
    assert np.allclose(material.maps.normal.texels[0, 0, :3], expected, rtol=2**-11)


def test_textures_that_lie_otherwise_are_named(tmp_path: Path) -> None:
    material, said = textured(tmp_path, "Kd 0.4\nmap_Kd brown.png\nmap_Pm -s 2 2 brown.png")
    assert material.maps.surface is None and material.maps.metallic == 0
    assert said == [
        "textures of metal that are not placed as the colour is, the surface is no metal: 1 "
        "(map_pm brown.png of m)"
    ]


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
    write_image(tmp_path / name, pixels, kind)
    material, said = read(tmp_path, f"Ke 1 1 1\nKd 0\nmap_Ke {name}")
    assert np.allclose(material.emission, expected, rtol=0.01)
    assert said[1] == "textures of meshes without texture coordinates, their mean stands for them: 1 (m)"


def test_a_black_factor_does_not_hide_a_texture(tmp_path: Path) -> None:
    (tmp_path / "brown.png").write_bytes(png_bytes(128, 32, 32))
    material, said = read(tmp_path, "Kd 0 0 0\nmap_Kd brown.png")
    assert np.allclose(material.albedo, BROWN, rtol=2**-11)
    assert said == [
        "materials with a black Kd beside a texture, which is taken for white: 1 (m)",
        "textures of meshes without texture coordinates, their mean stands for them: 1 (m)",
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
        "textures of metal that are missing or cannot be read, the surface is no metal: 1 "
        "(map_pr rough.png of m, map_pm metal.png of m)"
    ]


def test_emission_and_highlights_have_textures_too(tmp_path: Path) -> None:
    (tmp_path / "brown.png").write_bytes(png_bytes(128, 32, 32))
    material, said = read(tmp_path, "Kd 0.4\nmap_Ks brown.png\nKe 10 10 10\nmap_Ke brown.png")
    assert np.allclose(material.reflectance, BROWN, rtol=2**-11)
    assert np.allclose(material.emission, 10 * np.array(BROWN), rtol=2**-11)
    assert said[0] == (
        "textures are not read, their mean colour stands for them: 1 (map_Ks brown.png of m)"
    )
    material, said = textured(tmp_path, "Kd 0.4\nKe 10 10 10\nmap_Ke -s 2 2 brown.png")
    assert material.emission.tolist() == [10, 10, 10] and material.maps.placement[0] == 2
    assert np.allclose(material.maps.emission.texels[0, 0, :3], BROWN, rtol=2**-11)
    material, said = textured(tmp_path, "map_Kd brown.png\nKe 10 10 10\nmap_Ke -s 2 2 brown.png")
    assert np.allclose(material.emission, 10 * np.array(BROWN), rtol=2**-11)
    assert said[0] == (
        "textures that are not placed as the colour is, their mean colour stands for them: 1 "
        "(map_Ke brown.png of m)"
    )


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
