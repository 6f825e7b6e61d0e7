"""Materials of glTF: factors as written, the extensions that matter, and what is said of the rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mesh_files import SQUARE, Gltf, load, own_materials, pbr, read_square

from ncv_cl.scene.textures.surface import surface_at

OPAQUE = "materials that let light through are drawn opaque: 1 (w)"
EMITS = "materials that emit, which light the scene: 1 (w)"


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
    found, said = read_square(tmp_path, material)
    assert said == [] and found.name == "a.gltf:w"
    assert np.allclose(found.albedo, albedo, rtol=1e-5)
    assert np.allclose(found.reflectance, reflectance, rtol=1e-5)
    assert found.roughness == pytest.approx(roughness) and not found.emission.any()


def test_emission_has_a_strength(tmp_path: Path) -> None:
    strong = {"extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 20}}}
    found, said = read_square(tmp_path, {"emissiveFactor": [1, 0.5, 0]} | strong)
    assert found.emission.tolist() == [20, 10, 0] and said == [EMITS]
    found, said = read_square(tmp_path, strong)
    assert not found.emission.any() and said == []


@pytest.mark.parametrize(
    ("material", "sentences"),
    [
        (pbr(baseColorFactor=[1, 1, 1, 0.5]) | {"alphaMode": "BLEND"}, [OPAQUE]),
        (pbr(baseColorFactor=[1, 1, 1, 0.5]) | {"alphaMode": "MASK"}, [OPAQUE]),
        ({"alphaMode": "BLEND"}, []),
        ({"occlusionTexture": {"index": 0}}, ["occlusion textures are not read: 1 (w)"]),
        ({"extensions": {"KHR_materials_sheen": {}, "KHR_materials_clearcoat": {}}},
         [f"KHR_materials_{lobe} is not read: 1 (w)" for lobe in ("sheen", "clearcoat")]),
        ({"extensions": {"KHR_materials_unlit": {}}}, ["KHR_materials_unlit is not read: 1 (w)"]),
        (pbr(baseColorFactor=[2, 1, 1, 1]),
         ["materials with colours outside [0, 1], which are clamped: 1 (w)"]),
    ],
)  # fmt: skip
def test_what_is_left_out_is_said(tmp_path: Path, material: dict, sentences: list[str]) -> None:
    _, said = read_square(tmp_path, material)
    assert said == sentences
    assert load(tmp_path, "a.gltf").warnings == ()


def test_looks_may_be_required(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.tree["extensionsRequired"] = ["KHR_materials_unlit", "KHR_texture_transform"]
    _, said = read_square(tmp_path, {"extensions": {"KHR_materials_unlit": {}}}, gltf)
    assert said == ["KHR_materials_unlit is not read: 1 (w)"]


@pytest.mark.parametrize(
    ("kind", "half", "channels"), [("f4", 0.5, 4), ("f4", 0.5, 3), ("u1", 128, 4), ("u2", 32768, 3)]
)
def test_colours_of_vertices_multiply_the_base_colour(
    tmp_path: Path, kind: str, half: float, channels: int
) -> None:
    gltf = Gltf()
    colours = gltf.accessor(np.full((4, channels), half, kind), normalized=kind != "f4")
    table = pbr(baseColorFactor=[0.8, 0.2, 0.2, 1], metallicFactor=0)
    found, said = read_square(tmp_path, table, gltf, COLOR_0=colours)
    assert np.allclose(found.albedo, [0.4, 0.1, 0.1], rtol=5e-3) and said == []
    # Of a metal they are its reflectance.
    gltf = Gltf()
    colours = gltf.accessor(np.full((4, channels), half, kind), normalized=kind != "f4")
    found, _ = read_square(tmp_path, pbr(), gltf, COLOR_0=colours)
    assert not found.albedo.any() and np.allclose(found.reflectance, 0.5, rtol=5e-3)


@pytest.mark.parametrize("metallic", [None, 0, 0.25])
def test_colours_that_vary_multiply_the_base_colour(tmp_path: Path, metallic: float | None) -> None:
    material = None if metallic is None else pbr(metallicFactor=metallic, baseColorFactor=[0.5] * 4)
    gltf = Gltf()
    rows = np.float32([(0, 0, 0), (0.5,) * 3, (1, 0.5, 0), (0.5,) * 3])
    _, said = read_square(tmp_path, material, gltf, COLOR_0=gltf.accessor(rows))
    scene = load(tmp_path, "a.gltf", "")
    assert said == [] and (scene.vertex_colours == rows).all() and scene.vertex_uv is None
    found = surface_at(scene, np.array([0]), np.array([0.25]), np.array([0.5]))
    base = np.array([0.625, 0.375, 0.125]) * (1 if metallic is None else 0.5)
    assert np.allclose(found.albedo, base * (1 - (metallic or 0)))
    reflectance = 0 if metallic is None else 0.04 * (1 - metallic) + base * metallic
    assert np.allclose(found.reflectance, reflectance)
    # A material of the scene has no colours of a file.
    assert load(tmp_path, "a.gltf").vertex_colours is None


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
    found, said = read_square(tmp_path, None)
    assert found.albedo.tolist() == [0.5] * 3 and not found.reflectance.any()
    (sentence,) = said
    assert sentence.startswith("no material could be read")
