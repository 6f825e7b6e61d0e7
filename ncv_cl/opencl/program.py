"""Assemble the kernel texts, specialise them by `-D` constants, build once, keep the kernels."""

from __future__ import annotations

import functools
import threading
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyopencl as cl

from .device import Device
from .kernel import Kernel


def kernel_folder() -> Path:
    """Where the `.cl` files lie: inside the installed package, or at the top of a checkout."""
    package = Path(__file__).parent.parent
    installed = package / "cl"
    return installed if installed.is_dir() else package.parent / "cl"


def kernel_files() -> dict[str, Path]:
    """The `.cl` files by their base names, which are unique."""
    return {path.stem: path for path in sorted(kernel_folder().rglob("*.cl"))}


@dataclass(frozen=True)
class KernelText:
    """The text of a kernel file that is not part of the package.

    Attributes
    ----------
    name : str
        What compilers call it in their messages, such as the file's path.
    text : str
        Programs are cached by this text, not by the name.
    """

    name: str
    text: str

    @classmethod
    def read(cls, path: Path) -> KernelText:
        """The text of a file; OSError or UnicodeDecodeError where it cannot be read."""
        return cls(str(path), path.read_text(encoding="utf-8-sig"))


# A file of the package by its base name without suffix, or a text.
KernelFile = str | KernelText


@functools.cache
def source(files: tuple[KernelFile, ...]) -> str:
    """The joined text of `files`, each under its own ``#line``.

    The texts are joined here, and not by ``#include``, because NVIDIA's program cache misses edits of
    included headers.
    """
    parts, paths = [], kernel_files()
    for file in files:
        if isinstance(file, str):
            name = f"{file}.cl"
            text = paths[file].read_text(encoding="utf-8")
        else:
            name, text = file.name.replace("\\", "\\\\").replace('"', '\\"'), file.text
        parts.append(f'#line 1 "{name}"\n{text}')
    return "\n".join(parts)


def device_defines(device: Device) -> dict[str, int]:
    """The `-D` constants that every program takes from its device."""
    return {
        "VEC": device.vector_width,
        "LANES": device.lanes,
        "USE_FMA": int(device.use_fma),
    }


def option_list(defines: Mapping[str, int | str]) -> list[str]:
    """Compiler options for a set of defines, in a fixed order (the driver's cache keys on them)."""
    return ["-cl-std=CL1.2", *(f"-D{name}={value}" for name, value in sorted(defines.items()))]


class Program:
    """A built program; `kernel(name)` returns the same retained `Kernel` every time."""

    def __init__(
        self, device: Device, files: tuple[KernelFile, ...], defines: Mapping[str, int | str]
    ) -> None:
        self.device = device
        self.files = files
        self.defines = {**device_defines(device), **defines}
        options = option_list(self.defines)
        # PoCL contracts a * b + c only when told; where `fma` is fast the sources call it by name.
        if not device.use_fma:
            options.append("-cl-mad-enable")
        options.append("-cl-kernel-arg-info")
        try:
            self._program = _built(device, source(files), options)
        except cl.RuntimeError as error:
            raise RuntimeError(_complaint(error, device, files, self.defines)) from error
        self._kernels: dict[str, Kernel] = {}

    def kernel(self, name: str) -> Kernel:
        # Two threads may both make one; setdefault has them go on with the same.
        return self._kernels.get(name) or self._kernels.setdefault(name, self.own_kernel(name))

    def own_kernel(self, name: str) -> Kernel:
        """A kernel that nobody else has, for arguments that are to stay."""
        return Kernel(self.device, cl.Kernel(self._program, name))


def _complaint(
    error: cl.RuntimeError,
    device: Device,
    files: tuple[KernelFile, ...],
    defines: Mapping[str, int | str],
) -> str:
    """What did not compile, and the compiler's messages, those about `KernelText`s first."""
    names = [file if isinstance(file, str) else file.name for file in files]
    theirs = [file.name for file in files if not isinstance(file, str)]
    failed = f"building {' + '.join(names)} failed on {device.name} with {dict(defines)}:\n{error}"
    found = [line for line in str(error).splitlines() if any(f"{name}:" in line for name in theirs)]
    if not found:
        return failed
    return "\n".join([f"{' and '.join(theirs)} cannot be compiled:", *found, "", failed])


def _built(device: Device, text: str, options: list[str]) -> cl.Program:
    """The built program, with the names and types of its kernels' arguments.

    On Intel's runtime the binaries in pyopencl's cache lack these; the text is then compiled again.
    """
    with warnings.catch_warnings():
        # Intel's compiler reports every build, also those without anything to warn of.
        warnings.simplefilter("ignore", cl.CompilerWarning)
        program = _compiled(device, text, options)
        try:
            program.all_kernels()[0].get_arg_info(0, cl.kernel_arg_info.NAME)
        except cl.RuntimeError as error:
            if error.code != cl.status_code.KERNEL_ARG_INFO_NOT_AVAILABLE:
                raise
            program = cl.Program(device.context, text)
            # False turns the cache off, which pyopencl's hints leave out.
            program.build(options, cache_dir=False)  # type: ignore[arg-type]
    return program


def _compiled(device: Device, text: str, options: list[str]) -> cl.Program:
    """Compile the program, twice if the first try fails.

    When a signal arrives, LLVM deletes its temporary files, and the compilation under way fails.
    """
    try:
        return cl.Program(device.context, text).build(options)
    except cl.RuntimeError:
        return cl.Program(device.context, text).build(options)


_programs: dict[tuple[Any, ...], Program] = {}
_lock = threading.Lock()


def build(
    device: Device, files: tuple[KernelFile, ...], defines: Mapping[str, int | str] | None = None
) -> Program:
    """Build (or return the retained) program of `files` for `device` with these `-D` constants."""
    defines = dict(defines or {})
    key = (device, files, tuple(sorted(defines.items())))
    with _lock:
        if key not in _programs:
            _programs[key] = Program(device, files, defines)
        return _programs[key]
