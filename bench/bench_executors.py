"""What it costs to render by worker processes: processor seconds over those of one process, and bytes.

The same image is rendered alone and by processes, in turn; bits must be the same. Processor seconds are
those of parent and workers together. `seconds_a_task` is what a task takes beside its samples: what the
same samples take more if they are cut into more tasks, over the number of these.

    python bench/bench_executors.py [--quick] [--json FILE] [--processes 2] [--rounds 2]
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path

import numpy as np

import ncv_cl as ncv

SCENE = Path(__file__).parent.parent / "scenes" / "interior.toml"
# Some ten seconds of a core, and what takes seconds.
FULL = {"size": (256, 256), "spp": 96}
QUICK = {"size": (64, 64), "spp": 64}


def processor_seconds() -> float:
    """Of this process and of children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def timed(processes: int, **options: object) -> tuple[ncv.Image, dict[str, float]]:
    """The image, and what it took, starting the processes included; 0 processes: none."""
    began, clock = processor_seconds(), time.perf_counter()
    if processes:
        with ncv.Processes(processes) as executor:
            image = ncv.render(SCENE, "gi", method="mc", executor=executor, **options)
    else:
        image = ncv.render(SCENE, "gi", method="mc", **options)
    took = {"processor": processor_seconds() - began, "clock": time.perf_counter() - clock}
    return image, took


def measure(processes: int, rounds: int, options: dict[str, object]) -> dict[str, object]:
    """Minima over the rounds."""
    few = -(-options["size"][0] * options["size"][1] // 16)
    ways = {
        "alone": (0, {}),
        "processes": (processes, {"task_points": few}),
        "more tasks": (processes, {"task_points": -(-few // 4)}),
    }
    # What is compiled once does not count.
    timed(0, **options | {"spp": 2})
    found: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    images = {}
    for _ in range(rounds):
        for name, (number, more) in ways.items():
            images[name], took = timed(number, **options, **more)
            found[name].append(took)
    same = all(np.array_equal(images["alone"].pixels, one.pixels) for one in images.values())
    least = {
        name: {key: min(one[key] for one in took) for key in took[0]} for name, took in found.items()
    }
    machines = images["processes"].stats["machines"]
    tasks = {name: images[name].stats["machines"]["tasks"] for name in ("processes", "more tasks")}
    more = least["more tasks"]["processor"] - least["processes"]["processor"]
    return {
        "seconds": least,
        "same_bits": same,
        "overhead": least["processes"]["processor"] / least["alone"]["processor"],
        "tasks": tasks,
        "seconds_a_task": more / max(1, tasks["more tasks"] - tasks["processes"]),
        "bytes_a_task": machines["bytes_a_task"],
        "most_bytes_a_task": machines["most_bytes_a_task"],
        "value_bytes_a_worker": [one["value_bytes"] for one in machines["workers"].values()],
        "device": images["alone"].stats["device"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=2)
    options = parser.parse_args()
    chosen = (1, QUICK) if options.quick else (options.rounds, FULL)
    found = measure(options.processes, *chosen)
    print(json.dumps(found, indent=1))
    if options.json:
        Path(options.json).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if not found["same_bits"]:
        raise SystemExit("pixels by processes differ from those of one process")


if __name__ == "__main__":
    main()
