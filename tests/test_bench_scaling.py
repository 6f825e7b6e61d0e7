"""The scaling benchmark: its scenes, its marks of memory, and one job in a process of its own."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "bench"))
import bench_scaling


@pytest.mark.parametrize("number", list(bench_scaling.SPHERES)[:4])
def test_spheres_have_as_many_triangles_as_named(number):
    scene = bench_scaling.spheres(*bench_scaling.SPHERES[number])
    assert np.count_nonzero(scene.vertex_normals[scene.triangles[:, 0]].any(axis=1)) == number
    assert (scene.triangle_light >= 0).sum() == 2
    # The light shines down on all.
    assert scene.lights[0].normal[1] == pytest.approx(-1)


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="needs Linux's marks of memory")
def test_memory_of_a_stage_does_not_count_for_the_next():
    from ncv_cl.host.clock import Stopwatch

    watch, marks = Stopwatch(), bench_scaling.HighWater()
    with marks.watching():
        with watch("large"):
            np.ones(1 << 27, np.uint8)
        with watch("small"):
            np.ones(1 << 10, np.uint8)
    assert marks.bytes["large"] > marks.bytes["small"] + (1 << 26)
    assert marks.bytes[bench_scaling.WHOLE] == max(marks.bytes.values())
    assert set(watch.seconds) == {"large", "small"}


@pytest.mark.slow
def test_a_job_reports_stages_and_memory(one_device):
    job = {"size": 24, "spp": 4, "method": "ncv", "repeats": 1, "width": 8, "device": one_device.index}
    row = bench_scaling._in_a_process(job)
    assert {"train", "integrate", "resolve", "total"} <= set(row["seconds"])
    assert row["bytes"][bench_scaling.WHOLE] > 1e7 and row["device"] == one_device.identity
