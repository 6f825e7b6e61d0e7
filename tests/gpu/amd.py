"""Kernels compiled for AMD's GPUs by clang, which but for its version is the driver's compiler."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from pathlib import Path

from .compilers import CLANG, Row, run

# Of one SIMD: vector registers a lane, their granule, waves; lanes of a wave; of one compute unit:
# SIMDs, bytes of local memory.
LIMITS = {"gfx1100": (1536, 24, 16, 32, 2, 64 << 10)}
LIBRARIES = (
    "opencl",
    "ocml",
    "ockl",
    "oclc_daz_opt_off",
    "oclc_unsafe_math_off",
    "oclc_finite_only_off",
    "oclc_correctly_rounded_sqrt_off",
    "oclc_wavefrontsize64_off",
    "oclc_abi_version_400",
)


class Amd:
    """The compiler for one architecture.

    Parameters
    ----------
    arch : str
        Of `LIMITS`.

    Attributes
    ----------
    missing : str, optional
        What is not installed.
    """

    def __init__(self, arch: str) -> None:
        self.archs = (arch,)
        folders = ("/usr/lib/*/amdgcn/bitcode", "/opt/rocm*/amdgcn/bitcode")
        folder = next((found for one in folders for found in glob.glob(one)), None)
        self.missing = None if CLANG and folder else "clang 15 or Debian's rocm-device-libs"
        if self.missing:
            return
        # It only switches instructions on that newer versions of the libraries know.
        isa = Path(folder, f"oclc_isa_version_{arch.removeprefix('gfx')}.bc")
        isa = isa if isa.exists() else Path(folder, "oclc_isa_version_1030.bc")
        self._libraries = [*(str(Path(folder, f"{name}.bc")) for name in LIBRARIES), str(isa)]

    def rows(self, text: str, options: Sequence[str], groups: dict[str, int]) -> list[Row]:
        """A row for each kernel of `groups` in a program's text."""
        linked = [
            part
            for library in self._libraries
            for part in ("-Xclang", "-mlink-builtin-bitcode", "-Xclang", library)
        ]
        command = [
            *(
                CLANG,
                "-x",
                "cl",
                "-cl-std=CL1.2",
                "-target",
                "amdgcn-amd-amdhsa",
                f"-mcpu={self.archs[0]}",
            ),
            *("-nogpulib", "-mcode-object-version=4", "-Xclang", "-finclude-default-header", "-O3"),
            *(*linked, "-S", "-o", "-", *options, "-"),
        ]
        assembly, _ = run(command, text)
        # The metadata is YAML, a block a kernel; only flat scalars of it are read here.
        blocks = assembly[assembly.index("amdhsa.kernels:") :].split("\n  - ")[1:]
        found = []
        for block in blocks:
            symbol = re.search(r"\.symbol:\s*'?(\w+)\.kd", block)
            if symbol is not None and symbol[1] in groups:
                found.append(self._row(symbol[1], block, groups[symbol[1]]))
        return found

    def _row(self, name: str, block: str, group: int) -> Row:
        registers, granule, waves, lanes, simds, local_memory = LIMITS[self.archs[0]]

        def number_of(key: str) -> int:
            return int(re.search(rf"\.{key}:\s*(\d+)", block)[1])

        used, local = number_of("vgpr_count"), number_of("group_segment_fixed_size")
        waves_a_group = -(-group // lanes)
        limits = {
            "waves": waves,
            "registers": registers // (-(-max(used, 1) // granule) * granule),
            # A compute unit's, which its SIMDs share.
            "local": local_memory // max(local, 1) * waves_a_group / simds,
        }
        bound = min(limits, key=limits.get)
        return Row(
            self.archs[0],
            name,
            used,
            4 * number_of("vgpr_spill_count"),
            number_of("private_segment_fixed_size"),
            local,
            group,
            min(1.0, limits[bound] / waves),
            bound,
        )
