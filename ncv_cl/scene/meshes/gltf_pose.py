"""Where the nodes of a glTF file are, and what that does to meshes with skins and morph targets."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .common import Notes, Vectors
from .gltf_buffers import Container


def trs_matrices(translation: Vectors, rotation: Vectors, scale: Vectors) -> Vectors:
    """Matrices (n, 4, 4) that scale, then turn, then move.

    Parameters
    ----------
    translation, scale : float64 (n, 3)
    rotation : float64 (n, 4)
        Quaternions x, y, z, w of any length but zero.
    """
    x, y, z, w = (rotation / np.linalg.norm(rotation, axis=1, keepdims=True)).T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    matrices = np.tile(np.eye(4), (len(x), 1, 1))
    matrices[:, :3, :3] = np.moveaxis(np.array(rows), 2, 0) * scale[:, None, :]
    matrices[:, :3, 3] = translation
    return matrices


class Nodes:
    """The tree of nodes.

    Attributes
    ----------
    parents : dict of int to int
        Of every node that has one.

    Raises
    ------
    ValueError
        If a node does not exist or is its own ancestor.
    """

    def __init__(self, container: Container) -> None:
        self._container = container
        self._nodes: list[dict[str, Any]] = container.tree.get("nodes", [])
        self._world: dict[int, Vectors] = {}
        self.parents: dict[int, int] = {}
        for index, node in enumerate(self._nodes):
            for child in node.get("children", []):
                container.entry("nodes", child)
                if child in self.parents:
                    raise ValueError(f"nodes[{child}] has two parents")
                self.parents[child] = index
        reached = self.roots()
        for index in reached:
            reached += self._nodes[index].get("children", [])
        if len(reached) < len(self._nodes):
            index = min(set(range(len(self._nodes))) - set(reached))
            raise ValueError(f"nodes[{index}] is among its own descendants")

    def roots(self) -> list[int]:
        """Nodes without a parent."""
        return [index for index in range(len(self._nodes)) if index not in self.parents]

    def world(self, index: int | None) -> Vectors:
        """A node's transform (4, 4) to the file's world, for column vectors."""
        chain = []
        while index is not None and index not in self._world:
            chain.append(index)
            index = self.parents.get(index)
        matrix = np.eye(4) if index is None else self._world[index]
        for index in reversed(chain):
            matrix = matrix @ self._local(index)
            self._world[index] = matrix
        return matrix

    def _local(self, index: int) -> Vectors:
        node = self._nodes[index]
        if "matrix" in node:
            matrix = np.array(node["matrix"], dtype=np.float64)
        else:
            parts = [
                ("translation", [0.0] * 3),
                ("rotation", [0.0, 0.0, 0.0, 1.0]),
                ("scale", [1.0] * 3),
            ]
            rows = [np.array([node.get(key, default)], dtype=np.float64) for key, default in parts]
            if not rows[1].any():
                raise ValueError(f"nodes[{index}]: its rotation is zero")
            matrix = trs_matrices(*rows)[0].T
        if matrix.size != 16 or not np.isfinite(matrix).all():
            raise ValueError(f"nodes[{index}]: its transform is not 16 finite numbers")
        return matrix.reshape(4, 4).T

    def instances(self, index: int) -> list[Vectors]:
        """The places of a node's mesh (4, 4): one, or those of EXT_mesh_gpu_instancing."""
        extension = self._nodes[index].get("extensions", {}).get("EXT_mesh_gpu_instancing")
        if extension is None:
            return [self.world(index)]
        found = {key: self._container.array(i) for key, i in extension["attributes"].items()}
        if not found:
            raise ValueError(f"nodes[{index}]: its instances have no attributes")
        count = len(next(iter(found.values())))
        matrices = trs_matrices(
            found.get("TRANSLATION", np.zeros((count, 3))),
            found.get("ROTATION", np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))),
            found.get("SCALE", np.ones((count, 3))),
        )
        return list(self.world(index) @ matrices)

    def joint_matrices(self, skin: object) -> Vectors:
        """What each joint of a skin does to the vertices of a mesh: (n_joints, 4, 4)."""
        entry = self._container.entry("skins", skin)
        joints = entry["joints"]
        matrices = np.stack([self.world(joint) for joint in joints])
        if "inverseBindMatrices" not in entry:
            return matrices
        stored = self._container.array(entry["inverseBindMatrices"])
        if stored.shape[1] != 16 or len(stored) < len(joints):
            raise ValueError(f"skins[{skin}]: its inverse bind matrices do not fit its joints")
        return matrices @ np.swapaxes(stored[: len(joints)].reshape(-1, 4, 4), 1, 2)


def shown_nodes(container: Container, nodes: Nodes, notes: Notes) -> Iterator[int]:
    """Nodes of the file's default scene, else of its first, else all; hidden ones are left out.

    Raises
    ------
    ValueError
        If a node or the scene does not exist.
    """
    scenes = container.tree.get("scenes", [])
    roots = nodes.roots()
    if scenes:
        chosen = container.tree.get("scene", 0)
        roots = container.entry("scenes", chosen).get("nodes", [])
        for index, scene in enumerate(scenes):
            if index != chosen:
                notes.shape("other scenes of the file are left out", scene.get("name", f"{index}"))
    waiting = list(reversed(roots))
    while waiting:
        index = waiting.pop()
        node = container.entry("nodes", index)
        visibility = node.get("extensions", {}).get("KHR_node_visibility", {})
        if visibility.get("visible", True):
            waiting += reversed(node.get("children", []))
            yield index


def skinned(
    vertices: Vectors,
    normals: Vectors | None,
    joints: Vectors,
    weights: Vectors,
    matrices: Vectors,
) -> tuple[Vectors, Vectors | None]:
    """Vertices and normals in the file's world, moved by the joints of a skin.

    Parameters
    ----------
    vertices : float64 (n, 3)
    normals : float64 (n, 3) or None
    joints : int64 (n, k)
        Indices into `matrices`.
    weights : float64 (n, k)
        Scaled here so that each vertex's sum is 1.
    matrices : float64 (n_joints, 4, 4)
    """
    if joints.max() >= len(matrices):
        raise ValueError(f"a vertex follows joint {joints.max()} of a skin of {len(matrices)}")
    total = weights.sum(axis=1, keepdims=True)
    if not np.all(total > 0.0):
        raise ValueError("a vertex of a mesh with a skin has no weights")
    blended = np.zeros((len(vertices), 4, 4))
    for joint, weight in zip(joints.T, (weights / total).T, strict=True):
        blended += weight[:, None, None] * matrices[joint]
    placed = np.einsum("nij,nj->ni", blended[:, :3, :3], vertices) + blended[:, :3, 3]
    if normals is not None:
        # The cofactors map normals as the inverse transpose does, also where that does not exist.
        one, two, three = np.moveaxis(blended[:, :3, :3], 1, 0)
        cofactors = np.stack([np.cross(two, three), np.cross(three, one), np.cross(one, two)], axis=1)
        normals = np.einsum("nij,nj->ni", cofactors, normals)
    return placed, normals
