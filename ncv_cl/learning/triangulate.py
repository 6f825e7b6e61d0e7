"""Sampling densities that are linear on the triangles of a network's own subdivision."""

from __future__ import annotations

import math

import numpy as np
import pyopencl as cl

from ..integration.arrangement import Capacities
from ..network.fold import FoldedNetwork
from ..network.network import NetworkError
from ..opencl.device import GROUPS_PER_COMPUTE_UNIT, CutShortError, Device
from ..opencl.layout import Record
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..sampling.warp import Warp, warp_defines
from .density import Density

# Records held at a time; batches of samples are cut to points that fit.
RECORD_BYTES = 64 << 20
# |sum of areas - 1| beyond which a point's square is left undivided; that of the integrals.
COVER_TOLERANCE = 1e-5
# Most of the square that may lie in triangles too small to be chosen: the largest bias there is.
MISSED_AREA = 1e-6
# A triangle's three corners share a word.
VERTEX_BITS = 10
# Floats of a record are padded to a cache line.
RECORD_PADDING = 16


class TriangleWarp(Warp):
    """Density linear on the triangles into which the network's first layer cuts each point's square.

    The magnitude at the triangles' corners is read off `density`'s tables. Records are built for the
    points of one batch at a time, since they are too large to be kept for all (some 5 kB each for 16
    lines).

    Parameters
    ----------
    device : Device
    folded : FoldedNetwork
        The control variate. Its second layer's lines are not used: they would make up to four times as
        many triangles, for the same variance (in a prototype, see `Notes`).
    density : Density

    Attributes
    ----------
    undivided : int
        Points so far, counted once a batch, whose triangles did not cover the square within
        `COVER_TOLERANCE`, or more than `MISSED_AREA` of it by slivers, and which are sampled from two
        triangles instead.

    Notes
    -----
    Mean of r² / p over that of r² (r the residual, independent samples, nine tenths of p by e), of
    16 × 16 neurons, on 300 points of 96 × 96 pixels; in brackets training samples a point. "w" is the
    non-negative combination of the last layer's neurons that minimises mean(r² / e + e), weights by a
    head of 32 units:

    ======================  ===========  ================  ============  ========
    density                 Cornell box  occluders direct  occluders AO  knot AO
                            direct (16)  (64)              (64)          (16)
    ======================  ===========  ================  ============  ========
    table                   0.929        1.047             0.705         0.620
    first layer, as here    0.893        1.011             0.707         0.628
    first layer, vertices   0.913        1.016             0.727         0.661
    both layers, vertices   0.914        1.014             0.713         0.627
    both layers, "w"        0.967        1.028             0.832         0.718
    ======================  ===========  ================  ============  ========

    So independent samples have the table's variance, within 5 %. Sobol points lose part of their spread
    from triangle to triangle: on these four at 16, 64 and 256 samples (8 × 8 or 16 × 16 neurons, 4
    seeds) the image's variance is 1.2 to 1.8 times that under the table, least so at 256. Drawing takes
    up to 5 times as long with 8 neurons, up to 12 times with 16, most so where few samples share a
    record, and 0.9 to 2.8 times at 256 samples. So the table is the default. Strips from left to right,
    in which v picks the triangle, in place of the curve gained nothing for sure (−12 to +7 %).

    Raises
    ------
    NetworkError
        If the first layer has more lines than `VERTEX_BITS` can number the crossings of.
    """

    files = ("warp_triangles",)

    def __init__(self, device: Device, folded: FoldedNetwork, density: Density) -> None:
        description = folded.network.description
        lines, vector = description.hidden[0], device.vector_width * device.lanes
        bounds = Capacities.of(lines, 4)
        if bounds.vertices > 1 << VERTEX_BITS:
            raise NetworkError(
                f"density 'subdivision' numbers {1 << VERTEX_BITS} vertices at most, {lines} neurons "
                f"of the first layer can make {bounds.vertices}: use density 'table'"
            )
        self._device = device
        self._inputs = {
            "w1": folded.groups["W1"],
            "b1": folded.groups["B1"],
            "tables": density.table,
        }
        self.defines = _record_defines(bounds, density.uniform_share)
        stride = math.ceil(lines / vector) * vector
        strides = {g: description.defines()[f"STRIDE_{g}"] for g in ("W1", "B1")}
        self._defines = {
            **self.defines,
            **{f"STRIDE_{group}": f"{floats}ul" for group, floats in strides.items()},
            **warp_defines(),
            "DOUBLE": 0,
            "HIDDEN": 0,
            "SPACE": "__global",
            "LINES": lines,
            "LINE_STRIDE": stride,
            "MAX_VERTICES": math.ceil(bounds.vertices / vector) * vector,
            # The walk asks for room for four; at the border it needs three.
            "MAX_HALF_EDGES": bounds.half_edges + 1,
            "MAX_FACES": bounds.faces,
            "MAX_TRIANGLES": bounds.triangles,
            "AREA_TOLERANCE": f"{COVER_TOLERANCE!r}f",
            "MISSED_AREA": f"{MISSED_AREA!r}f",
        }
        self.record_words = int(self.defines["RECORD_WORDS"])
        self.most_points = max(1, RECORD_BYTES // (4 * self.record_words))
        self._program = build(device, ("common", "number", "dcel", "warp", "triangulate"), self._defines)
        memory = HostArray(device, 1, np.int32)
        self._program.kernel("triangulate_memory")(1, bytes=memory, group=1)
        units = device.cl_device.max_compute_units
        self._groups = units if device.lanes == 1 else units * GROUPS_PER_COMPUTE_UNIT
        work_bytes = self._groups * int(memory.read()[0])
        self._work = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, size=work_bytes)
        self._records = HostArray(device, (1, self.record_words), np.uint32)
        self._counts = HostArray(device, 3, np.int32)
        self._counts.fill(0)
        # Points and groups so far.
        self._asked = np.zeros(2, np.int64)
        self._checked = 0

    @property
    def undivided(self) -> int:
        """Points whose square is not divided.

        Raises
        ------
        CutShortError
            The device's runtime did not finish all points so far.
        """
        undivided, *done = self._counts.read().tolist()
        if done != self._asked.tolist():
            said = f"cut the square of {done[0]} of {self._asked[0]} points"
            raise CutShortError.of(self._device, said)
        return undivided

    def records(self, order: HostArray, points: range) -> HostArray:
        """Records of points order[i], i in `points`, valid until the next call.

        Raises
        ------
        CutShortError
            See `undivided`.
        """
        count = len(points)
        if count > self._records.shape[0]:
            self._records = HostArray(self._device, (count, self.record_words), np.uint32)
        groups = min(self._groups, count)
        self._asked += count, groups
        self._program.kernel("triangulate")(
            groups * self._device.lanes,
            first_point=points.start,
            count=count,
            order=order,
            **self._inputs,
            all_work=self._work,
            records=self._records,
            counts=self._counts,
            group=self._device.lanes,
        )
        # The more points, the more turns a group's loop takes: what is no longer than one that was
        # checked is not waited for.
        if count > self._checked:
            self._checked = count
            _ = self.undivided
        return self._records


def _record_defines(bounds: Capacities, uniform_share: float) -> dict[str, int | str]:
    """Where a record's parts begin, in words, as `-D` constants."""
    fields = {
        "count": 1,
        "cumulative": bounds.triangles + 1,
        "corners": bounds.triangles,
        "scales": bounds.triangles,
        "x": bounds.vertices,
        "y": bounds.vertices,
        "values": bounds.vertices,
    }
    return {
        **Record("RECORD", fields, np.uint32, RECORD_PADDING).defines(),
        "VERTEX_BITS": VERTEX_BITS,
        "VERTEX_MASK": f"{(1 << VERTEX_BITS) - 1}u",
        "UNIFORM_SHARE": f"{uniform_share!r}f",
    }
