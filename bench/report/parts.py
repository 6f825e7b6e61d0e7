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
    """One script, what heads its section, and what is missing without it."""

    name: str
    script: str
    title: str
    shows: str

    @property
    def path(self) -> Path:
        return BENCH / self.script


PARTS = {
    part.name: part
    for part in (
        Part("curves", "bench_curves.py", "Whole renders",
             "error against time of every method, the crossovers, auto, the slides' table"),
        Part("equal", "bench_equal.py", "Seconds to equal error",
             "the control variate against independent, Sobol and pilot-allocated Monte Carlo"),
        Part("pictures", "bench_pictures.py", "Pictures at equal time",
             "picture strips, error maps and FLIP at equal time"),
        Part("planar", "bench_planar.py", "The slides' two-dimensional experiments, with peers",
             "automatic integration, flows and regression as control variates of planar integrands"),
        Part("mitsuba", "compare_mitsuba.py", "Beside Mitsuba 3",
             "speed and time to error against a renderer that users already have"),
        Part("gi", "bench_gi.py", "Global illumination",
             "control variates for nested integrals with noisy estimates"),
        Part("scaling", "bench_scaling.py", "Scaling",
             "cost of stages against points, width, depth, triangles and threads; memory"),
        Part("device", "bench_device.py", "Device",
             "validation and time of every stage on this device"),
        Part("integrate", "bench_integrate.py", "Exact integration",
             "cost of the exact integral, and beside quadrature"),
        Part("network", "bench_network.py", "Inference", "cost of the network's evaluation"),
        Part("train", "bench_train.py", "Training", "residual variance against training's seconds"),
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
