"""The paper model: seconds that a render takes on a GPU, from counts and from assumptions with bounds.

A kernel takes as long as its instructions need to be issued, or its bytes to be moved, whichever is
more, and each launch what one warp alone takes from its begin to its end. The host's thread works beside
the device where it waits once a pass, and in turn with it where embree traces rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

WARP = 32
BATCH = 1 << 19


@dataclass(frozen=True)
class Gpu:
    """A GPU's numbers, as its maker or its driver tells them.

    Attributes
    ----------
    units, lanes, warps : int
        Multiprocessors, lanes of each, and warps that one can hold.
    gigahertz : float
    memory, cache, bus : float
        Gigabytes a second: of its memory, of the cache that all units share, and to the host and back.
    cores : int
        Of the host.
    """

    name: str
    units: int
    lanes: int
    warps: int
    gigahertz: float
    memory: float
    cache: float
    bus: float
    cores: int

    @property
    def peak(self) -> float:
        """Billion multiply-adds a second."""
        return self.units * self.lanes * self.gigahertz


H100 = Gpu("H100 SXM", 132, 128, 64, 1.755, 3350.0, 5500.0, 50.0, 16)


@dataclass(frozen=True)
class Assumption:
    """A number that nobody has measured here.

    Attributes
    ----------
    value : float
    factor : float
        By which it may be larger or smaller.
    why : str
        What it is and where it comes from.
    """

    value: float
    factor: float
    why: str


ASSUMPTIONS = {
    "instructions": Assumption(
        1.0, 1.5, "a compiler's instructions over those that are counted, see the weights in "
        "`bench/gpu_instructions.py`"
    ),
    "active": Assumption(
        0.8, 1.2, "part of a warp's lanes that work, where all do the same but for the last few"
    ),
    "active in walks": Assumption(
        0.4, 1.6, "the same where each lane walks through triangles, lists or paths of its own"
    ),
    "arithmetic clocks": Assumption(5.0, 1.3, "until another instruction can use a result"),
    "memory clocks": Assumption(
        250.0, 1.6, "until a load's value is there: 33 from the nearest cache, 260 from the shared one, "
        "600 from memory"
    ),
    "independent": Assumption(
        2.5, 1.5, "instructions of one warp that are under way at once, as none needs another's result"
    ),
    "issued": Assumption(0.7, 1.2, "instructions a clock and scheduler, at most"),
    "missed": Assumption(0.3, 2.0, "part of the loaded bytes that the nearest cache does not hold"),
    "from memory": Assumption(0.1, 2.0, "part of the loaded bytes that no cache holds"),
    "launch": Assumption(5e-6, 1.6, "seconds between the end of a kernel and the begin of the next"),
    "wait": Assumption(20e-6, 1.6, "seconds until the host goes on after the device has ended"),
    "bus": Assumption(1.0, 1.3, "part of the bus's bytes a second that copies reach"),
    "call": Assumption(30e-6, 1.5, "seconds of the host's thread for a launch or a wait, in Python"),
    "host": Assumption(1.0, 1.5, "other seconds of the host's thread, over those on this machine"),
    "rays": Assumption(12e6, 1.5, "rays a second and core that embree traces (devices.md)"),
}  # fmt: skip
# Kernels whose lanes go their own ways.
WALKS = {
    *("find_hits", "find_visible", "find_lit", "find_occluders", "count_leaves", "draw_samples"),
    *("shade_hits", "share_rays", "share_paths", "share_seen"),
}


@dataclass(frozen=True)
class KernelTime:
    """What one kernel takes in all its launches.

    Attributes
    ----------
    launches, items : float
    instructions, flops, moved : float
        Of an item; bytes are those that leave the nearest cache.
    warps : float
        Resident ones of a scheduler.
    seconds : float
    bound : str
        What most of the seconds are: instructions, latency, memory or launches.
    """

    name: str
    launches: float
    items: float
    instructions: float
    flops: float
    moved: float
    warps: float
    seconds: float
    bound: str


@dataclass(frozen=True)
class Prediction:
    """What a render takes, by its parts, in seconds."""

    kernels: tuple[KernelTime, ...]
    launches: float
    waits: float
    to_host: float
    to_device: float
    waiting: float
    copying: float
    host: float
    embree: float

    @property
    def device(self) -> float:
        return sum(one.seconds for one in self.kernels)

    @property
    def seconds(self) -> float:
        """Host and device work at the same time, but where each waits for what the other traces."""
        if self.embree:
            return self.device + self.host + self.embree + self.waiting + self.copying
        return max(self.device, self.host) + self.waiting + self.copying

    @property
    def bound(self) -> str:
        parts = {"kernels": self.device, "the host's thread": self.host, "embree": self.embree}
        parts |= {"waits": self.waiting, "the bus": self.copying}
        return max(parts, key=parts.get)


def values(**changed: float) -> dict[str, float]:
    """The assumptions' values, some of them multiplied."""
    return {name: one.value * changed.get(name, 1.0) for name, one in ASSUMPTIONS.items()}


def kernel_time(
    name: str, launches: float, items: float, work: dict, occupancy: float, gpu: Gpu, given: dict
) -> KernelTime:
    """What the launches of a kernel take.

    Parameters
    ----------
    work : dict
        A `gpu_instructions.Work` of an item.
    occupancy : float
        The part of a multiprocessor's warps that can be resident.
    given : dict
        The assumptions' values.
    """
    schedulers = gpu.lanes / WARP
    clock = 1e9 * gpu.gigahertz
    instructions = work["instructions"] * given["instructions"]
    accesses = min(1.0, (work["loaded"] + work["stored"]) / 4 / max(instructions, 1.0))
    latency = (given["arithmetic clocks"] + accesses * given["memory clocks"]) / given["independent"]
    warps = occupancy * gpu.warps / schedulers
    rate = min(given["issued"], warps / latency)
    active = given["active in walks" if name in WALKS else "active"]
    issued = instructions * items / WARP / active
    moved = work["loaded"] * given["missed"] + work["stored"]
    parts = {
        "instructions" if rate == given["issued"] else "latency": issued
        / (gpu.units * schedulers * clock * rate),
        "memory": items
        * max(
            moved / (1e9 * gpu.cache),
            (work["loaded"] * given["from memory"] + work["stored"]) / (1e9 * gpu.memory),
        ),
    }
    alone = launches * (given["launch"] + instructions * latency / clock)
    bound = max(parts | {"launches": alone}, key=(parts | {"launches": alone}).get)
    seconds = max(parts.values()) + alone
    return KernelTime(name, launches, items, instructions, work["flops"], moved, warps, seconds, bound)


def linear(low: tuple[float, float], high: tuple[float, float], at: float) -> float:
    """The line through two points, not below zero."""
    (x, y), (X, Y) = low, high
    return max(0.0, y + (Y - y) / (X - x) * (at - x))


def scaled(case: dict, side: int, spp: int, batch: int = BATCH) -> dict:
    """Counts of a case's render of another size, from those of the two that were made.

    Items and bytes go as the pixels, launches and waits as the batches, of `batch` samples.
    """
    low, high = case["counted"]
    pixels, batches = float(side * side), side * side * spp / batch

    def by(key: str, at: float, one: dict, other: dict, what: str) -> float:
        return linear((low[key], one.get(what, 0)), (high[key], other.get(what, 0)), at)

    kernels = {}
    for name, other in high["kernels"].items():
        one = low["kernels"].get(name, {})
        kernels[name] = {
            "count": by("batches", batches, one, other, "count"),
            "items": by("pixels", pixels, one, other, "items"),
        }
    found: dict = {
        what: by("pixels", pixels, low, high, what) for what in ("to_host", "to_device", "rays")
    }
    own = [own_seconds(row, case["rays"] == "embree") for row in (low, high)]
    found["host_seconds"] = linear((low["pixels"], own[0]), (high["pixels"], own[1]), pixels)
    return found | {"kernels": kernels, "waits": by("batches", batches, low, high, "waits")}


def own_seconds(row: dict, by_embree: bool) -> float:
    """What the host's thread did in a counted render beside calls, and rays, which it traced itself."""
    traced = row["rays"] / ASSUMPTIONS["rays"].value if by_embree else 0.0
    return max(0.0, row["host_seconds"] - ASSUMPTIONS["call"].value * calls(row) - traced)


def calls(row: dict) -> float:
    """Launches and waits."""
    return row["waits"] + sum(one["count"] for one in row["kernels"].values())


def predict(case: dict, counts: dict, gpu: Gpu, given: dict[str, float] | None = None) -> Prediction:
    """What a render of these counts takes.

    Parameters
    ----------
    case : dict
        Of `gpu_record.record`: the kernels' work and occupancy. A kernel that the simulator's small
        render did not launch is left out.
    counts : dict
        Of `scaled`, or of a render that was counted.
    """
    given = given or values()
    times = tuple(
        kernel_time(name, one["count"], one["items"], case["work"][name],
                    case["occupancy"][name]["occupancy"], gpu, given)
        for name, one in counts["kernels"].items() if name in case["work"] and name in case["occupancy"]
    )  # fmt: skip
    by_embree = case["rays"] == "embree"
    return Prediction(
        kernels=times,
        launches=sum(one.launches for one in times),
        waits=counts["waits"],
        to_host=counts["to_host"],
        to_device=counts["to_device"],
        waiting=counts["waits"] * given["wait"],
        copying=(counts["to_host"] + counts["to_device"]) / (1e9 * gpu.bus * given["bus"]),
        host=counts["host_seconds"] * given["host"] + calls(counts) * given["call"],
        embree=counts["rays"] / (given["rays"] * gpu.cores) if by_embree else 0.0,
    )


def uncertainty(case: dict, counts: dict, gpu: Gpu) -> float:
    """By which factor the seconds may be off: the assumptions' own, each alone, as if independent."""
    middle = predict(case, counts, gpu).seconds
    squares = 0.0
    for name, one in ASSUMPTIONS.items():
        changed = (predict(case, counts, gpu, values(**{name: f})) for f in (one.factor, 1 / one.factor))
        squares += max(abs(math.log(other.seconds / middle)) for other in changed) ** 2
    return math.exp(math.sqrt(squares))
