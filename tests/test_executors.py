"""Renders by workers: the bits of one process, whoever carries the tasks and whoever is first."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest
from executors import CASES, SCENES, disc, picture
from processes import PATIENCE, ROOT, environment
from test_determinism import assert_same_bits
from test_integrand_plugin import SKY, write

import ncv_cl as ncv
from ncv_cl.cli import main
from ncv_cl.machines.inline import Inline

AROUND = np.random.default_rng(3)
POSITIONS = AROUND.uniform((50, 10, 50), (500, 500, 500), size=(300, 3))
NORMALS = AROUND.normal(size=(300, 3))


@functools.cache
def alone(case: str) -> ncv.Image:
    return picture(case)


@pytest.fixture(scope="module")
def processes():
    """Two processes, which find classes and functions of these tests."""
    before = os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = os.pathsep.join((str(ROOT), str(ROOT / "tests"), before))
    with ncv.Processes(2) as executor:
        yield executor
    os.environ["PYTHONPATH"] = before


FEWER_THREADS = [("direct, network", 1), ("direct, network", 2), ("gi", 1), ("gi", 2)]


@pytest.mark.parametrize(("case", "threads"), [*((case, 4) for case in CASES), *FEWER_THREADS])
def test_threads_make_the_bits_of_no_executor(case, threads):
    with ThreadPoolExecutor(threads) as executor:
        image = picture(case, executor=executor)
    assert_same_bits(alone(case), image)
    assert image.stats["machines"]["tasks"] > 2
    for name in ("samples_per_point", "rays_traced", "rays_on_device", "rays_skipped", "ended_by"):
        assert image.stats[name] == alone(case).stats[name], name


@pytest.mark.parametrize("case", ["direct", "gi, network"])
@pytest.mark.parametrize("points", [7, 1000])
def test_bits_do_not_depend_on_how_points_are_cut(case, points):
    if case == "gi, network" and points == 7:
        points = 61
    assert_same_bits(alone(case), picture(case, executor=Inline(), task_points=points))


@pytest.mark.parametrize("case", ["ao by rays", "direct, network", "gi, network"])
def test_processes_make_the_bits_of_no_executor(processes, case):
    image = picture(case, executor=processes)
    assert_same_bits(alone(case), image)
    assert 1 <= len(image.stats["machines"]["workers"]) <= 2


def test_shapes_of_devices_travel(device, processes):
    """Workers open the device in the parent's shape, which is that of a GPU here once."""
    case = "direct, network"
    assert_same_bits(picture(case, device=device), picture(case, device=device, executor=processes))


def test_functions_and_sensors_by_processes(processes):
    features = np.arange(300)[:, None] / 300
    asked = {"points": 300, "features": features, "spp": 64, "train_spp": 16}
    here = ncv.estimate(disc, **asked)
    there = ncv.estimate(disc, **asked, executor=processes, task_points=110)
    np.testing.assert_array_equal(here.mean, there.mean)
    np.testing.assert_array_equal(here.variance, there.variance)
    assert there.stats["machines"]["tasks"] == 3
    for integrand in ("direct", "gi"):
        asked = {"integrand": integrand, "spp": 32}
        box = SCENES / "cornell_box.toml"
        one = ncv.irradiance(box, POSITIONS, NORMALS, **asked)
        other = ncv.irradiance(box, POSITIONS, NORMALS, **asked, executor=processes, task_points=90)
        np.testing.assert_array_equal(one.values, other.values)
        np.testing.assert_array_equal(one.variance, other.variance)


def test_surfaces_maps_and_view_factors():
    box = ncv.load_scene(SCENES / "cornell_box.toml")
    quad = ncv.UVMesh(
        np.array([[0, 0, 0], [550, 0, 0], [550, 0, 550], [0, 0, 550]], float),
        np.array([[0, 2, 1], [0, 3, 2]]),
        np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float),
    )
    asked = {"integrand": "direct", "spp": 16, "method": "mc"}
    with ThreadPoolExecutor(2) as executor:
        workers = {"executor": executor, "task_points": 100}
        one, other = (ncv.bake(box, quad, 12, **asked, **more) for more in ({}, workers))
        assert_same_bits(one, other)
        floor = POSITIONS * (1, 0, 1)
        up = np.broadcast_to([0.0, 1.0, 0.0], floor.shape)
        asked = {"directions": up, "integrand": "gi", "spp": 16, "method": "mc"}
        one, other = (ncv.radiance(box, floor, up, **asked, **more) for more in ({}, workers))
        np.testing.assert_array_equal(one.values, other.values)
        names = [name for name, _ in box.named][:2]
        if len(names) == 2:
            one = ncv.view_factors(box, names, points=32, lines=4)
            other = ncv.view_factors(box, names, points=32, lines=4, executor=executor)
            np.testing.assert_array_equal(one.values, other.values)


@pytest.mark.parametrize("which", ["one file", "sky"])
def test_classes_from_files_travel_as_text(tmp_path, processes, which):
    name = SKY if which == "sky" else write(tmp_path)
    asked = {"spp": 32, "size": (16, 16), "method": "mc"}
    one = ncv.render(SCENES / "occluders.toml", name, **asked)
    other = ncv.render(SCENES / "occluders.toml", name, **asked, executor=processes, task_points=100)
    assert one.pixels.any()
    assert_same_bits(one, other)


def test_what_cannot_travel_is_named():
    with ThreadPoolExecutor(1) as executor, pytest.raises(ncv.CannotTravel, match="f cannot be sent"):
        ncv.estimate(lambda u, v, point: u, points=4, spp=16, method="mc", executor=executor)


def test_scene_and_network_travel_once_a_worker(processes, tmp_path):
    """Or not at all where there is a shared folder; tasks themselves are small."""
    scene = replace(ncv.load_scene(SCENES / "cornell_box.toml"), name="not seen before")
    asked = {"spp": 32, "size": (32, 32), "method": "mc", "task_points": 60}
    image = ncv.render(scene, "direct", **asked, executor=processes)
    sent, workers = image.stats["machines"], image.stats["machines"]["workers"].values()
    assert sent["tasks"] > 8 and sent["most_bytes_a_task"] < 1000
    one = min(one["value_bytes"] for one in workers)
    assert 0 < one < 50_000
    # A worker may be sent them twice at most: while it was at its first task.
    assert all(each["value_bytes"] <= 2 * one for each in workers)
    scene = replace(scene, name="nor this")
    shared = ncv.render(scene, "direct", **asked, executor=processes, shared=tmp_path)
    assert_same_bits(image, shared)
    assert all(one["value_bytes"] == 0 for one in shared.stats["machines"]["workers"].values())
    assert len(list(tmp_path.iterdir())) == 3


def test_each_tasks_device_is_in_the_metadata():
    image = picture("direct", executor=Inline())
    assert image.stats["device"] in image.metadata["task_devices"]
    assert image.metadata["task_devices"].count("],[") == image.stats["machines"]["tasks"] - 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"shared": "."}, "shared is for renders by workers"),
        ({"task_points": 3}, "task_points is for renders by workers"),
        ({"mixed_devices": True}, "mixed_devices is for renders by workers"),
        ({"executor": 4}, "must be a concurrent.futures.Executor"),
        ({"executor": ProcessPoolExecutor(1, get_context("fork"))}, "does not survive a fork"),
        ({"executor": Inline(), "shared": "/nowhere"}, "a folder that exists"),
        ({"executor": Inline(), "task_limit": 0}, "task_limit must be a positive number"),
    ],
    ids=lambda value: " and ".join(value) if isinstance(value, dict) else "",
)
def test_options_without_effect_or_sense_are_errors(options, said):
    with pytest.raises(ValueError, match=said):
        picture("direct", **options, **({} if "task_points" in options else {"task_points": None}))


def test_other_devices_and_other_builds_are_refused(monkeypatch):
    monkeypatch.setattr("ncv_cl.rendering.carried.tile.OWN_DEVICES", {})
    monkeypatch.setattr("ncv_cl.rendering.carried.tile.all_devices", list)
    monkeypatch.setattr("ncv_cl.rendering.carried.tile.BENCHES", {})
    monkeypatch.setattr(
        "ncv_cl.rendering.carried.tile.device_line", lambda device: "another, VEC 1, LANES 1, fma"
    )
    with pytest.raises(ncv.TaskError, match=r"a worker's device is another.*mixed_devices"):
        picture("direct", executor=Inline())
    image = picture("direct", executor=Inline(), mixed_devices=True)
    assert "another" in image.metadata["task_devices"]
    monkeypatch.setattr("ncv_cl.rendering.carried.tile.this_build", lambda: ("0", "", ""))
    with pytest.raises(ncv.TaskError, match="install the same on all machines"):
        picture("direct", executor=Inline(), seed=77)


def test_dask_makes_the_bits_of_no_executor(monkeypatch, tmp_path):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}{os.pathsep}{ROOT / 'tests'}")
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        for case in ("direct, network", "gi"):
            assert_same_bits(alone(case), picture(case, executor=client.get_executor()))
        out, stats = tmp_path / "image.exr", tmp_path / "stats.json"
        options = "--size 24x20 --method mc --spp 160 --seed 5 --task-points 130"
        command = f"{SCENES}/cornell_box.toml {options}"
        files = ["-o", str(out), "--json", str(stats), "--dask", cluster.scheduler_address]
        assert main(["render", *command.split(), *files]) == 0
        np.testing.assert_array_equal(ncv.Image.read(out).pixels, alone("direct").pixels)
        assert len(json.loads(stats.read_text())["machines"]["workers"]) >= 1


def test_one_kind_of_workers_at_a_time(tmp_path, capsys):
    files = ["-o", str(tmp_path / "image.exr"), "--processes", "2", "--dask", "tcp://localhost:1"]
    assert main(["render", str(SCENES / "cornell_box.toml"), *files]) == 2
    assert "either --processes or --dask" in capsys.readouterr().err


BY_MPI = """
from executors import picture
from mpi4py.futures import MPIPoolExecutor
import numpy as np, sys
if __name__ == "__main__":
    with MPIPoolExecutor() as executor:
        image = picture("direct, network", executor=executor)
    np.savez(sys.argv[1], pixels=image.pixels, variance=image.variance, **image.layers)
"""


def test_mpi_makes_the_bits_of_no_executor(tmp_path):
    pytest.importorskip("mpi4py")
    launcher = os.path.join(os.path.dirname(sys.executable), "mpiexec")
    if not os.path.exists(launcher):
        pytest.skip("there is no mpiexec beside Python: pip install mpich")
    script, out = tmp_path / "by_mpi.py", tmp_path / "image.npz"
    script.write_text(BY_MPI)
    command = [launcher, "-n", "2", sys.executable, "-m", "mpi4py.futures", str(script), str(out)]
    paths = environment(PYTHONPATH=f"{ROOT}{os.pathsep}{ROOT / 'tests'}")
    done = subprocess.run(command, env=paths, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    image = alone("direct, network")
    with np.load(out) as found:
        for name in ("pixels", "variance"):
            np.testing.assert_array_equal(getattr(image, name), found[name])
        for name, layer in image.layers.items():
            np.testing.assert_array_equal(layer, found[name])
