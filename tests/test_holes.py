"""Holes that textures make: for the camera, shadows, occlusion and paths alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mesh_files import write_image
from reference import camera_at, intersect, light_at

import ncv_cl as ncv
from ncv_cl import GlobalIllumination, Material, QuadLight, SceneError, Texture, TriangleMesh
from ncv_cl.points.trace import Tracer
from ncv_cl.scene.textures.holes import Holes
from ncv_cl.scene.textures.texture import Maps

CAMERA = camera_at([0.3, 2.5, 3], [0, 0.3, 0], 45)
LIGHT = light_at([-0.4, 2.4, -0.4], [0.8, 0, 0], [0, 0, 0.8], (9, 8, 7))
LAMP = QuadLight(LIGHT.corner, LIGHT.edge1, LIGHT.edge2, LIGHT.radiance)
TWO = [[0, 1, 2], [0, 2, 3]]
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
# Rows from below; True is a hole.
PATTERN = np.random.default_rng(8).random((5, 6)) < 0.5
FLOOR = ([-2, 0, 2], [4, 0, 0], [0, 0, -4])
SHEETS = [
    ([-1, 0.7, 1], [2, 0.1, 0], [0, 0.1, -2]),
    ([-1, 1.1, 1], [2, 0, 0.2], [0, -0.1, -2]),
    ([-1, 0.2, -1.2], [2, 0, 0], [0, 1.6, 0]),
]


def corners_of(corner, edge1, edge2):
    corner, edge1, edge2 = (np.asarray(vector, float) for vector in (corner, edge1, edge2))
    return np.stack([corner + u * edge1 + v * edge2 for u, v in SQUARE])


def opacity(scale=1.0, nearest=True):
    image = np.ones((*PATTERN.shape, 4))
    image[..., 3] = np.where(PATTERN[::-1], 0.0, scale)
    return Texture.of(image, nearest=nearest)


def with_holes(scale=1.0, cutoff=0.5, nearest=True):
    """Sheets above a floor, with holes by a texture."""
    maps = Maps(opacity=opacity(scale, nearest), cutoff=cutoff)
    sheet = Material(albedo=(0.8, 0.6, 0.4), maps=maps)
    meshes = [TriangleMesh(corners_of(*FLOOR), TWO, "floor")]
    meshes += [TriangleMesh(corners_of(*one), TWO, "sheet", uv=SQUARE) for one in SHEETS]
    return ncv.build_scene(CAMERA, {"floor": Material(0.7), "sheet": sheet}, meshes, [LAMP])


def in_parts():
    """The same of small sheets, where there is no hole."""
    meshes = [TriangleMesh(corners_of(*FLOOR), TWO, "floor")]
    rows, columns = PATTERN.shape
    for corner, edge1, edge2 in SHEETS:
        edge1, edge2 = np.asarray(edge1, float), np.asarray(edge2, float)
        for row, column in np.argwhere(~PATTERN):
            start = corner + column / columns * edge1 + row / rows * edge2
            meshes.append(TriangleMesh(corners_of(start, edge1 / columns, edge2 / rows), TWO, "sheet"))
    materials = {"floor": Material(0.7), "sheet": Material((0.8, 0.6, 0.4))}
    return ncv.build_scene(CAMERA, materials, meshes, [LAMP])


def rays(count):
    """Rays through the sheets, from above and below and from between."""
    generator = np.random.default_rng(4)
    origins = generator.uniform([-1, 0.1, -1], [1, 2.3, 1], (count, 3)).astype(np.float32)
    return origins, generator.normal(size=(count, 3)).astype(np.float32)


def test_a_hit_is_in_a_hole_where_the_opacity_is_small():
    scene = with_holes()
    uv = np.random.default_rng(1).random((200, 2))
    lower = uv[:, 0] >= uv[:, 1]
    u = np.where(lower, uv[:, 0] - uv[:, 1], uv[:, 0])
    v = np.where(lower, uv[:, 1], uv[:, 1] - uv[:, 0])
    triangle = np.where(lower, 2, 3)
    expected = PATTERN[(uv[:, 1] * 5).astype(int), (uv[:, 0] * 6).astype(int)]
    assert (Holes(scene).at(triangle, u, v) == expected).all()
    assert (
        not Holes(scene).at(triangle - 2, u, v).any()
        and not Holes(scene).at(triangle * 0 - 1, u, v).any()
    )
    assert not Holes(with_holes(0.4, 0.3)).at(triangle, u, v)[~expected].any()
    assert Holes(with_holes(0.4, 0.5)).at(triangle, u, v).all()


def test_rays_pass_holes_as_if_there_were_nothing(one_device):
    origins, directions = rays(20000)
    found = Tracer(with_holes(), threads=2).closest(origins, directions)
    expected = Tracer(in_parts(), threads=2).closest(origins, directions)
    # A few rays graze the border of a hole.
    same = np.isclose(found.distance, expected.distance, rtol=1e-4) | (
        (found.triangle < 0) & (expected.triangle < 0)
    )
    assert same.mean() > 0.9995
    assert ((found.triangle < 0) == (expected.triangle < 0)).mean() > 0.9995
    position = origins + found.distance[:, None] * directions
    hit = found.triangle >= 0
    scene = with_holes()
    corners = scene.vertices[scene.triangles[found.triangle[hit]]]
    share = np.stack([1 - found.u - found.v, found.u, found.v], 1)[hit]
    np.testing.assert_allclose(position[hit], np.einsum("ij,ijk->ik", share, corners), atol=1e-4)


def test_shadows_end_at_their_lights(one_device):
    origins, directions = rays(20000)
    lengths = np.random.default_rng(5).uniform(0.05, 1.5, len(origins)).astype(np.float32)
    answers = []
    for scene in (with_holes(), in_parts()):
        out = np.empty(len(origins), np.uint8)
        Tracer(scene, threads=2).visible(origins, directions, lengths, out)
        answers.append(out)
    assert (answers[0] == answers[1]).mean() > 0.9995 and 0.2 < answers[0].mean() < 0.9
    # And what the brute force of the tests says.
    _, _, _, distance = intersect(in_parts(), origins[:2000], directions[:2000])
    assert ((distance > lengths[:2000]) == answers[0][:2000]).mean() > 0.999


def test_many_sheets_in_one_place_are_passed(one_device):
    """All rays pass a hundred sheets with nothing but holes, and hit the floor at its distance."""
    nothing = Material(0.5, maps=Maps(opacity=Texture.of(np.zeros((1, 1, 4)))))
    meshes = [TriangleMesh(corners_of(*FLOOR), TWO, "floor")]
    heights = 1 + np.repeat(np.arange(50) * 1e-6, 2)
    meshes += [
        TriangleMesh(corners_of([-2, y, 2], *FLOOR[1:]), TWO, "sheet", uv=SQUARE) for y in heights
    ]
    scene = ncv.build_scene(CAMERA, {"floor": Material(0.7), "sheet": nothing}, meshes, [LAMP])
    origins = np.array([[x, 2, z] for x in (-0.9, 0.1, 0.8) for z in (-0.7, 0.3)], np.float32)
    towards = np.tile(np.float32([0.01, -2.0, 0.02]), (6, 1))
    found = Tracer(scene).closest(origins, towards)
    assert (found.triangle < 2).all()
    np.testing.assert_allclose(found.distance, 1.0, rtol=1e-5)


def test_a_wall_close_behind_a_hole_is_hit(one_device):
    """Rays go on as little behind a hole as rounding allows: a picture on a wall is no leak."""
    nothing = Material(0.5, maps=Maps(opacity=Texture.of(np.zeros((1, 1, 4)))))
    meshes = [TriangleMesh(corners_of([-2, y, 2], *FLOOR[1:]), TWO, "floor") for y in (1, 0)]
    meshes.append(TriangleMesh(corners_of([-2, 1 + 4e-6, 2], *FLOOR[1:]), TWO, "sheet", uv=SQUARE))
    scene = ncv.build_scene(CAMERA, {"floor": Material(0.7), "sheet": nothing}, meshes, [LAMP])
    generator = np.random.default_rng(3)
    origins = generator.uniform([-0.5, 1.2, -0.5], [0.5, 2.3, 0.5], (4000, 3)).astype(np.float32)
    targets = generator.uniform([-0.9, 1, -0.9], [0.9, 1, 0.9], (4000, 3)).astype(np.float32)
    found = Tracer(scene).closest(origins, targets - origins)
    assert (found.triangle < 2).all()
    np.testing.assert_allclose(found.distance, 1, rtol=2e-6)


@pytest.mark.parametrize("integrand", ["ao", "direct", GlobalIllumination(4)])
def test_holes_are_as_good_as_small_sheets(device, integrand):
    options = {"method": "mc", "sampler": "independent", "spp": 512, "size": (16, 12), "device": device}
    first = ncv.render(with_holes(), integrand, seed=1, **options)
    second = ncv.render(in_parts(), integrand, seed=2, **options)
    same = np.isclose(first.layers["depth"], second.layers["depth"], atol=1e-3)
    assert same.mean() > 0.98
    variance = first.variance + second.variance
    known = same & (variance > 1e-10).all(axis=2)
    z = ((first.pixels - second.pixels) / np.sqrt(variance + 1e-12))[known]
    assert z.size > 200 and np.mean(z**2) < 1 + 5 * np.sqrt(2 / (z.size / 3)) and np.abs(z).max() < 5.5
    # The light that passes is seen: whole sheets give another picture.
    whole = replace(
        with_holes(),
        materials=tuple(replace(one, maps=None) for one in with_holes().materials),
        vertex_uv=None,
    )
    third = ncv.render(whole, integrand, seed=3, **options)
    assert not np.allclose(third.pixels.mean(), first.pixels.mean(), rtol=0.02)


def test_both_methods_and_any_visibility_see_the_same_holes(one_device):
    options = {"size": (12, 9), "device": one_device, "sampler": "independent"}
    plain = ncv.render(with_holes(), "direct", "mc", spp=1024, seed=1, **options)
    for more in ({"method": "ncv", "train_spp": 16}, {"method": "mc", "visibility": "points"},
                 {"method": "mc", "visibility": "embree"}):  # fmt: skip
        other = ncv.render(with_holes(), "direct", spp=512, seed=2, **more, **options)
        z = (plain.pixels - other.pixels) / np.sqrt(plain.variance + other.variance + 1e-12)
        assert np.mean(z**2) < 2, more
    for integrand in ("ao", "direct"):
        with pytest.raises(ValueError, match="visibility 'lines' takes triangles for whole"):
            ncv.render(with_holes(), integrand, visibility="lines", **options)


SCENE = """
[camera]
position = [0, 0, 4]
target = [0, 0, 0]
vertical_fov = 28.072487
[materials.leaf]
albedo = 0.5
opacity = { file = "leaf.png", filter = "nearest" }
[materials.back]
albedo = [0, 1, 0]
[[quads]]
corner = [-1, -1, 0]
edge1 = [2, 0, 0]
edge2 = [0, 2, 0]
material = "leaf"
[[quads]]
corner = [-9, -9, -1]
edge1 = [18, 0, 0]
edge2 = [0, 18, 0]
material = "back"
"""


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_a_scene_file_may_give_an_opacity(tmp_path, one_device, channels):
    """It is an image's alpha, and of an image without alpha its red."""
    pixels = np.full((4, 4, channels), 200, np.uint8)
    pixels[..., -1 if channels in (2, 4) else 0] = np.where(np.eye(4) > 0, 127, 128)
    write_image(tmp_path / "leaf.png", pixels)
    (tmp_path / "x.toml").write_text(SCENE)
    image = ncv.render(tmp_path / "x.toml", "ao", "mc", spp=1, size=(4, 4), device=one_device)
    np.testing.assert_allclose(image.layers["albedo"][np.eye(4) > 0], [[0, 1, 0]] * 4)
    np.testing.assert_allclose(image.layers["albedo"][np.eye(4) == 0], 0.5)


@pytest.mark.parametrize(
    "text, said",
    [('{ file = "leaf.png", factor = 0.5 }', "opacity.factor: opacity has none"),
     ('{ file = "leaf.png", encoding = "srgb" }', "opacity.encoding: opacity has none"),
     ("0.5", r"opacity: expected a table \{ file")],
)  # fmt: skip
def test_an_opacity_that_is_no_image_is_refused(tmp_path, text, said):
    write_image(tmp_path / "leaf.png", np.zeros((1, 1, 1), np.uint8))
    (tmp_path / "x.toml").write_text(SCENE.replace('{ file = "leaf.png", filter = "nearest" }', text))
    with pytest.raises(SceneError, match=said):
        ncv.load_scene(tmp_path / "x.toml")


def test_scenes_without_holes_ask_nothing(one_device):
    assert not in_parts().has_holes and Tracer(in_parts(), threads=1)._holes is None
    assert with_holes().has_holes
