"""φ → features: which inputs vary in a scene, and their encoding on the device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..host.files import some_of, whole_number
from ..opencl.device import Device
from ..opencl.kernel import Arguments
from ..opencl.memory import HostArray
from ..opencl.program import Program, build
from ..points.points import INPUTS, ShadingPoints, surface_defines

# Shading points that extend over less than this part of the scene, three levels of its grid, have a grid
# of their own; a few of them may lie outside it, this part to each side.
SMALL_PART, OUTLIERS = 1 / 8, 1 / 64
# What the kernels can hold: vectors of so many features, indices of 32 bits.
ENTRY_FEATURES = (1, 2, 4, 8, 16)
MOST_GRID_CELLS = 1 << 30
MOST_TABLE_FLOATS = 1 << 28


@dataclass(frozen=True)
class Encoding:
    """How φ becomes the network's features; defaults follow the slides' table.

    Attributes
    ----------
    inputs : tuple of str
        Which of `INPUTS` the network gets. Position is always one of them.
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

    def __post_init__(self) -> None:
        # A network's file sets these, and they become constants of kernels: so they are checked.
        some_of("inputs", self.inputs, INPUTS)
        if "position" not in self.inputs:
            raise ValueError(f"inputs must hold position, are {self.inputs!r}")
        for name, most in (("levels", 32), ("base", MOST_GRID_CELLS), ("entries", 1 << 24)):
            whole_number(f"grid_{name}", getattr(self, f"grid_{name}"), 1, most)
        if self.grid_features not in ENTRY_FEATURES:
            raise ValueError(f"grid_features must be of {ENTRY_FEATURES}, is {self.grid_features!r}")
        if self.grid_base << (self.grid_levels - 1) > MOST_GRID_CELLS:
            raise ValueError(
                f"the finest of grid_levels {self.grid_levels} over grid_base {self.grid_base} has more "
                f"than {MOST_GRID_CELLS} cells an axis"
            )
        if self.grid_entries * self.grid_rows > MOST_TABLE_FLOATS:
            raise ValueError(f"the hash grid's table would hold more than {MOST_TABLE_FLOATS} numbers")
        whole_number("blob_bins", self.blob_bins, 1, 64)

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
    has_specular = bool(np.any(points.active_rows("reflectance") > 0))
    chosen = []
    for name in INPUTS:
        if name not in candidates or (name in ("outgoing", "roughness") and not has_specular):
            continue
        rows = points.active_rows(name)
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

    @classmethod
    def of_points(cls, points: ShadingPoints, bounds: np.ndarray) -> GridCube:
        """The cube around a scene's `bounds`, or around its shading points if these fill little of it.

        In world space. The finest cells are a fixed part of the cube, so around a ground that reaches to
        the horizon everything in view would lie in one cell. A few points may lie outside the cube; they
        count as on its sides.
        """
        whole = cls.around(bounds)
        if not points.active:
            return whole
        positions = points.active_rows("position").astype(np.float64)
        most = np.quantile(positions, [OUTLIERS, 1 - OUTLIERS], axis=1) + points.origin
        seen = cls.around(most)
        return seen if 0 < np.ptp(most, axis=0).max() < SMALL_PART * whole.side else whole

    def about(self, origin: np.ndarray) -> Arguments:
        """As encode.cl takes it: the lower corner about the points' `origin`, and one over the side."""
        x, y, z = (np.asarray(self.lower) - origin).tolist()
        return {"lower_x": x, "lower_y": y, "lower_z": z, "inverse_side": 1.0 / self.side}


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
        self._unit = HostArray(device, (3, self.stride), np.float32)
        self._items = self.stride // device.vector_width
        self._corners = (encoding.grid_levels * 8, self.stride)
        self._program.kernel("encode_fixed")(
            self._items,
            count=self.count,
            stride=self.stride,
            total_points=points.total,
            **cube.about(points.origin),
            order=order,
            surface=points.surface,
            unit=self._unit,
            features=self.features,
        )

    @property
    def unit(self) -> HostArray:
        """float32 (3, stride), the columns' positions relative to the cube."""
        return self._unit

    def encode_grid(self, table: HostArray) -> None:
        """Refresh the grid's feature rows from `table`."""
        self._program.kernel("encode_grid")(
            self._items,
            count=self.count,
            stride=self.stride,
            unit=self._unit,
            table=table,
            features=self.features,
        )

    def corners(self) -> tuple[HostArray, HostArray]:
        """Table entry and trilinear weight of every corner of every level, each (levels * 8, stride)."""
        device = self.features.device
        corner = HostArray(device, self._corners, np.uint32)
        weight = HostArray(device, self._corners, np.float32)
        self._program.kernel("grid_corners")(
            self._items,
            count=self.count,
            stride=self.stride,
            unit=self._unit,
            corner=corner,
            weight=weight,
        )
        return corner, weight


class TouchedTable:
    """The hash grid's touched entries with what training keeps beside their values (adam.cl).

    Parameters
    ----------
    device
    start : ndarray
        float32 (entries, features), the whole table's values.
    touched : ndarray
        The entries that are kept.
    moments : int
        Floats beside the values of each.
    """

    def __init__(self, device: Device, start: np.ndarray, touched: np.ndarray, moments: int) -> None:
        self._start, self._touched = start, touched
        self._features = start.shape[1]
        # A power of two: no entry lies across two cache lines.
        self.entry_floats = 1 << (self._features + moments - 1).bit_length()
        self.state = HostArray(device, (len(touched), self.entry_floats), np.float32)
        with self.state.mapped(write=True) as state:
            state[:, : self._features] = start[touched]
            state[:, self._features :] = 0.0

    def read(self) -> np.ndarray:
        """The whole table, untouched entries as they were."""
        table = self._start.copy()
        with self.state.mapped() as state:
            table[self._touched] = state[:, : self._features]
        return table
