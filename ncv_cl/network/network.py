"""The network: its description, its parameters, and its file."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..host.files import (
    array_of,
    json_of,
    read_arrays,
    real_number,
    record_of,
    save_arrays,
    some_of,
    whole_number,
    write_whole,
)
from ..points.sampler import HostStream, host_generator
from .encode import Encoding, GridCube

# The widest hidden layer, and the most channels, that exact integration and the kernels take.
WIDEST, MOST_CHANNELS = 128, 256


class NetworkError(ValueError):
    """A network that cannot be used: a bad file, or inputs or channels that do not fit the scene."""


# Groups of weights that φ may act on, in the order of their rows; W2 is the same for all points.
WEIGHT_GROUPS = ("W1", "B1", "B2", "W3", "B3")


@dataclass(frozen=True)
class NetworkDescription:
    """The shape of a network: all but its numbers.

    Attributes
    ----------
    encoding : Encoding
    channels : int
        Outputs.
    hidden : tuple of int
        Widths of the two hidden ReLU layers.
    modulated : tuple of str
        Those of `WEIGHT_GROUPS` that are ``base + head · features(φ)``; the others are ``base`` alone.
    demodulated : bool
        Whether the network learns f over the mean of its unshadowed part, point by point.
    """

    encoding: Encoding
    channels: int
    hidden: tuple[int, int] = (16, 16)
    modulated: tuple[str, ...] = WEIGHT_GROUPS
    demodulated: bool = False

    def __post_init__(self) -> None:
        whole_number("channels", self.channels, 1, MOST_CHANNELS)
        if not isinstance(self.hidden, tuple) or len(self.hidden) != 2:
            raise ValueError(f"hidden must be the widths of two layers, is {self.hidden!r}")
        for width in self.hidden:
            whole_number("hidden", width, 1, WIDEST)
        some_of("modulated", self.modulated, WEIGHT_GROUPS)
        if not isinstance(self.demodulated, bool):
            raise ValueError(f"demodulated must be true or false, is {self.demodulated!r}")

    @property
    def group_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each group's weights at one shading point."""
        first, second = self.hidden
        return {
            "W1": (first, 2),
            "B1": (first,),
            "B2": (second,),
            "W3": (self.channels, second),
            "B3": (self.channels,),
        }

    @property
    def group_rows(self) -> dict[str, int]:
        """First row of each group: modulated groups, which have heads, come first."""
        order = [g for g in WEIGHT_GROUPS if g in self.modulated] + [
            g for g in WEIGHT_GROUPS if g not in self.modulated
        ]
        rows, row = {}, 0
        for group in order:
            rows[group] = row
            row += math.prod(self.group_shapes[group])
        return rows

    @property
    def head_rows(self) -> int:
        return sum(math.prod(self.group_shapes[group]) for group in self.modulated)

    @property
    def base_rows(self) -> int:
        return sum(math.prod(shape) for shape in self.group_shapes.values()) - self.head_rows

    @property
    def parameter_count(self) -> int:
        heads = self.head_rows * (self.encoding.feature_count + 1)
        return math.prod(self.hidden) + heads + self.base_rows

    def unpack(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Views of a parameter vector: W2, heads (rows, features + 1), bases (rows,)."""
        first, second = self.hidden
        heads_at = first * second
        bases_at = parameters.size - self.base_rows
        w2 = parameters[:heads_at].reshape(second, first)
        heads = parameters[heads_at:bases_at].reshape(self.head_rows, self.encoding.feature_count + 1)
        return w2, heads, parameters[bases_at:]

    def base(self, parameters: np.ndarray, group: str) -> np.ndarray:
        """View of a group's base, its value where all features are zero."""
        _, heads, bases = self.unpack(parameters)
        rows, shape = self.group_rows[group], self.group_shapes[group]
        count = math.prod(shape)
        if group in self.modulated:
            return heads[rows : rows + count, -1].reshape(shape)
        start = rows - self.head_rows
        return bases[start : start + count].reshape(shape)

    def fold_layout(self, width: int) -> tuple[dict[str, int], int]:
        """First row of each modulated group, padded to vectors of `width`, and the number of rows."""
        offsets, row = {}, 0
        for group in WEIGHT_GROUPS:
            if group in self.modulated:
                offsets[group] = row
                row += -(-math.prod(self.group_shapes[group]) // width) * width
        return offsets, row

    def defines(self) -> dict[str, int | str]:
        """The `-D` constants of mlp.cl."""
        shapes = self.group_shapes
        strides = {g: math.prod(shapes[g]) if g in self.modulated else 0 for g in WEIGHT_GROUPS}
        return {
            **self.encoding.defines(),
            **{f"ROW_{group}": row for group, row in self.group_rows.items()},
            **{f"STRIDE_{group}": stride for group, stride in strides.items()},
            "HEAD_ROWS": self.head_rows,
            "BASE_ROWS": self.base_rows,
            "HIDDEN1": self.hidden[0],
            "HIDDEN2": self.hidden[1],
            "CHANNELS": self.channels,
            "DEMODULATED": int(self.demodulated),
        }


@dataclass(frozen=True)
class Network:
    """A description with its numbers.

    Attributes
    ----------
    description : NetworkDescription
    parameters : ndarray
        float32 (description.parameter_count,).
    table : ndarray
        float32, the hash grid's entries, shape ``encoding.table_shape``.
    cube : GridCube
    """

    description: NetworkDescription
    parameters: np.ndarray
    table: np.ndarray
    cube: GridCube

    @classmethod
    def random(cls, description: NetworkDescription, cube: GridCube, seed: int) -> Network:
        """He-uniform weights, first-layer lines spread over the unit square, a grid near zero."""
        generator = host_generator(seed, HostStream.NETWORK)
        parameters = np.zeros(description.parameter_count, np.float32)
        first, second = description.hidden
        w2, heads, _ = description.unpack(parameters)
        features = description.encoding.feature_count
        heads[...] = generator.uniform(-1, 1, heads.shape) * np.sqrt(6.0 / (2 + features))
        w2[...] = generator.uniform(-1, 1, w2.shape) * np.sqrt(6.0 / first)
        w1 = description.base(parameters, "W1")
        w1[...] = generator.uniform(-1, 1, w1.shape) * np.sqrt(6.0)
        w3 = description.base(parameters, "W3")
        w3[...] = generator.uniform(-1, 1, w3.shape) * np.sqrt(6.0 / second)
        # Each first-layer line passes through a random point of the square, before features move it.
        through = generator.uniform(size=(first, 2))
        description.base(parameters, "B1")[...] = -np.sum(w1 * through, axis=1)
        description.base(parameters, "B2")[...] = 0.0
        description.base(parameters, "B3")[...] = 0.0
        table = generator.random(description.encoding.table_shape, np.float32)
        table -= np.float32(0.5)
        table *= np.float32(2e-4)
        return cls(description, parameters, table, cube)

    @property
    def digest(self) -> str:
        """A hash of the numbers and the description."""
        digest = hashlib.sha256(f"{self.description}{self.cube}".encode())
        for array in (self.parameters, self.table):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def check_fits(self, channels: int, inputs: tuple[str, ...]) -> None:
        """Refuse other channels or inputs than the ones a scene and integrand have.

        Raises
        ------
        NetworkError
            Naming what differs.
        """
        own = self.description
        if own.channels != channels:
            raise NetworkError(f"the network has {own.channels} channels, the integrand {channels}")
        if own.encoding.inputs != inputs:
            raise NetworkError(
                f"the network takes {', '.join(own.encoding.inputs)}, but what varies in this scene is "
                f"{', '.join(inputs)}: train it on this scene and integrand"
            )

    def save(self, path: str | Path, **companions: np.ndarray) -> None:
        """Write an ``.npz`` with the numbers and, as JSON, the description.

        Parameters
        ----------
        companions : ndarray
            Further arrays for the same file, by name: the density network's.
        """
        write_whole(path, lambda file: self.write(file, **companions))

    def write(self, file: BinaryIO, **companions: np.ndarray) -> None:
        """As `save`, into an open file."""
        text = json.dumps({"description": asdict(self.description), "cube": asdict(self.cube)})
        arrays = {"about": np.array(text), "parameters": self.parameters, "table": self.table}
        save_arrays(file, arrays | companions)

    @classmethod
    def load(cls, path: str | Path) -> Network:
        """Read what `save` wrote.

        Raises
        ------
        NetworkError
            If the file is not a network's, or its arrays do not fit its description.
        """
        try:
            return cls.of_arrays(read_arrays(path))
        except ValueError as error:
            raise NetworkError(f"{path} is not a network saved by ncv_cl: {error}") from error

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Network:
        """The network whose numbers and description `write` has put into a file's arrays.

        Raises
        ------
        ValueError
            Naming what is missing, of another type or shape, or out of range.
        """
        about = record_of(json_of(arrays, "about"), "about", ("description", "cube"))
        names = (field.name for field in fields(NetworkDescription))
        stored = record_of(about["description"], "description", names)
        names = (field.name for field in fields(Encoding))
        encoding = record_of(stored["encoding"], "encoding", names)
        # JSON has lists only; their elements are checked where they are used.
        lists = {"inputs": encoding["inputs"]} | {k: stored[k] for k in ("hidden", "modulated")}
        if not all(isinstance(one, list) for one in lists.values()):
            raise ValueError("inputs, hidden and modulated must be lists")
        tuples = {name: tuple(one) for name, one in lists.items()}
        stored["encoding"] = Encoding(**encoding | {"inputs": tuples.pop("inputs")})
        description = NetworkDescription(**stored | tuples)
        cube = record_of(about["cube"], "cube", ("lower", "side"))
        lower, largest = cube["lower"], float(np.finfo(np.float32).max)
        if not isinstance(lower, list) or len(lower) != 3:
            raise ValueError(f"the cube's lower corner must be three numbers, is {lower!r}")
        x, y, z = (real_number("the cube's corner", one, -largest, largest) for one in lower)
        side = real_number("the cube's side", cube["side"], float(np.finfo(np.float32).tiny), largest)
        return cls(
            description,
            array_of(arrays, "parameters", np.float32, (description.parameter_count,)),
            array_of(arrays, "table", np.float32, description.encoding.table_shape),
            GridCube((x, y, z), side),
        )
