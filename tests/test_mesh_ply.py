"""PLY files in every encoding and layout that tools write, and STL in both forms."""

from __future__ import annotations

import struct
from pathlib import Path

import mesh_files
import numpy as np
import pytest
from mesh_files import L_SHAPE, SQUARE, load, own_materials, ply_bytes, png_bytes, same_surface

from ncv_cl.scene.load import SceneError

FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
TRIANGLE = [(5, 0, 0), (6, 0, 0), (5, 1, 0)]
MIXED = [[tuple(p) for p in SQUARE.tolist()], TRIANGLE, [(x + 9, y, z) for x, y, z in L_SHAPE]]
HEAD = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
FACES = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
POINTS = "0 0 0\n2 0 0\n2 2 0\n0 2 0\n"
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("index", ["vertex_indices", "vertex_index"])
@pytest.mark.parametrize("shapes", [MIXED, [TRIANGLE], MIXED[:1], MIXED[2:]])
def test_faces_of_any_number_of_corners(tmp_path: Path, form: str, index: str, shapes: list) -> None:
    (tmp_path / "m.ply").write_bytes(ply_bytes(shapes, form, index))
    scene = load(tmp_path, "m.ply")
    assert scene.warnings == () and same_surface(scene, shapes)


@pytest.mark.parametrize("order", ["<", ">"])
def test_wide_types_and_properties_that_nothing_reads(tmp_path: Path, order: str) -> None:
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    header = (
        f"ply\nformat {form} 1.0\nobj_info by hand\nelement vertex 4\nproperty uchar flags\n"
        "property double x\nproperty double y\nproperty double z\nproperty list uchar float extra\n"
        "element face 2\nproperty list int uint vertex_indices\nproperty uchar flags\n"
        "property list uchar float texcoord\nend_header\n"
    )
    body = b"".join(struct.pack(f"{order}B3dB2f", 1, *p, 2, 0, 0) for p in SQUARE.tolist())
    for face in ((0, 1, 2), (0, 2, 3)):
        body += struct.pack(f"{order}i3IBB6f", 3, *face, 9, 6, *[0.0] * 6)
    (tmp_path / "w.ply").write_bytes(header.encode() + body)
    scene = load(tmp_path, "w.ply")
    assert scene.warnings == () and same_surface(scene, [MIXED[0]])


def test_headers_with_other_line_ends_comments_and_encodings(tmp_path: Path) -> None:
    plain = ply_bytes(MIXED, "binary_little_endian")
    ascii_form = ply_bytes(MIXED, "ascii")
    head, body = plain.split(b"end_header\n")
    variants = [
        head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body,
        plain.replace(b"made by hand", "Größe".encode("latin-1")),
        plain.replace(b"made by hand", "Größe".encode()),
        b"\xef\xbb\xbf" + plain,
        ascii_form.replace(b"\n", b"\r\n"),
        ascii_form.replace(b"\n", b"\r"),
        ascii_form.replace(b"\n", b"\n \n").replace(b" ", b"\t  "),
        ascii_form.replace(b"made by hand", "Größe".encode("latin-1")),
        b"\xef\xbb\xbf" + ascii_form,
    ]
    for i, content in enumerate(variants):
        (tmp_path / "h.ply").write_bytes(content)
        assert same_surface(load(tmp_path, "h.ply"), MIXED), i


def test_triangle_strips_are_read(tmp_path: Path) -> None:
    head = HEAD + "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    (tmp_path / "s.ply").write_text(head + POINTS + "8 1 2 0 3 -1 0 1 3\n")
    scene = load(tmp_path, "s.ply")
    # The square, and a triangle that lies in it.
    areas = mesh_files.vector_areas(mesh_files.corners(scene))
    assert areas.tolist() == [[0, 0, 2]] * 3 and scene.warnings == ()


def test_normals_of_vertices_are_used(tmp_path: Path) -> None:
    head = HEAD + "property float nx\nproperty float ny\nproperty float nz\n" + FACES
    points = POINTS.replace("\n", " 0 0.6 0.8\n", 3).replace("0 2 0\n", "0 2 0 0 0 nan\n")
    (tmp_path / "n.ply").write_text(head + points + "4 0 1 2 3\n")
    normals = load(tmp_path, "n.ply").vertex_normals
    # The last is none, so it is that of the triangle.
    assert np.allclose(normals, [[0, 0.6, 0.8]] * 3 + [[0, 0, 1]])


@pytest.mark.parametrize(
    ("kind", "value", "linear"),
    [("uchar", 128, 0.21586), ("float", 0.5, 0.21404), ("ushort", 65535, 1.0)],
)
@pytest.mark.parametrize("prefix", ["", "diffuse_"])
def test_one_colour_of_all_vertices_is_the_albedo(
    tmp_path: Path, kind: str, value: float, linear: float, prefix: str
) -> None:
    channels = "".join(f"property {kind} {prefix}{c}\n" for c in ("red", "green", "blue", "alpha"))
    points = POINTS.replace("\n", f" {value} 0 0 {value}\n")
    (tmp_path / "c.ply").write_text(HEAD + channels + FACES + points + "4 0 1 2 3\n")
    (material,), said = own_materials(tmp_path, "c.ply")
    assert np.allclose(material.albedo, [linear, 0, 0], atol=1e-5) and material.roughness == 1.0
    assert said == [] and load(tmp_path, "c.ply", "").vertex_colours is None
    assert load(tmp_path, "c.ply").materials[0].name == "grey"


def test_colours_of_vertices_vary_over_the_surface(tmp_path: Path) -> None:
    channels = "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    points = "".join(
        f"{line} {value} 0 255\n"
        for line, value in zip(POINTS.splitlines(), (0, 128, 255, 0), strict=True)
    )
    (tmp_path / "c.ply").write_text(HEAD + channels + FACES + points + "4 0 1 2 3\n")
    scene = load(tmp_path, "c.ply", "")
    assert scene.warnings == () and (scene.materials[1].albedo == 1).all()
    expected = [[0, 0, 1], [0.21586, 0, 1], [1, 0, 1], [0, 0, 1]]
    np.testing.assert_allclose(scene.vertex_colours, expected, atol=1e-5)
    assert load(tmp_path, "c.ply").vertex_colours is None


def test_colours_of_faces_stay_on_their_faces(tmp_path: Path) -> None:
    faces = FACES.replace("face 1", "face 2").replace(
        "end_header", "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header"
    )
    points = "0 0 0\n3 0 0\n0 1 0\n0 -1 0\n"
    text = HEAD + faces + points + "3 0 1 2 255 0 0\n4 0 3 1 2 0 255 0\n"
    (tmp_path / "f.ply").write_text(text)
    scene = load(tmp_path, "f.ply", "")
    assert scene.warnings == () and len(scene.triangles) == 3
    expected = [[1, 0, 0], [0, 1, 0], [0, 1, 0]]
    for triangle, colour in zip(scene.triangles, expected, strict=True):
        assert (scene.vertex_colours[triangle] == colour).all()


@pytest.mark.parametrize("names", [("u", "v"), ("s", "t"), ("texture_u", "texture_v")])
def test_a_texture_file_lies_on_the_coordinates_of_vertices(
    tmp_path: Path, names: tuple[str, str]
) -> None:
    (tmp_path / "wood.png").write_bytes(png_bytes(128, 32, 32))
    head = HEAD.replace("element", "comment TextureFile wood.png\nelement", 1)
    head += "".join(f"property float {name}\n" for name in names) + FACES
    points = "".join(
        f"{line} {u} {v}\n" for line, (u, v) in zip(POINTS.splitlines(), UV.tolist(), strict=True)
    )
    (tmp_path / "t.ply").write_text(head + points + "4 0 1 2 3\n")
    scene = load(tmp_path, "t.ply", "")
    assert scene.warnings == () and (scene.vertex_uv == UV).all()
    assert scene.materials[1].maps.colour.texels.shape == (1, 1, 4)
    (tmp_path / "wood.png").unlink()
    scene = load(tmp_path, "t.ply", "")
    (said,) = (one for one in scene.warnings if "TextureFile" in one)
    assert "missing or cannot be read, in whose place 0.5 stands: 1 (TextureFile wood.png)" in said


def test_textures_and_other_elements_are_named(tmp_path: Path) -> None:
    head = HEAD.replace("element", "comment TextureFile wood.png\nelement", 1) + FACES.replace(
        "end_header", "element edge 2\nproperty int vertex1\nproperty int vertex2\nend_header"
    )
    (tmp_path / "t.ply").write_text(head + POINTS + "4 0 1 2 3\n0 1\n1 2\n")
    _, said = own_materials(tmp_path, "t.ply")
    assert said[:2] == [
        "elements that are left out: 2 (edge)",
        "textures are not read, the surface is as without them: 1 (TextureFile wood.png)",
    ]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (HEAD + FACES + POINTS + "4 0 1 2 9\n", "face 0 refers to vertex 9, but there are 4"),
        (HEAD + FACES + POINTS + "4 0 1 2 -1\n", "face 0 refers to vertex -1"),
        (HEAD + FACES + POINTS.replace("2 2 0", "2 inf 0") + "4 0 1 2 3\n", "vertex 2 is not finite"),
        (HEAD + FACES + POINTS + "4 0 1 2\n", "cannot be read: .*face.* row 0"),
        (
            HEAD + FACES + POINTS.replace("2 2 0", "2 a 0") + "4 0 1 2 3\n",
            "cannot be read: .*vertex.* row 2",
        ),
        (HEAD + "end_header\n" + POINTS, r"the mesh is empty: the file has no faces, but vertex \(4\)"),
        (HEAD + FACES.replace("face 1", "face 0") + POINTS, "the mesh is empty: the file has no faces"),
        (
            HEAD + FACES.replace("vertex_indices", "corners") + POINTS + "4 0 1 2 3\n",
            "has no list vertex",
        ),
        (
            HEAD.replace("float z", "float w") + FACES + POINTS + "4 0 1 2 3\n",
            "no element vertex with x, y",
        ),
        ("no header", "cannot be read"),
        (ply_bytes(MIXED, "binary_little_endian")[:-5], "cannot be read: .*face.* row 2"),
        (ply_bytes([TRIANGLE], "binary_little_endian")[:-5], "cannot be read: .*early end-of-file"),
    ],
)
def test_errors_name_file_and_place(tmp_path: Path, content: str | bytes, reason: str) -> None:
    (tmp_path / "b.ply").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(SceneError, match=rf"x\.toml: meshes\[0\]\.file: b\.ply: .*{reason}"):
        load(tmp_path, "b.ply")


SOLID = (
    "solid one\n facet normal 0 0 0\n  outer loop\n   vertex 5 0 0\n   vertex 6 0 0\n   vertex 5 1 0\n"
    "  endloop\n endfacet\nendsolid one\n"
)


def binary_stl(triangles: list, header: bytes = b"", attribute: int = 0) -> bytes:
    """Triangles as binary STL, with normals that are none."""
    records = [struct.pack("<12fH", 0, 0, 0, *np.ravel(t), attribute) for t in triangles]
    return header.ljust(80, b" ") + struct.pack("<I", len(triangles)) + b"".join(records)


@pytest.mark.parametrize(
    "content",
    [
        SOLID.encode(),
        SOLID.upper().encode(),
        SOLID.replace("\n", "\r\n").encode(),
        SOLID.replace("\n", "\r").encode(),
        SOLID.replace(" one", " vertex facet normal Größe").encode("latin-1"),
        b"\xef\xbb\xbf" + SOLID.replace("5 0 0", "5.0e0\t0 -0").encode(),
        binary_stl([TRIANGLE]),
        binary_stl([TRIANGLE], b"solid, says the header"),
        binary_stl([TRIANGLE], "Größe".encode("latin-1")),
    ],
)
def test_both_forms_of_stl(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "s.stl").write_bytes(content)
    scene = load(tmp_path, "s.stl")
    assert scene.warnings == () and same_surface(scene, [TRIANGLE])


def test_all_solids_of_an_stl_are_read(tmp_path: Path) -> None:
    second = SOLID.replace("5", "7").replace("6", "8")
    (tmp_path / "s.STL").write_text(SOLID + second)
    other = [(7, 0, 0), (8, 0, 0), (7, 1, 0)]
    assert same_surface(load(tmp_path, "s.STL"), [TRIANGLE, other])


def test_what_an_stl_has_beyond_its_triangles_is_said(tmp_path: Path) -> None:
    (tmp_path / "s.stl").write_bytes(binary_stl([TRIANGLE], attribute=0x8000 | 31) + b"tail")
    _, said = own_materials(tmp_path, "s.stl")
    assert said[:2] == [
        "bytes behind the announced triangles are left out: 4",
        "colours or attributes of triangles are left out: 1",
    ]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (binary_stl([TRIANGLE, TRIANGLE])[:-60], "cut off after 0 of 2 triangles"),
        (SOLID.replace("   vertex 6 0 0\n", "").encode(), "2 vertices for 1 facets"),
        (SOLID.replace("endsolid one\n", "").encode(), "no endsolid"),
        (SOLID.replace("6 0 0", "6 x 0").encode(), "not three numbers"),
        (SOLID.replace("6 0 0", "6 0").encode(), "not three numbers"),
        (SOLID.replace("6 0 0", "6 nan 0").encode(), "vertex 1 is not finite"),
        (b"nothing", "neither binary nor ASCII"),
        (binary_stl([]), "the mesh is empty"),
    ],
)
def test_errors_in_stl_are_named(tmp_path: Path, content: bytes, reason: str) -> None:
    (tmp_path / "b.stl").write_bytes(content)
    with pytest.raises(SceneError, match=rf"x\.toml: meshes\[0\]\.file: b\.stl: .*{reason}"):
        load(tmp_path, "b.stl")


def test_other_kinds_of_files_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "m.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(
        SceneError, match=r"m\.off: cannot be read as a mesh: \.off is none of \.obj, \.ply"
    ):
        load(tmp_path, "m.off")
