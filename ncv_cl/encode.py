"""φ → features: which inputs vary in a scene, and their encoding on the device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .device import Device, HostArray
from .points import ShadingPoints, surface_defines
from .program import Program, build

# Components that each input has before its encoding, in feature order.
INPUTS = ("position", "normal", "outgoing", "albedo", "roughness")


@dataclass(frozen=True)
class Encoding:
    """How φ becomes the network's features; defaults follow the slides' table.

    Attributes
    ----------
    inputs : tuple of str
        Which of `INPUTS` are fed. Position is always among them.
    grid_levels, grid_features, grid_base, grid_entries : int
        The hash grid over position: levels, features a level, cells an axis of the coarsest level
        (each next one has twice as many), table entries a level.
    blob_bins : int
        Gaussians a one-blob angle is encoded in.
    """

    inputs: tuple[str, ...]
    grid_levels: int = 4
    grid_features: int = 2
    grid_base: int = 8
    grid_entries: int = 1 << 15
    blob_bins: int = 4

    @property
    def grid_rows(self) -> int:
        return self.grid_levels * self.grid_features

    @property
    def feature_count(self) -> int:
        widths = {
            "normal": 2 * self.blob_bins,
            "outgoing": 2 * self.blob_bins,
            "albedo": 3,
            "roughness": 1,
        }
        return self.grid_rows + sum(widths[name] for name in self.inputs if name != "position")

    @property
    def table_shape(self) -> tuple[int, int]:
        return self.grid_levels * self.grid_entries, self.grid_features

    def defines(self) -> dict[str, int | str]:
        """The `-D` constants of encode.cl."""
        return {
            **surface_defines(),
            "FEATURES": self.feature_count,
            "GRID_LEVELS": self.grid_levels,
            "GRID_FEATURES": self.grid_features,
            "GRID_BASE": self.grid_base,
            "GRID_ENTRIES": f"{self.grid_entries}u",
            "BLOB_BINS": self.blob_bins,
            **{f"USE_{name.upper()}": int(name in self.inputs) for name in INPUTS[1:]},
        }


def varying_inputs(points: ShadingPoints, candidates: tuple[str, ...]) -> tuple[str, ...]:
    """Those of `candidates` that differ between active shading points; position always does.

    An input that is the same at every point tells the network nothing.
    """
    has_specular = bool(np.any(points.rows("reflectance")[:, : points.active] > 0))
    chosen = []
    for name in INPUTS:
        if name not in candidates or (name in ("outgoing", "roughness") and not has_specular):
            continue
        rows = points.rows(name)[:, : points.active]
        if name == "position" or np.any(np.ptp(rows, axis=1) > 0 if rows.size else False):
            chosen.append(name)
    return tuple(chosen)


@dataclass(frozen=True)
class GridCube:
    """The cube that the hash grid divides: its lower corner and side, world space."""

    lower: tuple[float, float, float]
    side: float

    @classmethod
    def around(cls, bounds: np.ndarray) -> GridCube:
        """The smallest such cube around `bounds`, float (2, 3)."""
        side = float(np.max(bounds[1] - bounds[0])) or 1.0
        lower = 0.5 * (bounds[0] + bounds[1]) - 0.5 * side
        return cls((float(lower[0]), float(lower[1]), float(lower[2])), side)


class Encoder:
    """Encodes shading points, column after column in a given order, into feature rows.

    Parameters
    ----------
    device, encoding, points, cube
    order : HostArray
        uint32 (columns,), the shading point of each column.
    """

    def __init__(
        self,
        device: Device,
        encoding: Encoding,
        points: ShadingPoints,
        cube: GridCube,
        order: HostArray,
    ) -> None:
        self._program: Program = build(device, ("common", "surface", "encode"), encoding.defines())
        self.count = order.shape[0]
        # Whole vectors can be loaded at the end of each row.
        self.stride = -(-self.count // device.vector_width) * device.vector_width
        self.features = HostArray(device, (encoding.feature_count, self.stride), np.float32)
        self.features.fill(0.0)
        corners = (encoding.grid_levels * 8, self.stride)
        self.corner = HostArray(device, corners, np.uint32)
        self.weight = HostArray(device, corners, np.float32)
        place = (self.count, self.stride, points.total)
        kernel = self._program.kernel
        if encoding.feature_count > encoding.grid_rows:
            kernel("encode_fixed")(self.count, *place, order, points.surface, self.features)
        kernel("grid_corners")(
            self.count,
            *place,
            *cube.lower,
            1.0 / cube.side,
            order,
            points.surface,
            self.corner,
            self.weight,
        )

    def encode_grid(self, table: HostArray) -> None:
        """Refresh the grid's feature rows from `table`."""
        self._program.kernel("encode_grid")(
            self.count, self.count, self.stride, self.corner, self.weight, table, self.features
        )
