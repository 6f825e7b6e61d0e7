"""Scene files: the shipped ones, every kind of bad input, transforms and mesh formats."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.transformations import rotation_matrix
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from ncv_cl.scene.load import Scene, SceneError, load_scene

SCENES = Path(__file__).parent.parent / "scenes"

CAMERA = """
[camera]
position = [0, 1, 5]
target = [0, 0, 0]
vertical_fov = 40
"""
GREY = """
[materials.grey]
albedo = 0.5
"""
FLOOR = """
[[quads]]
corner = [-1, 0, -1]
edge1 = [0, 0, 2]
edge2 = [2, 0, 0]
material = "grey"
"""
LIGHT = """
[[lights]]
corner = [-1, 2, -1]
edge1 = [2, 0, 0]
edge2 = [0, 0, 3]
radiance = [1, 2, 3]
"""
TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float64)
TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def load_text(folder: Path, text: str) -> Scene:
    path = folder / "x.toml"
    path.write_text(text, encoding="utf-8")
    return load_scene(path)


def load_mesh(folder: Path, file: str, keys: str = 'material = "grey"') -> Scene:
    return load_text(folder, f'{CAMERA}{GREY}[[meshes]]\nfile = "{file}"\n{keys}\n')


def export(folder: Path, name: str, **visual: object) -> None:
    mesh = trimesh.Trimesh(TETRAHEDRON, TETRAHEDRON_FACES, process=False, **visual)
    mesh.export(folder / name)


def geometric_normals(scene: Scene) -> np.ndarray:
    corners = scene.vertices[scene.triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("name", "n_triangles"),
    [
        ("cornell_box", 2 * 15 + 2),
        ("knot", 8960 + 2 + 2),
        ("occluders", 120 * 12 + 80 * 320 + 2 + 2),
        ("plane_light", 2 + 2),
    ],
)
def test_shipped_scenes_load(name: str, n_triangles: int) -> None:
    scene = load_scene(SCENES / f"{name}.toml")
    assert (scene.name, scene.warnings, len(scene.lights)) == (name, (), 1)
    assert scene.triangles.shape == (n_triangles, 3)
    assert scene.triangles.max() == len(scene.vertices) - 1
    assert [a.dtype for a in (scene.vertices, scene.vertex_normals)] == [np.float32] * 2
    assert scene.triangles.dtype == np.uint32
    assert scene.triangle_light.tolist() == [-1] * (n_triangles - 2) + [0, 0]
    black = scene.materials[scene.triangle_material[-1]]
    assert not black.albedo.any() and not black.reflectance.any()
    light = scene.lights[0]
    assert light.normal[1] == -1.0
    assert np.allclose(geometric_normals(scene)[-2:], light.normal)
    lengths = np.linalg.norm(scene.vertex_normals, axis=1)
    assert np.all((lengths == 0.0) | (np.abs(lengths - 1.0) < 1e-6))


def test_cornell_box_is_open_only_at_the_front_and_under_its_blocks() -> None:
    scene = load_scene(SCENES / "cornell_box.toml")
    boxes = trimesh.Trimesh(scene.vertices, scene.triangles[:-2])
    edges, count = np.unique(boxes.edges_sorted, axis=0, return_counts=True)
    boundary = boxes.vertices[edges[count == 1]]
    at_front = np.all(boundary[:, :, 2] == 0.0, axis=1)
    under_block = np.all(boundary[:, :, 1] == 0.0, axis=1) & ~at_front
    assert count.max() == 2
    assert (at_front.sum(), under_block.sum(), len(boundary)) == (4, 8, 12)
    assert scene.lights[0].area == pytest.approx(130 * 105)
    assert scene.camera.vertical_fov == pytest.approx(
        math.degrees(2 * math.atan(0.0125 / 0.035)), abs=1e-4
    )


def test_cornell_box_shows_red_left_and_green_right() -> None:
    scene = load_scene(SCENES / "cornell_box.toml")
    right = np.cross(scene.camera.target - scene.camera.position, scene.camera.up)
    side = {}
    for index, material in enumerate(scene.materials):
        chosen = scene.triangles[scene.triangle_material == index]
        centre = scene.vertices[chosen].mean(axis=(0, 1))
        side[material.name] = (centre - scene.camera.position) @ right
    assert side["red"] < 0.0 < side["green"]


def test_the_knot_is_closed_and_shaded_smoothly_outwards() -> None:
    scene = load_scene(SCENES / "knot.toml")
    knot = np.flatnonzero(scene.triangle_material == 0)
    mesh = trimesh.Trimesh(scene.vertices, scene.triangles[knot])
    assert mesh.is_watertight and mesh.volume > 0.0
    shading = scene.vertex_normals[scene.triangles[knot]]
    assert np.min(shading * geometric_normals(scene)[knot][:, None, :] @ np.ones(3)) > 0.9


def test_lights_follow_the_geometry_in_their_order(tmp_path: Path) -> None:
    second = LIGHT.replace("[-1, 2, -1]", "[5, 2, -1]") + "two_sided = true\n"
    scene = load_text(tmp_path, CAMERA + LIGHT + second + GREY + FLOOR)
    assert scene.triangle_light.tolist() == [-1, -1, 0, 0, 1, 1]
    assert [light.two_sided for light in scene.lights] == [False, True]
    assert (scene.lights[0].area, scene.lights[0].normal.tolist()) == (6.0, [0.0, -1.0, 0.0])
    assert scene.lights[0].radiance.tolist() == [1.0, 2.0, 3.0]


def test_a_scene_without_light_loads(tmp_path: Path) -> None:
    scene = load_text(tmp_path, CAMERA + GREY + FLOOR)
    assert scene.lights == () and [m.name for m in scene.materials] == ["grey"]
    assert scene.bounds.tolist() == [[-1.0, 0.0, -1.0], [1.0, 0.0, 1.0]]


SPHERE = '[[spheres]]\ncenter = [0, 0, 0]\nradius = 1\nmaterial = "grey"\n'
BOX = '[[boxes]]\nmin = [0, 0, 0]\nmax = [1, 1, 1]\nmaterial = "grey"\n'
BASE = CAMERA + GREY + FLOOR + LIGHT
POLYGON = '[[polygons]]\nmaterial = "grey"\nvertices = '


@pytest.mark.parametrize(
    ("text", "place", "reason"),
    [
        ("= 3", "not a TOML file", "line 1"),
        (GREY + FLOOR, "camera", "missing"),
        (CAMERA, "the scene is empty", "quads"),
        ("camra = 1\n" + BASE, "camra", "did you mean 'camera'"),
        (BASE.replace("target", "tarjet"), "camera.tarjet", "did you mean 'target'"),
        (BASE.replace("albedo", "albdo"), "materials.grey.albdo", "did you mean 'albedo'"),
        (BASE.replace("edge1 = [2", "egde1 = [2"), "lights[0].egde1", "did you mean 'edge1'"),
        (BASE.replace("[0, 1, 5]", "[0, 0, 0]"), "camera.target", "same point"),
        (BASE.replace("vertical_fov = 40", "vertical_fov = 180"), "camera.vertical_fov", "180"),
        (BASE.replace("vertical_fov", "up = [0, 2, 10]\nvertical_fov"), "camera.up", "parallel"),
        (BASE.replace("[0, 1, 5]", "[0, nan, 5]"), "camera.position[1]", "not a finite"),
        (BASE.replace("[0, 1, 5]", "[0, 1]"), "camera.position", "3 numbers"),
        (BASE.replace("[0, 1, 5]", '[0, "a", 5]'), "camera.position[1]", "expected a number"),
        (BASE.replace("0.5", "1.2"), "materials.grey.albedo", "from 0 to 1"),
        (BASE.replace("0.5", "[0.5, -0.1, 0]"), "materials.grey.albedo[1]", "from 0 to 1"),
        (BASE.replace("0.5", "0.5\nreflectance = inf"), "materials.grey.reflectance", "finite"),
        (BASE.replace("0.5", "0.5\nroughness = 0"), "materials.grey.roughness", "0.01 to 1"),
        (BASE + FLOOR.replace("grey", "gray"), "quads[1].material", "known materials: grey"),
        (BASE + FLOOR.replace("[2, 0, 0]", "[0, 0, 4]"), "quads[1]", "no area"),
        (BASE + FLOOR.replace("-1, 0, -1", "1e16, 0, 0"), "quads[1]", "too large"),
        (BASE + LIGHT.replace("0, 0, 3", "-6, 0, 0"), "lights[1].edge2", "parallel"),
        (BASE + LIGHT.replace("2, 0, 0", "0, 0, 0"), "lights[1].edge1", "no area"),
        (BASE + LIGHT.replace("[1, 2, 3]", "-1"), "lights[1].radiance", "at least 0"),
        (BASE + LIGHT + "two_sided = 1\n", "lights[1].two_sided", "true or false"),
        (BASE + SPHERE.replace("1", "-1"), "spheres[0].radius", "positive"),
        (BASE + SPHERE + "subdivisions = 9\n", "spheres[0].subdivisions", "0 to 7"),
        (BASE + BOX.replace("1, 1, 1", "1, 0, 1"), "boxes[0].max", "positive size"),
        (BASE + BOX + "size = [1, 1, 1]\n", "boxes[0].min", "not both"),
        (BASE + BOX + "rotate = {axis = [0, 0, 0], angle = 1}\n", "boxes[0].rotate.axis", "zero"),
        (BASE + POLYGON + "[[0, 0, 0], [1, 0, 0]]\n", "polygons[0].vertices", "at least 3"),
        (BASE + POLYGON + "[[0, 0, 0], [1, 0, 0], [2, 0, 0]]", "polygons[0].vertices", "no area"),
        (
            BASE + POLYGON + "[[0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0]]",
            "polygons[0].vertices",
            "not planar",
        ),
        (
            BASE + POLYGON + "[[0, 0, 0], [2, 0, 0], [0.5, 0.5, 0], [0, 2, 0]]",
            "polygons[0].vertices",
            "not convex",
        ),
        (BASE + '[[meshes]]\nfile = "no.obj"\n', "meshes[0].file", "does not exist"),
        (BASE + '[[meshes]]\nfile = "x.toml"\n', "meshes[0].file", "cannot be read"),
        (BASE + '[[meshes]]\nfile = "a.obj"\nscale = [1, 0, 1]\n', "meshes[0].scale", "zero"),
        (
            BASE + '[[meshes]]\nfile = "a.obj"\nscale = 2\ntransform = [[1, 0, 0, 0]]\n',
            "meshes[0].scale",
            "cannot be combined",
        ),
    ],
)
def test_bad_input_names_file_key_and_index(tmp_path: Path, text: str, place: str, reason: str) -> None:
    with pytest.raises(SceneError) as caught:
        load_text(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'x.toml'}: {place}: ")
    assert reason in str(caught.value)


def test_a_scene_file_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "bom.toml"
    path.write_text(BASE, encoding="utf-8-sig")
    assert load_scene(path).digest == load_text(tmp_path, BASE).digest
    path.write_text("= 3", encoding="utf-8-sig")
    with pytest.raises(SceneError, match=r"bom\.toml: not a TOML file: .*line 1, column 1"):
        load_scene(path)


def test_missing_scene_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"none\.toml: cannot read the scene file"):
        load_scene(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "empty"),
        ("v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "line 2: a vertex of the mesh is not finite"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "all its triangles are degenerate"),
        (
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
            "line 4: .* a vertex that does not exist: the file has 3",
        ),
    ],
)
def test_bad_mesh_files_are_named(tmp_path: Path, content: str, reason: str) -> None:
    (tmp_path / "bad.obj").write_text(content)
    with pytest.raises(SceneError, match=rf"x\.toml: meshes\[0\]\.file: .*{reason}") as caught:
        load_mesh(tmp_path, "bad.obj")
    assert "bad.obj" in str(caught.value)


def test_degenerate_triangles_are_dropped_with_a_warning(tmp_path: Path) -> None:
    content = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 3 0 0\nv 9 9 9\nf 1 2 3\nf 1 2 4\nf 1 1 3\n"
    (tmp_path / "thin.obj").write_text(content)
    with pytest.warns(UserWarning, match=r"meshes\[0\]\.file: thin\.obj: dropped 2 degenerate of 3"):
        scene = load_mesh(tmp_path, "thin.obj")
    assert len(scene.warnings) == 1
    assert scene.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_scale_alone_makes_no_triangle_degenerate(tmp_path: Path, scale: float) -> None:
    export(tmp_path, "t.stl")
    scene = load_mesh(tmp_path, "t.stl", f'material = "grey"\nscale = {scale}')
    # Huge triangles are cut, and none of their parts is lost.
    area = trimesh.Trimesh(scene.vertices / scale, scene.triangles, process=False).area
    assert np.isclose(area, 1.5 + np.sqrt(0.75)) and scene.warnings == ()
    assert np.allclose(scene.bounds[1], scale)


def test_a_mesh_of_coarse_coordinates_is_warned_about(tmp_path: Path) -> None:
    far = trimesh.Trimesh(TETRAHEDRON + 2.0**23, TETRAHEDRON_FACES, process=False)
    far.export(tmp_path / "far.stl")
    with pytest.warns(UserWarning, match=r"far\.stl: its coordinates are in single precision"):
        load_mesh(tmp_path, "far.stl")


@pytest.mark.parametrize(
    ("keys", "point"),
    [
        ("translate = [1, 2, 3]", [2, 2, 3]),
        ("scale = [2, 3, 4]", [2, 0, 0]),
        ("rotate = {axis = [0, 0, 5], angle = 90}", [0, 1, 0]),
        # About x first, which leaves the point, then y, then z.
        ("rotate = [90, 90, 90]", [0, 0, -1]),
        ("scale = 2\nrotate = [0, 0, 90]\ntranslate = [0, 0, 1]", [0, 2, 1]),
        ("transform = [[0, 0, 1, 5], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]", [5, 1, 0]),
    ],
)
def test_meshes_are_scaled_then_rotated_then_moved(
    tmp_path: Path, keys: str, point: list[float]
) -> None:
    export(tmp_path, "t.ply")
    scene = load_mesh(tmp_path, "t.ply", f'material = "grey"\n{keys}')
    assert np.allclose(scene.vertices[1], point, atol=1e-6)


def test_a_mirrored_mesh_keeps_its_normals_outwards(tmp_path: Path) -> None:
    export(tmp_path, "t.ply")
    scene = load_mesh(tmp_path, "t.ply", 'material = "grey"\nscale = [-1, 2, 1]\nsmooth = true')
    mesh = trimesh.Trimesh(scene.vertices, scene.triangles, process=False)
    assert mesh.volume > 0.0
    outwards = scene.vertices - scene.vertices.mean(axis=0)
    assert np.all(np.sum(scene.vertex_normals * outwards, axis=1) > 0.0)


def test_boxes_turn_about_their_centre(tmp_path: Path) -> None:
    box = BOX.replace("1, 1, 1", "4, 2, 2") + "rotate = [0, 0, 90]\n"
    scene = load_text(tmp_path, CAMERA + GREY + box)
    assert np.allclose(scene.bounds, [[1, -1, 0], [3, 3, 2]])
    centred = box.replace("min = [0, 0, 0]\nmax", "center = [2, 1, 1]\nsize")
    assert load_text(tmp_path, CAMERA + GREY + centred).digest == scene.digest


@pytest.mark.parametrize("name", ["t.obj", "t.ply", "t.stl", "t.glb"])
def test_mesh_formats_keep_the_surface(tmp_path: Path, name: str) -> None:
    export(tmp_path, name)
    scene = load_mesh(tmp_path, name)
    mesh = trimesh.Trimesh(scene.vertices, scene.triangles)
    assert (len(mesh.faces), mesh.is_watertight) == (4, True)
    assert mesh.volume == pytest.approx(1.0 / 6.0)
    assert [m.name for m in scene.materials] == ["grey"]


def test_obj_materials_come_from_the_mtl(tmp_path: Path) -> None:
    material = SimpleMaterial(diffuse=[0.2, 0.4, 0.6], specular=[0.05] * 3, glossiness=30.0, name="blue")
    visual = trimesh.visual.TextureVisuals(uv=np.zeros((4, 2)), material=material)
    export(tmp_path, "t.obj", visual=visual)
    (tmp_path / "material.mtl").write_text("newmtl blue\nKd 0.123 0.4 0.6\nKs 0.05 0.05 0.05\nNs 30")
    scene = load_mesh(tmp_path, "t.obj", "")
    found = scene.materials[scene.triangle_material[0]]
    assert found.name == "t.obj:blue"
    assert np.allclose(found.albedo, [0.123, 0.4, 0.6])
    assert np.allclose(found.reflectance, 0.05)
    # Ns = 30 is alpha = sqrt(2 / 32) = 0.25.
    assert found.roughness**2 == pytest.approx(0.25)


def test_an_obj_with_two_materials_uses_both(tmp_path: Path) -> None:
    (tmp_path / "m.mtl").write_text("newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 1 0\n")
    (tmp_path / "t.obj").write_text(
        "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 5\n"
        "usemtl a\nf 1 2 3 4\nusemtl b\nf 1 2 5\n"
    )
    scene = load_mesh(tmp_path, "t.obj", "")
    by_height = {}
    for triangle, material in zip(scene.triangles, scene.triangle_material, strict=True):
        by_height[float(scene.vertices[triangle, 2].max())] = scene.materials[material].name
    assert by_height == {0.0: "t.obj:a", 5.0: "t.obj:b"}


def test_glb_honours_nodes_and_metallic_roughness(tmp_path: Path) -> None:
    material = PBRMaterial(
        name="gold", baseColorFactor=[1.0, 0.6, 0.2, 1.0], metallicFactor=0.5, roughnessFactor=0.3
    )
    visual = trimesh.visual.TextureVisuals(material=material)
    mesh = trimesh.Trimesh(TETRAHEDRON, TETRAHEDRON_FACES, process=False, visual=visual)
    source = trimesh.Scene()
    source.add_geometry(mesh, geom_name="t")
    turn = rotation_matrix(math.pi / 2, [0, 0, 1])
    turn[:3, 3] = [10, 0, 0]
    source.graph.update(frame_to="second", geometry="t", matrix=turn)
    source.export(tmp_path / "t.glb")
    scene = load_mesh(tmp_path, "t.glb", "")
    assert len(scene.triangles) == 8
    assert np.allclose(scene.bounds, [[0, 0, 0], [10, 1, 1]])
    assert [m.name for m in scene.materials] == ["grey", "t.glb:gold"]
    gold = scene.materials[1]
    assert np.allclose(gold.albedo, [0.5, 0.3, 0.1])
    assert np.allclose(gold.reflectance, 0.02 + 0.5 * np.array([1.0, 0.6, 0.2]))
    assert gold.roughness == pytest.approx(0.3)


def test_a_mesh_without_material_is_grey_with_a_warning(tmp_path: Path) -> None:
    export(tmp_path, "t.stl")
    with pytest.warns(UserWarning, match=r"meshes\[0\]\.file: t\.stl: no material could be read"):
        scene = load_mesh(tmp_path, "t.stl", "")
    assert scene.materials[scene.triangle_material[0]].albedo.tolist() == [0.5, 0.5, 0.5]


def test_smooth_normals_join_split_vertices_and_flat_has_none(tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=3).export(tmp_path / "s.stl")
    smooth = load_mesh(tmp_path, "s.stl", 'material = "grey"\nsmooth = true')
    radial = smooth.vertices / np.linalg.norm(smooth.vertices, axis=1, keepdims=True)
    assert np.min(np.sum(smooth.vertex_normals * radial, axis=1)) > 0.9999
    for keys in ('material = "grey"', 'material = "grey"\nsmooth = false'):
        assert not load_mesh(tmp_path, "s.stl", keys).vertex_normals.any()


def test_normals_in_the_file_are_used_unless_flat_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "n.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0.6 0.8\nvn 0 0 3\nvn 0 0 0\nf 1//1 2//2 3//3\n"
    )
    given = load_mesh(tmp_path, "n.obj").vertex_normals
    # The zero normal is replaced by the average over triangles, here the only one's.
    assert np.allclose(given, [[0, 0.6, 0.8], [0, 0, 1], [0, 0, 1]])
    flat = load_mesh(tmp_path, "n.obj", 'material = "grey"\nsmooth = false')
    assert not flat.vertex_normals.any()
    # A normal turns against a stretch: it is (0, 0.6 / 3, 0.8) here, normalised.
    stretched = load_mesh(tmp_path, "n.obj", 'material = "grey"\nscale = [1, 3, 1]')
    assert np.allclose(stretched.vertex_normals[0], np.array([0, 0.2, 0.8]) / math.hypot(0.2, 0.8))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("vertical_fov = 40", "vertical_fov = 41"),
        ("albedo = 0.5", "albedo = 0.51"),
        ("albedo = 0.5", "albedo = 0.5\nroughness = 0.9"),
        ("corner = [-1, 0, -1]", "corner = [-1, 0.1, -1]"),
        ("radiance = [1, 2, 3]", "radiance = [1, 2, 4]"),
        ("radiance = [1, 2, 3]", "radiance = [1, 2, 3]\ntwo_sided = true"),
    ],
)
def test_digest_changes_with_what_affects_the_image(tmp_path: Path, old: str, new: str) -> None:
    assert old in BASE
    digest = load_text(tmp_path, BASE).digest
    assert load_text(tmp_path, BASE.replace(old, new)).digest != digest
    assert load_text(tmp_path, 'name = "other"\n' + BASE.replace("grey", "gray")).digest == digest
