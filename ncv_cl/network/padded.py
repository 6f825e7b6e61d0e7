"""A network's parameters in training: rows padded to whole vectors, moments, moving averages."""

from __future__ import annotations

import numpy as np

from ..opencl.device import Device
from ..opencl.kernel import Arguments
from ..opencl.layout import Record
from ..opencl.memory import HostArray
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
        # In a vector of gradients the loss rides behind them.
        fields = {
            "w2": second * self.w2_stride,
            "heads": description.head_rows * self.feature_floats,
            "bases": description.base_rows,
            "loss": 1,
        }
        self._record = Record("PARAMETER", fields, multiple=width)
        self.size = self._record.size

    def defines(self) -> dict[str, int | str]:
        """The `-D` constants of train.cl and adam.cl about it."""
        return {
            "W2_STRIDE": self.w2_stride,
            "FEATURE_FLOATS": self.feature_floats,
            **self._record.defines(),
        }

    def _views(self, padded: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        w2 = padded[self._record["w2"]].reshape(-1, self.w2_stride)
        heads = padded[self._record["heads"]].reshape(-1, self.feature_floats)
        description = self._description
        columns = description.encoding.feature_count + 1
        return (
            w2[:, : description.hidden[0]],
            heads[:, :columns],
            padded[self._record["bases"]],
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
    def arrays(self) -> Arguments:
        """As adam.cl calls them."""
        return {
            "parameters": self.value,
            "moment1": self.moment1,
            "moment2": self.moment2,
            "average": self.average,
        }
