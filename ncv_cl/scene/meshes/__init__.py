"""Mesh files: OBJ with MTL, PLY, STL and glTF to triangles and materials in world space.

Readers know nothing of scenes: they raise `ValueError` with what is wrong and where in the file, and
note what they leave out or replace.
"""

from .common import FALLBACK_ALBEDO, FileMaterial
from .read import EMITS, KINDS, FileMesh, FileMeshes, read_meshes

__all__ = ["EMITS", "FALLBACK_ALBEDO", "KINDS", "FileMaterial", "FileMesh", "FileMeshes", "read_meshes"]
