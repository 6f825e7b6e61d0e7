"""Glass in scene files, in Python and in mesh files: what is read, refused and said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mesh_files import obj_text, own_materials, pbr, read_square

import ncv_cl as ncv
from ncv_cl import Material, SceneError
from ncv_cl.scene.about import describe

SCENE = """
[camera]
position = [0, 1, 3]
target = [0, 0, 0]
vertical_fov = 40
[materials.window]
{keys}
[[quads]]
corner = [-1, -1, 0]
edge1 = [2, 0, 0]
edge2 = [0, 2, 0]
material = "window"
"""
TRIANGLE = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
OPAQUE = "materials that let light through are drawn opaque: 1 (m)"


def scene_of(folder: Path, keys: str) -> ncv.Scene:
    (folder / "scene.toml").write_text(SCENE.format(keys=keys), encoding="utf-8")
    return ncv.load_scene(folder / "scene.toml")


@pytest.mark.parametrize(
    ("keys", "transmission", "ior", "roughness", "thin"),
    [
        ("transmission = 1", 1, 1.5, 0.01, False),
        ("transmission = [0.9, 0.5, 0]\nior = 1.33", (0.9, 0.5, 0), 1.33, 0.01, False),
        ("transmission = 0.8\nthin = true\nalbedo = 0", 0.8, 1.5, 0.01, True),
        ("transmission = 1\nroughness = 0.4\nthin = false", 1, 1.5, 0.4, False),
    ],
)
def test_what_a_table_says(tmp_path, keys, transmission, ior, roughness, thin):
    scene = scene_of(tmp_path, keys)
    (material,) = scene.materials
    assert material.is_glass and material.has_lobe and scene.has_glass and scene.has_panes == thin
    np.testing.assert_allclose(material.transmission, np.broadcast_to(transmission, 3), rtol=1e-6)
    assert (material.ior, material.roughness, material.thin) == (ior, roughness, thin)
    assert material.signed_ior == (-ior if thin else ior)
    np.testing.assert_allclose(material.facing, ((ior - 1) / (ior + 1)) ** 2, rtol=1e-6)
    # The same in Python, with what is left out left to its defaults.
    given = {"roughness": roughness} if roughness != 0.01 else {}
    given |= {"ior": ior} if ior != 1.5 else {}
    corners = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    mesh = ncv.TriangleMesh(np.array(corners, float), [[0, 1, 2], [0, 2, 3]], "window")
    window = Material(0, transmission=transmission, thin=thin, **given)
    built = ncv.build_scene(scene.camera, {"window": window}, [mesh])
    assert built.digest == scene.digest


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("albedo = 0.5\nior = 1.5", r"materials.window.ior: has no effect without transmission"),
        ("albedo = 0.5\nthin = true", r"materials.window.thin: has no effect without transmission"),
        ("transmission = 1\nalbedo = 0.1", r"materials.window.albedo: glass has none"),
        ("transmission = 1\nreflectance = 0.1", r"materials.window.reflectance: glass has none"),
        ("transmission = 1.5", r"transmission: 1.5 is out of range"),
        ("transmission = 1\nior = 0.1", r"ior: 0.1 is out of range; it must be from 0.2 to 5"),
        ("transmission = 1\nthin = true\nroughness = 0.2", r"roughness: a thin pane is smooth"),
        ("transmission = 1\nthin = 1", r"thin: expected true or false"),
        ("ior = 1.5", r"ior: has no effect without transmission"),
        ("", r"albedo: is missing"),
    ],
)
def test_what_is_refused(tmp_path, keys, message):
    with pytest.raises(SceneError, match=message):
        scene_of(tmp_path, keys)


def test_glass_takes_no_image_of_colour(tmp_path):
    texture = ncv.Texture.of(np.full((2, 2, 3), 0.5))
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0]], float)
    mesh = ncv.TriangleMesh(corners, [[0, 1, 2]], "window", uv=np.eye(3)[:, :2])
    camera = ncv.Camera((0, 0, 3), (0, 0, 0), 40)
    with pytest.raises(SceneError, match=r"albedo: glass takes no image"):
        ncv.build_scene(camera, {"window": Material(texture, transmission=1)}, [mesh])
    with pytest.raises(SceneError, match="transmission: expected a number"):
        ncv.build_scene(camera, {"window": Material(0, transmission="red")}, [mesh])


def test_scenes_without_glass_keep_their_digest_and_others_differ(tmp_path):
    """Checkpoints of earlier versions go on."""
    opaque = scene_of(tmp_path, "albedo = 0.5").digest
    assert opaque == scene_of(tmp_path, "albedo = 0.5\nthin = false\ntransmission = 0").digest
    digests = {
        scene_of(tmp_path, f"transmission = 1\n{keys}").digest
        for keys in ("", "ior = 1.4", "thin = true", "roughness = 0.1")
    }
    assert len(digests) == 4


def test_info_says_what_glass_is(tmp_path):
    scene_of(tmp_path, "transmission = [1, 0.5, 0.5]\nior = 1.33")
    assert "window: glass, transmission (1, 0.5, 0.5), ior 1.33" in describe(tmp_path / "scene.toml")
    scene_of(tmp_path, "transmission = 1\nthin = true")
    assert "window: thin glass, transmission 1, ior 1.5" in describe(tmp_path / "scene.toml")


# ------------------------------------------------------------------------------------- mesh files


def of_library(folder: Path, text: str) -> tuple[Material, list[str]]:
    (folder / "m.mtl").write_text(f"newmtl m\n{text}\n")
    (folder / "m.obj").write_text("mtllib m.mtl\nusemtl m\n" + obj_text([TRIANGLE]))
    (material,), said = own_materials(folder, "m.obj")
    return material, said


@pytest.mark.parametrize(
    ("text", "transmission", "ior", "thin"),
    [
        ("illum 7\nNi 1.33", 1, 1.33, False),
        ("illum 7\nKd 0.4\nKs 1 1 1\nNs 500\nTf 0.9 0.8 0.7", (0.9, 0.8, 0.7), 1.5, False),
        ("illum 6\nd 0.1\nNi 1.45", 1, 1.45, False),
        ("illum 9\nd 0.1\nNi 1.45", 1, 1.45, False),
        ("illum 9\nd 0.5", 1, 1.5, True),
        ("illum 4\nTf 0.5", 0.5, 1.5, True),
        ("illum 4\nTr 0.5\nNi 1", 1, 1.5, True),
    ],
)
def test_models_of_mtl_that_let_light_through(tmp_path, text, transmission, ior, thin):
    material, said = of_library(tmp_path, f"Kd 0.2\n{text}")
    assert said == [] and material.is_glass
    assert not material.albedo.any() and not material.reflectance.any()
    np.testing.assert_allclose(material.transmission, np.broadcast_to(transmission, 3), rtol=1e-6)
    assert (material.ior, material.thin, material.roughness) == (ior, thin, 0.01)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        # As one exporter writes all materials.
        ("illum 4\nTf 1 1 1\nNi 1.0", [OPAQUE]),
        ("illum 7\nTf 0 0 0", [OPAQUE]),
        ("illum 2\nd 0.5\nNi 1.5\nTf 0.5", [OPAQUE]),
        ("illum 5\nTf 0.5\nNi 1.5", []),
    ],
)
def test_models_of_mtl_that_are_opaque(tmp_path, text, said):
    material, found = of_library(tmp_path, f"Kd 0.2\n{text}")
    assert not material.is_glass and np.allclose(material.albedo, 0.2) and found == said


def test_rough_glass_of_mtl(tmp_path):
    material, said = of_library(tmp_path, "Kd 0.2\nillum 7\nPr 0.3")
    assert material.roughness == pytest.approx(0.3) and said == []
    material, said = of_library(tmp_path, "Kd 0.2\nillum 4\nTf 0.5\nPr 0.3")
    assert material.roughness == 0.01 and said == ["rough panes are drawn smooth: 1 (m)"]
    material, said = of_library(tmp_path, "Kd 0.2\nillum 7\nNi 20")
    assert material.ior == 5 and said == [
        "indices of refraction outside [0.2, 5], which are clamped: 1 (m)"
    ]


def transmitting(factor=1.0, base=(0.9, 0.8, 0.7, 1), roughness=0.0, metallic=0.0, **extensions):
    table = pbr(baseColorFactor=list(base), metallicFactor=metallic, roughnessFactor=roughness)
    own = {"KHR_materials_transmission": {"transmissionFactor": factor}, **extensions}
    return table | {"extensions": own}


VOLUME = {"KHR_materials_volume": {"thicknessFactor": 0.2}}
PART = "materials of which a part lets light through: glass from a half on, else opaque: 1 (w)"


@pytest.mark.parametrize(
    ("material", "transmission", "ior", "roughness", "thin", "said"),
    [
        (transmitting(), (0.9, 0.8, 0.7), 1.5, 0.01, True, []),
        (transmitting(**VOLUME), (0.9, 0.8, 0.7), 1.5, 0.01, False, []),
        (
            transmitting(roughness=0.4, **VOLUME, KHR_materials_ior={"ior": 1.33}),
            (0.9, 0.8, 0.7), 1.33, 0.4, False, [],
        ),
        (
            transmitting(roughness=0.4), (0.9, 0.8, 0.7), 1.5, 0.01, True,
            ["rough panes are drawn smooth: 1 (w)"],
        ),
        (transmitting(0.5), (0.45, 0.4, 0.35), 1.5, 0.01, True, [PART]),
        (
            transmitting(KHR_materials_volume={"thicknessFactor": 1, "attenuationDistance": 2}),
            (0.9, 0.8, 0.7), 1.5, 0.01, False, ["absorption inside of glass is not read: 1 (w)"],
        ),
    ],
)  # fmt: skip
def test_transmission_of_gltf(tmp_path, material, transmission, ior, roughness, thin, said):
    found, sentences = read_square(tmp_path, material)
    assert sentences == said and found.is_glass and not found.albedo.any()
    np.testing.assert_allclose(found.transmission, transmission, rtol=1e-6)
    assert (found.ior, found.thin) == (pytest.approx(ior), thin)
    assert found.roughness == pytest.approx(roughness)


@pytest.mark.parametrize(
    ("material", "said"),
    [
        (transmitting(0.0), []),
        (transmitting(0.4), [PART]),
        (transmitting(metallic=1.0), []),
        (transmitting(base=(0, 0, 0, 1)), []),
    ],
)
def test_gltf_that_stays_opaque(tmp_path, material, said):
    found, sentences = read_square(tmp_path, material)
    assert not found.is_glass and sentences == said
