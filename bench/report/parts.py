"""The parts of the benchmark: which script measures what, and one run of it in a process of its own."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

BENCH = Path(__file__).parent.parent
# Lines of a failed part's output that the report shows.
LAST_LINES = 15


@dataclass(frozen=True)
class Part:
    """One script and what is missing without it.

    Attributes
    ----------
    seconds : float
        What the full run may take of it, on two cores; see `FULL_SECONDS`.
    """

    name: str
    script: str
    seconds: float
    shows: str

    @property
    def path(self) -> Path:
        return BENCH / self.script


# The full run ends within this. A part has its own seconds, and what those before it have left.
FULL_SECONDS = 2700.0
PARTS = {
    part.name: part
    for part in (
        Part("static", "bench_static.py", 10,
             "what GPUs' compilers make of the kernels, and the paper model"),
        Part("curves", "bench_curves.py", 200, "error against seconds of every method; crossovers"),
        # After the curves, whose references it takes.
        Part("pictures", "bench_pictures.py", 60, "pictures, error maps and FLIP at equal time"),
        Part("equal", "bench_equal.py", 170,
             "seconds to equal error, absolute and relative, of all ways"),
        Part("gi", "bench_gi.py", 160, "global illumination: rays a second, nested noise, equal error"),
        Part("gi_equal", "bench_gi_equal.py", 230,
             "global illumination to equal error, absolute and relative"),
        Part("auto", "bench_auto.py", 450, "what auto chooses in scenes that no number was tuned on"),
        Part("lines", "bench_lines.py", 60, "direct light along lines beside points"),
        Part("slices", "bench_slices.py", 70, "ambient occlusion by slices beside rays"),
        Part("lights", "bench_lights.py", 60, "variance and cost of 1 to 1000 lights"),
        Part("mesh_lights", "bench_mesh_lights.py", 30, "what a mesh that emits costs"),
        Part("integrate", "bench_integrate.py", 130, "errors and cost of the exact integral"),
        Part("mitsuba", "compare_mitsuba.py", 150, "agreement with Mitsuba 3, and speed beside it"),
        Part("peers", "bench_peers.py", 170,
             "Mitsuba in every scene, Radiance at sensors, view factors of others"),
        Part("planar", "bench_planar.py", 160, "other control variates of planar integrands"),
        Part("sensors", "bench_sensors.py", 50, "direct light at sensors, beside Radiance"),
        Part("bake", "bench_bake.py", 40, "baked maps: seconds and errors"),
        Part("filters", "bench_filters.py", 70, "points a pixel and filters: error and cost of edges"),
        Part("rays", "bench_rays.py", 40, "rays a second by embree and by kernels"),
        Part("executors", "bench_executors.py", 70, "cost of rendering by worker processes"),
        Part("scaling", "bench_scaling.py", 120,
             "seconds and memory against points, width, triangles, threads"),
        Part("device", "bench_device.py", 90, "checks and times of every stage on this device"),
        Part("network", "bench_network.py", 10, "cost of the network's evaluation"),
        Part("train", "bench_train.py", 100, "residual variance against training's seconds"),
    )
}  # fmt: skip


@dataclass(frozen=True)
class Run:
    """How one part's run ended.

    Attributes
    ----------
    part, command, date : str
    status : {"ok", "failed", "timed out", "absent", "no time left"}
    seconds : float
    load : float or None
        The machine's load average before the run, where it has one: more than 0 means company.
    message : str
        The last lines of the output, where it failed.
    """

    part: str
    command: str
    date: str
    status: str
    seconds: float
    load: float | None
    message: str

    def as_dict(self) -> dict[str, object]:
        return asdict(self)


def command_of(part: str, quick: bool, extra: Sequence[str] = ()) -> str:
    """What a reader types to measure a part again."""
    own = f' --options "{shlex.join(extra)}"' if extra else ""
    return f"ncv-cl bench {part}{' --quick' if quick else ''}{own}"


def run_part(
    part: Part,
    out: Path,
    quick: bool,
    device: str | None,
    limit: float | None,
    extra: Sequence[str] = (),
) -> Run:
    """Run a part's script; its results are in ``out/<name>.json`` if it came to its end.

    Parameters
    ----------
    limit : float or None
        Seconds after which the script and all that it started are killed.
    extra : sequence of str
        Options of the script's own.
    """
    command, date = command_of(part.name, quick, extra), time.strftime("%Y-%m-%d %H:%M")
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    if not part.path.exists():
        return Run(part.name, command, date, "absent", 0.0, load, f"there is no bench/{part.script}")
    if limit is not None and limit <= 0:
        return Run(part.name, command, date, "no time left", 0.0, load, "")
    results = out / f"{part.name}.json"
    # What an earlier run left must not pass for this one's.
    results.unlink(missing_ok=True)
    arguments = [sys.executable, str(part.path), "--json", str(results)]
    arguments += [*(["--quick"] if quick else []), *extra]
    started = time.perf_counter()
    code, lines, killed = _call(arguments, device, limit)
    status = "timed out" if killed else "ok" if code == 0 and results.exists() else "failed"
    message = "" if status == "ok" else "\n".join(lines)
    return Run(part.name, command, date, status, time.perf_counter() - started, load, message)


def _call(arguments: list[str], device: str | None, limit: float | None) -> tuple[int, list[str], bool]:
    """Exit status, last lines of output (shown as they come), and whether the limit ended it."""
    environment = dict(os.environ, PYTHONUNBUFFERED="1")
    if device is not None:
        environment["NCV_CL_DEVICE"] = device
    # A session of its own, so that a script's children end with it.
    process = subprocess.Popen(
        arguments,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=environment,
        start_new_session=True,
    )
    killed = threading.Event()

    def kill() -> None:
        killed.set()
        os.killpg(process.pid, signal.SIGKILL)

    timer = threading.Timer(limit, kill) if limit is not None else None
    if timer is not None:
        timer.start()
    lines: deque[str] = deque(maxlen=LAST_LINES)
    try:
        for line in process.stdout:
            print(f"  {line}", end="", flush=True)
            lines.append(line.rstrip())
        code = process.wait()
    except BaseException:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        raise
    finally:
        if timer is not None:
            timer.cancel()
    return code, list(lines), killed.is_set()
