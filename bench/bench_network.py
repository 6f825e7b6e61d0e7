"""Inference and training of the renderer's networks, beside PyTorch on the same machine in the same run.

Inference is checked against PyTorch's before either is timed, in interleaved repeats of which the median
counts. Of training the fastest repeat counts, ours and theirs: it takes long enough for others on the
machine to disturb it. PyTorch uses as many threads as there are cores;
without it only our figures are printed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
from training import TrainingCase

from ncv_cl.network.encode import Encoding
from ncv_cl.network.network import WEIGHT_GROUPS, NetworkDescription
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device
from ncv_cl.opencl.memory import HostArray
from ncv_cl.opencl.program import build
from ncv_cl.settings.presets import PRESETS

POINTS, SAMPLES, CHANNELS = 1024, 256, 3
NETWORKS = {
    "2x32, bias 1 per point": ((32, 32), ("B1",)),
    "16x16, all per point": ((16, 16), WEIGHT_GROUPS),
    "8x8, all per point": ((8, 8), WEIGHT_GROUPS),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer repeats")
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    options = parser.parse_args()
    device = choose_device(options.device)
    torch = import_torch()
    print(device.identity)
    repeats = 5 if options.quick else 15
    inference = [inference_row(device, torch, name, repeats) for name in NETWORKS]
    # A training sample is compared with an inference sample of the default network.
    training = training_row(device, torch, options.quick, inference[1]["ns_a_sample"])
    if options.json:
        report = {"device": device.identity, "inference": inference, "training": training}
        Path(options.json).write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def import_torch() -> ModuleType | None:
    try:
        import torch
    except ImportError:
        print("PyTorch is not installed: no comparison")
        return None
    return torch


def interleaved(repeats: int, *works: Callable[[], object]) -> list[float]:
    """Median seconds of each of `works`, run in turn after a warm-up of each."""
    for work in works:
        work()
    times: list[list[float]] = [[] for _ in works]
    for _ in range(repeats):
        for work, own in zip(works, times, strict=True):
            begun = time.perf_counter()
            work()
            own.append(time.perf_counter() - begun)
    return [float(np.median(own)) for own in times]


def inference_row(device: Device, torch: ModuleType | None, name: str, repeats: int) -> dict:
    """Nanoseconds a sample, all cores, ours and PyTorch's."""
    hidden, modulated = NETWORKS[name]
    description = NetworkDescription(Encoding(("position",)), CHANNELS, hidden, modulated)
    generator = np.random.default_rng(0)
    shapes = {**description.group_shapes, "W2": hidden[::-1]}
    arrays = {
        group: generator.normal(size=(POINTS, *shape) if group in modulated else (1, *shape))
        for group, shape in shapes.items()
    }
    arrays = {group: array.astype(np.float32) for group, array in arrays.items()}
    uv = generator.random((2, POINTS, SAMPLES), np.float32)
    given = arrays | dict(zip("UV", uv, strict=True))
    buffers = {name.lower(): HostArray.of(device, array) for name, array in given.items()}
    value = HostArray(device, (CHANNELS, POINTS, SAMPLES), np.float32)
    evaluate = build(device, ("common", "mlp"), description.defines()).kernel("evaluate")

    def ours() -> None:
        evaluate(
            POINTS * SAMPLES // device.vector_width,
            first_point=0,
            point_count=POINTS,
            stride=SAMPLES,
            **buffers,
            value=value,
        )
        device.queue.finish()

    works: list[Callable[[], object]] = [ours]
    if torch is not None:
        tensors = {group: torch.from_numpy(array) for group, array in arrays.items()}
        stacked = torch.from_numpy(np.stack(uv, -1))

        @torch.no_grad()
        def theirs() -> object:
            h = torch.relu(stacked @ tensors["W1"].mT + tensors["B1"][:, None])
            h = torch.relu(h @ tensors["W2"].mT + tensors["B2"][:, None])
            return h @ tensors["W3"].mT + tensors["B3"][:, None]

        works.append(theirs)
        ours()
        np.testing.assert_allclose(
            value.read().transpose(1, 2, 0), theirs().numpy(), rtol=1e-3, atol=1e-3
        )
    seconds = interleaved(repeats, *works)
    row = {"network": name, "ns_a_sample": seconds[0] / (POINTS * SAMPLES) * 1e9}
    line = f"{name:24} inference {row['ns_a_sample']:6.2f} ns a sample"
    if torch is not None:
        row["torch_over_ours"] = seconds[1] / seconds[0]
        line += f", PyTorch {row['torch_over_ours']:.1f} times that"
    print(line, flush=True)
    return row


def training_row(device: Device, torch: ModuleType | None, quick: bool, inference_ns: float) -> dict:
    """Nanoseconds a training sample takes, all in, on the Cornell box's direct light."""
    case = TrainingCase(device, "cornell_box", "direct", 48 if quick else 96)
    preset = PRESETS["default"]
    case.run(preset, 16)
    ours = min(case.run(preset, 16).nanoseconds_a_sample for _ in range(5))
    row = {"ns_a_training_sample": ours, "inference_samples": ours / inference_ns}
    line = (
        f"default network: training {ours:.0f} ns a sample = {ours / inference_ns:.1f} inference samples"
    )
    if torch is not None:
        row["torch_over_ours"] = torch_training_ns(torch, case, quick) / ours
        line += f"; PyTorch {row['torch_over_ours']:.1f} times that"
    print(line, flush=True)
    return row


def torch_training_ns(torch: ModuleType, case: TrainingCase, quick: bool) -> float:
    """The same network, hash grid, minibatch and Adam in PyTorch; random samples serve as well."""
    preset, device_points = PRESETS["default"], case.points.active
    description = preset.description(case.integrand, case.inputs)
    encoding = description.encoding
    first, second = description.hidden
    generator = torch.Generator().manual_seed(0)
    table = torch.nn.Parameter(1e-4 * torch.randn(encoding.table_shape, generator=generator))
    fixed = encoding.feature_count - encoding.grid_rows
    heads = torch.nn.Linear(encoding.feature_count, description.head_rows)
    w2 = torch.nn.Parameter(torch.randn(second, first, generator=generator) * (2 / first) ** 0.5)
    adam = torch.optim.Adam([w2, *heads.parameters()], lr=preset.schedule.rate)
    # Ours updates only the entries that a minibatch touches, so PyTorch is given its sparse Adam.
    sparse_adam = torch.optim.SparseAdam([table], lr=preset.schedule.rate)
    columns, samples = preset.schedule.batch, preset.schedule.samples_a_step
    corner = torch.randint(0, len(table), (device_points, encoding.grid_levels, 8), generator=generator)
    weight = torch.rand(device_points, encoding.grid_levels, 8, 1, generator=generator)
    features = torch.rand(device_points, fixed, generator=generator)
    uv = torch.rand(device_points, samples, 2, generator=generator)
    target = torch.rand(device_points, samples, CHANNELS, generator=generator)
    sizes = [2 * first, first, second, CHANNELS * second, CHANNELS]

    def step(pick: object) -> None:
        entries = torch.nn.functional.embedding(corner[pick], table, sparse=True)
        grid = (entries * weight[pick]).sum(2).flatten(1)
        theta = heads(torch.cat([grid, features[pick]], 1))
        w1, b1, b2, w3, b3 = theta.split(sizes, 1)
        h = torch.relu(uv[pick] @ w1.view(-1, first, 2).mT + b1[:, None])
        h = torch.relu(h @ w2.mT + b2[:, None])
        loss = ((h @ w3.view(-1, CHANNELS, second).mT + b3[:, None] - target[pick]) ** 2).mean()
        adam.zero_grad()
        sparse_adam.zero_grad()
        loss.backward()
        adam.step()
        sparse_adam.step()

    times = []
    for _ in range(8 if quick else 40):
        pick = torch.randint(0, device_points, (columns,), generator=generator)
        begun = time.perf_counter()
        step(pick)
        times.append(time.perf_counter() - begun)
    return min(times) / (columns * samples) * 1e9


if __name__ == "__main__":
    main()
