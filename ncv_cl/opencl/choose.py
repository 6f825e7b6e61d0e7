"""List the OpenCL devices, and choose one."""

from __future__ import annotations

import os
from dataclasses import dataclass

import pyopencl as cl

from .device import (
    Device,
    DeviceError,
    check_process,
    first_error,
    list_cl_devices,
    open_device,
    pocl_version,
)
from .prefer import facts_of, gpu_pays
from .probe import Probe, measure, record
from .runtimes import INTEL_PLATFORM, platforms

VARIABLE = "NCV_CL_DEVICE"
_PYOPENCLS_VARIABLE = "PYOPENCL_CTX"


@dataclass(frozen=True)
class DeviceReport:
    """A device and what the micro-benchmark measured on it, if it can be used."""

    device: Device
    probe: Probe | None
    problem: str | None = None

    def __str__(self) -> str:
        if self.probe is None:
            return f"{self.device.describe()} | not used: {self.problem}"
        return (
            f"{self.device.describe()} | {self.probe.multiply_adds:.3g} billion multiply-adds a second"
        )


class DeviceList(list[DeviceReport]):
    """Device reports that print one line each, and below which of them is taken, and why.

    Attributes
    ----------
    choice : str
        That last line.
    """

    choice = ""

    def __str__(self) -> str:
        return "\n".join([*map(str, self), *([self.choice] if self.choice else [])])

    __repr__ = __str__


def all_devices() -> list[Device]:
    """Every device that can be used, opened with its default widths, in the order of their indices."""
    return [device for device in _listed() if device.problem is None]


def _listed() -> list[Device]:
    """The same with those that cannot be used."""
    return [open_device(cl_device, index) for index, cl_device in enumerate(list_cl_devices())]


def devices() -> DeviceList:
    """Every OpenCL device, benchmarked now for about a third of a second each, or why it cannot be used.

    Raises
    ------
    DeviceError
        If there is none; the message says what to install.
    """
    listed = _listed()
    found = DeviceList(map(_report, listed))
    try:
        device, why = _chosen(None, listed)
        found.choice = f"taken unless another is named: [{device.index}], {why}"
    except DeviceError as error:
        found.choice = f"none is taken: {first_error(error)}"
    return found


def _report(device: Device) -> DeviceReport:
    if device.problem is not None:
        return DeviceReport(device, None, device.problem)
    try:
        return DeviceReport(device, measure(device))
    # One that fails does not keep the others from the list.
    except (RuntimeError, cl.Error) as error:
        return DeviceReport(device, None, f"its benchmark failed ({first_error(error)})")


def device_is_chosen() -> bool:
    """Whether a variable of the environment chooses the device."""
    return bool(os.environ.get(VARIABLE) or os.environ.get(_PYOPENCLS_VARIABLE))


def choose_device(selector: Device | int | str | None = None) -> Device:
    """The device to work on.

    Parameters
    ----------
    selector : Device, int or str, optional
        A device, an index from `devices()`, or part of a device's or platform's name. Without one:
        the variable ``NCV_CL_DEVICE`` (index or name), then pyopencl's ``PYOPENCL_CTX``, then the GPU of
        the highest peak if that pays (`prefer.gpu_pays`), else of the CPU runtimes the newest PoCL from
        3.1 on, Intel's, an older PoCL, or what there is. No clock decides, so it is the same device
        every time.

    Raises
    ------
    DeviceError
        If nothing matches, a name matches several devices, or the device cannot be used.
    """
    check_process()
    if isinstance(selector, Device):
        return selector
    device, _ = _chosen(selector, _listed())
    record(device)
    return device


def _chosen(selector: int | str | None, found: list[Device]) -> tuple[Device, str]:
    """The device that is taken of those `found`, and why."""
    why = "as asked for"
    if selector is None:
        selector = os.environ.get(VARIABLE) or None
        why = f"as {VARIABLE} says"
    if selector is not None:
        return _checked(_match(found, selector)), why
    if os.environ.get(_PYOPENCLS_VARIABLE):
        return _checked(_match_as_pyopencl(found)), f"as {_PYOPENCLS_VARIABLE} says"
    usable = [device for device in found if device.problem is None]
    if not usable:
        problems = "; ".join(f"{device.name}, {device.problem}" for device in found)
        raise DeviceError(f"no OpenCL device can be used: {problems}")
    return _by_rule(usable)


def _by_rule(usable: list[Device]) -> tuple[Device, str]:
    """The GPU of the highest peak where it pays, else the CPU whose runtime is known to be fastest."""
    if len(usable) == 1:
        return usable[0], "the only device that can be used"
    gpus = [device for device in usable if device.is_gpu]
    others = [device for device in usable if not device.is_gpu]
    facts = {device: facts_of(device.cl_device) for device in usable}
    gpu = max(gpus, key=lambda device: (facts[device].is_gpu, facts[device].peak), default=None)
    if gpu is not None and not others:
        return gpu, "the GPU of the highest peak, without a CPU's runtime beside it"
    cpu = max(others, key=_preference)
    if gpu is None:
        return cpu, "whose runtime is known to be the fastest of these"
    pays, why = gpu_pays(facts[gpu], facts[cpu])
    return (gpu if pays else cpu), why


def _preference(device: Device) -> tuple[int, tuple[int, int]]:
    """A rank: the highest measured fastest on several CPUs; equal ones keep the loader's order."""
    version = pocl_version(device.cl_device)
    if version is not None:
        return (3 if version >= (3, 1) else 1), version
    return (2 if device.platform_name == INTEL_PLATFORM else 0), (0, 0)


def _match(found: list[Device], selector: int | str) -> Device:
    lines = "\n".join(f"  {device.describe()}" for device in found)
    text = str(selector).strip()
    if text.isdecimal():
        if int(text) < len(found):
            return found[int(text)]
        raise DeviceError(f"there is no device {text}; choose among\n{lines}")
    matches = [device for device in found if text.lower() in _names(device)]
    if len(matches) > 1:
        # Of several devices with this name only the usable ones count.
        matches = [device for device in matches if device.problem is None] or matches[:1]
    if len(matches) == 1:
        return matches[0]
    problem = "no device matches" if not matches else "more than one device matches"
    raise DeviceError(f"{problem} {text!r}; choose by index or a longer name among\n{lines}")


def _names(device: Device) -> str:
    return f"{device.platform_name} | {device.identity}".lower()


def _match_as_pyopencl(found: list[Device]) -> Device:
    """The device that pyopencl's own variable names."""
    value = os.environ[_PYOPENCLS_VARIABLE]
    try:
        answers = value.split(":")
        if answers[0].isdecimal() or not answers[0]:
            # Indices count without the platform that this package adds, which the loader may list first.
            answers[0] = str(cl.get_platforms().index(platforms()[int(answers[0] or 0)]))
        wanted = cl.create_some_context(interactive=False, answers=answers).devices[0]
        return next(device for device in found if device.cl_device == wanted)
    # For a text that names no device pyopencl raises its own errors, ValueError or IndexError.
    except Exception as error:
        lines = "\n".join(f"  {device.describe()}" for device in found)
        raise DeviceError(
            f"{_PYOPENCLS_VARIABLE}={value} names no device ({error}): unset it, or give platform and "
            f"device as pyopencl counts them, such as 0:0, or set {VARIABLE} to an index of\n{lines}"
        ) from error


def _checked(device: Device) -> Device:
    if device.problem is not None:
        raise DeviceError(f"device {device.index}, {device.name}, {device.problem}")
    return device
