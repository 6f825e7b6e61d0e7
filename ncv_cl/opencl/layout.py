"""Records: named fields of numbers one after another, declared once for the host and for kernels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import ArrayLike


class Record:
    """What a record is made of: fields in order, and how many numbers each has.

    Records lie one after another (an array of shape (records, size)), or their numbers in planes (size,
    records). ``record["name"]`` is a field's slice of either's axis; iterating yields the fields' names.

    Parameters
    ----------
    prefix : str
        What the names of the `-D` constants begin with.
    fields : dict of int
        Numbers of each field, by name in lower case.
    dtype : numpy dtype
        float32 or uint32. What else a word holds is the user's business.
    multiple : int
        Records are this long, or twice, ...; what no field names is zero.

    Attributes
    ----------
    size : int
        Numbers of a record.
    """

    def __init__(
        self,
        prefix: str,
        fields: Mapping[str, int],
        dtype: np.dtype | type = np.float32,
        multiple: int = 1,
    ) -> None:
        self._prefix, self._dtype = prefix, np.dtype(dtype)
        self._slices, end = {}, 0
        for name, count in fields.items():
            self._slices[name] = slice(end, end + count)
            end += count
        self.size = -(-end // multiple) * multiple

    def __getitem__(self, name: str) -> slice:
        return self._slices[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._slices)

    def defines(self) -> dict[str, int]:
        """Where each field begins, and how long a record is.

        Of the record LIGHT with a field `edge1`: LIGHT_EDGE1, and LIGHT_FLOATS, or LIGHT_WORDS where
        records are of integers.
        """
        starts = {f"{self._prefix}_{name.upper()}": at.start for name, at in self._slices.items()}
        unit = "FLOATS" if self._dtype.kind == "f" else "WORDS"
        return {**starts, f"{self._prefix}_{unit}": self.size}

    def pack(self, **values: ArrayLike) -> np.ndarray:
        """Records of these values, an array of shape (..., size).

        Parameters
        ----------
        values : array_like
            Of every field, shape (...) where it is one number and (..., numbers) where it is several.
            What the dots stand for is broadcast.

        Raises
        ------
        TypeError
            If a field is missing or unknown.
        ValueError
            If a field has another number of numbers.
        """
        if values.keys() != self._slices.keys():
            odd = ", ".join(sorted(values.keys() ^ self._slices.keys()))
            raise TypeError(f"{self._prefix} has the fields {', '.join(self._slices)}: see {odd}")
        arrays = {}
        for name, value in values.items():
            at, array = self._slices[name], np.asarray(value)
            count = at.stop - at.start
            arrays[name] = array = array[..., None] if count == 1 else array
            if array.shape[-1:] != (count,):
                raise ValueError(f"{self._prefix}: {name} is {count} numbers, got shape {array.shape}")
        shape = np.broadcast_shapes(*(array.shape[:-1] for array in arrays.values()))
        records = np.zeros((*shape, self.size), self._dtype)
        for name, array in arrays.items():
            records[..., self._slices[name]] = array
        return records
