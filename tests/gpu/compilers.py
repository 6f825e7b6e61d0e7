"""What compilers of GPUs that are not here have in common: tools, rows, the worst of many programs."""

from __future__ import annotations

import glob
import re
import shutil
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from every_program import Built

from ncv_cl.opencl import program

from .forms import form_of, worst_programs


@dataclass(frozen=True)
class Row:
    """What a kernel takes on a GPU.

    Attributes
    ----------
    arch, kernel : str
    registers : int
        32-bit registers of a work-item.
    spilt, stack : int
        Bytes that are spilt, and bytes of private arrays that do not fit registers.
    local : int
        Bytes of local memory of a group.
    group : int
        Work-items of a group.
    occupancy : float
        The part of a multiprocessor's warps (of a SIMD's waves) that can be resident.
    bound : str
        What bounds that: warps, groups, registers, local.
    form : str
        Of the kernel, as `form_of` says it.
    """

    arch: str
    kernel: str
    registers: int
    spilt: int
    stack: int
    local: int
    group: int
    occupancy: float
    bound: str
    form: str = ""

    @property
    def name(self) -> str:
        """Of the kernel and its form."""
        return f"{self.kernel} ({self.form})" if self.form else self.kernel


class Compiler(Protocol):
    """Compiles programs for GPUs of one maker."""

    archs: tuple[str, ...]
    missing: str | None

    def rows(self, text: str, options: Sequence[str], groups: dict[str, int]) -> list[Row]: ...


def find_tool(*names: str) -> str | None:
    """The first of these commands or patterns of paths that there is."""
    for name in names:
        found = shutil.which(name) or next(iter(sorted(glob.glob(name), reverse=True)), None)
        if found:
            return found
    return None


# AMD's compilers of before 15 know no gfx1100.
CLANG = find_tool("clang-1[5-9]", "/usr/bin/clang-1[5-9]", "clang")


def run(command: Sequence[str], text: str = "") -> tuple[str, str]:
    """What a command printed to its two outputs; RuntimeError if it failed."""
    done = subprocess.run(list(command), input=text, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{Path(command[0]).name}: {done.stderr.strip()[:2000]}")
    return done.stdout, done.stderr


def required_groups(text: str, options: Sequence[str]) -> dict[str, int]:
    """Work-items of a group of the kernels that say so in their attributes."""
    constants = dict(option[2:].split("=", 1) for option in options if option.startswith("-D"))
    found = {}
    for size, name in re.findall(
        r"reqd_work_group_size\(([^,]+),[^)]*\)\)\)\s*(?:void\s+)?(\w+)\(", text
    ):
        factors = [constants.get(word.strip(), word.strip()).rstrip("u") for word in size.split("*")]
        found[name] = 1
        for factor in factors:
            found[name] *= int(factor)
    return found


def worst_rows(compiler: Compiler, programs: Sequence[Built], jobs: int) -> list[Row]:
    """A row for each GPU and form of a launched kernel, of all its programs the one that takes most."""

    def compiled(one: Built) -> list[Row]:
        options = program.option_list(one.defines)
        try:
            rows = compiler.rows(program.source(one.files), options, one.groups)
        except RuntimeError as error:
            names = " + ".join(str(file) for file in one.files)
            raise RuntimeError(f"{names} for {', '.join(compiler.archs)}: {error}") from error
        return [replace(row, form=form_of(row.kernel, one)) for row in rows]

    with ThreadPoolExecutor(jobs) as pool:
        rows = [row for found in pool.map(compiled, worst_programs(programs)) for row in found]
    worst: dict[tuple[str, str], Row] = {}
    for row in rows:
        known = worst.setdefault((row.arch, row.name), row)
        if _demand(row) > _demand(known):
            worst[row.arch, row.name] = row
    return [worst[key] for key in sorted(worst)]


def _demand(row: Row) -> tuple[float, ...]:
    return row.spilt, row.stack, -row.occupancy, row.registers
