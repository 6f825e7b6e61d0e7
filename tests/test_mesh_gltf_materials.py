"""Materials of glTF: factors as written, the extensions that matter, and what is said of the rest."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
import pytest
from mesh_files import SQUARE, Gltf, load, own_materials, png_bytes

from ncv_cl.scene.load import Material

# sRGB (128, 32, 32), in linear light.
BROWN = np.array([0.21586, 0.014444, 0.014444])
OPAQUE = "materials that let light through are drawn opaque: 1 (w)"
EMITS = "materials that emit, which integrand gi renders and direct refuses: 1 (w)"
MEANS = "textures are not read, their mean colour stands for them: "
NO_METAL = "textures of metal and roughness are not read, the surface is no metal: 1 (w)"


def read(
    folder: Path, material: dict | None, gltf: Gltf | None = None, **attributes: int
) -> tuple[Material, list[str]]:
    """The material `w` of a square, and what was said."""
    gltf = gltf or Gltf()
    primitive = gltf.square()
    primitive["attributes"] |= attributes
    if material is not None:
        primitive["material"] = 0
        gltf.tree["materials"] = [{"name": "w"} | material]
    gltf.tree["meshes"] = [{"name": "m", "primitives": [primitive]}]
    gltf.write(folder / "a.gltf")
    (found,), said = own_materials(folder, "a.gltf")
    return found, said


def pbr(**table: object) -> dict:
    return {"pbrMetallicRoughness": table}


@pytest.mark.parametrize(
    ("material", "albedo", "reflectance", "roughness"),
    [
        # Factors are not rounded to 8 bits: 0.001 is not 0.
        (pbr(baseColorFactor=[0.001, 0.123, 0.9, 1], metallicFactor=0), [0.001, 0.123, 0.9], 0.04, 1),
        (pbr(baseColorFactor=[0.5, 0.6, 0.7, 1], roughnessFactor=0.25), 0, [0.5, 0.6, 0.7], 0.25),
        (pbr(baseColorFactor=[0.5, 0.5, 0.5, 1], metallicFactor=0.5), 0.25, 0.27, 1),
        ({}, 0, 1, 1),
        (pbr(metallicFactor=0, roughnessFactor=0), 1, 0.04, 0.01),
        # Opaque by default, whatever alpha says; culling does not matter to two-sided surfaces.
        (pbr(metallicFactor=0, baseColorFactor=[1, 1, 1, 0.2]) | {"doubleSided": False}, 1, 0.04, 1),
        (
            pbr(metallicFactor=0) | {"extensions": {"KHR_materials_ior": {"ior": 2.0}}},
            1, 1 / 9, 1,
        ),
        (pbr(metallicFactor=0) | {"extensions": {"KHR_materials_ior": {"ior": 0}}}, 1, 1, 1),
        (
            pbr(metallicFactor=0) | {"extensions": {"KHR_materials_specular": {"specularFactor": 0}}},
            1, 0, 1,
        ),
        (
            {"extensions": {"KHR_materials_pbrSpecularGlossiness": {
                "diffuseFactor": [0.5, 0.4, 0.3, 1],
                "specularFactor": [0.2, 0.1, 0],
                "glossinessFactor": 0.7,
            }}},
            [0.4, 0.32, 0.24], [0.2, 0.1, 0], 0.3,
        ),
    ],
)  # fmt: skip
def test_what_is_read_without_a_word(
    tmp_path: Path, material: dict, albedo: object, reflectance: object, roughness: float
) -> None:
    found, said = read(tmp_path, material)
    assert said == [] and found.name == "a.gltf:w"
    assert np.allclose(found.albedo, albedo, rtol=1e-5)
    assert np.allclose(found.reflectance, reflectance, rtol=1e-5)
    assert found.roughness == pytest.approx(roughness) and not found.emission.any()


def test_emission_has_a_strength(tmp_path: Path) -> None:
    strong = {"extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 20}}}
    found, said = read(tmp_path, {"emissiveFactor": [1, 0.5, 0]} | strong)
    assert found.emission.tolist() == [20, 10, 0] and said == [EMITS]
    found, said = read(tmp_path, strong)
    assert not found.emission.any() and said == []


@pytest.mark.parametrize(
    ("material", "sentences"),
    [
        (pbr(baseColorFactor=[1, 1, 1, 0.5]) | {"alphaMode": "BLEND"}, [OPAQUE]),
        (pbr(baseColorFactor=[1, 1, 1, 0.5]) | {"alphaMode": "MASK"}, [OPAQUE]),
        ({"alphaMode": "BLEND"}, []),
        ({"normalTexture": {"index": 0}}, ["normal textures are not read: 1 (w)"]),
        ({"occlusionTexture": {"index": 0}}, ["occlusion textures are not read: 1 (w)"]),
        ({"extensions": {"KHR_materials_transmission": {}, "KHR_materials_clearcoat": {}}},
         [f"KHR_materials_{lobe} is not read: 1 (w)" for lobe in ("transmission", "clearcoat")]),
        ({"extensions": {"KHR_materials_unlit": {}}}, ["KHR_materials_unlit is not read: 1 (w)"]),
        (pbr(baseColorFactor=[2, 1, 1, 1]),
         ["materials with colours outside [0, 1], which are clamped: 1 (w)"]),
    ],
)  # fmt: skip
def test_what_is_left_out_is_said(tmp_path: Path, material: dict, sentences: list[str]) -> None:
    _, said = read(tmp_path, material)
    assert said == sentences
    assert load(tmp_path, "a.gltf").warnings == ()


def test_looks_may_be_required(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.tree["extensionsRequired"] = ["KHR_materials_unlit", "KHR_texture_transform"]
    _, said = read(tmp_path, {"extensions": {"KHR_materials_unlit": {}}}, gltf)
    assert said == ["KHR_materials_unlit is not read: 1 (w)"]


@pytest.mark.parametrize("place", ["file", "view", "data", "webp"])
def test_the_mean_of_a_texture_stands_for_it(tmp_path: Path, place: str) -> None:
    gltf = Gltf()
    content = png_bytes(128, 32, 32)
    gltf.tree["textures"] = [{"source": 0}]
    if place == "view":
        image = {"bufferView": gltf.view(content), "mimeType": "image/png"}
    elif place == "data":
        image = {"uri": "data:image/png;base64," + base64.b64encode(content).decode()}
    else:
        (tmp_path / "my image.png").write_bytes(content)
        image = {"uri": "my%20image.png"}
    if place == "webp":
        gltf.tree["textures"] = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
    gltf.tree["images"] = [image]
    table = {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 0.5, 1, 1], "metallicFactor": 0}
    found, said = read(tmp_path, pbr(**table), gltf)
    assert np.allclose(found.albedo, BROWN * [1, 0.5, 1], atol=1e-5)
    assert said == [MEANS + "1 (baseColorTexture of w)"]


def test_textures_that_are_missing_and_those_of_metal(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.tree |= {"textures": [{"source": 0}], "images": [{"uri": "none.png"}]}
    textures = {key: {"index": 0} for key in ("baseColorTexture", "metallicRoughnessTexture")}
    found, said = read(tmp_path, pbr(**textures, roughnessFactor=0.5), gltf)
    # No metal, and not the white that the factors alone would give.
    assert np.allclose(found.albedo, 0.5) and np.allclose(found.reflectance, 0.04)
    assert found.roughness == 0.5
    missing = "textures that are missing or cannot be read, in whose place 0.5 stands: "
    assert said == [missing + "1 (baseColorTexture of w)", NO_METAL]


def test_an_emissive_texture_gives_the_power_of_its_mean(tmp_path: Path) -> None:
    gltf = Gltf()
    image = {"uri": "data:image/png;base64," + base64.b64encode(png_bytes(128, 32, 32)).decode()}
    gltf.tree |= {"textures": [{"source": 0}], "images": [image]}
    found, said = read(tmp_path, {"emissiveTexture": {"index": 0}, "emissiveFactor": [1, 1, 1]}, gltf)
    assert np.allclose(found.emission, BROWN, atol=1e-5)
    assert said == [MEANS + "1 (emissiveTexture of w)", EMITS]


@pytest.mark.parametrize(
    ("kind", "half", "channels"), [("f4", 0.5, 4), ("f4", 0.5, 3), ("u1", 128, 4), ("u2", 32768, 3)]
)
def test_colours_of_vertices_multiply_the_base_colour(
    tmp_path: Path, kind: str, half: float, channels: int
) -> None:
    gltf = Gltf()
    colours = gltf.accessor(np.full((4, channels), half, kind), normalized=kind != "f4")
    table = pbr(baseColorFactor=[0.8, 0.2, 0.2, 1], metallicFactor=0)
    found, said = read(tmp_path, table, gltf, COLOR_0=colours)
    assert np.allclose(found.albedo, [0.4, 0.1, 0.1], rtol=5e-3) and said == []
    # Of a metal they are its reflectance.
    gltf = Gltf()
    colours = gltf.accessor(np.full((4, channels), half, kind), normalized=kind != "f4")
    found, _ = read(tmp_path, pbr(), gltf, COLOR_0=colours)
    assert not found.albedo.any() and np.allclose(found.reflectance, 0.5, rtol=5e-3)


def test_colours_that_vary_become_their_mean_and_it_is_said(tmp_path: Path) -> None:
    sentence = "colours of vertices are not read, their mean stands for them: 1 (m.primitives[0])"
    for material, albedo in ((pbr(metallicFactor=0, baseColorFactor=[0.5] * 4), 0.25), (None, 0.5)):
        gltf = Gltf()
        colours = gltf.accessor(np.float32([(0, 0, 0), (0.5,) * 3, (1,) * 3, (0.5,) * 3]))
        found, said = read(tmp_path, material, gltf, COLOR_0=colours)
        assert np.allclose(found.albedo, albedo) and said == [sentence]


def test_one_material_with_two_tints_is_mentioned_once(tmp_path: Path) -> None:
    gltf = Gltf()
    dark, bright = (gltf.accessor(np.float32([(c,) * 3] * 4)) for c in (0.25, 0.5))
    primitives = [gltf.square(material=0), gltf.square(material=0)]
    primitives[0]["attributes"]["COLOR_0"] = dark
    primitives[1]["attributes"] |= {"COLOR_0": bright, "POSITION": gltf.accessor(SQUARE + np.float32(5))}
    gltf.tree["materials"] = [pbr(metallicFactor=0) | {"extensions": {"KHR_materials_sheen": {}}}]
    gltf.tree["meshes"] = [{"primitives": primitives}]
    gltf.write(tmp_path / "a.gltf")
    materials, said = own_materials(tmp_path, "a.gltf")
    assert [float(m.albedo[0]) for m in materials] == [0.25, 0.5]
    assert said == ["KHR_materials_sheen is not read: 1 (materials[0])"]


def test_a_primitive_without_material_is_grey(tmp_path: Path) -> None:
    found, said = read(tmp_path, None)
    assert found.albedo.tolist() == [0.5] * 3 and not found.reflectance.any()
    (sentence,) = said
    assert sentence.startswith("no material could be read")
