"""glTF: containers, accessors of every layout, topologies, and what is refused by name."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from mesh_files import SIX, SQUARE, Gltf, load, same_surface, write_and_load

from ncv_cl.scene.load import SceneError

POINTS = [tuple(p) for p in SQUARE.tolist()]


@pytest.mark.parametrize("name", ["a.gltf", "a.glb", "A.GLB"])
def test_both_containers(tmp_path: Path, name: str) -> None:
    gltf = Gltf()
    gltf.tree["meshes"] = [{"primitives": [gltf.square()]}]
    gltf.write(tmp_path / name.lower())
    (tmp_path / name.lower()).rename(tmp_path / name)
    scene = load(tmp_path, name)
    assert same_surface(scene, [POINTS]) and scene.warnings == ()


@pytest.mark.parametrize(
    ("uri", "file"),
    [
        ("my%20model.bin", "my model.bin"),
        ("my model.bin", "my model.bin"),
        ("gr%C3%B6%C3%9Fe.bin", "größe.bin"),
        ("100%.bin", "100%.bin"),
        ("sub/a%23b.bin", "sub/a#b.bin"),
        ("./Data.BIN", "data.bin"),
    ],
)
def test_the_name_of_a_buffer_is_a_uri(tmp_path: Path, uri: str, file: str) -> None:
    gltf = Gltf()
    gltf.tree["meshes"] = [{"primitives": [gltf.square()]}]
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_bytes(gltf.blob)
    gltf.write(tmp_path / "a.gltf", uri=uri)
    assert same_surface(load(tmp_path, "a.gltf"), [POINTS])


def test_the_text_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    gltf = Gltf()
    gltf.tree["meshes"] = [{"primitives": [gltf.square()]}]
    gltf.write(tmp_path / "a.gltf")
    (tmp_path / "a.gltf").write_bytes(b"\xef\xbb\xbf" + (tmp_path / "a.gltf").read_bytes())
    assert same_surface(load(tmp_path, "a.gltf"), [POINTS])


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2"])
@pytest.mark.parametrize("normalised", [False, True])
def test_quantised_positions(tmp_path: Path, kind: str, normalised: bool) -> None:
    largest = np.iinfo(kind).max
    quantum = largest if normalised else 1
    gltf = Gltf()
    position = gltf.accessor((SQUARE / 2 * quantum).astype(kind), normalized=normalised)
    primitive = {"attributes": {"POSITION": position}, "indices": gltf.accessor(SIX)}
    needs = ["KHR_mesh_quantization"]
    scene = write_and_load(
        tmp_path, gltf, [primitive], extensionsUsed=needs, extensionsRequired=needs,
        nodes=[{"mesh": 0, "scale": [2, 2, 2]}],
    )  # fmt: skip
    assert same_surface(scene, [POINTS]) and scene.warnings == ()


def test_normalised_normals_and_the_most_negative_integer(tmp_path: Path) -> None:
    gltf = Gltf()
    normals = np.array([(0, 0, 127), (0, 0, -128), (0, 76, 102), (0, 0, 64)], "i1")
    primitive = gltf.square()
    primitive["attributes"]["NORMAL"] = gltf.accessor(normals, normalized=True)
    found = write_and_load(tmp_path, gltf, [primitive]).vertex_normals
    assert np.allclose(found, [(0, 0, 1), (0, 0, -1), (0, 0.597, 0.802), (0, 0, 1)], atol=1e-3)


def test_interleaved_attributes_and_offsets(tmp_path: Path) -> None:
    gltf = Gltf()
    rows = b"".join(struct.pack("<3f3f2H", *p, 0, 0.6, 0.8, 7, 7) for p in POINTS)
    view = gltf.view(b"\xff" * 8 + rows, byteStride=28)
    layout = {"bufferView": view, "componentType": 5126, "count": 4, "type": "VEC3"}
    gltf.tree["accessors"] += [layout | {"byteOffset": 8}, layout | {"byteOffset": 20}]
    indices = gltf.view(struct.pack("<2I6I", 9, 9, *SIX.tolist()))
    gltf.tree["accessors"].append(
        {"bufferView": indices, "byteOffset": 8, "componentType": 5125, "count": 6, "type": "SCALAR"}
    )
    scene = write_and_load(tmp_path, gltf, [{"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2}])
    assert same_surface(scene, [POINTS]) and np.allclose(scene.vertex_normals, [0, 0.6, 0.8])


@pytest.mark.parametrize("base", [True, False])
def test_sparse_values_are_put_in(tmp_path: Path, base: bool) -> None:
    gltf = Gltf()
    stored = SQUARE.copy()
    stored[1:3] = 9
    where = np.array([1, 2] if base else [1, 2, 3], "u1")
    sparse = {
        "count": len(where),
        "indices": {"bufferView": gltf.view(where.tobytes()), "componentType": 5121},
        "values": {"bufferView": gltf.view(SQUARE[where].tobytes())},
    }
    position = gltf.accessor(stored, sparse=sparse)
    if not base:
        # Without a buffer view all others are zero, as the first corner is.
        del gltf.tree["accessors"][position]["bufferView"]
    primitive = {"attributes": {"POSITION": position}, "indices": gltf.accessor(SIX)}
    assert same_surface(write_and_load(tmp_path, gltf, [primitive]), [POINTS])


@pytest.mark.parametrize(
    ("mode", "order"),
    [(4, [0, 1, 2, 0, 2, 3]), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3]), (None, [2, 3, 0, 2, 0, 1])],
)
@pytest.mark.parametrize("kind", ["u1", "u2", "u4", None])
def test_lists_strips_and_fans_with_and_without_indices(
    tmp_path: Path, mode: int | None, order: list[int], kind: str | None
) -> None:
    gltf = Gltf()
    if kind is None:
        primitive = {"attributes": {"POSITION": gltf.accessor(SQUARE[order])}}
    else:
        indices = gltf.accessor(np.array(order, kind))
        primitive = {"attributes": {"POSITION": gltf.accessor(SQUARE)}, "indices": indices}
    if mode is not None:
        primitive["mode"] = mode
    scene = write_and_load(tmp_path, gltf, [primitive])
    assert same_surface(scene, [POINTS]) and scene.warnings == ()


def test_points_and_lines_beside_triangles_are_counted(tmp_path: Path) -> None:
    gltf = Gltf()
    square = gltf.square()
    others = [square | {"mode": mode} for mode in (0, 1, 2, 3)]
    scene = write_and_load(tmp_path, gltf, [*others, square, {"attributes": {}}])
    assert same_surface(scene, [POINTS])
    said = [warning.split("a.gltf: ")[1] for warning in scene.warnings]
    assert said[0].startswith("lines and points are left out: 4 (points in m.primitives[0], lines in ")
    assert said[1:] == ["primitives without positions are left out: 1 (m.primitives[5])"]
    with pytest.raises(
        SceneError, match=r"a\.gltf: the mesh is empty.*lines and points are left out: 4"
    ):
        write_and_load(tmp_path, gltf, others)


@pytest.mark.parametrize(
    "extension",
    ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "ACME_own_shape"],
)
def test_a_required_extension_that_is_not_read_is_an_error(tmp_path: Path, extension: str) -> None:
    gltf = Gltf()
    with pytest.raises(
        SceneError, match=rf"a\.gltf: requires the extension {extension}, which is not read"
    ):
        write_and_load(
            tmp_path, gltf, [gltf.square()], extensionsUsed=[extension], extensionsRequired=[extension]
        )
    scene = write_and_load(
        tmp_path, gltf, [gltf.square()], extensionsUsed=[extension], extensionsRequired=[]
    )
    assert same_surface(scene, [POINTS])
    said = [] if "draco" in extension else [f"extensions that are not read: 1 ({extension})"]
    assert [warning.split("a.gltf: ")[1] for warning in scene.warnings] == said


def test_compressed_data_without_a_fallback_names_what_compressed_it(tmp_path: Path) -> None:
    gltf = Gltf()
    primitive = gltf.square(extensions={"KHR_draco_mesh_compression": {"bufferView": 0}})
    assert same_surface(write_and_load(tmp_path, gltf, [primitive]), [POINTS])
    gltf.tree["accessors"][0].pop("bufferView")
    with pytest.raises(
        SceneError, match=r"m\.primitives\[0\] is compressed by KHR_draco_mesh_compression"
    ):
        write_and_load(tmp_path, gltf, [primitive])
    gltf = Gltf()
    primitive = gltf.square()
    gltf.tree["bufferViews"][0] |= {"buffer": 1, "extensions": {"EXT_meshopt_compression": {}}}
    buffers = [{"uri": "data:,", "byteLength": 0}, {"byteLength": 48}]
    with pytest.raises(SceneError, match=r"buffers\[1\] has no data: .*EXT_meshopt_compression"):
        write_and_load(tmp_path, gltf, [primitive], buffers=buffers)


def bad(change: str) -> tuple[Gltf, list[dict]]:
    """A file with one thing wrong."""
    gltf = Gltf()
    primitive = gltf.square()
    tree = gltf.tree
    match change:
        case "index":
            primitive["indices"] = gltf.accessor(np.array([0, 1, 4], "u2"))
        case "position":
            primitive["attributes"]["POSITION"] = gltf.accessor(SQUARE + np.float32(np.inf))
        case "two indices":
            primitive["indices"] = gltf.accessor(np.array([0, 1], "u2"))
        case "accessor":
            primitive["indices"] = 7
        case "short view":
            tree["accessors"][0]["count"] = 5
        case "long view":
            tree["bufferViews"][0]["byteLength"] = 10**6
        case "circle":
            tree["nodes"] = [{"mesh": 0}, {"children": [2]}, {"children": [1]}]
        case "parents":
            tree["nodes"] = [{"mesh": 0, "children": [2]}, {"children": [2]}, {}]
        case "self":
            tree["nodes"] = [{"mesh": 0}, {"children": [1]}]
        case "rotation":
            tree["nodes"] = [{"mesh": 0, "rotation": [0, 0, 0, 0]}]
        case "matrix":
            tree["nodes"] = [{"mesh": 0, "matrix": [1, 0, 0]}]
        case "scene":
            tree["scene"] = 3
        case "mode":
            primitive["mode"] = 9
        case "type":
            tree["accessors"][0]["type"] = "VEC5"
        case "plane":
            flat = gltf.accessor(SQUARE[:, :2].copy())
            primitive["attributes"]["POSITION"] = flat
        case "version":
            tree["asset"] = {"version": "1.0"}
        case "missing":
            tree["buffers"] = [{"uri": "none%20here.bin", "byteLength": 4}]
        case "cut":
            tree["buffers"] = [{"uri": "data:;base64,AAAA", "byteLength": 99}]
        case "key":
            del tree["accessors"][0]["count"]
        case "normals":
            primitive["attributes"]["NORMAL"] = gltf.accessor(SQUARE[:3])
    return gltf, [primitive]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("index", r"m\.primitives\[0\]: triangle 0 refers to the vertices \[0, 1, 4\], but there are 4"),
        ("position", r"m\.primitives\[0\]: vertex 0 is not finite"),
        ("two indices", r"m\.primitives\[0\] has 2 indices, which are no whole triangles"),
        ("accessor", r"accessors\[7\] does not exist: the file has 2"),
        ("short view", r"accessors\[0\] ends at byte 60, but its bufferView has 48"),
        ("long view", r"bufferViews\[0\] ends at byte 1000000, but its buffer has 60"),
        ("circle", r"nodes\[1\] is among its own descendants"),
        ("parents", r"nodes\[2\] has two parents"),
        ("self", r"nodes\[1\] is among its own descendants"),
        ("rotation", r"nodes\[0\]: its rotation is zero"),
        ("matrix", r"nodes\[0\]: its transform is not 16 finite numbers"),
        ("scene", r"scenes\[3\] does not exist: the file has 1"),
        ("mode", r"m\.primitives\[0\] has the unknown mode 9"),
        ("type", r"accessors\[0\] has an unknown type"),
        ("plane", r"m\.primitives\[0\]: POSITION has 2 components, not 3"),
        ("version", r"is glTF 1\.0, and glTF 2 is read"),
        ("missing", r"buffers\[0\]: the file 'none here\.bin' does not exist"),
        ("cut", r"buffers\[0\] was cut off: it has 3 of 99 bytes"),
        ("key", r"cannot be read, for it is malformed: KeyError\('count'\)"),
        ("normals", r"m\.primitives\[0\] has 3 normals for 4 positions"),
    ],
)
def test_errors_name_file_and_place(tmp_path: Path, change: str, reason: str) -> None:
    with pytest.raises(SceneError, match=rf"x\.toml: meshes\[0\]\.file: a\.gltf: ({reason})"):
        write_and_load(tmp_path, *bad(change))


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"glTF\1\0\0\0\x0c\0\0\0", b"glTF\2\0\0\0\xff\0\0\0"]
)
def test_what_is_no_gltf_is_said(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.glb").write_bytes(content)
    with pytest.raises(SceneError, match=r"a\.glb: (cannot be read|is a GLB file of|was cut off)"):
        load(tmp_path, "a.glb")
