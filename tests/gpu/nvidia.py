"""Kernels compiled for NVIDIA's GPUs: by clang and libdevice to PTX, whose registers ptxas allocates.

The driver's own front end is another, its ptxas is the same. OpenCL's built-in functions are those of
builtins.cl; divisions and square roots are as inexact as OpenCL allows, and everything is inlined.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

from .compilers import CLANG, Row, find_tool, required_groups, run

# Of one multiprocessor: registers, warps, groups, bytes of shared memory.
LIMITS = {"sm_80": (65536, 64, 32, 164 << 10), "sm_90": (65536, 64, 32, 228 << 10)}
LIBRARY = "nvvm/libdevice/libdevice.10.bc"


class Nvidia:
    """The compilers for some architectures: of PTX, which is the same for all, and of each one's code.

    Parameters
    ----------
    archs : tuple of str
        Of `LIMITS`.
    scratch : Path
        A folder for files on the way.

    Attributes
    ----------
    missing : str, optional
        What is not installed.
    """

    def __init__(self, archs: tuple[str, ...], scratch: Path) -> None:
        self.archs = archs
        site = [f"{path}/nvidia/*/bin/ptxas" for path in sys.path if path.endswith("-packages")]
        self._ptxas = find_tool("ptxas", "/usr/local/cuda*/bin/ptxas", *site)
        homes = ["/usr/local/cuda*", *(one.removesuffix("/bin/ptxas") for one in site)]
        if self._ptxas:
            homes.insert(0, str(Path(self._ptxas).resolve().parent.parent))
        self._libdevice = find_tool(*(f"{home}/{LIBRARY}" for home in homes))
        self.missing = None
        if not (CLANG and self._ptxas and self._libdevice):
            self.missing = "clang, ptxas or libdevice.10.bc (pip install nvidia-cuda-nvcc-cu12)"
            return
        # PTX of sm_80 runs on what came later, and clang 15 knows no Hopper.
        self._front = [
            *(CLANG, "-x", "cl", "-cl-std=CL1.2", "-target", "nvptx64-nvidia-nvcl"),
            *(part for flag in _FRONT for part in ("-Xclang", flag)),
        ]
        self._builtins = scratch / "builtins.bc"
        text = Path(__file__).with_name("builtins.cl").read_text(encoding="utf-8")
        run([*self._front, "-O2", "-c", "-emit-llvm", "-o", str(self._builtins), "-"], text)

    def rows(self, text: str, options: Sequence[str], groups: dict[str, int]) -> list[Row]:
        """A row for each kernel of `groups` in a program's text."""
        required = required_groups(text, options)
        ptx, _ = run([*self._front, *self._back(), "-S", "-o", "-", *options, "-"], text)
        # clang hands required group sizes on to AMD only.
        for name, size in required.items():
            ptx = re.sub(
                rf"(\.entry {name}\(.*?^\))",
                rf"\1\n.reqntid {size}, 1, 1",
                ptx,
                flags=re.DOTALL | re.MULTILINE,
            )
        return [row for arch in self.archs for row in self._rows_of(arch, ptx, groups)]

    def _rows_of(self, arch: str, ptx: str, groups: dict[str, int]) -> list[Row]:
        _, log = run([self._ptxas, "-v", f"-arch={arch}", "-", "-o", "/dev/null"], ptx)
        found = []
        for part in re.split(r"Compiling entry function ", log)[1:]:
            name = re.match(r"'(\w+)'", part)[1]
            if name in groups:
                found.append(_row(arch, name, part, groups[name]))
        return found

    def _back(self) -> list[str]:
        """What comes after the front end's options."""
        linked = [part for bc in (str(self._builtins), self._libdevice) for part in _linked(bc)]
        precision = ["-nvptx-prec-divf32=1", "-nvptx-prec-sqrtf32=0", "-inline-threshold=10000"]
        return ["-O3", *linked, *(part for flag in precision for part in ("-mllvm", flag))]


def _row(arch: str, name: str, log: str, group: int) -> Row:
    stack, stores, loads = map(
        int,
        re.search(
            r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads", log
        ).groups(),
    )
    shared = re.search(r"(\d+) bytes smem", log)
    local = int(shared[1]) if shared else 0
    registers = int(re.search(r"Used (\d+) registers", log)[1])
    limits, warps = _limits(arch, registers, local, group)
    bound = min(limits, key=limits.get)
    occupancy = limits[bound] * -(-group // 32) / warps
    return Row(arch, name, registers, stores + loads, stack, local, group, occupancy, bound)


def _limits(arch: str, registers: int, local: int, group: int) -> tuple[dict[str, int], int]:
    """Groups of a multiprocessor by what bounds them, and its warps."""
    all_registers, warps, groups, shared = LIMITS[arch]
    warps_a_group = -(-group // 32)
    registers_a_warp = -(-registers * 32 // 256) * 256
    return {
        "warps": warps // warps_a_group,
        "groups": groups,
        # The system keeps 1 KiB of each group's shared memory.
        "local": shared // (-(-local // 128) * 128 + 1024),
        "registers": all_registers // registers_a_warp // warps_a_group,
    }, warps


_FRONT = ("-target-cpu", "sm_80", "-target-feature", "+ptx75", "-finclude-default-header")


def _linked(bitcode: str) -> tuple[str, ...]:
    return "-Xclang", "-mlink-builtin-bitcode", "-Xclang", bitcode
