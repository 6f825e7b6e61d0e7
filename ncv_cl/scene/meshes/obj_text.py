"""The statements of a Wavefront OBJ file: sorted, and their numbers as arrays."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from .common import Indices, Notes, Vectors

# Statements that change nothing in what is rendered: names of parts, display attributes.
_WITHOUT_EFFECT = {"g", "o", "bevel", "c_interp", "d_interp", "shadow_obj", "trace_obj", "mg"}
# Statements that bring in surfaces which are not polygons.
_OTHER_SURFACES = {"surf": "a free-form surface", "call": "another file", "csh": "a command's output"}
_OTHER_SURFACES |= {name: "a patch" for name in ("bzp", "bsp", "cdc", "cdp", "res")}
_CURVES = {"vp", "cstype", "deg", "bmat", "step", "curv", "curv2", "parm", "trim", "hole", "scrv"}
_CURVES |= {"sp", "end", "con", "ctech", "stech"}


@dataclass
class Statements:
    """The statements of a file that matter, as text without the keyword, and their lines."""

    positions: list[str] = field(default_factory=list)
    position_lines: list[int] = field(default_factory=list)
    normals: list[str] = field(default_factory=list)
    normal_lines: list[int] = field(default_factory=list)
    coordinates: list[str] = field(default_factory=list)
    coordinate_lines: list[int] = field(default_factory=list)
    faces: list[str] = field(default_factory=list)
    face_lines: list[int] = field(default_factory=list)
    # Faces with relative indices, and how many v, vt and vn there were before them.
    relative: list[int] = field(default_factory=list)
    before: list[tuple[int, int, int]] = field(default_factory=list)
    # First face and name of every usemtl.
    materials: list[tuple[int, str]] = field(default_factory=list)
    libraries: list[str] = field(default_factory=list)
    smoothing: bool = False


def scan(lines: list[str], notes: Notes) -> Statements:
    """Sort lines by their first word.

    Raises
    ------
    ValueError
        For statements that bring in surfaces which are not polygons.
    """
    found = Statements()
    for number, line in enumerate(lines, 1):
        key, _, rest = line.partition(" ")
        if "#" in rest and key in ("v", "vn", "vt", "f", "fo", "s"):
            rest = rest.partition("#")[0]
        if key == "v":
            found.positions.append(rest)
            found.position_lines.append(number)
        elif key == "f" or key == "fo":
            if "-" in rest:
                before = len(found.positions), len(found.coordinates), len(found.normals)
                found.relative.append(len(found.faces))
                found.before.append(before)
            found.faces.append(rest)
            found.face_lines.append(number)
        elif key == "vn":
            found.normals.append(rest)
            found.normal_lines.append(number)
        elif key == "vt":
            found.coordinates.append(rest)
            found.coordinate_lines.append(number)
        elif key and not key.startswith("#"):
            _scan_other(key, rest.strip(), number, found, notes)
    return found


def _scan_other(key: str, rest: str, number: int, found: Statements, notes: Notes) -> None:
    if key == "usemtl":
        found.materials.append((len(found.faces), rest))
    elif key == "mtllib":
        found.libraries.append(rest)
    elif key in _OTHER_SURFACES:
        raise ValueError(
            f"line {number}: {key} brings in {_OTHER_SURFACES[key]}, and only polygons are read: "
            "convert the file to polygons"
        )
    elif key in ("l", "p"):
        notes.shape("lines and points are left out", "lines" if key == "l" else "points")
    elif key == "s":
        found.smoothing |= rest.lower() not in ("", "off", "0")
    elif key in _CURVES:
        notes.shape("statements about curves are left out", key)
    elif key in ("maplib", "usemap"):
        notes.look("textures are not read, the surface is as without them", f"{key} {rest}")
    elif key not in _WITHOUT_EFFECT:
        notes.shape("statements that are not known are left out", f"{key} in line {number}")


def table(
    rows: list[str], lines: list[int], key: str, widths: tuple[int, ...]
) -> tuple[Vectors, Indices]:
    """Rows of numbers as an array, and how many each has.

    Parameters
    ----------
    rows : list of str
    lines : list of int
        The rows' lines in the file.
    key : str
        The keyword before them, for messages.
    widths : tuple of int
        How many numbers a row may have, in ascending order.

    Returns
    -------
    values : float64 (n_rows, widths[-1])
        Short rows are filled up with NaN.
    lengths : int64 (n_rows,)

    Raises
    ------
    ValueError
        If a row has another number of numbers or words that are none; names its line.
    """
    lengths = np.array([len(row.split()) for row in rows], dtype=np.int64)
    odd = np.flatnonzero(~np.isin(lengths, widths))
    if odd.size:
        i = odd[0]
        wanted = " or ".join(map(str, widths))
        raise ValueError(
            f"line {lines[i]}: expected {wanted} numbers, found {lengths[i]}: '{key} {rows[i].strip()}'"
        )
    values = np.full((len(rows), widths[-1]), np.nan)
    for length in np.unique(lengths):
        chosen = lengths == length
        picked = rows if chosen.all() else [row for row, c in zip(rows, chosen, strict=True) if c]
        parsed = _parsed(" ".join(picked), np.float64, len(picked) * length)
        if parsed is None:
            _raise_unreadable(rows, lines, key, float)
        values[chosen, :length] = parsed.reshape(-1, length)
    return values, lengths


def references_of(statements: Statements) -> tuple[Indices, Indices]:
    """The corners of all faces as the file writes them.

    Returns
    -------
    references : int64 (n_corners, 3)
        Indices of v, vt and vn; 0 where absent.
    counts : int64 (n_faces,)
        How many corners each face has.

    Raises
    ------
    ValueError
        If a word is no index; names the line.
    """
    counts = np.array([len(face.split()) for face in statements.faces], dtype=np.int64)
    text = " ".join(statements.faces) + " "
    found = np.zeros((int(counts.sum()), 3), dtype=np.int64)
    if "/" in text:
        # v//vn and v/ with their gaps filled: then every corner is numbers between slashes.
        words = text.replace("//", "/0/").replace("/ ", "/0 ").split()
        slashes = np.array([word.count("/") for word in words])
    else:
        words, slashes = text.split(), np.zeros(len(found), dtype=np.int64)
    for k in np.unique(slashes):
        chosen = slashes == k
        picked = words if chosen.all() else [w for w, c in zip(words, chosen, strict=True) if c]
        parsed = _parsed(" ".join(picked).replace("/", " "), np.int64, len(picked) * (k + 1))
        if k > 2 or parsed is None:
            _raise_unreadable(statements.faces, statements.face_lines, "f", int)
        found[chosen, : k + 1] = parsed.reshape(-1, k + 1)
    return found, counts


def resolve(
    found: Indices,
    counts: Indices,
    statements: Statements,
    n_positions: int,
    n_normals: int,
    n_coordinates: int | None = None,
) -> None:
    """Turn what `references_of` returns in place into indices from 0, -1 where there is none.

    Negative ones count backwards from the face. Raises `ValueError`, which names the line, for a
    vertex or normal that does not exist, and for texture coordinates unless their number is None.
    """
    if statements.relative:
        before = np.zeros((len(counts), 3), dtype=np.int64)
        before[statements.relative] = statements.before
        absolute = np.repeat(before, counts, axis=0) + 1 + found
        # What would lie before the first element is as wrong as what lies behind the last.
        absolute[absolute < 1] = np.iinfo(np.int64).max
        np.copyto(found, absolute, where=found < 0)
    checked = [(0, "vertex", 1, n_positions), (2, "normal", 0, n_normals)]
    if n_coordinates is not None:
        checked.append((1, "texture coordinate", 0, n_coordinates))
    for column, what, least, total in checked:
        index = found[:, column]
        bad = np.flatnonzero((index < least) | (index > total))
        if bad.size:
            face = int(np.searchsorted(np.cumsum(counts), bad[0], side="right"))
            raise ValueError(
                f"line {statements.face_lines[face]}: 'f {statements.faces[face].strip()}' refers to a "
                f"{what} that does not exist: the file has {total}, counted from 1"
            )
    found -= 1


def check_finite(positions: Vectors, used: Indices, statements: Statements) -> None:
    """Raise `ValueError`, which names the line, if a vertex in use is not finite."""
    usable = np.isfinite(positions).all(axis=1)
    if usable.all():
        return
    bad = np.intersect1d(np.flatnonzero(~usable), used)
    if bad.size:
        line, row = statements.position_lines[bad[0]], statements.positions[bad[0]].strip()
        raise ValueError(f"line {line}: a vertex of the mesh is not finite: 'v {row}'")


def _parsed(text: str, dtype: type, count: int) -> NDArray | None:
    """All numbers of a text, or None unless it holds `count` numbers and nothing else."""
    if count == 0:
        return np.zeros(0, dtype)
    with warnings.catch_warnings():
        # Before numpy 2.3 a word that is no number ends the parse with this warning only, and the
        # number behind all others is not reached.
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            values: NDArray = np.fromstring(f"{text} 0", dtype, sep=" ")
        except ValueError:
            return None
    return values[:-1] if len(values) == count + 1 else None


def _raise_unreadable(rows: list[str], lines: list[int], key: str, parse: type) -> NoReturn:
    """Raise `ValueError` for the first word that is no number."""
    for row, line in zip(rows, lines, strict=True):
        for corner in row.split():
            words = [word for word in corner.split("/") if word] if parse is int else [corner]
            try:
                for word in words:
                    parse(word)
                readable = 0 < len(words) <= 3
            except ValueError:
                readable = False
            if not readable:
                kind = "an index" if parse is int else "a number"
                raise ValueError(f"line {line}: {corner!r} is not {kind}: '{key} {row.strip()}'")
    raise ValueError(f"a statement {key} cannot be read")
