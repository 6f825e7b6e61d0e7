"""Polygons of any number of corners as triangles, in memory and through every format of files."""

from __future__ import annotations

import math

import mesh_files
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ncv_cl.scene.meshes.polygons import strip_triangles, triangulate


def cut(*polygons: object) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles (n, 3, 3), owners and crossing ones of polygons with vertices of their own."""
    vertices = np.concatenate([np.asarray(p, dtype=np.float64).reshape(-1, 3) for p in polygons])
    counts = np.array([len(p) for p in polygons])
    triangles, owner, crossing = triangulate(vertices, np.arange(len(vertices)), counts)
    return vertices[triangles], owner, crossing


def star(radii: np.ndarray, turn: float, tilt: np.ndarray) -> np.ndarray:
    """A simple polygon (n, 3), concave where radii vary: corners at equal angles, in a tilted plane."""
    angle = turn + 2.0 * math.pi * np.arange(len(radii)) / len(radii)
    flat = np.stack([radii * np.cos(angle), radii * np.sin(angle)], axis=1)
    axes, _ = np.linalg.qr(tilt.reshape(3, 2))
    return flat @ axes.T


# Radii and tilts without near ties, so that no corner is in doubt.
radii = st.integers(3, 12).flatmap(lambda n: hnp.arrays(np.float64, n, elements=st.floats(0.2, 1.0)))
tilts = hnp.arrays(np.float64, 6, elements=st.floats(-1.0, 1.0, allow_subnormal=False)).filter(
    lambda t: np.linalg.svd(t.reshape(3, 2), compute_uv=False)[1] > 0.1
)
polygons = st.builds(star, radii, st.floats(0.0, 6.3, allow_subnormal=False), tilts)


@given(st.lists(polygons, min_size=1, max_size=6))
@settings(max_examples=150, deadline=None)
def test_triangles_fill_every_simple_polygon(shapes: list[np.ndarray]) -> None:
    triangles, owner, crossing = cut(*shapes)
    assert crossing.size == 0 and np.all(np.diff(owner) >= 0)
    for i, shape in enumerate(shapes):
        expected = mesh_files.polygon_vector_area(shape)
        size = np.linalg.norm(expected)
        areas = mesh_files.vector_areas(triangles[owner == i])
        # All wind as the polygon does, so that none lies beyond the outline if their sum is right.
        assert np.min(areas @ expected) >= -1e-12 * size**2
        assert np.allclose(areas.sum(axis=0), expected, atol=1e-9 * size)


@given(st.lists(polygons, min_size=1, max_size=5))
@settings(max_examples=25, deadline=None)
def test_every_format_gives_the_same_surface(
    tmp_path_factory: pytest.TempPathFactory, shapes: list[np.ndarray]
) -> None:
    # Side by side, in single precision, as files have them.
    placed = [np.float32(p + np.array([3.0 * i, 0.0, 0.0])) for i, p in enumerate(shapes)]
    folder = tmp_path_factory.mktemp("formats")
    (folder / "a.obj").write_text(mesh_files.obj_text(placed))
    for form in ("ascii", "binary_little_endian", "binary_big_endian"):
        (folder / f"{form}.ply").write_bytes(mesh_files.ply_bytes(placed, form))
    gltf = mesh_files.Gltf()
    triangles, _, _ = cut(*placed)
    attributes = {"POSITION": gltf.accessor(np.float32(triangles.reshape(-1, 3)))}
    gltf.tree["meshes"] = [{"primitives": [{"attributes": attributes}]}]
    gltf.write(folder / "a.glb")
    expected = np.array([mesh_files.polygon_vector_area(np.float64(p) - p[0]) for p in placed])
    for path in sorted(folder.iterdir()):
        scene = mesh_files.load(folder, path.name)
        found = mesh_files.corners(scene)
        owner = np.round(found.mean(axis=1)[:, 0] / 3.0).astype(int)
        areas = mesh_files.vector_areas(found)
        sums = np.stack([areas[owner == i].sum(axis=0) for i in range(len(placed))])
        assert np.allclose(sums, expected, atol=2e-6), path.name
        normals = expected / np.linalg.norm(expected, axis=1, keepdims=True)
        assert np.allclose(
            np.linalg.norm(areas, axis=1), np.sum(areas * normals[owner], axis=1), atol=2e-6
        )


def test_a_fan_is_kept_where_it_fills_the_polygon() -> None:
    pentagon = star(np.ones(5), 0.0, np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    triangles, _, _ = triangulate(pentagon, np.arange(5), np.array([5]))
    assert triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]


@pytest.mark.parametrize("first", range(4))
def test_a_concave_quadrilateral_is_cut_at_its_reflex_corner(first: int) -> None:
    dart = np.roll([(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.5, 0.5, 0.0), (0.0, 2.0, 0.0)], first, axis=0)
    triangles, _, crossing = cut(dart)
    assert len(triangles) == 2 and crossing.size == 0
    assert np.allclose(mesh_files.vector_areas(triangles)[:, 2], 0.5)


def test_a_hole_that_a_cut_joins_to_the_outline_stays_open() -> None:
    outer = [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0)]
    inner = [(1, 1), (1, 2), (2, 2), (2, 1), (1, 1)]
    triangles, _, crossing = cut([(x, y, 0.0) for x, y in outer + inner])
    areas = mesh_files.vector_areas(triangles)[:, 2]
    assert crossing.size == 0 and areas.min() > 0.0 and areas.sum() == pytest.approx(8.0)
    centres = triangles.mean(axis=1)[:, :2]
    assert not np.any(np.all((centres > 1.0) & (centres < 2.0), axis=1))


def test_corners_on_a_straight_edge_make_no_empty_triangle() -> None:
    square = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 2, 0), (1, 2, 0), (0, 2, 0)]
    for first in range(6):
        triangles, _, _ = cut(np.roll(np.array(square, float), first, axis=0))
        areas = mesh_files.vector_areas(triangles)[:, 2]
        assert areas.min() > 0.1 and areas.sum() == pytest.approx(4.0)


def test_outlines_that_cross_themselves_are_named_and_keep_their_place_in_the_order() -> None:
    bow = [(0, 0, 0), (2, 2, 0), (2, 0, 0), (0, 2, 0)]
    pentagram = star(np.ones(5), 0.0, np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0]))[[0, 2, 4, 1, 3]]
    fine = [(0, 0, 5), (1, 0, 5), (0, 1, 5)]
    triangles, owner, crossing = cut(fine, bow, fine, pentagram, fine)
    assert crossing.tolist() == [1, 3]
    for i in (0, 2, 4):
        assert np.array_equal(triangles[owner == i][0], fine)
    assert np.all(np.diff(owner) >= 0) and set(owner.tolist()) == {0, 1, 2, 3, 4}


def test_a_far_from_flat_polygon_keeps_all_its_corners() -> None:
    crown = [(1, 0, 0), (0, 1, 3), (-1, 0, 0), (0, -1, 3)]
    triangles, _, _ = cut(crown)
    assert {tuple(p) for p in triangles.reshape(-1, 3).tolist()} == {tuple(map(float, p)) for p in crown}


def test_polygons_of_one_or_two_corners_become_nothing() -> None:
    triangles, owner, crossing = cut(
        [(0, 0, 0)], [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 0, 0), (1, 1, 1)]
    )
    assert (len(triangles), owner.tolist(), crossing.size) == (1, [1], 0)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_scale_and_place_do_not_matter(scale: float) -> None:
    shape = scale * (np.array(mesh_files.L_SHAPE, float) + np.array([1e4, -1e4, 0.0]))
    triangles, _, crossing = cut(shape)
    areas = mesh_files.vector_areas(triangles)[:, 2] / scale**2
    assert crossing.size == 0 and areas.min() > 0.0 and areas.sum() == pytest.approx(3.0)


def test_strips_turn_every_other_triangle_and_begin_anew_behind_a_gap() -> None:
    assert strip_triangles(np.array([0, 1, 2, 3])).tolist() == [[0, 1, 2], [2, 1, 3]]
    found = strip_triangles(np.array([0, 1, 2, -1, 4, 5, 6, 7, -1, 8, 9]))
    assert found.tolist() == [[0, 1, 2], [4, 5, 6], [6, 5, 7]]
    assert strip_triangles(np.array([0, 1])).shape == (0, 3)
