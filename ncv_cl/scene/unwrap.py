"""UVs for meshes that have none, by xatlas, in a process of its own."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from .uv_mesh import BakeError, Triangles, UVMesh, checked_triangles

# What the process does; crashes and endless loops of it do not matter to this one.
_SCRIPT = """
import sys, numpy, xatlas
given = numpy.load(sys.argv[1])
atlas, pack = xatlas.Atlas(), xatlas.PackOptions()
atlas.add_mesh(given["vertices"], given["triangles"])
pack.resolution, pack.padding = int(sys.argv[3]), int(sys.argv[4])
atlas.generate(pack_options=pack)
vertex, triangles, uv = atlas[0]
numpy.savez(sys.argv[2], vertex=vertex, triangles=triangles, uv=uv)
"""


def unwrap(mesh: Triangles, size: int = 512, padding: int = 4, time_limit: float = 60.0) -> UVMesh:
    """The same mesh with UVs that do not overlap; vertices are doubled where charts are cut.

    Parameters
    ----------
    mesh
        With `vertices`, `triangles` and, if there are some, `normals`.
    size, padding : int
        Texels of a side of the map that it is for, about, and between charts.
    time_limit : float
        Seconds.

    Raises
    ------
    BakeError
        If xatlas is not installed, fails, or takes longer.
    """
    vertices, triangles, normals = checked_triangles(mesh)
    if importlib.util.find_spec("xatlas") is None:
        raise BakeError('unwrapping needs xatlas: pip install "ncv_cl[unwrap]"')
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "given.npz", Path(folder) / "found.npz"
        # About its middle: single precision is finest there.
        middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        near = (vertices - middle).astype(np.float32)
        np.savez(given, vertices=near, triangles=triangles.astype(np.uint32))
        command = [sys.executable, "-c", _SCRIPT, str(given), str(found), str(size), str(padding)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=time_limit)
        except subprocess.TimeoutExpired as error:
            raise BakeError(f"xatlas took more than {time_limit:g} s: raise time_limit") from error
        if done.returncode or not found.exists():
            last = (done.stderr.strip().splitlines() or [f"it ended with {done.returncode}"])[-1]
            raise BakeError(f"xatlas could not unwrap the mesh: {last}")
        with np.load(found) as arrays:
            vertex, cut, uv = arrays["vertex"], arrays["triangles"], arrays["uv"]
    own = None if normals is None else normals[vertex]
    return UVMesh(vertices[vertex], cut.astype(np.int64), uv.astype(np.float64), own)
