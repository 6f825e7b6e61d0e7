"""OBJ as people's tools write it: every spelling gives the right surface, or an error with its line."""

from __future__ import annotations

from pathlib import Path

import mesh_files
import numpy as np
import pytest
from mesh_files import L_SHAPE, SQUARE, load, own_materials, png_bytes, same_surface

from ncv_cl.scene.load import SceneError

POINTS = [tuple(p) for p in SQUARE.tolist()]
V = "".join("v {:g} {:g} {:g}\n".format(*p) for p in POINTS)
FACE = V + "f 1 2 3 4\n"
GREY = "no material could be read"


@pytest.mark.parametrize("first", range(6))
def test_a_concave_face_is_filled_and_not_spilled_over(tmp_path: Path, first: int) -> None:
    shape = L_SHAPE[first:] + L_SHAPE[:first]
    (tmp_path / "l.obj").write_text(mesh_files.obj_text([shape]))
    scene = load(tmp_path, "l.obj")
    assert scene.warnings == () and same_surface(scene, [shape])


@pytest.mark.parametrize(
    "text",
    [
        FACE.replace(" ", "\t"),
        FACE.replace(" ", "  \t "),
        "\n".join("   " + line for line in FACE.split("\n")),
        FACE.replace("\n", "\r\n"),
        FACE.replace("\n", "\r"),
        FACE.removesuffix("\n"),
        FACE.replace("\n", "   \n\n"),
        V.replace("\n", " # a vertex\n") + "f 1 2 3 4 # a face\n",
        V.replace("\n", "# a vertex\n") + "f 1 2 3 4# a face\n",
        "# C:\\exported\\by\\\n" + FACE,
        V + "f 1 2 \\\n3 4\n",
        V.replace(" 2 ", " \\\n  2 ") + "f \\\n 1 2 3 \\  \n 4\n",
        V + "fo 1 2 3 4\n",
        V + "f 1/ 2/ 3/ 4/\n",
        V + "f 1// 2// 3// 4//\n",
        V + "vt 0 0\nvn 0 0 1\nf 1/1/1 2//1 3/1 4\n",
        V + "vt 0 0 0\nvt 1 1\nf 1/1 2/2 3/1 4/2\n",
        V.replace("\n", " 1.0\n") + "f 1 2 3 4\n",
        FACE.replace("v 2 2 0", "v 2.0e+00 +2. -0"),
        "f 1 2 3 4\n" + V,
        "o square\ng a b\ns off\n" + FACE + "g c\n",
        FACE + "s 0\n",
    ],
)
def test_spellings_of_one_square(tmp_path: Path, text: str) -> None:
    (tmp_path / "s.obj").write_bytes(text.encode())
    scene = load(tmp_path, "s.obj")
    assert same_surface(scene, [POINTS]) and scene.warnings == ()


def test_the_encodings_that_tools_write(tmp_path: Path) -> None:
    (tmp_path / "m.mtl").write_text("newmtl röt\nKd 0.8 0.1 0.1\n", encoding="latin-1")
    text = "# Größe\nmtllib m.mtl\n" + V + "usemtl röt\nf 1 2 3 4\n"
    for encoding in ("latin-1", "utf-8", "utf-8-sig", "utf-16"):
        (tmp_path / "s.obj").write_text(text, encoding=encoding)
        materials, said = own_materials(tmp_path, "s.obj")
        assert said == [] and np.allclose(materials[0].albedo, [0.8, 0.1, 0.1]), encoding
        assert materials[0].name == "s.obj:röt"
    # A byte-order mark before the first vertex does not hide it.
    (tmp_path / "s.obj").write_text(FACE, encoding="utf-8-sig")
    assert same_surface(load(tmp_path, "s.obj"), [POINTS])
    # The next line of Latin-1, 0x85, is an ellipsis in Windows' own encoding and ends no line.
    (tmp_path / "s.obj").write_bytes(b"# and so on \x85 f 9 9 9\n" + FACE.encode())
    assert same_surface(load(tmp_path, "s.obj"), [POINTS])


def test_relative_indices_count_from_their_own_line(tmp_path: Path) -> None:
    squares = [SQUARE + np.array([3 * i, i, 0]) for i in range(3)]
    text = "".join(
        "".join("v {:g} {:g} {:g}\n".format(*p) for p in square)
        + f"vn 0 0 {i + 1}\nvt 0 0\nf -4/-1/-1 -3/-1/-1 -2/-1/-1 -1/-1/-1\n"
        for i, square in enumerate(squares)
    )
    (tmp_path / "r.obj").write_text(text)
    scene = load(tmp_path, "r.obj")
    assert same_surface(scene, squares) and np.allclose(scene.vertex_normals, [0, 0, 1])
    mixed = V + "f 1 -3 3 -1\n" + "v 9 9 9\nf -2 -3 1\n"
    (tmp_path / "r.obj").write_text(mixed)
    assert same_surface(load(tmp_path, "r.obj"), [POINTS, [POINTS[i] for i in (3, 2, 0)]])


def test_normals_belong_to_corners_and_faces_without_them_stay_flat(tmp_path: Path) -> None:
    (tmp_path / "n.obj").write_text(
        V + "v 0 0 5\nvn 0 0.6 0.8\nvn 0 0 -1\nf 1//1 2//1 3//2\nf 1//2 3//1 4//1\nf 1 2 5\n"
    )
    scene = load(tmp_path, "n.obj")
    expected = {(0, 0, 0): {(0, 0.6, 0.8), (0, 0, -1), (0, 0, 0)}, (2, 0, 0): {(0, 0.6, 0.8), (0, 0, 0)}}
    for place, normals in expected.items():
        at = np.all(scene.vertices == np.float32(place), axis=1)
        found = {tuple(n) for n in scene.vertex_normals[at].round(6).tolist()}
        assert found == {tuple(np.float32(n).round(6).tolist()) for n in normals}
    flat = scene.triangles[scene.vertices[scene.triangles][:, :, 2].max(axis=1) == 5.0]
    assert len(flat) == 1 and not scene.vertex_normals[flat].any()


def test_smooth_normals_do_not_break_where_the_material_changes(tmp_path: Path) -> None:
    # A roof: two slopes of 45 degrees, each of a material of its own, whose mean normal points up.
    (tmp_path / "m.mtl").write_text("newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 1 0\n")
    (tmp_path / "r.obj").write_text(
        "mtllib m.mtl\nv -1 0 0\nv -1 0 1\nv 0 1 0\nv 0 1 1\nv 1 0 0\nv 1 0 1\n"
        "usemtl a\nf 1 2 4 3\nusemtl b\nf 3 4 6 5\n"
    )
    scene = load(tmp_path, "r.obj", "smooth = true")
    ridge = scene.vertices[:, 1] == 1.0
    assert ridge.sum() == 4 and np.allclose(scene.vertex_normals[ridge], [0, 1, 0], atol=1e-6)
    eaves = scene.vertices[~ridge][:, :1]
    assert np.allclose(
        scene.vertex_normals[~ridge], np.hstack([eaves, 0 * eaves + 1, 0 * eaves]) / 2**0.5
    )


def test_smoothing_groups_without_normals_are_mentioned_unless_smooth_is_given(tmp_path: Path) -> None:
    (tmp_path / "s.obj").write_text("s 1\n" + FACE)
    (warning,) = load(tmp_path, "s.obj").warnings
    assert "smoothing groups" in warning and "smooth = true" in warning
    for smooth in ("true", "false"):
        assert load(tmp_path, "s.obj", f'material = "grey"\nsmooth = {smooth}').warnings == ()


@pytest.mark.parametrize(
    "head",
    [
        "mtllib a.mtl\nmtllib b.mtl\n",
        "mtllib a.mtl b.mtl\n",
        "mtllib\ta.mtl   b.mtl\n",
        "mtllib a.mtl b.mtl # both\n",
        "mtllib ./a.mtl\nmtllib C:\\work\\B.MTL\n",
        'mtllib "a.mtl"\nmtllib my own b.mtl\n',
        "mtllib my own b.mtl a.mtl\n",
        "mtllib my own b.mtl\nmtllib a.mtl my other.mtl\n",
    ],
)
def test_all_material_libraries_are_read(tmp_path: Path, head: str) -> None:
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 0.8 0.1 0.1\n")
    (tmp_path / "my other.mtl").write_text("newmtl green\nKd 0.1 0.8 0.1\n")
    for name in ("b.mtl", "my own b.mtl"):
        (tmp_path / name).write_text("newmtl blue\nKd 0.1 0.1 0.8\nnewmtl red\nKd 0 0 0\n")
    order = "usemtl red\nf 1 2 3\nusemtl blue\nf 1 3 4\n"
    (tmp_path / "m.obj").write_text(head + V + order)
    scene = load(tmp_path, "m.obj", "")
    by_corner = {
        tuple(scene.vertices[t].sum(axis=0).tolist()): scene.materials[m]
        for t, m in zip(scene.triangles, scene.triangle_material, strict=True)
    }
    first = "blue" if head.startswith("mtllib my own") else "red"
    red = by_corner[4.0, 2.0, 0.0]
    assert (red.name, by_corner[2.0, 4.0, 0.0].name) == ("m.obj:red", "m.obj:blue")
    # The library that is named first has the say about a name.
    assert np.allclose(red.albedo, [0, 0, 0] if first == "blue" else [0.8, 0.1, 0.1])
    assert scene.warnings == ()


def test_libraries_and_materials_that_are_not_there_are_named(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(
        "mtllib none.mtl\n" + V + "usemtl a\nf 1 2 3\nusemtl b\nf 1 3 4\nusemtl a\nf 1 2 4\n"
    )
    materials, said = own_materials(tmp_path, "m.obj")
    assert [m.albedo.tolist() for m in materials] == [[0.5, 0.5, 0.5]]
    assert "material libraries that do not exist: 1 (none.mtl)" in said
    assert "materials that no library of the file has: 2 (a, b)" in said
    assert any(GREY in sentence for sentence in said) and len(said) == 3
    # With a material of the scene it does not matter.
    assert load(tmp_path, "m.obj").warnings == ()


def test_names_may_hold_blanks_and_number_signs(tmp_path: Path) -> None:
    (tmp_path / "m.mtl").write_text("newmtl Material #25\nKd 1 0 0\nnewmtl Material #26\nKd 0 1 0\n")
    text = "mtllib m.mtl\n" + V + "usemtl Material #25\nf 1 2 3\nusemtl Material #26 # grass\nf 1 3 4\n"
    (tmp_path / "m.obj").write_text(text)
    materials, said = own_materials(tmp_path, "m.obj")
    assert [m.name for m in materials] == ["m.obj:Material #25", "m.obj:Material #26"] and said == []


def test_colours_of_vertices_vary_over_the_surface(tmp_path: Path) -> None:
    # 0.5 in sRGB is 0.214 in light.
    (tmp_path / "c.obj").write_text("v 0 0 0 0.5 0 1\nv 1 0 0 0.5 0 1\nv 0 1 0 0 0 1\nf 1 2 3\n")
    scene = load(tmp_path, "c.obj", "")
    half = ((0.5 + 0.055) / 1.055) ** 2.4
    assert scene.warnings == () and (scene.materials[1].albedo == 1).all()
    np.testing.assert_allclose(scene.vertex_colours, [[half, 0, 1], [half, 0, 1], [0, 0, 1]], rtol=1e-6)
    (tmp_path / "c.obj").write_text(V.replace("\n", " 255 0 0\n") + "f 1 2 3 4\n")
    materials, said = own_materials(tmp_path, "c.obj")
    assert np.allclose(materials[0].albedo, [1, 0, 0]) and said == []
    (tmp_path / "m.mtl").write_text("newmtl red\nKd 0.8 0.1 0.1\n")
    (tmp_path / "c.obj").write_text(
        "mtllib m.mtl\nusemtl red\n" + V.replace("\n", " 0 1 0\n") + "f 1 2 3 4\n"
    )
    materials, said = own_materials(tmp_path, "c.obj")
    assert np.allclose(materials[0].albedo, [0.8, 0.1, 0.1])
    assert said == ["colours of vertices are left out beside a material: 1 (red)"]


def test_texture_coordinates_split_vertices_where_they_differ(tmp_path: Path) -> None:
    """Two triangles over a seam: corners that differ in vt are vertices of their own."""
    (tmp_path / "white.png").write_bytes(png_bytes(255, 255, 255))
    (tmp_path / "m.mtl").write_text("newmtl m\nmap_Kd -s 2 1 white.png\nnewmtl plain\nKd 1\n")
    coordinates = "vt 0 0\nvt 1 0 0\nvt 1 1\nvt 0 1\nvt 0.5\n"
    text = f"mtllib m.mtl\n{V}{coordinates}usemtl m\nf 1/1 2/2 3/3\nf 1/5 3/-3 4/4\n"
    (tmp_path / "s.obj").write_text(text)
    scene = load(tmp_path, "s.obj", "")
    assert scene.warnings == () and len(scene.vertices) == 5
    found = scene.vertex_uv[scene.triangles]
    expected = np.array([[[0, 0], [2, 0], [2, 1]], [[1, 0], [2, 1], [0, 1]]])
    # Where images are repeated, all may be moved by two of them.
    shift = found[0, 0] - expected[0, 0]
    np.testing.assert_allclose(found - shift, expected)
    assert (shift % 2 == 0).all()
    # Of a material without a texture they are not looked at, right or wrong.
    (tmp_path / "s.obj").write_text(text.replace("usemtl m", "usemtl plain").replace("1/5", "1/99"))
    scene = load(tmp_path, "s.obj", "")
    assert scene.vertex_uv is None and len(scene.vertices) == 4
    (tmp_path / "s.obj").write_text(text.replace("1/5", "1/99"))
    with pytest.raises(SceneError, match=r"line 13: .* a texture coordinate that does not exist"):
        load(tmp_path, "s.obj", "")


def test_what_is_left_out_is_counted_by_kind(tmp_path: Path) -> None:
    (tmp_path / "x.obj").write_text(
        V
        + "l 1 2 3\np 1 2\nl 1 3\nf 1 2\nf 3\nf 1 2 3 4\ncurv 0 1 1 2\ncstype bezier\nfoo 1\nv 0 0 9 2\n"
    )
    scene = load(tmp_path, "x.obj")
    assert same_surface(scene, [POINTS])
    said = [warning.split("x.obj: ")[1] for warning in scene.warnings]
    assert said == [
        "lines and points are left out: 3 (lines × 2, points)",
        "statements about curves are left out: 2 (curv, cstype)",
        "statements that are not known are left out: 1 (foo in line 13)",
        "weights w of vertices are left out: 1",
        "faces with less than three corners are left out: 2 (the first in line 8)",
    ]


def test_faces_that_cross_themselves_are_counted(tmp_path: Path) -> None:
    (tmp_path / "x.obj").write_text(FACE + "v 0 0 9\nv 2 2 9\nv 2 0 9\nv 0 2 9\nf 5 6 7 8\nf 6 7 8 5\n")
    (warning,) = load(tmp_path, "x.obj").warnings
    assert "cross themselves" in warning and warning.endswith(": 2 (the first in line 10)")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (V + "f 1 2 5\n", r"line 5: 'f 1 2 5' refers to a vertex that does not exist: the file has 4"),
        (V + "f 0 1 2\n", r"line 5: .* refers to a vertex that does not exist"),
        (V + "f -5 -1 -2\n", r"line 5: .* refers to a vertex that does not exist"),
        (V + "\n# why\nf 1//1 2//1 3//1\n", r"line 7: .* refers to a normal that does not exist"),
        (V + "f 1 2 x\n", r"line 5: 'x' is not an index"),
        (V + "f 1 2 3.5\n", r"line 5: '3\.5' is not an index"),
        (V + "f 1 2 3\nf 1/1/1/1 2/1/1/1 3/1/1/1\n", r"line 6: '1/1/1/1' is not an index"),
        (V + "f 1 2 3/a\n", r"line 5: '3/a' is not an index"),
        ("v 0 0\n" + FACE, r"line 1: expected 3 or 4 or 6 or 7 numbers, found 2: 'v 0 0'"),
        (FACE + "v 0 0 1x\n", r"line 6: '1x' is not a number"),
        ("v 0,5 0 0\n" + FACE, r"line 1: '0,5' is not a number"),
        ("v 0 \\\n 0 \\\n x\n" + FACE, r"line 1: 'x' is not a number"),
        ("v 0 0 0\nv 1 1 1\nv inf 0 0\nf 1 2 3", r"line 3: a vertex of the mesh is not finite"),
        (FACE + "vn 0 0\n", r"line 6: expected 3 numbers, found 2: 'vn 0 0'"),
        (FACE + "surf 0 1 0 1 1 2 3 4\n", r"line 6: surf brings in a free-form surface"),
        (FACE + "call other.obj\n", r"line 6: call brings in another file"),
        (V, r"the mesh is empty: it has no triangles"),
        (V + "l 1 2\n", r"the mesh is empty: .*lines and points are left out: 1"),
        ("", r"the mesh is empty"),
        ("\0\1\2", r"cannot be read: it is not a text file"),
    ],
)
def test_errors_name_file_and_line(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "bad.obj").write_text(text)
    with pytest.raises(SceneError, match=rf"x\.toml: meshes\[0\]\.file: bad\.obj: {reason}"):
        load(tmp_path, "bad.obj")


def test_vertices_without_a_face_may_be_anything(tmp_path: Path) -> None:
    (tmp_path / "x.obj").write_text("v nan inf 0\n" + FACE.replace("f 1 2 3 4", "f 2 3 4 5"))
    scene = load(tmp_path, "x.obj")
    assert scene.warnings == () and same_surface(scene, [POINTS])


def test_map_coordinates_are_not_rounded_before_the_mesh_is_moved(tmp_path: Path) -> None:
    far = np.array([500000.125, 4000000.25, 0.0])
    shape = [tuple(far + p) for p in L_SHAPE]
    lines = "".join("v {:.4f} {:.4f} {:.4f}\n".format(*p) for p in shape)
    (tmp_path / "far.obj").write_text(lines + "f 1 2 3 4 5 6\n")
    moved = f'material = "grey"\ntranslate = {(-far).tolist()}'
    assert same_surface(load(tmp_path, "far.obj", moved), [L_SHAPE])


def test_one_flat_part_among_many_is_a_warning(tmp_path: Path) -> None:
    (tmp_path / "m.mtl").write_text("newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 1 0\n")
    text = "mtllib m.mtl\n" + V + "usemtl b\nf 1 1 2\nf 3 3 4\nusemtl a\nf 1 2 3 4\n"
    (tmp_path / "d.obj").write_text(text)
    materials, said = own_materials(tmp_path, "d.obj")
    assert [m.name for m in materials] == ["d.obj:a"]
    assert said == ["dropped 2 degenerate of 4 triangles (they have no area)"]
