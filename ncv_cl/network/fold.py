"""The network folded: for each shading point, a small network of (u, v) alone."""

from __future__ import annotations

import math

import numpy as np

from ..opencl.device import Device
from ..opencl.kernel import Arguments
from ..opencl.memory import HostArray
from ..opencl.program import Program, build
from ..points.points import ShadingPoints
from .network import WEIGHT_GROUPS, Network, NetworkError

# Points whose features are held at a time while they are folded: a bound on memory, of 64 features
# 16 MiB; pixels do not depend on it.
POINTS_PER_FOLD = 1 << 16


class FoldedNetwork:
    """A network with φ folded in: per shading point, a small network of (u, v) alone.

    Parameters
    ----------
    device, network, points
    factor : HostArray, optional
        float32 (channels, points.active), what a demodulated network's output is multiplied by.

    Attributes
    ----------
    arrays : dict of HostArray
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
        groups: Arguments = {group.lower(): self.groups[group] for group in WEIGHT_GROUPS}
        build(device, ("common", "surface", "encode", "fold"), defines).kernel("fold")(
            -(-points.active // width),
            count=points.active,
            total_points=points.total,
            **network.cube.about(points.origin),
            surface=points.surface,
            table=HostArray.of(device, network.table),
            heads=heads_array,
            factor=factor if factor is not None else heads_array,
            **groups,
        )
        device.queue.finish()

    @property
    def arrays(self) -> Arguments:
        return {"w2": self._w2, **{group.lower(): array for group, array in self.groups.items()}}

    def program(self) -> Program:
        return build(self.device, ("common", "mlp"), self.network.description.defines())

    def layers(self) -> tuple[list[HostArray], list[HostArray]]:
        """Weights and biases as `Integrator.run` takes them."""
        arrays = self.arrays
        return [arrays[w] for w in ("w1", "w2", "w3")], [arrays[b] for b in ("b1", "b2", "b3")]

    @property
    def per_point(self) -> tuple[list[bool], list[bool]]:
        """Which weights and biases have a leading points axis."""
        modulated = self.network.description.modulated
        return ["W1" in modulated, False, "W3" in modulated], [
            b in modulated for b in ("B1", "B2", "B3")
        ]
