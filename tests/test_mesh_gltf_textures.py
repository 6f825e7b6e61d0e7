"""Textures of glTF: where their images are, how they lie, and what of a material they are."""

from __future__ import annotations

import base64
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mesh_files import Gltf, load, pbr, png_bytes, read_square, write_image
from reference import intersect

from ncv_cl.scene.load import SceneError
from ncv_cl.scene.textures.surface import surface_at

# sRGB (128, 32, 32), in linear light. Texels are halves, so within 2^-11 of that.
BROWN = np.array([0.21586, 0.014444, 0.014444])
OPAQUE = "materials that let light through are drawn opaque: 1 (w)"
HALF_OPAQUE = "materials that blend are opaque, with holes where their opacity is below a half: 1 (w)"
EMITS = "materials that emit, which light the scene: 1 (w)"
OTHERS = "textures that are not placed as the colour is, their mean colour stands for them: "
NO_METAL = (
    "textures of metal that are missing or cannot be read, the surface is no metal: "
    "1 (metallicRoughnessTexture of w)"
)
UV = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], np.float32)


def image(pixels: list[list[tuple[int, int, int]]], folder: Path) -> dict[str, str]:
    """An image inside a file; the uppermost row first."""
    write_image(folder / "x.png", np.array(pixels, np.uint8))
    return {"uri": "data:image/png;base64," + base64.b64encode((folder / "x.png").read_bytes()).decode()}


def with_coordinates(*images: dict[str, str], uv: np.ndarray = UV) -> tuple[Gltf, dict[str, int]]:
    """A file with these images and textures of them, and the attribute of texture coordinates."""
    gltf = Gltf()
    gltf.tree["images"] = list(images)
    gltf.tree["textures"] = [{"source": i} for i in range(len(images))]
    return gltf, {"TEXCOORD_0": gltf.accessor(uv)}


@pytest.mark.parametrize("place", ["file", "view", "data", "webp"])
def test_a_texture_of_the_base_colour_is_read(tmp_path: Path, place: str) -> None:
    content = png_bytes(128, 32, 32)
    source = {"uri": "data:image/png;base64," + base64.b64encode(content).decode()}
    gltf, attributes = with_coordinates(source)
    if place == "view":
        gltf.tree["images"] = [{"bufferView": gltf.view(content), "mimeType": "image/png"}]
    elif place != "data":
        (tmp_path / "my image.png").write_bytes(content)
        gltf.tree["images"] = [{"uri": "my%20image.png"}]
    if place == "webp":
        gltf.tree["textures"] = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
    table = {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 0.5, 1, 1], "metallicFactor": 0}
    found, said = read_square(tmp_path, pbr(**table), gltf, **attributes)
    assert said == [] and np.allclose(found.albedo, [1, 0.5, 1])
    assert np.allclose(found.maps.colour.texels[0, 0], [*BROWN, 1], rtol=2**-11)
    assert found.maps.metallic == 0 and found.maps.colour.wrap == ("repeat", "repeat")


def test_the_first_row_of_an_image_is_where_v_is_zero(tmp_path: Path) -> None:
    rows = [[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (255, 255, 255)]]
    gltf, attributes = with_coordinates(image(rows, tmp_path))
    read_square(tmp_path, pbr(baseColorTexture={"index": 0}), gltf, **attributes)
    scene = load(tmp_path, "a.gltf", "")
    centres = np.array([[0.5, 1.5, 0], [1.5, 1.5, 0], [0.5, 0.5, 0], [1.5, 0.5, 0]])
    directions = centres - [1, 1, 5]
    triangle, u, v, _ = intersect(scene, np.broadcast_to([1.0, 1, 5], (4, 3)), directions)
    # Of a metal the texture is the reflectance.
    found = surface_at(scene, triangle, u, v)
    expected = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)]
    np.testing.assert_allclose(found.reflectance, expected, atol=1e-6)
    assert not found.albedo.any()


def test_samplers_say_how_an_image_goes_on(tmp_path: Path) -> None:
    gltf, attributes = with_coordinates(image([[(1, 2, 3)]], tmp_path))
    gltf.tree["samplers"] = [{"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}]
    gltf.tree["textures"][0]["sampler"] = 0
    found, _ = read_square(tmp_path, pbr(baseColorTexture={"index": 0}), gltf, **attributes)
    assert found.maps.colour.wrap == ("clamp", "mirror") and found.maps.colour.nearest


@pytest.mark.parametrize(
    ("transform", "moved"),
    [
        ({"offset": [0.25, 0.5]}, lambda u, v: (u + 0.25, v + 0.5)),
        ({"scale": [2, 3]}, lambda u, v: (2 * u, 3 * v)),
        # Counter-clockwise as seen, where v goes downwards.
        ({"rotation": np.pi / 2}, lambda u, v: (v, -u)),
        (
            {"rotation": np.pi / 2, "scale": [2, 3], "offset": [0.1, 0]},
            lambda u, v: (3 * v + 0.1, -2 * u),
        ),
    ],
)
def test_texture_transforms(tmp_path: Path, transform: dict, moved: Callable) -> None:
    gltf, attributes = with_coordinates(image([[(1, 2, 3)]], tmp_path))
    gltf.tree["samplers"] = [{"wrapS": 33071, "wrapT": 33071}]
    gltf.tree["textures"][0]["sampler"] = 0
    texture = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    _, said = read_square(tmp_path, pbr(baseColorTexture=texture), gltf, **attributes)
    scene = load(tmp_path, "a.gltf", "")
    expected = np.stack(moved(UV[:, 0], UV[:, 1]), axis=1)
    assert said == []
    np.testing.assert_allclose(
        scene.vertex_uv, np.stack([expected[:, 0], 1 - expected[:, 1]], 1), atol=1e-6
    )


@pytest.mark.parametrize("of_transform", [False, True])
def test_a_texture_may_take_other_coordinates(tmp_path: Path, of_transform: bool) -> None:
    gltf, attributes = with_coordinates(image([[(1, 2, 3)]], tmp_path), uv=UV * 0)
    attributes["TEXCOORD_1"] = gltf.accessor((UV * 255).astype(np.uint8), normalized=True)
    texture = {"index": 0, "texCoord": 1}
    if of_transform:
        texture = {"index": 0, "extensions": {"KHR_texture_transform": {"texCoord": 1}}}
    read_square(tmp_path, pbr(baseColorTexture=texture), gltf, **attributes)
    scene = load(tmp_path, "a.gltf", "")
    np.testing.assert_allclose(scene.vertex_uv, np.stack([UV[:, 0], 1 - UV[:, 1]], 1), atol=1e-6)
    own = gltf.tree["meshes"][0]["primitives"][0]["attributes"]
    own["TEXCOORD_1"] = own["POSITION"]
    gltf.write(tmp_path / "a.gltf")
    with pytest.raises(SceneError, match=r"TEXCOORD_1 is \(4, 3\), not \(4, 2\)"):
        load(tmp_path, "a.gltf", "")


def test_a_mesh_without_coordinates_gets_the_mean_of_its_textures(tmp_path: Path) -> None:
    gltf, _ = with_coordinates(image([[(0, 255, 51)], [(255, 255, 51)]], tmp_path))
    table = {key: {"index": 0} for key in ("baseColorTexture", "metallicRoughnessTexture")}
    found, said = read_square(tmp_path, pbr(**table, metallicFactor=0.5, roughnessFactor=0.8), gltf)
    assert said == ["textures of meshes without texture coordinates, their mean stands for them: 1 (w)"]
    assert found.textures == () and found.maps.metallic == pytest.approx(0.1, rel=2**-11)
    assert found.roughness == pytest.approx(0.8)
    blue = ((0.2 + 0.055) / 1.055) ** 2.4
    assert np.allclose(found.albedo, [0.5, 1, blue], rtol=2**-11)


def test_a_texture_of_metal_and_roughness_is_linear(tmp_path: Path) -> None:
    gltf, attributes = with_coordinates(image([[(7, 102, 51)]], tmp_path))
    table = {"metallicRoughnessTexture": {"index": 0}, "metallicFactor": 0.5, "roughnessFactor": 0.5}
    found, said = read_square(
        tmp_path, pbr(**table, baseColorFactor=[0.8, 0.6, 0.4, 1]), gltf, **attributes
    )
    assert said == [] and found.maps.metallic == 0.5 and found.roughness == 0.5
    assert np.allclose(found.maps.surface.texels[0, 0, 1:3], [0.4, 0.2], rtol=2**-11)
    surface = surface_at(load(tmp_path, "a.gltf", ""), np.array([0]), np.array([0.2]), np.array([0.3]))
    base = np.array([0.8, 0.6, 0.4])
    assert np.allclose(surface.albedo, 0.9 * base, rtol=1e-3) and np.allclose(
        surface.roughness, 0.2, rtol=1e-3
    )
    assert np.allclose(surface.reflectance, 0.9 * 0.04 + 0.1 * base, rtol=1e-3)


def test_a_texture_of_metal_that_lies_otherwise_is_left_out(tmp_path: Path) -> None:
    gltf, attributes = with_coordinates(image([[(255, 255, 255)]], tmp_path))
    turned = {"index": 0, "extensions": {"KHR_texture_transform": {"rotation": 1}}}
    table = {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": turned}
    found, said = read_square(tmp_path, pbr(**table), gltf, **attributes)
    assert found.maps.surface is None and found.maps.metallic == 0
    assert said == [
        "textures of metal that are not placed as the colour is, the surface is no metal: 1 (w)"
    ]


def test_textures_that_are_missing_and_those_of_metal(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.tree |= {"textures": [{"source": 0}], "images": [{"uri": "none.png"}]}
    textures = {key: {"index": 0} for key in ("baseColorTexture", "metallicRoughnessTexture")}
    found, said = read_square(tmp_path, pbr(**textures, roughnessFactor=0.5), gltf)
    # No metal, and not the white that the factors alone would give.
    assert np.allclose(found.albedo, 0.5) and np.allclose(found.reflectance, 0.04)
    assert found.roughness == 0.5
    missing = "textures that are missing or cannot be read, in whose place 0.5 stands: "
    assert said == [missing + "1 (baseColorTexture of w)", NO_METAL]


def test_an_emissive_texture_multiplies_the_factor(tmp_path: Path) -> None:
    material = {"emissiveTexture": {"index": 0}, "emissiveFactor": [1, 1, 0.5]}
    material["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 20}}
    gltf, attributes = with_coordinates(image([[(128, 32, 32)]], tmp_path))
    found, said = read_square(tmp_path, material, gltf, **attributes)
    assert found.emission.tolist() == [20, 20, 10] and said == [EMITS]
    assert np.allclose(found.maps.emission.texels[0, 0, :3], BROWN, rtol=2**-11)
    # Where it cannot be shown, the power is that of its mean.
    gltf, _ = with_coordinates(image([[(128, 32, 32)]], tmp_path))
    found, said = read_square(tmp_path, material, gltf)
    assert np.allclose(found.emission, BROWN * [20, 20, 10], rtol=2**-11) and EMITS in said
    assert "textures of meshes without texture coordinates, their mean stands for them: 1 (w)" in said
    turned = {"index": 0, "extensions": {"KHR_texture_transform": {"rotation": 1}}}
    gltf, attributes = with_coordinates(image([[(128, 32, 32)]], tmp_path))
    material |= pbr(baseColorTexture=turned)
    found, said = read_square(tmp_path, material, gltf, **attributes)
    assert np.allclose(found.emission, BROWN * [20, 20, 10], rtol=2**-11)
    assert said == [OTHERS + "1 (emissiveTexture of w)", EMITS]


def test_a_texture_of_normals_is_read(tmp_path: Path) -> None:
    gltf, attributes = with_coordinates(image([[(255, 128, 128)]], tmp_path))
    material = pbr(metallicFactor=0) | {"normalTexture": {"index": 0, "scale": 0.5}}
    found, said = read_square(tmp_path, material, gltf, **attributes)
    assert said == [] and found.maps.normal_scale == 0.5 and found.maps.colour is None
    assert np.allclose(found.maps.normal.texels[0, 0, :3], [1, 128 / 255, 128 / 255], rtol=2**-11)
    assert np.allclose(found.albedo, 1) and found.maps.metallic == 0
    gltf, attributes = with_coordinates(image([[(255, 128, 128)]], tmp_path))
    turned = {"index": 0, "extensions": {"KHR_texture_transform": {"rotation": 1}}}
    material |= pbr(baseColorTexture=turned, metallicFactor=0)
    found, said = read_square(tmp_path, material, gltf, **attributes)
    kind = "textures of normals that are missing or not placed as the colour is, which are left out: "
    assert found.maps.normal is None and said == [kind + "1 (normalTexture of w)"]


def leaf(folder: Path) -> dict[str, str]:
    """An image of two pixels, of alpha 102 and 204."""
    write_image(folder / "leaf.png", np.array([[(9, 99, 9, 102), (9, 99, 9, 204)]], np.uint8))
    content = base64.b64encode((folder / "leaf.png").read_bytes()).decode()
    return {"uri": f"data:image/png;base64,{content}"}


@pytest.mark.parametrize(
    ("material", "cutoff", "sentences"),
    [
        ({"alphaMode": "OPAQUE"}, None, []),
        ({}, None, []),
        ({"alphaMode": "MASK"}, 0.5, []),
        ({"alphaMode": "MASK", "alphaCutoff": 0.7}, 0.7, []),
        # No texel is below.
        ({"alphaMode": "MASK", "alphaCutoff": 0.3}, None, []),
        ({"alphaMode": "BLEND"}, 0.5, [HALF_OPAQUE]),
    ],
)
def test_alpha_of_a_texture_makes_holes(
    tmp_path: Path, material: dict, cutoff: float | None, sentences: list[str]
) -> None:
    gltf, attributes = with_coordinates(leaf(tmp_path))
    table = pbr(baseColorTexture={"index": 0}, metallicFactor=0)
    found, said = read_square(tmp_path, material | table, gltf, **attributes)
    assert said == sentences and (found.maps.opacity is not None) == (cutoff is not None)
    assert load(tmp_path, "a.gltf", "").has_holes == (cutoff is not None)
    if cutoff is not None:
        assert found.maps.cutoff == cutoff and found.maps.opacity is found.maps.colour


def test_the_factor_of_alpha_counts_where_a_material_masks(tmp_path: Path) -> None:
    gltf, attributes = with_coordinates(leaf(tmp_path))
    table = pbr(baseColorTexture={"index": 0}, baseColorFactor=[1, 1, 1, 0.5])
    found, said = read_square(tmp_path, {"alphaMode": "MASK"} | table, gltf, **attributes)
    # 0.5 * alpha < 0.5: all of it is a hole but where alpha is 1.
    assert found.maps.cutoff == 1.0 and said == []
    found, said = read_square(
        tmp_path, {"alphaMode": "BLEND"} | table, *with_coordinates(leaf(tmp_path))[:1]
    )
    assert OPAQUE in said


def test_specular_glossiness_has_a_diffuse_texture(tmp_path: Path) -> None:
    gltf, attributes = with_coordinates(image([[(128, 32, 32)]], tmp_path))
    table = {"diffuseTexture": {"index": 0}, "specularFactor": [0.2, 0.1, 0], "glossinessFactor": 0.7}
    material = {"extensions": {"KHR_materials_pbrSpecularGlossiness": table}}
    found, said = read_square(tmp_path, material, gltf, **attributes)
    assert (
        said == [] and np.allclose(found.albedo, 0.8) and np.allclose(found.reflectance, [0.2, 0.1, 0])
    )
    assert np.allclose(found.maps.colour.texels[0, 0, :3], BROWN, rtol=2**-11)
