"""Where it runs: several machines, GPUs, memory, rays, stages; and values at points of the user."""

from __future__ import annotations

from bench_scaling import LARGEST_BYTES

from .. import svg
from ..document import Answer, Figure, Table
from .common import Question, Results, named, records, shown, span

# Kernels of a render's samples and training: the others run once.
HOT = (
    "draw_samples",
    "accumulate",
    "gradients",
    "shade_hits",
    "fold",
    "integrate",
    "find_hits",
    "find_visible",
    "encode_grid",
    "share_paths",
    "density_gradients",
    "squared_residuals",
)

# Who traces.
BY = ("embree", "kernels")


def sensors(found: Results) -> Answer:
    """Irradiance at points of the user, and maps."""
    rows = found.get("sensors", {}).get("rows", [])
    answer = Answer("Sensors were not measured.")
    if rows:
        ours = [row for row in rows if "lines" in row["way"]]
        theirs = [row for row in rows if "lines" not in row["way"]]
        data = found["sensors"]
        text = (
            f"Direct light at {data['sensors']} sensors takes {seconds_to(ours[0])} and "
            f"{seconds_to(ours[-1])}"
        )
        if theirs:
            best = min(theirs, key=lambda row: row["error_over_values"])
            text += f"; Radiance's rtrace takes {seconds_to(best)} at its best"
        answer = Answer(text + ".")
        series = {
            name: [(row["processor_seconds"], row["error_over_values"]) for row in own]
            for name, own in (("ncv.irradiance", ours), ("rtrace", theirs))
            if own
        }
        drawn = svg.lines(series, "processor seconds", "error over values")
        answer.figure = Figure("sensors", drawn, "Direct light at sensors of scenes/interior.toml.")
        answer.table = records(rows, "Sensors")
    bakes = found.get("bake", {}).get("rows", [])
    if bakes:
        most = max(row["spp"] for row in bakes)
        own = [row for row in bakes if row["spp"] == most and row["method"] == "auto"]
        each = [
            f"{row['integrand']} {shown(row['processor_seconds'])} s to {row['relative_error']:.1e}"
            for row in own
        ]
        size = found["bake"]["size"]
        answer.more.append(
            f"A baked map of {size} × {size} texels with {most} samples each takes, to a relative "
            f"error: {named(each)}."
        )
        answer.details.append(records(bakes, "Baked maps of the Cornell box's floor"))
    return answer


def seconds_to(row: dict) -> str:
    """A row of the sensors in words."""
    seconds, error = shown(row["processor_seconds"]), 100 * row["error_over_values"]
    return f"{seconds} processor seconds to {error:.2g} % of the values"


def workers(found: Results) -> Answer:
    """Rendering by processes."""
    data = found["executors"]
    same = "the same bits" if data["same_bits"] else "other bits"
    answer = Answer(
        f"Two worker processes give {same} for {shown(data['overhead'])} times the processor seconds "
        f"of one process, starting them included; a task costs {shown(1e3 * data['seconds_a_task'])} ms "
        f"and {data['bytes_a_task'] / 1e3:.0f} kB more."
    )
    answer.more.append("All ran on one machine: what a network takes is not in it.")
    rows = [
        (f"{name}, {kind}", one, 0 if kind == "processor" else 1)
        for name, took in data["seconds"].items()
        for kind, one in took.items()
    ]
    drawn = svg.bars(rows, "seconds", log=False, series=("processor", "clock"))
    answer.figure = Figure("workers", drawn, "Seconds, all processes together.")
    answer.table = Table(
        ["", "processor", "clock"],
        [[n, t["processor"], t["clock"]] for n, t in data["seconds"].items()],
        "Seconds",
    )
    return answer


def gpu(found: Results) -> Answer:
    """The static table, the model, and checks on the device at hand."""
    kernels = {table["heading"]: table for table in found.get("static", {}).get("kernels", [])}
    answer = Answer("There is no table of kernels on GPUs.")
    chosen = kernels.get("sm_90")
    if chosen:
        at = {name: k for k, name in enumerate(chosen["columns"])}
        rows = {row[0]: row for row in chosen["rows"]}
        shares = {name: float(row[at["occupancy"]].rstrip("%")) for name, row in rows.items()}
        spilt = [name for name, row in rows.items() if row[at["spilt B"]] not in ("0", "")]
        hot = [name for name in HOT if name in shares]
        answer = Answer(
            f"For an H100 the compilers keep {span([shares[n] for n in hot])} % of the warps resident "
            f"in the kernels that take the time, and {len(spilt)} of {len(rows)} kernels spill registers"
            + (f" ({named(spilt)})" if spilt else "")
            + "; a table of compilers, not of a clock."
        )
        bars = [(name, shares[name], 0 if shares[name] >= 25 else 1) for name in hot]
        drawn = svg.bars(bars, "occupancy in %, sm_90", log=False)
        answer.figure = Figure("gpu", drawn, "Warps resident, by registers and local memory.")
        answer.details += [
            Table(t["columns"], t["rows"], f"Kernels by their compilers: {name}")
            for name, t in kernels.items()
        ]
    model = found.get("static", {}).get("model", [])
    if model:
        times = next((one for one in model if "ratio" in one["columns"]), model[0])
        if "ratio" in times["columns"]:
            ratio = times["columns"].index("ratio")
            each = [f"{row[0]} {row[ratio]}" for row in times["rows"]]
            answer.more.append(
                "A model on paper (docs/gpu_model.md) says how many times sooner than two cores an H100 "
                f"would be done: {'; '.join(each)}."
            )
        answer.table = Table(times["columns"], times["rows"], f"The model: {times['heading']}")
        answer.details += [
            Table(one["columns"], one["rows"], one["heading"]) for one in model if one is not times
        ]
    device = found.get("device")
    if device and "checks" in device:
        failed = [check["subject"] for check in device["checks"] if check["error"]]
        answer.more.append(
            f"On the device of this report ({device['device']}), "
            f"{len(device['checks']) - len(failed)} of {len(device['checks'])} checks of kernels "
            "against their references pass" + (f"; {named(failed)} fail." if failed else ".")
        )
        answer.details.append(records(device["checks"], "Checks on this device"))
    for name, other in (device or {}).get("others", {}).items():
        answer.more.append(f"Of {other.get('device', '?')} there is {name}.json.")
        rows = [
            {key: one for key, one in row.items() if key != "seconds"}
            | {"seconds": row["seconds"].get("total")}
            for row in other.get("stages", [])
        ]
        answer.details.append(records(rows, f"Renders on {other.get('device', '?')}"))
    return answer


def memory(found: Results) -> Answer:
    """The process's largest resident memory by points."""
    data = found["scaling"]
    rows = data["points"]
    fits = "within" if data["largest_fits"] else "beyond"
    answer = Answer(
        f"A render of {rows[-1]['size']} × {rows[-1]['size']} points by the control variate takes "
        f"{shown(data['largest_bytes'] / 1e9)} GB, {fits} the {LARGEST_BYTES / 1e9:.0f} GB that "
        f"it may take; one of {rows[0]['size']} × "
        f"{rows[0]['size']} takes {shown(rows[0]['bytes']['whole'] / 1e9)} GB."
    )
    series = {"whole process": [(row["size"] ** 2, row["bytes"]["whole"] / 1e9) for row in rows]}
    drawn = svg.lines(series, "points", "GB")
    answer.figure = Figure("memory", drawn, "Largest resident memory, Python and libraries included.")
    answer.table = Table(
        ["points a side", "GB", "seconds"],
        [[r["size"], r["bytes"]["whole"] / 1e9, sum_of(r)] for r in rows],
        "By points",
    )
    return answer


def sum_of(row: dict) -> float | None:
    """A row's total seconds."""
    seconds = row["seconds"]
    return seconds.get("total", sum(seconds.values()) or None)


def stages(found: Results) -> Answer:
    """Stages of a render, and how they grow."""
    data = found.get("scaling", {})
    answer = Answer("Stages were not measured.")
    if data.get("points"):
        row = data["points"][min(3, len(data["points"]) - 1)]
        own = {name: s for name, s in row["seconds"].items() if name != "total" and s > 0}
        total, first = sum(own.values()), max(own, key=own.__getitem__)
        answer = Answer(
            f"Of a control variate's {row['size']} × {row['size']} image with {row['spp']} samples, "
            f"{100 * own[first] / total:.0f} % of {shown(total)} s go to {first}."
        )
        order = sorted(own.items(), key=lambda one: -one[1])
        drawn = svg.bars([(name, s, 0) for name, s in order if s > 1e-3 * total], "seconds", log=False)
        answer.figure = Figure("stages", drawn, "Seconds by stage.")
        for sweep, key in (
            ("points", "size"),
            ("width", "width"),
            ("triangles", "triangles"),
            ("threads", "threads"),
        ):
            rows = [[r.get("method"), r[key], sum_of(r)] for r in data.get(sweep, [])]
            answer.details.append(Table(["method", key, "seconds"], rows, f"By {key}"))
    network = found.get("network", {})
    if network:
        answer.details.append(records(network["inference"], "Inference of the network"))
    train = found.get("train", {}).get("runs", [])
    default = [row for row in train if row["preset"] == "default"]
    if default:
        best, size = min(default, key=lambda row: row["residual"]), found["train"]["size"]
        answer.more.append(
            f"Training leaves {100 * best['residual']:.2g} % of the variance at best ({best['scene']} "
            f"{best['integrand']}, {shown(best['seconds'])} s at {size} × {size} points)."
        )
        answer.details.append(records(train, "Residual variance by training"))
    return answer


def rays(found: Results) -> Answer:
    """Rays by embree and by kernels."""
    rows = found.get("rays", {}).get("rows", [])
    answer = Answer("Rays by kernels were not measured.")
    if rows:
        embree = {row["scene"]: row for row in rows if row["by"] == "embree"}
        others = [row for row in rows if row["by"] != "embree"]
        ratios = [row["first_hits"] / embree[row["scene"]]["first_hits"] for row in others]
        verdict = "so embree stays the default there" if max(ratios) < 1 else "so it depends"
        answer = Answer(
            f"On a CPU, kernels find first hits {span(ratios)} times as fast as embree with its "
            f"binding, {verdict}."
        )
        bars = [
            (f"{row['scene']}, {row['by']}"[:34], row["first_hits"], int(row in others)) for row in rows
        ]
        drawn = svg.bars(bars, "million first hits a second of one core", log=False, series=BY)
        answer.figure = Figure("rays", drawn, "Rays that leave what the camera sees; more are better.")
        answer.table = records(rows, "Million rays a second of one core")
    for scene, case in found.get("gi", {}).get("cases", {}).items():
        speed = case["throughput"]
        answer.more.append(
            f"{scene}: paths answer {shown(speed['million_rays_a_second'])} million rays a second, all "
            f"in, {shown(speed['ratio'])} of what embree alone traces of the same rays."
        )
    return answer


QUESTIONS = (
    Question("Sensors and baking?", ("sensors", "bake"), sensors),
    Question("Several machines?", ("executors",), workers),
    Question("What happens on my GPU?", ("static", "device"), gpu),
    Question("How much memory?", ("scaling",), memory),
    Question("Where do the seconds go?", ("scaling", "network", "train"), stages),
    Question("Rays by embree or by kernels?", ("rays", "gi"), rays),
)
