"""A network's parameters in training: rows padded to whole vectors, moments, moving averages."""

from __future__ import annotations

import numpy as np

from ..opencl.device import Device, HostArray
from .network import NetworkDescription


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


class Averaged:
    """A trained array on the device with Adam's moments and its moving average."""

    def __init__(self, device: Device, start: np.ndarray) -> None:
        self.value = HostArray.of(device, start)
        self.moment1 = HostArray.of(device, np.zeros_like(start))
        self.moment2 = HostArray.of(device, np.zeros_like(start))
        self.average = HostArray.of(device, start)

    @property
    def arrays(self) -> tuple[HostArray, HostArray, HostArray, HostArray]:
        return self.value, self.moment1, self.moment2, self.average
