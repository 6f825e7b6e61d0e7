"""Run the parts of the benchmark, each in a process of its own, and write the report: `ncv-cl bench`."""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from report.parts import FULL_SECONDS, PARTS, Run, run_part

from ncv_cl.opencl.choose import choose_device
from ncv_cl.output.report import package_version

# Not a part but what is made of them.
REPORT = "report"
# Seconds of a quick run: in all, and the most that one part may take of them.
QUICK_SECONDS, QUICK_PART_SECONDS = 570.0, 240.0
# What the report itself takes is kept back.
REPORT_SECONDS = 25.0
PACKAGES = ("numpy", "pyopencl", "embreex", "OpenImageIO", "matplotlib", "torch", "zuko", "mitsuba")


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 0, 1 if a part failed (the report is written nonetheless), 2 for bad input."""
    options = _parser().parse_args(arguments)
    extra = shlex.split(options.options)
    unknown = [name for name in options.parts if name not in (*PARTS, REPORT)]
    if unknown:
        print(
            f"ncv-cl: error: bench has no part {unknown[0]!r}; the parts are {', '.join(PARTS)}, and "
            f"{REPORT} for what is there already",
            file=sys.stderr,
        )
        return 2
    if extra and len(options.parts) != 1:
        print("ncv-cl: error: --options are those of one part: name it", file=sys.stderr)
        return 2
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    wanted = [name for name in PARTS if name in options.parts or not options.parts]
    started, failed = time.perf_counter(), False
    for k, name in enumerate(wanted):
        limit = None
        # Parts that are asked for by name take what they take.
        if options.quick or not options.parts:
            gone = time.perf_counter() - started
            limit = _limit(options.quick, options.seconds, gone, wanted[k + 1 :])
        print(f"== {name}", flush=True)
        run = run_part(PARTS[name], out, options.quick, options.device, limit, extra)
        print(f"== {name}: {run.status}, {run.seconds:.0f} s", flush=True)
        failed |= run.status in ("failed", "timed out")
        record(out, run, options.device)
    return max(_write_report(out), int(failed))


def _limit(quick: bool, seconds: float, gone: float, later: Sequence[str]) -> float:
    """Seconds that a part may take after `gone` ones, so that those after it have theirs."""
    if quick:
        return min(QUICK_PART_SECONDS, QUICK_SECONDS - REPORT_SECONDS - gone)
    seconds -= REPORT_SECONDS
    return seconds - gone - sum(PARTS[name].seconds for name in later) * seconds / FULL_SECONDS


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="ncv-cl bench", description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("parts", nargs="*", metavar="PART", help=f"{', '.join(PARTS)}, {REPORT}; default: all")
    add("--quick", action="store_true", help="all at reduced size, in less than ten minutes")
    add(
        "--seconds",
        type=float,
        default=FULL_SECONDS,
        metavar="S",
        help="what all parts in full may take (default %(default).0f; shares: report/parts.py)",
    )
    add("--out", default="bench-report", metavar="DIR", help="results and report (default: %(default)s)")
    add("--device", metavar="D", help="as for ncv-cl render")
    add("--options", default="", metavar="TEXT", help="for one part's script, as --options='--size 128'")
    return parser


def record(out: Path, run: Run, device: str | None) -> None:
    """Keep how a part's run went; runs of other parts, and of other days, stay."""
    file = out / "runs.json"
    found = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {"runs": {}}
    found["machine"] = machine(device)
    found["runs"][run.part] = run.as_dict() | {"commit": _commit()}
    file.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def machine(device: str | None) -> dict[str, object]:
    """What the numbers depend on; no names of machines or people."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "device": choose_device(device).identity,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "ncv_cl": package_version(),
        **versions,
    }


def _commit() -> str:
    """The checkout's commit, marked if files other than results were changed since."""
    root = Path(__file__).parent.parent
    try:
        commit, changed = (
            subprocess.run(["git", *words], capture_output=True, text=True, cwd=root).stdout.strip()
            for words in (
                ("describe", "--always", "--exclude", "*"),
                ("status", "--porcelain", "--", ".", ":!bench/results"),
            )
        )
    except OSError:
        return "unknown"
    return commit + "-dirty" * bool(changed) if commit else "unknown"


def _write_report(out: Path) -> int:
    # Only the report needs matplotlib and jinja2: parts can be measured without them.
    try:
        from report.build import build_report
    except ImportError as error:
        print(
            f"ncv-cl: error: the report needs {error.name}; pip install -e '.[bench]'", file=sys.stderr
        )
        return 2
    for file in build_report(out):
        print(f"wrote {file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
