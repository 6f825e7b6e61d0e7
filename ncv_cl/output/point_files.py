"""Files of points, read, and of what was found there, written: CSV, numpy arrays, PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from ..host.files import write_whole

POINT_FILES = (".csv", ".npy", ".ply")
# A sensor's columns.
COLUMNS = ("x", "y", "z", "nx", "ny", "nz")


def check_suffix(path: str | Path) -> None:
    """Raise for a file that is none of `POINT_FILES`."""
    if Path(path).suffix.lower() not in POINT_FILES:
        raise ValueError(f"{path} must end in {', '.join(POINT_FILES[:-1])} or {POINT_FILES[-1]}")


def read_points(path: str | Path) -> np.ndarray:
    """Positions and normals, float64 (n, 6); their values are not checked.

    Parameters
    ----------
    path : str or Path
        ``.csv``: x, y, z, nx, ny, nz a line, or a first line that names these columns among others,
        in any order; lines that are empty or begin with # do not count. ``.npy``: (n, 6), or more
        dimensions of which the last has 6. ``.ply``: vertices with these properties.

    Raises
    ------
    ValueError
        Says what is wrong and where.
    """
    check_suffix(path)
    suffix = Path(path).suffix.lower()
    try:
        if suffix == ".csv":
            return _read_csv(path)
        return _read_npy(path) if suffix == ".npy" else _read_ply(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot read the points: {error.strerror or error}") from error


def _read_csv(path: str | Path) -> np.ndarray:
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file: {error}") from error
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1)]
    rows = [(number, line.split(",")) for number, line in lines if line and not line.startswith("#")]
    places = list(range(len(COLUMNS)))
    if rows and not _is_number(rows[0][1][0]):
        names = [name.strip().lower() for name in rows.pop(0)[1]]
        missing = [name for name in COLUMNS if name not in names]
        if missing:
            raise ValueError(f"{path}: line 1 names no column {missing[0]}: {', '.join(names)}")
        places = [names.index(name) for name in COLUMNS]
    found = np.empty((len(rows), len(COLUMNS)))
    for row, (number, cells) in enumerate(rows):
        try:
            found[row] = [float(cells[place]) for place in places]
        except IndexError:
            raise ValueError(f"{path}: line {number} has {len(cells)} numbers, of "
                             f"{max(places) + 1} that are needed") from None  # fmt: skip
        except ValueError as error:
            raise ValueError(f"{path}: line {number}: {error}") from None
    return found


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _read_npy(path: str | Path) -> np.ndarray:
    try:
        found = np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"{path}: not an array of numbers: {error}") from error
    is_array = isinstance(found, np.ndarray)
    if not is_array or found.dtype.kind not in "fiu" or found.ndim < 2 or found.shape[-1] != 6:
        shape = f"{found.dtype} {found.shape}" if is_array else "several arrays"
        raise ValueError(f"{path}: expected numbers (n, 6), x y z nx ny nz, got {shape}")
    return found.astype(np.float64).reshape(-1, len(COLUMNS))


def _read_ply(path: str | Path) -> np.ndarray:
    try:
        vertices = PlyData.read(str(path))["vertex"]
    except (PlyParseError, KeyError, ValueError) as error:
        raise ValueError(f"{path}: not a PLY file with vertices: {error}") from error
    names = [one.name for one in vertices.properties]
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise ValueError(f"{path}: vertices have no property {missing[0]}: {', '.join(names)}")
    return np.stack([np.asarray(vertices[name], np.float64) for name in COLUMNS], axis=1)


def write_values(path: str | Path, points: np.ndarray, values: np.ndarray, error: np.ndarray) -> None:
    """Write points with their values and standard errors, in the form that the name's end says.

    Columns are those of `COLUMNS`, then R, G, B, R_error, G_error, B_error, or, of one channel, value
    and error. A numpy array is float64 (n, columns).

    Parameters
    ----------
    points : ndarray
        float64 (n, 6).
    values, error : ndarray
        float64 (n, 3) or (n,).
    """
    channels = ("R", "G", "B") if values.ndim == 2 else ("value",)
    errors = tuple(f"{name}_error" for name in channels) if values.ndim == 2 else ("error",)
    names = (*COLUMNS, *channels, *errors)
    count = len(points)
    columns = (one.reshape(count, len(channels)) for one in (values, error))
    table = np.concatenate([points, *columns], axis=1)
    suffix = Path(path).suffix.lower()
    if suffix == ".npy":
        write_whole(path, lambda file: np.save(file, table))
    elif suffix == ".ply":
        vertices = np.empty(count, [(name, "f8") for name in names])
        for name, column in zip(names, table.T, strict=True):
            vertices[name] = column
        ply = PlyData([PlyElement.describe(vertices, "vertex")])
        write_whole(path, ply.write)
    else:
        lines = [",".join(names), *(",".join(map(repr, row)) for row in table.tolist())]
        write_whole(path, lambda file: file.write(("\n".join(lines) + "\n").encode()))
