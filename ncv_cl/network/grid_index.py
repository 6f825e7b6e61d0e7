"""The hash grid's gather lists: which columns touch which table entry, for each minibatch."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..opencl.kernel import Arguments, Kernel
from ..opencl.memory import HostArray
from ..opencl.program import build
from .encode import Encoder, Encoding

# Pairs that one work-item looks through when lists are written.
PAIRS_AN_ITEM = 256


@dataclass(frozen=True)
class GridIndex:
    """Which columns touch which table entry, for each minibatch: the hash grid's gather lists.

    Attributes
    ----------
    touched : ndarray
        The table entries that any column touches, in increasing order; the index counts only these.
    corner : HostArray
        uint32 (columns, levels * 8), the entries around each column.
    batches : list of range
        For each minibatch, its items in `entries` and `starts`.
    arrays : dict of HostArray
        entries, starts, places and weights as adam.cl reads them.
    """

    touched: np.ndarray
    corner: HostArray
    batches: list[range]
    arrays: dict[str, HostArray]

    @classmethod
    def of(cls, encoder: Encoder, encoding: Encoding, batches: list[range]) -> GridIndex:
        """The lists of an encoder's columns, sorted by GPUs themselves, else by the host: the same."""
        sort = on_device if encoder.unit.device.vector_width == 1 else on_host
        return sort(encoder, encoding, batches)


def on_host(encoder: Encoder, encoding: Encoding, batches: list[range]) -> GridIndex:
    """The index, built by the host."""
    device = encoder.unit.device
    corner, weight = (one.read()[:, : encoder.count] for one in encoder.corners())
    is_touched = np.zeros(encoding.table_shape[0], bool)
    is_touched[corner.ravel()] = True
    number = np.cumsum(is_touched, dtype=np.uint32) - np.uint32(1)
    corner = number[corner]
    parts: list[list[np.ndarray]] = [[], [], [], []]
    ranges = []
    entries = pairs = 0
    # One minibatch at a time, so that what is sorted stays in the cache.
    for batch in batches:
        own = slice(batch.start, batch.stop)
        entry, starts, number = _by_entry(corner[:, own])
        place = _places(encoding, len(batch))[number]
        found = entry, starts + np.uint32(pairs), place, weight[:, own].ravel()[number]
        for part, array in zip(parts, found, strict=True):
            part.append(array)
        ranges.append(range(entries, entries + len(entry)))
        entries += len(entry)
        pairs += len(number)
    parts[1].append(np.array([pairs], np.uint32))
    whole = (HostArray.of(device, np.concatenate(part)) for part in parts)
    return GridIndex(
        np.flatnonzero(is_touched),
        HostArray.of(device, np.ascontiguousarray(corner.T)),
        ranges,
        dict(zip(("entries", "starts", "places", "weights"), whole, strict=True)),
    )


def on_device(encoder: Encoder, encoding: Encoding, batches: list[range]) -> GridIndex:
    """The same, built by grid_index.cl: the host only sums counts."""
    device = encoder.unit.device
    kernel = build(device, ("common", "grid_index"), encoding.defines()).kernel
    corner, weight = encoder.corners()
    shared = {"count": encoder.count, "stride": encoder.stride}
    marked = HostArray(device, encoding.table_shape[0], np.uint32)
    marked.fill(0)
    rows = corner.shape[0]
    kernel("mark_entries")(rows * encoder.stride, **shared, corner=corner, touched=marked)
    is_touched = marked.read()
    touched = np.flatnonzero(is_touched)
    number = HostArray.of(device, np.cumsum(is_touched, dtype=np.uint32) - np.uint32(1))
    keyed = Keys.of(encoder, rows, len(touched), batches)
    numbered = HostArray(device, (encoder.count, rows), np.uint32)
    kernel("make_keys")(
        keyed.words.shape[0],
        **shared,
        **keyed.shifts,
        size=keyed.words.shape[0],
        batches=len(batches),
        edges=keyed.edges,
        corner=corner,
        number=number,
        numbered=numbered,
        keys=keyed.words,
    )
    keyed.sort(kernel("sort_keys"))
    return GridIndex(touched, numbered, *keyed.write(kernel, encoder.stride, weight))


@dataclass(frozen=True)
class Keys:
    """A key for each pair of corner and column, padded to a power of two.

    Attributes
    ----------
    words : HostArray
        uint64 (size,).
    edges : HostArray
        uint32 (batches + 1,), where minibatches begin, and where the last ends.
    pairs : int
        How many keys are no padding.
    shifts : dict
        Where in a key entry and batch stand.
    """

    words: HostArray
    edges: HostArray
    pairs: int
    shifts: dict[str, int]

    @classmethod
    def of(cls, encoder: Encoder, rows: int, entries: int, batches: list[range]) -> Keys:
        """Room for the keys of `rows` corners a column, of so many touched entries."""
        device = encoder.unit.device
        pairs = rows * encoder.count
        edges = np.array([0, *(batch.stop for batch in batches)], np.uint32)
        entry_shift = (rows * max(map(len, batches)) - 1).bit_length()
        return cls(
            HostArray(device, 1 << (pairs - 1).bit_length(), np.uint64),
            HostArray.of(device, edges),
            pairs,
            {"entry_shift": entry_shift, "batch_shift": entry_shift + entries.bit_length()},
        )

    def sort(self, step: Kernel) -> None:
        """Sort them, on the device."""
        size = self.words.shape[0]
        for span in (1 << k for k in range(1, size.bit_length())):
            for reach in (span >> k for k in range(1, span.bit_length())):
                step(size // 2, size=size, span=span, reach=reach, keys=self.words)

    def write(
        self, kernel: Callable[[str], Kernel], stride: int, weight: HostArray
    ) -> tuple[list[range], Arguments]:
        """`batches` and `arrays` of the index, from sorted keys."""
        device = self.words.device
        items = -(-self.pairs // PAIRS_AN_ITEM)
        shared: Arguments = {"pairs": self.pairs, "chunk": PAIRS_AN_ITEM, "keys": self.words}
        counts = HostArray(device, items, np.uint32)
        entry_shift = self.shifts["entry_shift"]
        kernel("count_lists")(items, **shared, entry_shift=entry_shift, counts=counts)
        ends = np.cumsum(counts.read(), dtype=np.uint32)
        lists = int(ends[-1])
        arrays: Arguments = {
            "entries": HostArray(device, lists, np.uint32),
            "starts": HostArray(device, lists + 1, np.uint32),
            "places": HostArray(device, self.pairs, np.uint32),
            "weights": HostArray(device, self.pairs, np.float32),
        }
        batch_lists = HostArray(device, self.edges.shape[0] - 1, np.uint32)
        kernel("write_lists")(
            items,
            **shared,
            **self.shifts,
            **arrays,
            stride=stride,
            edges=self.edges,
            offsets=HostArray.of(device, np.concatenate([[0], ends[:-1]]).astype(np.uint32)),
            weight=weight,
            batch_lists=batch_lists,
        )
        firsts = [*batch_lists.read().tolist(), lists]
        return [range(a, b) for a, b in itertools.pairwise(firsts)], arrays


def _by_entry(corner: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pairs of corner and column, in the order of their entries.

    Parameters
    ----------
    corner : ndarray
        uint32 (levels * 8, columns), the entries.

    Returns
    -------
    entry, starts, number : ndarray
        Each entry once (uint32), where its pairs begin (uint32), and every pair's number in `corner`.
    """
    # Entry and number in one word, a short one if they fit: sorting plain words is many times faster
    # than finding an order.
    bits = (corner.size - 1).bit_length()
    fits = bits + int(corner.max()).bit_length() <= 32
    word: type[np.unsignedinteger] = np.uint32 if fits else np.uint64
    keys: NDArray[np.unsignedinteger] = corner.astype(word).ravel()
    keys <<= word(bits)
    keys |= np.arange(keys.size, dtype=word)
    keys.sort()
    entry = keys >> word(bits)
    starts = np.flatnonzero(np.append(True, entry[1:] != entry[:-1]))
    number = (keys & word((1 << bits) - 1)).astype(np.intp)
    return entry[starts].astype(np.uint32), starts.astype(np.uint32), number


@functools.lru_cache(maxsize=4)
def _places(encoding: Encoding, columns: int) -> np.ndarray:
    """Where the gradient of each pair's feature row stands, uint32 (levels * 8 * columns,)."""
    row, column = np.divmod(np.arange(encoding.grid_levels * 8 * columns, dtype=np.uint32), columns)
    places = column * encoding.grid_rows + row // 8 * encoding.grid_features
    return places.astype(np.uint32)
