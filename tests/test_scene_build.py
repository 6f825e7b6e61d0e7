"""Scenes built from arrays: the bits of a scene file, and errors that name argument and index."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from trimesh.transformations import translation_matrix

import ncv_cl as ncv
from ncv_cl import Camera, Material, QuadLight, SceneError, TriangleMesh, build_scene, load_scene
from ncv_cl.scene.imports.read import tomllib
from ncv_cl.scene.meshes import read_meshes

FLOOR = np.array([[-1.0, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])
CAMERA = Camera((0, 1, 5), (0, 0, 0), 40)
LIGHT = QuadLight((-1, 2, -1), (2, 0, 0), (0, 0, 3), (1, 2, 3))
# A ground whose triangles are cut, seen from far away from the world's origin.
FAR = """
name = "far"
[camera]
position = [500000.25, 2, 300000]
target = [500000.25, 0.5, 299990]
vertical_fov = 35.5
[materials.ground]
albedo = 0.25
[materials.gloss]
albedo = [0.5, 0.25, 0.125]
reflectance = 0.04
roughness = 0.3
[[quads]]
corner = [400000, 0, 200000]
edge1 = [0, 0, 200000]
edge2 = [200000, 0, 0]
material = "ground"
[[polygons]]
vertices = [[500000, 0, 299992], [500001, 0, 299992], [500001.5, 1, 299992], [500000, 1, 299992]]
material = "gloss"
[[lights]]
corner = [499999, 4, 299990]
edge1 = [2, 0, 0]
edge2 = [0, 0, 2]
radiance = 5
two_sided = true
"""


def built(**arguments: object) -> ncv.Scene:
    """A floor and a light, but for what is given."""
    floor = TriangleMesh(FLOOR, TWO, "grey")
    usual = {
        "camera": CAMERA,
        "materials": {"grey": Material(0.5)},
        "meshes": [floor],
        "lights": [LIGHT],
    }
    return build_scene(**{**usual, **arguments})


def from_file(path: Path, dtype: type = np.float64) -> ncv.Scene:
    """What a scene file of quads, polygons and mesh files says, built by hand from arrays."""
    data = tomllib.loads(path.read_text())
    camera = {key: np.array(value, dtype) for key, value in data["camera"].items()}
    materials = {name: Material(**given) for name, given in data["materials"].items()}
    meshes = []
    for given in data.get("quads", []):
        corner, edge1, edge2 = (np.array(given[key], dtype) for key in ("corner", "edge1", "edge2"))
        corners = np.stack([corner, corner + edge1, corner + edge1 + edge2, corner + edge2])
        meshes.append(TriangleMesh(corners, TWO, given["material"]))
    for given in data.get("polygons", []):
        fan = [[0, i, i + 1] for i in range(1, len(given["vertices"]) - 1)]
        meshes.append(TriangleMesh(given["vertices"], fan, given["material"]))
    for given in data.get("meshes", []):
        assert set(given) <= {"file", "material", "smooth", "translate"}
        transform = translation_matrix(given.get("translate", (0, 0, 0)))
        for item in read_meshes(path.parent / given["file"], transform, given.get("smooth")).meshes:
            mesh = item.mesh
            meshes.append(TriangleMesh(mesh.vertices, mesh.triangles, given["material"], mesh.normals))
    lights = [QuadLight(**given) for given in data.get("lights", [])]
    return build_scene(Camera(**camera), materials, meshes, lights, data["name"])


def assert_same(one: ncv.Scene, other: ncv.Scene) -> None:
    """All that a scene holds but its path."""
    assert one.digest == other.digest
    assert one.name == other.name and one.warnings == other.warnings
    assert [material.name for material in one.materials] == [m.name for m in other.materials]
    for name, value in vars(one).items():
        if isinstance(value, np.ndarray):
            assert value.dtype == getattr(other, name).dtype
            np.testing.assert_array_equal(value, getattr(other, name))


@pytest.mark.parametrize("name", ["cornell_box", "knot", "plane_light"])
def test_a_shipped_scene_built_from_arrays_is_the_same(scenes, name):
    path = scenes / f"{name}.toml"
    assert_same(from_file(path), load_scene(path))


def test_a_far_scene_is_moved_and_cut_as_a_file_is(tmp_path):
    path = tmp_path / "far.toml"
    path.write_text(FAR)
    scene = from_file(path)
    assert scene.origin.any() and len(scene.triangles) > 100
    assert_same(scene, load_scene(path))


def test_both_render_the_same_bits(one_device, scenes):
    path = scenes / "cornell_box.toml"
    options = {"spp": 16, "size": (12, 12), "seed": 3, "device": one_device}
    for method in ("mc", "ncv"):
        pictures = [ncv.render(s, method=method, **options) for s in (from_file(path), path)]
        assert pictures[0].pixels.any()
        np.testing.assert_array_equal(pictures[0].pixels, pictures[1].pixels)


def test_a_built_scene_holds_what_was_given():
    normals = np.array([[0, 2.0, 0], [0, 0, 3], [0, 0, 0], [1, 0, 0]])
    scene = built(
        materials={"grey": Material(0.5), "red": Material((0.5, 0.25, 0), 0.04, 0.3, emission=2)},
        meshes=[TriangleMesh(FLOOR, TWO, "red", normals)],
        name="mine",
    )
    assert (scene.name, scene.path, scene.warnings) == ("mine", None, ())
    assert [material.name for material in scene.materials] == ["grey", "red", "light"]
    assert scene.materials[1].albedo.tolist() == [0.5, 0.25, 0]
    assert scene.materials[1].emission.tolist() == [2, 2, 2]
    assert scene.triangle_material.tolist() == [1, 1, 2, 2]
    assert scene.triangle_light.tolist() == [-1, -1, 0, 0]
    np.testing.assert_array_equal(scene.vertices[:4], FLOOR)
    lengths = np.array([2, 3, 1, 1])
    np.testing.assert_array_equal(scene.vertex_normals[:4], normals / lengths[:, None])
    assert scene.camera.up.tolist() == [0, 1, 0] and not scene.lights[0].two_sided
    with pytest.raises(ValueError, match="read-only"):
        scene.vertices[0] = 1


def test_arrays_of_any_kind_give_the_same_scene_and_stay_the_callers():
    digest = built().digest
    for vertices, triangles in (
        (FLOOR.astype(np.float32), TWO.astype(np.uint32)),
        (FLOOR.astype(np.int8), TWO.astype(">u2")),
        (np.asfortranarray(FLOOR), np.repeat(TWO, 2, axis=0)[::2]),
        (FLOOR.tolist(), tuple(map(tuple, TWO))),
    ):
        assert built(meshes=[TriangleMesh(vertices, triangles, "grey")]).digest == digest
    given = np.array([0.5, 0.5, 0.5], np.float32)
    assert built(materials={"grey": Material(given, roughness=np.float32(1))}).digest == digest
    vertices = FLOOR.copy()
    scene = built(meshes=[TriangleMesh(vertices, TWO, "grey")], camera=replace(CAMERA, up=(0, 3, 0)))
    vertices[:], given[:] = 7, 0
    np.testing.assert_array_equal(scene.vertices[:4], FLOOR)


def test_a_scene_without_light_or_without_meshes_is_built():
    assert built(lights=()).lights == ()
    assert built(meshes=[], materials={}).triangle_light.tolist() == [0, 0]


def mesh(**arguments: object) -> dict[str, object]:
    """Two meshes, the second with other arguments."""
    usual = {"vertices": FLOOR, "triangles": TWO, "material": "grey"}
    return {"meshes": [TriangleMesh(FLOOR, TWO, "grey"), TriangleMesh(**{**usual, **arguments})]}


def material(*values: object, **named: object) -> dict[str, object]:
    return {"materials": {"grey": Material(*values, **named)}}


def changed(array: np.ndarray, place: tuple[int, int], value: float) -> np.ndarray:
    array = array.copy()
    array[place] = value
    return array


@pytest.mark.parametrize(
    ("arguments", "place", "reason"),
    [
        ({"camera": None}, "camera", "expected a Camera, got None"),
        ({"camera": replace(CAMERA, position=(0, 1))}, "camera.position", "3 numbers"),
        ({"camera": replace(CAMERA, position=(0, np.nan, 5))}, "camera.position[1]", "not a finite"),
        ({"camera": replace(CAMERA, target=(0, 1, 5))}, "camera.target", "same point"),
        ({"camera": replace(CAMERA, up=np.array([0, 2, 10]))}, "camera.up", "parallel"),
        ({"camera": replace(CAMERA, vertical_fov=180)}, "camera.vertical_fov", "out of range"),
        ({"camera": replace(CAMERA, vertical_fov="40")}, "camera.vertical_fov", "expected a number"),
        ({"materials": [Material(0.5)]}, "materials", "a dict of name to Material"),
        ({"materials": {"grey": 0.5}}, "materials.grey", "expected a Material, got 0.5"),
        (material(1.5), "materials.grey.albedo", "from 0 to 1"),
        (material(np.array([0.5, -1, 0])), "materials.grey.albedo[1]", "from 0 to 1"),
        (material(np.zeros(4)), "materials.grey.albedo", "a number or 3 numbers"),
        (material(0.5, np.inf), "materials.grey.reflectance", "finite"),
        (material(0.5, roughness=0), "materials.grey.roughness", "0.01 to 1"),
        (material(0.5, emission=-1), "materials.grey.emission", "at least 0"),
        ({"meshes": TriangleMesh(FLOOR, TWO, "grey")}, "meshes", "a list of TriangleMesh"),
        ({"meshes": [FLOOR]}, "meshes[0]", "expected a TriangleMesh, got an array (4, 3)"),
        (mesh(vertices=FLOOR[:, :2]), "meshes[1].vertices", "numbers (n, 3), got float64 (4, 2)"),
        (mesh(vertices=[[0, 1], [0, 1, 2]]), "meshes[1].vertices", "numbers (n, 3)"),
        (mesh(vertices=None), "meshes[1].vertices", "is missing"),
        (mesh(vertices=FLOOR.astype(str)), "meshes[1].vertices", "numbers (n, 3)"),
        (
            mesh(vertices=changed(FLOOR, (2, 1), np.nan)),
            "meshes[1].vertices[2][1]",
            "nan is not a finite",
        ),
        (mesh(vertices=changed(FLOOR, (2, 1), 1e39)), "meshes[1].vertices[2][1]", "not a finite single"),
        (mesh(vertices=changed(FLOOR, (2, 1), 1e16)), "meshes[1].vertices", "too large for float32"),
        (mesh(triangles=TWO.astype(float)), "meshes[1].triangles", "whole numbers (n, 3), got float64"),
        (mesh(triangles=TWO.ravel()), "meshes[1].triangles", "whole numbers (n, 3), got int64 (6,)"),
        (mesh(triangles=TWO[:0]), "meshes[1].triangles", "no triangle"),
        (mesh(triangles=TWO + 1), "meshes[1].triangles[1]", "[1, 3, 4], but there are 4"),
        (mesh(triangles=TWO - 1), "meshes[1].triangles[0]", "[-1, 0, 1], but there are 4"),
        (
            mesh(triangles=np.array([[0, 1, 2**64 - 1]], np.uint64)),
            "meshes[1].triangles[0]",
            "there are 4",
        ),
        (
            {"meshes": [TriangleMesh(FLOOR * [1, 0, 0], TWO, "grey")]},
            "meshes[0].vertices",
            "all its triangles are degenerate",
        ),
        (mesh(material="gray"), "meshes[1].material", "unknown material 'gray'; known materials: grey"),
        (mesh(material=0), "meshes[1].material", "non-empty string"),
        (mesh(normals=FLOOR[:3]), "meshes[1].normals", "as many as vertices, 4, are 3"),
        (mesh(normals=changed(FLOOR, (3, 0), np.inf)), "meshes[1].normals[3][0]", "not a finite"),
        ({"lights": [LIGHT, Material(1)]}, "lights[1]", "expected a QuadLight"),
        ({"lights": [LIGHT, replace(LIGHT, edge1=(0, 0, 0))]}, "lights[1].edge1", "no area"),
        ({"lights": [replace(LIGHT, edge2=(-6, 0, 0))]}, "lights[0].edge2", "parallel"),
        ({"lights": [replace(LIGHT, radiance=(1, -1, 1))]}, "lights[0].radiance[1]", "at least 0"),
        ({"lights": [replace(LIGHT, two_sided=1)]}, "lights[0].two_sided", "true or false"),
        ({"name": ""}, "name", "non-empty string"),
    ],
)
def test_bad_arguments_are_named_with_their_index(arguments, place, reason):
    with pytest.raises(SceneError) as caught:
        built(**arguments)
    assert str(caught.value).startswith(f"build_scene: {place}: ")
    assert reason in str(caught.value)


def test_an_empty_scene_is_refused():
    with pytest.raises(SceneError, match="the scene is empty: give meshes"):
        built(meshes=[], lights=[])


def test_degenerate_triangles_are_dropped_with_a_warning():
    with pytest.warns(UserWarning, match=r"meshes\[0\].vertices: dropped 1 degenerate of 3 triangles"):
        scene = built(meshes=[TriangleMesh(FLOOR, [*TWO, [1, 1, 2]], "grey")])
    assert scene.digest == built().digest and len(scene.warnings) == 1


def test_one_mesh_without_area_of_several_is_left_out_with_a_warning():
    with pytest.warns(UserWarning, match=r"meshes\[1\].vertices: has no area and is left out"):
        scene = built(
            meshes=[TriangleMesh(FLOOR, TWO, "grey"), TriangleMesh(FLOOR * [1, 0, 0], TWO, "grey")]
        )
    assert scene.digest == built().digest and len(scene.warnings) == 1


def test_coarse_coordinates_are_warned_about():
    far = FLOOR + np.array([3e6, 0, 0])
    camera = Camera((3e6, 1, 5), (3e6, 0, 0), 40)
    for dtype in ("<f4", ">f4"):
        with pytest.warns(UserWarning, match=r"meshes\[0\].vertices: .* coarse; give them in double"):
            built(camera=camera, meshes=[TriangleMesh(far.astype(dtype), TWO, "grey")], lights=[])
    # The same numbers in double precision are not coarse: they are known to be what they say.
    assert built(camera=camera, meshes=[TriangleMesh(far, TWO, "grey")], lights=[]).warnings == ()
