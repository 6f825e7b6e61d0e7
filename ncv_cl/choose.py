"""List the OpenCL devices, and choose one."""

from __future__ import annotations

import os
from dataclasses import dataclass

import pyopencl as cl

from .device import Device, DeviceError, list_cl_devices, open_device
from .probe import Probe, cached_probe, measure

VARIABLE = "NCV_CL_DEVICE"


@dataclass(frozen=True)
class DeviceReport:
    """A device and what the micro-benchmark measured on it."""

    device: Device
    probe: Probe

    def __str__(self) -> str:
        how = "fma" if self.probe.use_fma else "multiply-add"
        return f"{self.device.describe()}, {how} | inference {self.probe.nanoseconds:.1f} ns a sample"


class DeviceList(list[DeviceReport]):
    """Device reports that print one line each."""

    def __str__(self) -> str:
        return "\n".join(str(report) for report in self)

    __repr__ = __str__


def all_devices() -> list[Device]:
    """Every device, opened with its default widths, in the order of their indices."""
    return [open_device(cl_device, index) for index, cl_device in enumerate(list_cl_devices())]


def devices() -> DeviceList:
    """Every OpenCL device with a fresh micro-benchmark of about a second each.

    Raises
    ------
    DeviceError
        If there is none; the message says what to install.
    """
    return DeviceList(DeviceReport(device, measure(device)) for device in all_devices())


def choose_device(selector: Device | int | str | None = None) -> Device:
    """The device to work on.

    Parameters
    ----------
    selector : Device, int or str, optional
        A device, an index from `devices()`, or part of a device's or platform's name. Without one:
        the variable ``NCV_CL_DEVICE`` (index or name), then pyopencl's ``PYOPENCL_CTX``, then a GPU if
        there is one, else the CPU runtime that the micro-benchmark finds fastest (measured once and
        cached).

    Raises
    ------
    DeviceError
        If nothing matches, or a name matches several devices.
    """
    if isinstance(selector, Device):
        return selector
    found = all_devices()
    if selector is None:
        selector = os.environ.get(VARIABLE) or None
    if selector is not None:
        return _tuned(_match(found, selector))
    if os.environ.get("PYOPENCL_CTX"):
        wanted = cl.create_some_context(interactive=False).devices[0]
        return _tuned(next(device for device in found if device.cl_device == wanted))
    gpus = [device for device in found if device.is_gpu]
    if gpus:
        return _tuned(gpus[0])
    return _tuned(min(found, key=lambda device: cached_probe(device).nanoseconds))


def _match(found: list[Device], selector: int | str) -> Device:
    lines = "\n".join(f"  {device.describe()}" for device in found)
    text = str(selector).strip()
    if text.isdigit():
        if int(text) < len(found):
            return found[int(text)]
        raise DeviceError(f"there is no device {text}; choose among\n{lines}")
    matches = [device for device in found if text.lower() in device.identity.lower()]
    if len(matches) == 1:
        return matches[0]
    problem = "no device matches" if not matches else "more than one device matches"
    raise DeviceError(f"{problem} {text!r}; choose by index or a longer name among\n{lines}")


def _tuned(device: Device) -> Device:
    """The same device with `use_fma` as measured."""
    probe = cached_probe(device)
    return open_device(device.cl_device, device.index, use_fma=probe.use_fma)
