"""glTF: where nodes, instances, skins and morph targets put a mesh, and which scene is shown."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from mesh_files import SQUARE, Gltf, corners, load, same_surface, vector_areas, write_and_load

from ncv_cl.scene.load import SceneError

POINTS = [tuple(p) for p in SQUARE.tolist()]


def moved(x: float, y: float = 0.0, z: float = 0.0) -> list[tuple[float, float, float]]:
    return [(a + x, b + y, c + z) for a, b, c in POINTS]


def test_nodes_place_one_mesh_many_times(tmp_path: Path) -> None:
    gltf = Gltf()
    half = math.sqrt(0.5)
    nodes = [
        {"children": [1, 2, 3], "translation": [10, 0, 0]},
        {"mesh": 0},
        # Column after column: scaled by 2, then moved by (0, 5, 0).
        {"mesh": 0, "matrix": [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 5, 0, 1]},
        # Of length two; a quarter turn about z after the stretch along x.
        {"mesh": 0, "rotation": [0, 0, 2 * half, 2 * half], "scale": [3, 1, 1], "children": [4]},
        {"mesh": 0, "translation": [0, 0, 1]},
    ]
    scene = write_and_load(tmp_path, gltf, [gltf.square()], nodes=nodes)
    turned = [(10 - y, 3 * x, z) for x, y, z in POINTS]
    assert same_surface(
        scene,
        [
            moved(10),
            [(10 + 2 * x, 5 + 2 * y, z) for x, y, z in POINTS],
            turned,
            [(x, y, z + 1) for x, y, z in turned],
        ],
    )


def test_instances_of_an_extension_and_hidden_nodes(tmp_path: Path) -> None:
    gltf = Gltf()
    places = {"TRANSLATION": gltf.accessor(np.array([(0, 0, 0), (5, 0, 0)], "f4"))}
    places["SCALE"] = gltf.accessor(np.array([(1, 1, 1), (2, 1, 1)], "f4"))
    nodes = [
        {
            "mesh": 0,
            "extensions": {"EXT_mesh_gpu_instancing": {"attributes": places}},
            "children": [1, 2],
        },
        {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}, "children": [2]},
        {"mesh": 0, "translation": [0, 50, 0]},
    ]
    nodes[0]["children"] = [1]
    used = ["EXT_mesh_gpu_instancing", "KHR_node_visibility"]
    scene = write_and_load(
        tmp_path, gltf, [gltf.square()], nodes=nodes, extensionsUsed=used, extensionsRequired=used
    )
    assert same_surface(scene, [POINTS, [(5 + 2 * x, y, z) for x, y, z in POINTS]])
    assert scene.warnings == ()


@pytest.mark.parametrize(
    ("tree", "expected", "said"),
    [
        ({}, [moved(0)], ""),
        ({"scene": 1}, [moved(7)], "other scenes of the file are left out: 1 (0)"),
        ({"scene": None}, [moved(0)], "other scenes of the file are left out: 1 (second)"),
        ({"scenes": None, "scene": None}, [moved(0), moved(7)], ""),
        ({"nodes": None, "scenes": None, "scene": None}, [moved(0)], "meshes that no node places stand"),
    ],
)
def test_which_scene_is_shown(tmp_path: Path, tree: dict, expected: list, said: str) -> None:
    gltf = Gltf()
    gltf.tree["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [7, 0, 0]}]
    gltf.tree["scenes"] = [{"nodes": [0]}, {"nodes": [1], "name": "second"}]
    if not tree:
        gltf.tree["scenes"].pop()
    for key, value in tree.items():
        if value is None:
            del gltf.tree[key]
        else:
            gltf.tree[key] = value
    scene = write_and_load(tmp_path, gltf, [gltf.square()])
    assert same_surface(scene, expected)
    assert [said in warning for warning in scene.warnings] == [True] * bool(said)


def test_a_flattened_node_among_others_is_left_out_and_named(tmp_path: Path) -> None:
    gltf = Gltf()
    nodes = [{"mesh": 0, "children": [1]}, {"mesh": 0, "scale": [0, 0, 0], "name": "hidden"}]
    scene = write_and_load(tmp_path, gltf, [gltf.square()], nodes=nodes)
    assert same_surface(scene, [POINTS])
    assert scene.warnings[0].endswith("meshes that their node flattens are left out: 1 (hidden)")
    with pytest.raises(SceneError, match=r"a\.gltf: the transform of a node in the file is singular"):
        write_and_load(tmp_path, gltf, [gltf.square()], nodes=[{"mesh": 0, "scale": [0, 1, 1]}])


def test_morph_targets_and_skins_in_the_rest_pose(tmp_path: Path) -> None:
    gltf = Gltf()
    primitive = gltf.square()
    primitive["targets"] = [
        {"POSITION": gltf.accessor(np.float32([(0, 0, 9)] * 4))},
        {"POSITION": gltf.accessor(np.float32([(0, 0, 4)] * 4))},
    ]
    nodes = [{"mesh": 0, "weights": [0, 0.5], "children": [1]}, {"mesh": 0}]
    animations = [{"name": "jump", "channels": [], "samplers": []}]
    scene = write_and_load(tmp_path, gltf, [primitive], nodes=nodes, animations=animations)
    assert same_surface(scene, [moved(0, 0, 2), POINTS])
    assert scene.warnings[0].endswith("animations are left out, the rest pose is shown: 1 (jump)")

    gltf = Gltf()
    primitive = gltf.square()
    joints = np.array([(0, 1, 0, 0)] * 4, "u1")
    weights = np.float32([(0.5, 0.5, 0, 0)] * 4)
    primitive["attributes"] |= {"JOINTS_0": gltf.accessor(joints), "WEIGHTS_0": gltf.accessor(weights)}
    # Both joints are at x = 2. The second, bound at z = 1, is at 9 now: half of the way from there.
    bind = np.stack([np.eye(4), np.eye(4)])
    bind[1, 2, 3] = -1.0
    bind = np.float32(bind.transpose(0, 2, 1).reshape(2, 16))
    skins = [{"joints": [1, 2], "inverseBindMatrices": gltf.accessor(bind)}]
    nodes = [
        # A skin's mesh does not move with its own node.
        {"mesh": 0, "skin": 0, "translation": [100, 0, 0], "children": [1]},
        {"translation": [-98, 0, 0], "children": [2]},
        {"translation": [0, 0, 9]},
    ]
    scene = write_and_load(tmp_path, gltf, [primitive], nodes=nodes, skins=skins)
    assert same_surface(scene, [moved(2, 0, 4)])


def test_double_precision_survives_the_nodes(tmp_path: Path) -> None:
    # A node at map coordinates, and the scene's own translation back.
    gltf = Gltf()
    far = np.array([4.0e6, 5.0e5, 0.125])
    gltf.tree["meshes"] = [{"primitives": [gltf.square()]}]
    gltf.tree["nodes"] = [{"mesh": 0, "translation": far.tolist()}]
    gltf.write(tmp_path / "a.gltf")
    scene = load(tmp_path, "a.gltf", f'material = "grey"\ntranslate = {(-far).tolist()}')
    assert same_surface(scene, [POINTS])
    assert np.abs(vector_areas(corners(scene)).sum(axis=0) - [0, 0, 4]).max() < 1e-6
