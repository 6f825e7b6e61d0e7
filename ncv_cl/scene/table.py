"""Checked access to the tables that describe a scene: errors name file or caller, key and index."""

from __future__ import annotations

import difflib
import math
import numbers
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LARGEST = float(np.finfo(np.float32).max)


class SceneError(ValueError):
    """A scene cannot be used as it is; the message names file or caller, key and index."""


class Table:
    """One TOML table, or what a caller gave in its place, read with type and range checked.

    Parameters
    ----------
    source : Path or str
        The scene file, or the function that was called, for error messages.
    where : str
        The table's place in there, such as ``lights[1]``; empty for the top level.
    data : object
        What the TOML reader returned for that place, or a dict of the caller's values: for lists these
        may have tuples and numpy arrays, for numbers numpy's.
    keys : collection of str
        The keys that may occur.

    Raises
    ------
    SceneError
        If `data` is no table or has a key that is not in `keys`.
    """

    def __init__(self, source: Path | str, where: str, data: object, keys: Collection[str]) -> None:
        self.source = source
        self.where = where
        if not isinstance(data, dict):
            raise SceneError(f"{source}: {where}: expected a table, got {_describe(data)}")
        self._data: dict[str, Any] = data
        for key in data:
            if key not in keys:
                near = difflib.get_close_matches(key, keys, n=1, cutoff=0.0)
                raise self.error(key, f"unknown key; did you mean {near[0]!r}?")

    def __contains__(self, key: str) -> bool:
        return key in self._data

    def replaced(self, values: dict[str, object]) -> Table:
        """The same table with other values of some keys."""
        return Table(self.source, self.where, self._data | values, {*self._data, *values})

    def only(self, keys: Collection[str]) -> Table:
        """The same table, of which other keys are errors."""
        return Table(self.source, self.where, self._data, keys)

    def error(self, key: str, message: str) -> SceneError:
        """A `SceneError` that says where `key` stands; the caller raises it."""
        place = ".".join(part for part in (self.where, key) if part)
        return SceneError(f"{self.source}: {place}: {message}")

    def raw(self, key: str) -> Any:
        """The value of a required key, unchecked."""
        if key not in self._data:
            raise self.error(key, "is missing; it is required")
        return self._data[key]

    def tables(self, key: str, keys: Collection[str]) -> list[Table]:
        """An array of tables (``[[key]]``), empty if absent; each may hold `keys`."""
        return [
            Table(self.source, f"{key}[{i}]", entry, keys) for i, entry in enumerate(self.entries(key))
        ]

    def entries(self, key: str) -> list[Any]:
        """What stands in an array of tables (``[[key]]``), unchecked; empty if absent."""
        entries = self._data.get(key, [])
        if not isinstance(entries, list):
            raise self.error(key, f"expected an array of tables [[{key}]]")
        return entries

    def number(
        self,
        key: str,
        default: float | None = None,
        low: float = -math.inf,
        high: float = math.inf,
    ) -> float:
        """A finite number in [`low`, `high`]; required if there is no default."""
        if key not in self and default is not None:
            return default
        return self._checked(key, self.raw(key), low, high)

    def integer(self, key: str, default: int, low: int, high: int) -> int:
        """An integer in [`low`, `high`]."""
        value = self._data.get(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise self.error(key, f"expected an integer from {low} to {high}, got {value!r}")
        return value

    def vector(self, key: str, default: tuple[float, ...] | None = None) -> NDArray[np.float64]:
        """Three finite numbers, float64 (3,)."""
        if key not in self and default is not None:
            return np.array(default, dtype=np.float64)
        return self.vector_value(key, self.raw(key))

    def vector_value(self, key: str, value: object) -> NDArray[np.float64]:
        """Check three numbers that were found inside another value, named `key` in errors."""
        value = _plain(value)
        if not isinstance(value, list) or len(value) != 3:
            raise self.error(key, f"expected 3 numbers [x, y, z], got {_describe(value)}")
        return np.array([self._checked(f"{key}[{i}]", v) for i, v in enumerate(value)])

    def colour(
        self,
        key: str,
        default: float | None = None,
        high: float = math.inf,
    ) -> NDArray[np.float32]:
        """A number or three, each in [0, `high`]: linear RGB, float32 (3,)."""
        value = _plain(self.raw(key) if default is None else self._data.get(key, default))
        if not isinstance(value, list):
            return np.full(3, self._checked(key, value, 0.0, high), dtype=np.float32)
        if len(value) != 3:
            raise self.error(key, f"expected a number or 3 numbers, got {_describe(value)}")
        channels = [self._checked(f"{key}[{i}]", v, 0.0, high) for i, v in enumerate(value)]
        return np.array(channels, dtype=np.float32)

    def matrix(self, key: str) -> NDArray[np.float64]:
        """An affine 4x4 matrix as four rows, for column vectors; float64 (4, 4)."""
        rows = self.raw(key)
        if not (isinstance(rows, list) and len(rows) == 4) or not all(
            isinstance(row, list) and len(row) == 4 for row in rows
        ):
            raise self.error(key, f"expected 4 rows of 4 numbers, got {_describe(rows)}")
        matrix = np.array(
            [
                [self._checked(f"{key}[{i}][{j}]", v) for j, v in enumerate(row)]
                for i, row in enumerate(rows)
            ]
        )
        if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
            raise self.error(f"{key}[3]", "the last row of an affine transform is [0, 0, 0, 1]")
        return matrix

    def points(self, key: str, width: int = 3) -> NDArray[np.float64]:
        """An array of points or vectors, finite, float64 (n, width)."""
        found = self._array(key, "fiu", f"numbers (n, {width})", width).astype(np.float64)
        usable = np.abs(found) <= _LARGEST
        if not usable.all():
            row, column = np.argwhere(~usable)[0]
            self._checked(f"{key}[{row}][{column}]", float(found[row, column]))
        return found

    def indices(self, key: str, count: int) -> NDArray[np.int64]:
        """An array of triangles, each three indices below `count`; int64 (n, 3), n at least 1."""
        found = self._array(key, "iu", "whole numbers (n, 3)")
        if not len(found):
            raise self.error(key, "holds no triangle")
        outside = np.flatnonzero(((found < 0) | (found >= count)).any(axis=1))
        if len(outside):
            raise self.error(
                f"{key}[{outside[0]}]",
                f"refers to the vertices {found[outside[0]].tolist()}, but there are {count}, "
                "counted from 0",
            )
        return found.astype(np.int64)

    def text(self, key: str, default: str | None = None) -> str:
        """A string that is not empty."""
        value = self.raw(key) if default is None else self._data.get(key, default)
        if not isinstance(value, str) or not value:
            raise self.error(key, f"expected a non-empty string, got {value!r}")
        return value

    def choice(self, key: str, known: tuple[str, ...], default: str) -> str:
        """One of some words."""
        value = self._data.get(key, default)
        if value not in known:
            raise self.error(key, f"expected one of {', '.join(known)}, got {value!r}")
        return value

    def pair(self, key: str, default: float) -> tuple[float, float]:
        """Two finite numbers, or one that stands for both."""
        value = _plain(self._data.get(key, default))
        if not isinstance(value, list):
            value = [value, value]
        if len(value) != 2:
            raise self.error(key, f"expected a number or 2 numbers, got {_describe(value)}")
        first, second = (self._checked(f"{key}[{i}]", v) for i, v in enumerate(value))
        return first, second

    def flag(self, key: str, default: bool | None) -> bool | None:
        """A boolean, or `default` where the key is absent."""
        if key not in self:
            return default
        if not isinstance(self._data[key], (bool, np.bool_)):
            raise self.error(key, f"expected true or false, got {self._data[key]!r}")
        return bool(self._data[key])

    def _array(self, key: str, kinds: str, expected: str, width: int = 3) -> NDArray[Any]:
        """What numpy makes of a value: (n, width), of a dtype of one of `kinds`."""
        try:
            found = np.asarray(self.raw(key))
        except ValueError as error:  # rows of unequal lengths
            raise self.error(key, f"expected {expected}: {error}") from error
        if found.ndim != 2 or found.shape[1] != width or found.dtype.kind not in kinds:
            raise self.error(key, f"expected {expected}, got {found.dtype} {found.shape}")
        return found

    def _checked(
        self, place: str, value: object, low: float = -math.inf, high: float = math.inf
    ) -> float:
        value = _plain(value)
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            raise self.error(place, f"expected a number, got {_describe(value)}")
        # A whole number may be too large for any test but this.
        if value < -_LARGEST or not value <= _LARGEST:
            raise self.error(place, f"{str(value)[:40]} is not a finite single-precision number")
        if value < low or not value <= high:
            limits = f"from {low:g} to {high:g}" if high < math.inf else f"at least {low:g}"
            raise self.error(place, f"{value} is out of range; it must be {limits}")
        return float(value)


def _plain(value: object) -> object:
    """Lists for tuples and numpy arrays."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value


def _describe(value: object) -> str:
    """A value as an error message shows it: lists by their length, the rest as written."""
    return f"a list of {len(value)}" if isinstance(value, list) else repr(value)
