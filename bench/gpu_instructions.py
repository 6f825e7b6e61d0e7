"""Instructions that kernels execute, counted by a simulator: oclgrind runs a small render.

``count(case)`` starts this file under oclgrind. Programs are not optimised there, as oclgrind 21.10 does
not know all that optimisers write. So instructions are weighed by what a GPU's compiler leaves of them
(`WEIGHTS`): what moves values between variables is nothing, since variables are registers; a division is
several instructions.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
OCLGRIND = shutil.which("oclgrind")
# As tests/test_oclgrind.py has them.
BUILD_OPTIONS = "-cl-opt-disable -DINLINED= -Dsincos(x,cosine)=(*(cosine)=cos(x),sin(x))"
# What OpenCL's functions and LLVM's instructions take on a GPU, in its instructions; those that are not
# named take `OTHER`, and the package's own functions nothing but what is in them.
WEIGHTS = {
    **dict.fromkeys(("fadd", "fsub", "fmul", "fneg", "fcmp", "add", "sub", "mul", "icmp", "select"), 1),
    **dict.fromkeys(("shl", "lshr", "ashr", "and", "or", "xor", "fma", "fmuladd", "min", "max"), 1),
    **dict.fromkeys(("fmin", "fmax", "floor", "rint", "clz", "popcount", "rotate", "mad24", "mul24"), 1),
    **dict.fromkeys(("uitofp", "sitofp", "fptoui", "fptosi", "mul_hi", "clamp", "isfinite"), 2),
    **dict.fromkeys(("load global", "store global", "load constant"), 2),
    **dict.fromkeys(("load local", "store local"), 2),
    **dict.fromkeys(("fdiv", "exp", "exp2", "log", "log2", "normalize", "length"), 8),
    **dict.fromkeys(("udiv", "urem", "sdiv", "srem", "sin", "cos", "frem"), 20),
    **dict.fromkeys(("acos", "asin", "atan", "atan2", "pow"), 30),
    **{"br": 0.5, "fabs": 0, "copysign": 1, "sqrt": 6, "rsqrt": 3, "dot": 3, "cross": 6},
    **{"vload3": 4, "vstore3": 4, "barrier": 10, "atomic_add": 4, "get_global_id": 2},
}
NOTHING = {
    "phi",
    "alloca",
    "ret",
    "bitcast",
    "getelementptr",
    "zext",
    "sext",
    "trunc",
    "freeze",
    "switch",
}
NOTHING |= {
    "insertelement",
    "extractelement",
    "shufflevector",
    "load private",
    "store private",
    "as_uint",
}
NOTHING |= {"insertvalue", "extractvalue", "unreachable", "as_float", "memcpy", "memset", "lifetime"}
OTHER = 4
FLOPS = {"fadd": 1, "fsub": 1, "fmul": 1, "fdiv": 1, "fma": 2, "fmuladd": 2, "sqrt": 1, "rsqrt": 1}
FLOPS |= {"dot": 5, "cross": 9, "normalize": 9}
# Of a vector's three numbers each takes its own; these are counted whole.
WHOLE = {"dot", "cross", "normalize", "length", "vload3", "vstore3"}


@dataclass(frozen=True)
class Work:
    """What a kernel's work-items did, in the mean.

    Attributes
    ----------
    instructions, flops : float
        Of a GPU, as `WEIGHTS` says, and floating-point operations, a fused multiply-add being two.
    loaded, stored : float
        Bytes of global memory, caches not counted.
    """

    instructions: float
    flops: float
    loaded: float
    stored: float


def count(scene: str, integrand: str, rays: str, size: int, spp: int) -> dict[str, Work]:
    """The mean work of an item of each kernel of a render in the shape of a GPU, by the simulator.

    Raises
    ------
    RuntimeError
        If oclgrind is not there, or does not come to the render's end.
    """
    if OCLGRIND is None:
        raise RuntimeError("oclgrind is not installed: apt install oclgrind")
    with tempfile.TemporaryDirectory() as folder:
        items = Path(folder, "items.json")
        environment = {
            k: v for k, v in os.environ.items() if k not in ("OCL_ICD_VENDORS", "NCV_CL_DEVICE")
        }
        environment |= {"PYOPENCL_NO_CACHE": "1", "XDG_CACHE_HOME": folder}
        arguments = (scene, integrand, rays, str(size), str(spp), str(items))
        done = subprocess.run(
            [
                OCLGRIND,
                "--inst-counts",
                "--build-options",
                BUILD_OPTIONS,
                sys.executable,
                __file__,
                *arguments,
            ],
            capture_output=True,
            text=True,
            env=environment,
            cwd=ROOT,
        )
        if done.returncode or not items.exists():
            raise RuntimeError(f"oclgrind did not render {scene}: {(done.stdout + done.stderr)[-2000:]}")
        return means(done.stdout, json.loads(items.read_text(encoding="utf-8")))


def means(log: str, items: dict[str, int]) -> dict[str, Work]:
    """A kernel's mean work of an item, from what oclgrind printed for each of its launches."""
    sums: dict[str, list[float]] = defaultdict(lambda: [0.0] * 4)
    kernel = ""
    for line in log.splitlines():
        heading = re.match(r"Instructions executed for kernel '(\w+)'", line)
        row = re.match(r"\s+(\d+) - (.+?)(?: \((\d+) bytes\))?$", line)
        if heading:
            kernel = heading[1]
        elif row and kernel:
            for place, value in enumerate(_weighed(int(row[1]), row[2], int(row[3] or 0))):
                sums[kernel][place] += value
    return {name: Work(*(x / items[name] for x in found)) for name, found in sums.items() if items[name]}


def _weighed(number: int, said: str, bytes_moved: int) -> tuple[float, float, float, float]:
    """Instructions, floating-point operations, and bytes loaded and stored, of one line."""
    name, lanes = _name(said)
    lanes = 1 if name in WHOLE else lanes
    weight = 0 if name in NOTHING else WEIGHTS.get(name, OTHER)
    in_global = "AS1" in said
    loaded = 12 * number * (name == "vload3" and in_global) + bytes_moved * (name == "load global")
    stored = 12 * number * (name == "vstore3" and in_global) + bytes_moved * (name == "store global")
    return number * lanes * weight, number * lanes * FLOPS.get(name, 0), loaded, stored


def _name(said: str) -> tuple[str, int]:
    """A built-in function's or an instruction's name, and how many lanes it has."""
    mangled = re.match(r"call _Z(\d+)(\w+)\(\)", said)
    intrinsic = re.match(r"call llvm\.(\w+)([\w.]*)\(\)", said)
    width = re.search(r"Dv(\d+)_|\.v(\d+)", said)
    lanes = int(width[1] or width[2]) if width else 1
    if mangled:
        return mangled[2][: int(mangled[1])], lanes
    if intrinsic:
        return intrinsic[1], lanes
    # The package's own functions: what they do is counted.
    return ("ret" if said.startswith("call ") else said), 1


def _render(scene: str, integrand: str, rays: str, size: str, spp: str, items: str) -> None:
    """Inside the simulator: render, and note the items of each kernel."""
    sys.path.insert(0, str(ROOT / "tests"))
    from device_counts import counting
    from oclgrind_run import take_slices

    import ncv_cl as ncv
    from ncv_cl.opencl.device import GPU_LANES, list_cl_devices, open_device

    take_slices()
    (simulator,) = list_cl_devices()
    device = open_device(simulator, vector_width=1, lanes=GPU_LANES)
    with counting() as counts:
        ncv.render(
            ROOT / f"scenes/{scene}.toml", integrand, "mc", rays=rays, spp=int(spp),
            size=(int(size), int(size)), device=device,
        )  # fmt: skip
    found = {name: one.items for name, one in counts.kernels.items()}
    Path(items).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    _render(*sys.argv[1:])
