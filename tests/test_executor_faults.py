"""Workers that are killed, fail, hang or are told to stop: the same bits, or a named error."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from executors import SCENES, Failing, picture
from processes import PATIENCE, environment
from test_determinism import assert_same_bits

import ncv_cl as ncv
from ncv_cl.machines.crew import MOST_TRIES
from ncv_cl.machines.inline import Inline
from ncv_cl.output.checkpoint import Checkpoint


def processes_of(executor) -> list[int]:
    pool = executor if isinstance(executor, ProcessPoolExecutor) else executor._pool
    return list(pool._processes)


def kill_one(executor) -> None:
    os.kill(processes_of(executor)[0], signal.SIGKILL)


@pytest.mark.parametrize("kind", ["ours", "Python's"])
def test_a_killed_process_is_replaced(kind, monkeypatch):
    made = {
        "ours": lambda: ncv.Processes(2),
        "Python's": lambda: ProcessPoolExecutor(2, get_context("spawn")),
    }
    alone = picture("direct")
    with made[kind]() as executor:
        killed = []
        put = ncv.rendering.carried.carrier.Carrier.save_now_and_then

        def kill_after_a_task(carrier):
            if not killed:
                killed.append(kill_one(executor))
            put(carrier)

        monkeypatch.setattr(
            "ncv_cl.rendering.carried.carrier.Carrier.save_now_and_then", kill_after_a_task
        )
        image = picture("direct", executor=executor, task_points=20)
    assert killed and image.stats["machines"]["retries"] > 0
    assert_same_bits(alone, image)


def test_tasks_that_fail_or_hang_are_done_elsewhere():
    alone = picture("direct, network")

    def meddle(number):
        return {1: RuntimeError("out of luck"), 2: "hang", 5: MemoryError()}.get(number)

    image = picture("direct, network", executor=Failing(meddle), task_limit=1.0, task_points=60)
    assert_same_bits(alone, image)
    counts = image.stats["machines"]
    assert counts["retries"] == 3 and counts["late"] == 1
    assert counts["sent"] == counts["tasks"] + 3


@pytest.mark.parametrize("case", ["direct, network", "gi", "ao by rays"])
@pytest.mark.parametrize("done", [3, 9])
def test_what_always_fails_ends_in_a_named_error_and_resumes_to_the_same_bits(tmp_path, case, done):
    alone, file = picture(case), tmp_path / "checkpoint.npz"

    def meddle(number):
        return RuntimeError("out of order") if number >= done else None

    with pytest.raises(
        ncv.TaskError, match=rf"points \d+ to \d+ failed {MOST_TRIES} times.*out of order"
    ):
        picture(case, executor=Failing(meddle), checkpoint=file, task_points=24)
    kept = Checkpoint.load(file)
    assert kept.is_between_tasks or kept.image.passes
    assert_same_bits(alone, picture(case, executor=Inline(), task_points=100, resume=file))
    again = picture(case, resume=file)
    assert_same_bits(alone, again)
    if kept.is_between_tasks:
        assert again.stats["machines"]["tasks"] > 0


def test_a_request_cancels_what_waits_and_the_image_so_far_goes_on(tmp_path):
    alone, file = picture("ao by rays"), tmp_path / "checkpoint.npz"
    executor = Failing(lambda number: None)

    def stop() -> bool:
        return executor.number >= 4

    part = picture("ao by rays", executor=executor, stop=stop, checkpoint=file, task_points=40)
    assert part.stats["ended_by"] == "request"
    assert 0 < part.stats["samples_per_point"] < alone.stats["samples_per_point"]
    assert part.stats["pixels_without_variance"] > 0
    assert executor.number < 8
    assert_same_bits(alone, picture("ao by rays", executor=Inline(), resume=file))


def test_a_broken_or_closed_executor_is_named():
    executor = Inline()
    executor.submit = lambda *arguments, **options: Future().set_result(1) or broken()
    with pytest.raises(ncv.TaskError, match="cannot schedule"):
        picture("direct", executor=executor)


def broken():
    raise RuntimeError("cannot schedule new futures after shutdown")


def test_checkpoints_that_were_tampered_with_are_refused(tmp_path):
    file = tmp_path / "checkpoint.npz"
    executor = Failing(lambda number: RuntimeError("no") if number >= 3 else None)
    with pytest.raises(ncv.TaskError):
        picture("direct", executor=executor, checkpoint=file, task_points=60)
    with np.load(file) as found:
        arrays = dict(found)
    for name, value in (("ahead", arrays["ahead"][1:]), ("ahead_to", arrays["ahead_to"] + 99)):
        np.savez(file, **{**arrays, name: value})
        with pytest.raises(ValueError, match=r"ahead|tampered"):
            picture("direct", resume=file)


def test_ctrl_c_writes_the_image_so_far(tmp_path):
    picture_file, checkpoint = tmp_path / "image.exr", tmp_path / "checkpoint.npz"
    command = [sys.executable, "-m", "ncv_cl.cli", "render", str(SCENES / "interior.toml")]
    options = "--integrand gi --method mc --spp 4096 --size 64x64 --task-points 64 --processes 2"
    command += options.split(" ")
    command += ["-o", str(picture_file), "--checkpoint", str(checkpoint)]
    paths = {"env": environment(), "text": True, "start_new_session": True}
    program = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, **paths)
    deadline = time.monotonic() + PATIENCE
    while not checkpoint.exists() or not Checkpoint.load(checkpoint).is_between_tasks:
        assert time.monotonic() < deadline and program.poll() is None
        time.sleep(0.05)
    # As a terminal does: all processes get it.
    os.killpg(program.pid, signal.SIGINT)
    said, complained = program.communicate(timeout=PATIENCE)
    assert program.returncode == 0, complained
    assert "stopped early" in said and picture_file.exists()
    assert "Traceback" not in complained


def test_a_killed_parent_loses_at_most_what_was_under_way(tmp_path):
    file = tmp_path / "checkpoint.npz"
    executor = Failing(lambda number: None)

    class Killed(BaseException):
        pass

    def stop() -> bool:
        if executor.number >= 6:
            raise Killed
        return False

    with pytest.raises(Killed):
        picture("direct", executor=executor, stop=stop, checkpoint=file, task_points=40)
    assert Checkpoint.load(file).is_between_tasks
    assert_same_bits(picture("direct"), picture("direct", resume=file))
