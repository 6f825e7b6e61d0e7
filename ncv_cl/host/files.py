"""Files: written whole or not at all; every value that is read is checked."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

# In a shape: any size.
ANY = -1
# Begins the names of temporary folders in which files are written first.
PREFIX = ".ncv_cl-"


def check_writable(path: str | Path) -> None:
    """Raise if a file cannot be written to `path`; call it before long work.

    Raises
    ------
    ValueError
        If the path is no path.
    OSError
        FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError or another: if the
        folder is missing, is not a folder or cannot be written, or `path` is a folder.
    """
    path = Path(path)
    exists = True
    try:
        os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        exists = False
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise type(error)(f"cannot write {str(path)!r}: {reason}") from error
    if not path.parent.exists():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {path.parent}; create it")
    if not path.parent.is_dir():
        raise NotADirectoryError(f"cannot write {path}: {path.parent} is not a folder")
    if path.is_dir():
        raise IsADirectoryError(f"cannot write {path}: it is a folder")
    if exists and not path.is_file():
        # A device or a pipe, which is written into.
        if not os.access(path, os.W_OK):
            raise PermissionError(f"cannot write {path}: no permission")
        return
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise PermissionError(f"cannot write {path}: no permission to write in {path.parent}")
    try:
        # Permissions do not show that a disk is read-only or full.
        with tempfile.TemporaryDirectory(prefix=PREFIX, dir=path.parent):
            pass
    except OSError as error:
        raise type(error)(f"cannot write {path}: {error.strerror}") from error


def check_paths(
    written: Mapping[str, str | Path | None], read: Mapping[str, str | Path | None] | None = None
) -> None:
    """`check_writable` for several files, which must all differ.

    Parameters
    ----------
    written, read : dict
        Paths by purpose, such as "checkpoint"; None for files that are not wanted. A file that is read
        must not be overwritten.
    """
    owner = {Path(path).resolve(): purpose for purpose, path in (read or {}).items() if path is not None}
    for purpose, path in written.items():
        if path is None:
            continue
        check_writable(path)
        if Path(path).exists() and not Path(path).is_file():
            continue
        other = owner.setdefault(Path(path).resolve(), purpose)
        if other != purpose:
            raise ValueError(f"{purpose} would be written over {other}: both are {path}")


def write_whole(path: str | Path, write: Callable[[BinaryIO], object]) -> None:
    """Replace `path` in one step: whenever the process is killed, there is an old or a new file.

    Parameters
    ----------
    write : callable
        Given the open file.

    Raises
    ------
    OSError
        Naming the path; an older file is still there.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            with open(path, "wb") as file:
                write(file)
            return
        # A folder, not a file of tempfile's: the file then gets the permissions of the umask.
        with tempfile.TemporaryDirectory(prefix=PREFIX, dir=path.parent) as folder:
            complete = Path(folder) / path.name
            with open(complete, "wb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(complete, path)
    except OSError as error:
        raise OSError(f"cannot write {path}: {error.strerror or error}") from error


def save_arrays(file: BinaryIO, arrays: Mapping[str, np.ndarray]) -> None:
    """Write an ``.npz``, which `read_arrays` reads."""
    # To numpy's hints an array of any name could be savez's own option.
    named: dict[str, Any] = dict(arrays)
    np.savez(file, **named)


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of an ``.npz``; none of them holds Python objects.

    Raises
    ------
    ValueError
        If there is no such file, or it is none, or is cut short.
    """
    if not os.path.exists(path):
        raise ValueError(f"there is no file {path}")
    if os.path.isdir(path):
        raise ValueError(f"{path} is a folder, not a file")
    try:
        with open(path, "rb") as file:
            if file.read(2) != b"PK":
                raise ValueError("it is no .npz archive")
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception as error:
        # A broken archive raises any of a dozen classes, depending on where it is broken.
        said = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise ValueError(f"{path} cannot be read: {said.removeprefix('ValueError: ')}") from error


def whole_number(name: str, value: object, low: int, high: int) -> int:
    """`value`, if it is a whole number from `low` to `high`; else ValueError."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or not low <= value <= high:
        raise ValueError(f"{name} must be a whole number from {low} to {high}, is {value!r}")
    return int(value)


def real_number(name: str, value: object, low: float, high: float) -> float:
    """`value`, if it is a number from `low` to `high` and not NaN; else ValueError."""
    if (
        not isinstance(value, (int, float, np.integer, np.floating))
        or isinstance(value, bool)
        or not low <= value <= high
    ):
        raise ValueError(f"{name} must be a number from {low:g} to {high:g}, is {value!r}")
    return float(value)


def some_of(name: str, value: object, known: Iterable[str]) -> tuple[str, ...]:
    """`value` as a tuple, if it is a list of `known` names, each once and in their order."""
    known = tuple(known)
    if (
        not isinstance(value, (list, tuple))
        or not all(isinstance(one, str) for one in value)
        or [one for one in known if one in value] != list(value)
    ):
        raise ValueError(f"{name} must be some of {', '.join(known)}, in this order, is {value!r}")
    return tuple(value)


def array_of(
    arrays: Mapping[str, np.ndarray],
    name: str,
    dtype: type,
    shape: tuple[int, ...],
    nan_allowed: bool = False,
) -> np.ndarray:
    """The array of that name, if it has this dtype and shape (`ANY` size where so) and is finite."""
    if name not in arrays:
        raise ValueError(f"there is no array {name!r}")
    array = arrays[name]
    expected = "(" + ", ".join("any" if size == ANY else str(size) for size in shape) + ")"
    fits = array.ndim == len(shape) and all(
        size in (ANY, own) for size, own in zip(shape, array.shape, strict=True)
    )
    if array.dtype != np.dtype(dtype) or not fits:
        raise ValueError(
            f"{name!r} must be {np.dtype(dtype)} {expected}, is {array.dtype} {array.shape}"
        )
    if array.dtype.kind == "f":
        bad = np.isinf(array) if nan_allowed else ~np.isfinite(array)
        if bad.any():
            raise ValueError(f"{name!r} holds {np.count_nonzero(bad)} values that are not finite")
    return array


def json_of(arrays: Mapping[str, np.ndarray], name: str) -> Any:
    """What the text of that name says, as JSON; else ValueError."""
    if name not in arrays:
        raise ValueError(f"there is no array {name!r}")
    array = arrays[name]
    if array.dtype.kind != "U" or array.ndim:
        raise ValueError(f"{name!r} must be a text, is {array.dtype} {array.shape}")
    try:
        return json.loads(str(array))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{name!r} is not JSON: {error}") from error


def record_of(value: object, name: str, keys: Iterable[str]) -> dict[str, Any]:
    """`value`, if it is a table (of JSON) with these keys and no others; else ValueError."""
    keys = set(keys)
    if not isinstance(value, dict) or set(value) != keys:
        found = ", ".join(map(str, value)) if isinstance(value, dict) else repr(value)
        raise ValueError(f"{name} must hold {', '.join(sorted(keys))}, and holds {found[:200]}")
    return value
