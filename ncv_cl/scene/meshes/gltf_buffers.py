"""The container of glTF 2.0: JSON, buffers, and accessors as arrays."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from ...host.reach import OutsideError, Reach
from .files import find_file

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# Zeros that a few bytes announce, of an accessor that has only sparse values.
_MOST_ZEROS = 1 << 22
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942


class Container:
    """A glTF or GLB file whose buffers are read when an accessor needs them.

    Attributes
    ----------
    tree : dict
        The JSON as it stands in the file.

    Raises
    ------
    ValueError
        If the file is not glTF 2.
    """

    def __init__(self, path: Path, reach: Reach) -> None:
        self._path = path
        self._reach = reach
        self._buffers: dict[object, bytes] = {}
        data = path.read_bytes()
        text: bytes | None = data
        self._binary: bytes | None = None
        if data[:4] == b"glTF":
            chunks = dict(reversed(list(_chunks(data))))
            text, self._binary = chunks.get(_JSON_CHUNK), chunks.get(_BINARY_CHUNK)
        try:
            self.tree: dict[str, Any] = json.loads((text or b"").decode("utf-8-sig"))
            version = str(self.tree["asset"]["version"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"cannot be read as glTF: {error!r}") from error
        if version.split(".")[0] != "2":
            raise ValueError(f"is glTF {version}, and glTF 2 is read: convert it")

    def entry(self, kind: str, index: object) -> dict[str, Any]:
        """An element of one of the top-level arrays; `ValueError` if there is none."""
        entries = self.tree.get(kind, [])
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(entries):
            raise ValueError(f"{kind}[{index}] does not exist: the file has {len(entries)}")
        return entries[index]

    def view(self, index: object) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride (0: tightly packed)."""
        view = self.entry("bufferViews", index)
        extensions = view.get("extensions", {})
        buffer = self._buffer(view.get("buffer"), extensions)
        start, length = view.get("byteOffset", 0), view["byteLength"]
        if start < 0 or start + length > len(buffer):
            raise ValueError(
                f"bufferViews[{index}] ends at byte {start + length}, but its buffer has {len(buffer)}"
            )
        return memoryview(buffer)[start : start + length], view.get("byteStride", 0)

    def array(self, index: object, decode: bool = True) -> NDArray:
        """An accessor's values (count, width), sparse ones put in.

        Parameters
        ----------
        index : int
        decode : bool
            Whether normalised integers become numbers in [0, 1] or [-1, 1] and all values float64;
            else they stay as stored.
        """
        accessor = self.entry("accessors", index)
        what = f"accessors[{index}]"
        width = _WIDTHS.get(accessor.get("type", ""))
        kind = _COMPONENTS.get(accessor.get("componentType", 0))
        if width is None or kind is None:
            raise ValueError(f"{what} has an unknown type or componentType")
        count = accessor["count"]
        if "bufferView" in accessor:
            values = self._block(accessor, count, width, kind, what)
        elif "sparse" not in accessor:
            raise ValueError(f"{what} has no data: it may be compressed by an extension")
        elif count > _MOST_ZEROS:
            raise ValueError(f"{what} has {count} elements without data; {_MOST_ZEROS} are read")
        else:
            values = np.zeros((count, width), dtype=kind)
        if "sparse" in accessor:
            values = self._substituted(values, accessor["sparse"], width, kind, what)
        return _decoded(values, bool(accessor.get("normalized"))) if decode else values

    def image(self, index: object) -> bytes | Path | None:
        """An image's content, or the file that holds it; None if it is not there."""
        try:
            image = self.entry("images", index)
            if "bufferView" in image:
                return bytes(self.view(image["bufferView"])[0])
            uri = image["uri"]
            return _data_of_uri(uri) if uri.startswith("data:") else self._file(uri)
        except OutsideError:
            raise
        except (ValueError, KeyError):
            return None

    def _block(self, place: dict[str, Any], count: int, width: int, kind: str, what: str) -> NDArray:
        """`count` rows of `width` components from a buffer view, as strided as they are stored."""
        data, stride = self.view(place["bufferView"])
        item = np.dtype(kind).itemsize * width
        offset, stride = place.get("byteOffset", 0), stride or item
        end = offset + (count - 1) * stride + item
        if count < 0 or offset < 0 or (count and end > len(data)):
            raise ValueError(f"{what} ends at byte {end}, but its bufferView has {len(data)}")
        if count == 0:
            return np.zeros((0, width), dtype=kind)
        steps = (stride, np.dtype(kind).itemsize)
        return np.ndarray((count, width), kind, data, offset, steps).copy()

    def _substituted(
        self, values: NDArray, sparse: dict[str, Any], width: int, kind: str, what: str
    ) -> NDArray:
        count, indices = sparse["count"], sparse["indices"]
        where = self._block(indices, count, 1, _COMPONENTS[indices["componentType"]], what)[:, 0]
        if count and where.max() >= len(values):
            raise ValueError(f"{what}: sparse index {where.max()} is beyond its {len(values)} elements")
        values[where] = self._block(sparse["values"], count, width, kind, what)
        return values

    def _buffer(self, index: object, extensions: dict[str, Any]) -> bytes:
        buffer = self.entry("buffers", index)
        if index not in self._buffers:
            uri = buffer.get("uri")
            if uri is None and index == 0 and self._binary is not None:
                data = self._binary
            elif uri is None:
                names = ", ".join(extensions) or "an extension"
                raise ValueError(f"buffers[{index}] has no data: it may be compressed by {names}")
            elif uri.startswith("data:"):
                data = _data_of_uri(uri)
            else:
                file = self._file(uri)
                if file is None:
                    raise ValueError(f"buffers[{index}]: the file {unquote(uri)!r} does not exist")
                data = file.read_bytes()
            if len(data) < buffer.get("byteLength", 0):
                raise ValueError(
                    f"buffers[{index}] was cut off: it has {len(data)} of {buffer['byteLength']} bytes"
                )
            self._buffers[index] = data
        return self._buffers[index]

    def _file(self, uri: str) -> Path | None:
        # Writers that do not encode names may mean a percent sign as it stands.
        folder = self._path.parent
        return find_file(folder, unquote(uri), self._reach) or find_file(folder, uri, self._reach)


def _chunks(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind and content of the chunks of a GLB file."""
    version, length = (int.from_bytes(data[i : i + 4], "little") for i in (4, 8))
    if version != 2:
        raise ValueError(f"is a GLB file of version {version}, and version 2 is read: convert it")
    if length > len(data):
        raise ValueError(f"was cut off: it has {len(data)} of {length} bytes")
    start = 12
    while start + 8 <= length:
        size, kind = (int.from_bytes(data[i : i + 4], "little") for i in (start, start + 4))
        yield kind, data[start + 8 : start + 8 + size]
        start += 8 + size


def _data_of_uri(uri: str) -> bytes:
    head, _, content = uri.partition(",")
    try:
        raw = unquote_to_bytes(content)
        if not head.endswith(";base64"):
            return raw
        return base64.b64decode(raw + b"=" * (-len(raw) % 4))
    except (ValueError, binascii.Error) as error:
        raise ValueError(f"a data URI cannot be decoded: {error}") from error


def _decoded(values: NDArray, normalised: bool) -> NDArray[np.float64]:
    """As float64; normalised integers by the equations of the specification."""
    numbers = values.astype(np.float64)
    if normalised and values.dtype.kind in "iu":
        numbers = np.maximum(numbers / np.iinfo(values.dtype).max, -1.0)
    return numbers
