"""How a step's gradients are cut into work-groups: tiles of columns, and samples of a column."""

from __future__ import annotations

from dataclasses import dataclass

from ..network.network import NetworkDescription
from ..network.padded import PaddedLayout
from ..opencl.device import GPU_LOCAL_BYTES, GROUP_SIZE, Device
from ..settings.schedule import Schedule
from . import tuning

# PoCL hands each thread that asks 1 + (groups left) / (threads) groups: of the few groups of a step the
# first thread would get too many, were its first ones not empty.
CPU_IDLE_GROUPS = 2
# Rows of partial sums; fixed, so that the order of additions does not depend on the device's size.
PARTIAL_SUMS = 64
# Bytes of a group's local memory on a GPU at most: two find room in the 64 KiB that a compute unit has.
GPU_STEP_BYTES = 2 * GPU_LOCAL_BYTES // 3


@dataclass(frozen=True)
class StepShape:
    """The groups of a gradient step.

    Attributes
    ----------
    file : str
        The kernel file: ``train``, where a work-item takes vectors of columns, or ``train_lanes``, where
        it takes a sample of one.
    group : int
        Work-items of a group.
    tile : int
        Columns that a group holds at a time.
    idle_groups : int
        Groups before these that do nothing.
    """

    file: str
    group: int
    tile: int
    idle_groups: int

    @classmethod
    def of(
        cls,
        device: Device,
        description: NetworkDescription,
        layout: PaddedLayout,
        settings: Schedule,
        samples: int,
    ) -> StepShape:
        """The shape for a device, of steps over `samples` samples a column at most.

        Raises
        ------
        MemoryError
            One column takes more local memory than the device has.
        """
        samples = min(settings.samples_a_step, samples)
        if device.lanes > 1 and device.vector_width == 1:
            return cls._of_samples(device, description, layout, samples)
        return cls._of_vectors(device, description, layout, samples)

    @classmethod
    def _of_vectors(
        cls, device: Device, description: NetworkDescription, layout: PaddedLayout, samples: int
    ) -> StepShape:
        rows = description.head_rows + description.base_rows
        features = description.encoding.feature_count
        column = features + layout.feature_floats + 2 * rows + samples * sum(description.hidden) + 1
        available = device.cl_device.local_mem_size
        budget = min(tuning.CPU_LOCAL_BYTES if device.lanes == 1 else GPU_LOCAL_BYTES, available)
        tile = device.vector_width
        while 8 * tile * column <= budget and tile < tuning.CPU_TILE:
            tile *= 2
        _check_memory(device, description, 4 * tile * column)
        return cls("train", device.lanes, tile, CPU_IDLE_GROUPS if device.is_cpu else 0)

    @classmethod
    def _of_samples(
        cls, device: Device, description: NetworkDescription, layout: PaddedLayout, samples: int
    ) -> StepShape:
        rows = layout.feature_floats + 2 * max(1, description.head_rows)
        # Activations and their gradients; gradients by the outputs, u, v, 1 and the loss.
        pair = 2 * sum(description.hidden) + description.channels + 4

        def local_bytes(tile: int) -> int:
            return 4 * (rows * tile + pair * (tile * samples + 1))

        tile = 1
        while 2 * tile * samples <= GROUP_SIZE and local_bytes(2 * tile) <= GPU_STEP_BYTES:
            tile *= 2
        _check_memory(device, description, local_bytes(tile))
        return cls("train_lanes", GROUP_SIZE, tile, 0)

    def groups(self, columns: int) -> int:
        """Groups of a step over so many columns; each has a row of partial sums."""
        return min(PARTIAL_SUMS, -(-columns // self.tile))

    @property
    def defines(self) -> dict[str, int | str]:
        """The `-D` constants of the kernel file."""
        return {"TILE": self.tile, "GROUP_ITEMS": self.group, "IDLE_GROUPS": f"{self.idle_groups}u"}


def _check_memory(device: Device, description: NetworkDescription, needed: int) -> None:
    available = device.cl_device.local_mem_size
    if needed > available:
        raise MemoryError(
            f"training hidden layers of {description.hidden} needs {needed} bytes of local memory, but "
            f"{device.name} has {available}: use a narrower network or fewer modulated groups"
        )
