"""The network: its description, its parameters, and its form folded for the points of an image."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO
from zipfile import BadZipFile

import numpy as np

from .device import Device, HostArray
from .encode import Encoding, GridCube
from .points import ShadingPoints
from .program import Program, build

# Points whose features are held at a time while they are folded.
POINTS_PER_FOLD = 1 << 16


class NetworkError(ValueError):
    """A network that does not fit: a bad file, or other features than the scene's."""


# Groups of weights that φ may act on, in the order of their rows; W2 is the same for all points.
GROUPS = ("W1", "B1", "B2", "W3", "B3")


@dataclass(frozen=True)
class NetworkDescription:
    """All that fixes the network but its numbers; training, inference and integration follow it.

    Attributes
    ----------
    encoding : Encoding
    channels : int
        Outputs.
    hidden : tuple of int
        Widths of the two hidden ReLU layers.
    modulated : tuple of str
        Those of `GROUPS` that are ``base + head · features(φ)``; the others are ``base`` alone.
    demodulated : bool
        Whether the network learns f over the mean of its unshadowed part, point by point.
    """

    encoding: Encoding
    channels: int
    hidden: tuple[int, int] = (16, 16)
    modulated: tuple[str, ...] = GROUPS
    demodulated: bool = False

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
        order = [g for g in GROUPS if g in self.modulated] + [
            g for g in GROUPS if g not in self.modulated
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
        """View of a group's base: what it is where all features are zero."""
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
        for group in GROUPS:
            if group in self.modulated:
                offsets[group] = row
                row += -(-math.prod(self.group_shapes[group]) // width) * width
        return offsets, row

    def defines(self) -> dict[str, int | str]:
        """The `-D` constants of mlp.cl."""
        shapes = self.group_shapes
        heads_at = math.prod(self.hidden)
        strides = {g: math.prod(shapes[g]) if g in self.modulated else 0 for g in GROUPS}
        return {
            **self.encoding.defines(),
            **{f"ROW_{group}": row for group, row in self.group_rows.items()},
            **{f"STRIDE_{group}": stride for group, stride in strides.items()},
            "HEAD_ROWS": self.head_rows,
            "BASE_ROWS": self.base_rows,
            "AT_HEADS": heads_at,
            "AT_BASES": heads_at + self.head_rows * (self.encoding.feature_count + 1),
            "HIDDEN1": self.hidden[0],
            "HIDDEN2": self.hidden[1],
            "CHANNELS": self.channels,
            "DEMODULATED": int(self.demodulated),
        }


class PaddedLayout:
    """A network's parameter vector as train.cl holds it: every row padded to vectors of `width`."""

    def __init__(self, description: NetworkDescription, width: int) -> None:
        def padded(floats: int) -> int:
            return -(-floats // width) * width

        self._description = description
        first, second = description.hidden
        self.w2_stride = padded(first)
        self.feature_floats = padded(description.encoding.feature_count + 1)
        self.heads_at = second * self.w2_stride
        self.bases_at = self.heads_at + description.head_rows * self.feature_floats
        self.loss_at = self.bases_at + description.base_rows
        self.size = padded(self.loss_at + 1)

    def defines(self) -> dict[str, int | str]:
        """The `-D` constants of train.cl and adam.cl about it."""
        return {
            "W2_STRIDE": self.w2_stride,
            "FEATURE_FLOATS": self.feature_floats,
            "AT_HEADS": self.heads_at,
            "AT_BASES": self.bases_at,
            "AT_LOSS": self.loss_at,
            "PARTIAL_FLOATS": f"{self.size}u",
        }

    def _views(self, padded: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        w2 = padded[: self.heads_at].reshape(-1, self.w2_stride)
        heads = padded[self.heads_at : self.bases_at].reshape(-1, self.feature_floats)
        description = self._description
        columns = description.encoding.feature_count + 1
        return (
            w2[:, : description.hidden[0]],
            heads[:, :columns],
            padded[self.bases_at : self.loss_at],
        )

    def pack(self, parameters: np.ndarray) -> np.ndarray:
        """The padded vector of a plain one."""
        padded = np.zeros(self.size, np.float32)
        for view, part in zip(self._views(padded), self._description.unpack(parameters), strict=True):
            view[...] = part
        return padded

    def unpack(self, padded: np.ndarray) -> np.ndarray:
        """The plain vector of a padded one."""
        return np.concatenate([view.ravel() for view in self._views(padded)])


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
        generator = np.random.Generator(np.random.Philox(seed))
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
            Arrays of what was trained beside the network, kept in the same file under their names.
        """
        with open(path, "wb") as file:
            self.write(file, **companions)

    def write(self, file: BinaryIO, **companions: np.ndarray) -> None:
        """As `save`, into an open file."""
        text = json.dumps({"description": asdict(self.description), "cube": asdict(self.cube)})
        arrays = {"parameters": self.parameters, "table": self.table}
        np.savez(file, about=np.array(text), **arrays, **companions)

    @classmethod
    def load(cls, path: str | Path) -> Network:
        """Read what `save` wrote.

        Raises
        ------
        NetworkError
            If the file is none of ours or its arrays do not fit its description.
        """
        try:
            with np.load(path) as file:
                about = json.loads(str(file["about"]))
                parameters, table = file["parameters"], file["table"]
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise NetworkError(f"{path} is not a network saved by ncv_cl: {error}") from error
        encoding = dict(about["description"]["encoding"])
        encoding["inputs"] = tuple(encoding["inputs"])
        stored = about["description"]
        description = NetworkDescription(
            Encoding(**encoding),
            stored["channels"],
            tuple(stored["hidden"]),
            tuple(stored["modulated"]),
            stored["demodulated"],
        )
        expected = (description.parameter_count,), description.encoding.table_shape
        if (parameters.shape, table.shape) != expected:
            raise NetworkError(
                f"{path}: arrays of shapes {parameters.shape} and {table.shape} do not fit the "
                f"description, which needs {expected[0]} and {expected[1]}"
            )
        cube = GridCube(tuple(about["cube"]["lower"]), about["cube"]["side"])
        return cls(description, parameters, table, cube)


class FoldedNetwork:
    """A network with φ folded in: per shading point, a small network of (u, v) alone.

    Parameters
    ----------
    device, network, points
    factor : HostArray, optional
        float32 (channels, points.active), what a demodulated network's output is multiplied by.

    Attributes
    ----------
    arrays : tuple of HostArray
        w1, b1, w2, b2, w3, b3 as mlp.cl takes them: modulated groups with a leading points axis.
    """

    def __init__(
        self,
        device: Device,
        network: Network,
        points: ShadingPoints,
        factor: HostArray | None = None,
    ) -> None:
        self.device = device
        self.network = network
        description = network.description
        if description.demodulated != (factor is not None):
            raise NetworkError("a demodulated network needs the points' factors, another takes none")
        self.groups: dict[str, HostArray] = {}
        for group, shape in description.group_shapes.items():
            if group in description.modulated:
                self.groups[group] = HostArray(device, (points.active, *shape), np.float32)
            else:
                self.groups[group] = HostArray.of(device, description.base(network.parameters, group))
        self._w2 = HostArray.of(device, description.unpack(network.parameters)[0])
        self._fold(points, factor)

    def _fold(self, points: ShadingPoints, factor: HostArray | None) -> None:
        device, network = self.device, self.network
        description, width = network.description, device.vector_width
        offsets, rows = description.fold_layout(width)
        _, heads, _ = description.unpack(network.parameters)
        transposed = np.zeros((heads.shape[1], rows), np.float32)
        for group, start in offsets.items():
            first, count = description.group_rows[group], math.prod(description.group_shapes[group])
            transposed[:, start : start + count] = heads[first : first + count].T
        defines = {
            **description.defines(),
            "FOLD_ROWS": rows,
            **{f"FOLD_{group}": offset for group, offset in offsets.items()},
        }
        heads_array = HostArray.of(device, transposed)
        build(device, ("common", "surface", "encode", "fold"), defines).kernel("fold")(
            -(-points.active // width),
            points.active,
            points.total,
            *network.cube.about(points.origin),
            points.surface,
            HostArray.of(device, network.table),
            heads_array,
            factor if factor is not None else heads_array,
            *(self.groups[group] for group in GROUPS),
        )
        device.queue.finish()

    @property
    def arrays(self) -> tuple[HostArray, ...]:
        groups = self.groups
        return groups["W1"], groups["B1"], self._w2, groups["B2"], groups["W3"], groups["B3"]

    def program(self) -> Program:
        return build(self.device, ("common", "mlp"), self.network.description.defines())

    def layers(self) -> tuple[list[HostArray], list[HostArray]]:
        """Weights and biases as `Integrator.run` takes them."""
        w1, b1, w2, b2, w3, b3 = self.arrays
        return [w1, w2, w3], [b1, b2, b3]

    @property
    def per_point(self) -> tuple[list[bool], list[bool]]:
        """Which weights and biases have a leading points axis."""
        modulated = self.network.description.modulated
        return ["W1" in modulated, False, "W3" in modulated], [
            b in modulated for b in ("B1", "B2", "B3")
        ]
