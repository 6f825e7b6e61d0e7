"""The network: its description, its parameters, and its form folded for the points of an image."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from .device import Device, HostArray
from .encode import Encoder, Encoding, GridCube
from .points import ShadingPoints
from .program import Program, build

# Points whose features are held at a time while they are folded.
POINTS_PER_FOLD = 1 << 16


class NetworkError(ValueError):
    """A network that does not fit: a bad file, or other features than the scene's."""


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
    """

    encoding: Encoding
    channels: int
    hidden: tuple[int, int] = (32, 32)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each parameter array, in the order in which the parameter vector holds them."""
        first, second = self.hidden
        return {
            "W1": (first, 2 + self.encoding.feature_count),
            "B1": (first,),
            "W2": (second, first),
            "B2": (second,),
            "W3": (self.channels, second),
            "B3": (self.channels,),
        }

    @property
    def parameter_count(self) -> int:
        return sum(int(np.prod(shape)) for shape in self.shapes.values())

    def unpack(self, parameters: np.ndarray) -> dict[str, np.ndarray]:
        """Views of the arrays in a parameter vector."""
        views, start = {}, 0
        for name, shape in self.shapes.items():
            size = int(np.prod(shape))
            views[name] = parameters[start : start + size].reshape(shape)
            start += size
        return views

    def defines(self) -> dict[str, int | str]:
        """The `-D` constants of mlp.cl."""
        starts, start = {}, 0
        for name, shape in self.shapes.items():
            starts[f"AT_{name}"] = start
            start += int(np.prod(shape))
        return {
            **self.encoding.defines(),
            **starts,
            "HIDDEN1": self.hidden[0],
            "HIDDEN2": self.hidden[1],
            "CHANNELS": self.channels,
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
        generator = np.random.Generator(np.random.Philox(seed))
        parameters = np.zeros(description.parameter_count, np.float32)
        views = description.unpack(parameters)
        for name in ("W1", "W2", "W3"):
            limit = np.sqrt(6.0 / views[name].shape[1])
            views[name][...] = generator.uniform(-limit, limit, views[name].shape)
        # Each first-layer line passes through a random point of the square, before features move it.
        through = generator.uniform(size=(description.hidden[0], 2))
        views["B1"][...] = -np.sum(views["W1"][:, :2] * through, axis=1)
        table = generator.uniform(-1e-4, 1e-4, description.encoding.table_shape).astype(np.float32)
        return cls(description, parameters, table, cube)

    def save(self, path: str | Path) -> None:
        """Write an ``.npz`` with the numbers and, as JSON, the description."""
        text = json.dumps({"description": asdict(self.description), "cube": asdict(self.cube)})
        with open(path, "wb") as file:
            np.savez(file, about=np.array(text), parameters=self.parameters, table=self.table)

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
        except (OSError, ValueError, KeyError) as error:
            raise NetworkError(f"{path} is not a network saved by ncv_cl: {error}") from error
        encoding = dict(about["description"]["encoding"])
        encoding["inputs"] = tuple(encoding["inputs"])
        description = NetworkDescription(
            Encoding(**encoding),
            about["description"]["channels"],
            tuple(about["description"]["hidden"]),
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

    Attributes
    ----------
    network : Network
    folded : HostArray
        float32 (points.active, HIDDEN1), the first layer's bias of each active point.
    parameters : HostArray
        float32 (description.parameter_count,).
    """

    def __init__(self, device: Device, network: Network, points: ShadingPoints) -> None:
        self.device = device
        self.network = network
        self.parameters = HostArray.of(device, network.parameters)
        hidden = network.description.hidden[0]
        self.folded = HostArray(device, (points.active, hidden), np.float32)
        table = HostArray.of(device, network.table)
        fold = self.program().kernel("fold")
        for first in range(0, points.active, POINTS_PER_FOLD):
            count = min(POINTS_PER_FOLD, points.active - first)
            order = HostArray.of(device, np.arange(first, first + count, dtype=np.uint32))
            encoder = Encoder(device, network.description.encoding, points, network.cube, order)
            encoder.encode_grid(table)
            part = self.folded.buffer.get_sub_region(first * hidden * 4, count * hidden * 4)
            groups = -(-count // device.vector_width)
            fold(groups, count, encoder.stride, encoder.features, self.parameters, part)
            device.queue.finish()

    def program(self) -> Program:
        return build(self.device, ("common", "mlp"), self.network.description.defines())

    def layers(self) -> tuple[list[HostArray], list[HostArray]]:
        """Weights and biases as `Integrator.run` takes them; the first bias is per point."""
        views = self.network.description.unpack(self.network.parameters)
        arrays = {
            name: HostArray.of(self.device, np.ascontiguousarray(view)) for name, view in views.items()
        }
        uv_columns = HostArray.of(self.device, np.ascontiguousarray(views["W1"][:, :2]))
        weights = [uv_columns, arrays["W2"], arrays["W3"]]
        return weights, [self.folded, arrays["B2"], arrays["B3"]]
