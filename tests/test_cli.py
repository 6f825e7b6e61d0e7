"""The command line: what it writes, what it refuses, and how it stops."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

import ncv_cl
from ncv_cl import Image
from ncv_cl.cli import main

TINY = ["--size", "8x6", "--spp", "4"]


@pytest.fixture
def cli(scenes, one_device, tmp_path, monkeypatch, capsys):
    """Render a shipped scene in an empty folder; returns (exit status, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str, scene: str = "cornell_box", device: str | None = None):
        device = str(one_device.index) if device is None else device
        file = str(scenes / f"{scene}.toml")
        try:
            status = main(["render", file, *TINY, "--device", device, *arguments])
        except SystemExit as stopped:
            status = stopped.code
        return status, *capsys.readouterr()

    return run


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_render_writes_images_and_statistics(cli, one_device, method):
    outputs = ["-o", "a.exr", "-o", "a.png", "--json", "a.json"]
    training = ["--train-spp", "2"] if method == "ncv" else []
    status, out, _ = cli("--method", method, "--seed", "5", *training, *outputs)
    assert status == 0
    image = Image.read("a.exr")
    assert image.pixels.shape == (6, 8, 3) and image.pixels.any()
    assert {"albedo", "N", "depth"} <= set(image.layers)
    assert ({"G", "residual"} <= set(image.layers)) == (method == "ncv")
    assert image.metadata["seed"] == 5 and image.metadata["scene"] == "cornell_box"
    assert Path("a.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"

    stats = json.loads(Path("a.json").read_text())
    seconds = stats["seconds"]
    stages = {"points", "sample", "trace", "estimate", "resolve", "total"}
    assert set(seconds) >= stages | ({"train", "fold", "integrate"} if method == "ncv" else set())
    assert sum(seconds.values()) - seconds["total"] <= seconds["total"]
    # Training draws 16 samples at some of the points: to within one of these, 2 a point.
    expected = (4 + 2 * (method == "ncv")) * stats["points"] + 4 * stats["points_done_twice"]
    assert abs(stats["samples_per_point"] * stats["points"] - expected) <= 16
    # Nothing in the box is so large that its rays would be left to embree.
    drawn = stats["rays_on_device"] + stats["rays_skipped"]
    assert drawn == pytest.approx(stats["points"] * stats["samples_per_point"])
    assert stats["rays_on_device"] > 0 and stats["rays_traced"] == 0
    assert stats["points"] + stats["points_skipped"] == 48
    assert stats["device"] == one_device.identity
    assert "mse" not in stats
    assert all(stage in out for stage in stages) and "a.exr" in out


def test_global_illumination_in_one_part_or_two(cli):
    common = ("--integrand", "gi", "--max-depth", "4", "--clamp", "10", "--method", "mc", "-o", "a.exr")
    for split in ("auto", "on", "off"):
        assert cli(*common, "--split-direct", split)[0] == 0
        about = Image.read("a.exr").metadata
        assert about["max_depth"] == 4 and about["clamp"] == 10
        assert about["split_direct"] == split and ("direct_spp" in about) == (split != "off")


def test_a_reference_adds_errors(cli):
    assert cli("-o", "reference.exr", "--method", "mc", "--spp", "64")[0] == 0
    status, out, _ = cli("-o", "a.exr", "--reference", "reference.exr", "--json", "a.json")
    assert status == 0
    stats = json.loads(Path("a.json").read_text())
    truth = Image.read("reference.exr").pixels.astype(np.float64)
    squared = (Image.read("a.exr").pixels - truth) ** 2
    assert stats["mse"] == pytest.approx(squared.mean()) and stats["mse"] > 0
    assert stats["relmse"] == pytest.approx(
        (squared / (truth**2 + 0.01 * truth.mean() ** 2)).mean(), rel=1e-6
    )
    assert "relMSE" in out


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["-o", "a.tif"], r"a\.tif.*\.exr"),
        (["-o", "no/such/a.exr"], "folder"),
        (["-o", "a.exr", "--json", "no/such/a.json"], "folder"),
        (["-o", "a.exr", "--size", "8"], "WIDTHxHEIGHT"),
        (["-o", "a.exr", "--size", "0x8"], r"size.*at least 1"),
        (["-o", "a.exr", "--spp", "0"], "spp.*at least 1"),
        (["-o", "a.exr", "--train-spp", "0"], "train_spp.*positive"),
        (["-o", "a.exr", "--supersample", "0"], "supersample.*at least 1"),
        (["-o", "a.exr", "--seed", "-1"], "seed"),
        (["-o", "a.exr", "--threads", "-1"], "threads"),
        (["-o", "a.exr", "--integrand", "ao", "--radius", "0"], "radius"),
        (["-o", "a.exr", "--integrand", "gi", "--max-depth", "1"], "max_depth"),
        (["-o", "a.exr", "--integrand", "gi", "--clamp", "0"], "clamp"),
        (["-o", "a.exr", "--split-direct", "on"], "split_direct is for"),
        (["-o", "a.exr", "--integrand", "fog"], "invalid choice: 'fog'"),
        (["-o", "a.exr", "--device", "99"], "no device 99"),
        (["-o", "a.exr", "--device", "abacus"], "no device matches 'abacus'"),
        (["-o", "a.exr", "--reference", "none.exr"], r"none\.exr"),
        (["-o", "a.exr", "--reference", "."], "no image file"),
        (["-o", "a.exr", "-o", "./a.exr"], "output 2 would be written over output 1"),
        (["-o", "a.exr", "--json", "a.exr"], "--json would be written over output 1"),
        (["-o", "a.exr", "--checkpoint", "x", "--save-network", "x"], "would be written over"),
        (["-o", "a.exr", "--json", "."], "it is a folder"),
        (["-o", "a.exr", "--checkpoint", "no/such/c"], "no folder"),
        (["-o", "a.exr", "--save-network", "n" * 300], "too long"),
        (["-o", "a.exr", "--method", "mc", "--save-network", "n.npz"], "no network to save"),
        (["-o", "a.exr", "--radius", "3"], "--radius is for --integrand ao"),
        (["-o", "a.exr", "--mapping", "cosine", "--integrand", "gi"], "--mapping is for --integrand ao"),
        (["-o", "a.exr", "--max-depth", "3"], "--max-depth is for --integrand gi"),
        (["-o", "a.exr", "--clamp", "3", "--integrand", "ao"], "--clamp is for --integrand gi"),
        (["-o", "a.exr", "--size", "99999x99999"], "more than 2147483647 sub-pixels"),
        (["-o", "a.exr", "--spp", "99999999999"], "spp.*at most"),
        (["-o", "a.exr", "--train-spp", "inf"], "train_spp.*positive"),
        (["-o", "a.exr", "--time-limit", "nan"], "time_limit.*positive"),
        (["-o", "a.exr", "--resume", "none.npz"], "no file none.npz"),
        (["-o", "a.exr", "--network", "."], "is a folder"),
        ([], "required.*-o"),
    ],
)
def test_bad_arguments_are_refused_in_a_line(cli, arguments, said):
    status, out, err = cli(*arguments)
    assert status == 2 and not out
    *_, last = [line for line in err.splitlines() if "error:" in line]
    assert re.search(said, last), err
    assert "Traceback" not in err and not list(Path().glob("**/a.*"))


def test_a_missing_scene_is_refused(cli):
    status, _, err = cli("-o", "a.exr", scene="no_such_scene")
    assert status == 2 and "no_such_scene.toml" in err and len(err.splitlines()) == 1


def test_a_reference_of_another_size_is_refused(cli):
    assert cli("-o", "reference.exr", "--size", "4x4", "--method", "mc")[0] == 0
    status, _, err = cli("-o", "a.exr", "--reference", "reference.exr")
    assert status == 2 and "4x4" in err and "8x6" in err and len(err.splitlines()) == 1


def test_what_can_be_refused_is_refused_before_anything_is_traced(cli, monkeypatch):
    """A file that cannot be written, or a reference of another size, costs no render."""
    assert cli("-o", "reference.exr", "--size", "4x4", "--method", "mc")[0] == 0
    monkeypatch.setattr("ncv_cl.rendering.prepare.find_points", lambda *arguments: pytest.fail("worked"))
    for options in (
        ["--checkpoint", "no/such/folder"],
        ["--save-network", "reference.exr/n"],
        ["--json", "."],
        ["--reference", "reference.exr"],
        ["--seed", str(1 << 64)],
        ["--resume", "reference.exr"],
        ["--network", "reference.exr"],
    ):
        assert cli("-o", "a.exr", *options)[0] == 2


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "not enough memory"),
        (MemoryError("Unable to allocate 9 TiB"), "9 TiB"),
        (RuntimeError("building a + b failed:\n  line 1\n\n  line 2"), "failed:; line 1; line 2"),
        (FloatingPointError("3 of 9 points"), "3 of 9 points"),
        (OverflowError("too large"), "too large"),
        (cl.LogicError("clBuildProgram failed"), "clBuildProgram failed"),
        (BrokenPipeError(32, "Broken pipe"), "Broken pipe"),
        (KeyError("x"), "internal error, please report it.*KeyError: 'x'"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_errors_of_every_kind_end_in_a_line(cli, monkeypatch, error, said):
    def fail(*arguments, **options):
        raise error

    monkeypatch.setattr("ncv_cl.cli.render", fail)
    status, _, err = cli("-o", "a.exr")
    assert status == 2 and len(err.splitlines()) == 1 and re.search(said, err)


def test_an_interrupt_ends_in_a_line(cli, monkeypatch):
    def fail(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("ncv_cl.cli.render", fail)
    assert cli("-o", "a.exr")[::2] == (130, "ncv-cl: error: interrupted\n")


def test_warnings_are_a_line_each(cli, monkeypatch):
    def warn(scene, **options):
        warnings.warn("something is odd", stacklevel=2)
        raise ValueError("and wrong")

    monkeypatch.setattr("ncv_cl.commands.common.load_scene", warn)
    status, _, err = cli("-o", "a.exr")
    assert status == 2
    assert err == "ncv-cl: warning: something is odd\nncv-cl: error: and wrong\n"


def test_what_fails_after_the_work_costs_no_picture(cli, monkeypatch):
    """The other files are written, the line says what is not, and so does the exit status."""
    write = Image.write

    def full(self, path):
        if path.endswith(".exr"):
            raise OSError("cannot write a.exr: disk full")
        write(self, path)

    monkeypatch.setattr(Image, "write", full)
    status, out, err = cli("-o", "a.exr", "-o", "a.png", "--json", "a.json")
    assert status == 2 and "disk full" in err and len(err.splitlines()) == 1
    assert Path("a.png").exists() and Path("a.json").exists() and out.endswith("wrote a.png\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_statistics_that_cannot_be_written_cost_no_picture(cli):
    status, _, err = cli("-o", "a.exr", "--json", "/dev/full")
    assert status == 2 and "/dev/full" in err and len(err.splitlines()) == 1
    assert Image.read("a.exr").pixels.any()


@pytest.mark.parametrize("what", ["checkpoint", "save-network"])
def test_what_is_kept_beside_the_picture_costs_no_picture(cli, monkeypatch, what):
    def full(file, *arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    status, _, err = cli("-o", "a.exr", "--method", "ncv", f"--{what}", "a.npz", "--json", "a.json")
    assert status == 2 and not Path("a.npz").exists()
    assert err == "ncv-cl: warning: a.npz is not written: cannot write a.npz: No space left on device\n"
    assert Image.read("a.exr").pixels.any()
    assert "No space left" in json.loads(Path("a.json").read_text())["not_written"]["a.npz"]


def command(*arguments: str) -> dict:
    """Arguments for subprocess: `ncv-cl` with pipes instead of a terminal."""
    environment = {**os.environ, "PYTHONPATH": str(Path(ncv_cl.__file__).parent.parent)}
    return {
        "args": [sys.executable, "-m", "ncv_cl.cli", *arguments],
        "env": environment,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
    }


def test_pipes_get_no_progress_bar(scenes, one_device, tmp_path):
    scene, device = str(scenes / "cornell_box.toml"), str(one_device.index)
    target = ["-o", str(tmp_path / "a.exr")]
    done = subprocess.run(**command("render", scene, *TINY, "--device", device, *target))
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" and "\r" not in done.stdout


@pytest.mark.parametrize("encoding", ["ascii", "ascii:strict", "latin-1", "utf-8"])
def test_names_that_the_terminal_cannot_show_cost_no_picture(scenes, one_device, tmp_path, encoding):
    scene, device = str(scenes / "cornell_box.toml"), str(one_device.index)
    target = tmp_path / "Bild – ü.png"
    run = command("render", scene, *TINY, "--device", device, "-o", str(target))
    done = subprocess.run(**{**run, "env": run["env"] | {"PYTHONIOENCODING": encoding}, "text": False})
    assert done.returncode == 0, done.stderr
    assert target.exists() and b"wrote " in done.stdout and done.stderr == b""


def test_output_that_nobody_reads_ends_in_a_line(layers, one_device):
    """More than a pipe holds, into a pipe that is closed."""
    many = np.random.default_rng(0).uniform(size=(20_000, 2))
    np.savez(layers, weights0=np.eye(2), biases0=many)
    run = command("integrate", str(layers), "--device", str(one_device.index))
    with subprocess.Popen(**run) as process:
        process.stdout.close()
        err = process.stderr.read()
        assert process.wait() == 2
    assert err.startswith("ncv-cl: error: standard output") and len(err.splitlines()) == 1


@pytest.mark.skipif(os.name != "posix", reason="needs a POSIX shell")
@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-"])
def test_closed_streams_cost_no_picture(scenes, one_device, tmp_path, closed):
    scene, device = str(scenes / "cornell_box.toml"), str(one_device.index)
    run = command("render", scene, *TINY, "--device", device, "-o", str(tmp_path / "a.exr"))
    done = subprocess.run(["sh", "-c", f'exec "$@" {closed}', "sh", *run["args"]], env=run["env"])
    assert done.returncode == 0 and Image.read(tmp_path / "a.exr").pixels.any()


def test_version_and_help_name_the_commands(capsys):
    for option, expected in {"--version": "ncv_cl ", "--help": "render"}.items():
        with pytest.raises(SystemExit) as stopped:
            main([option])
        assert stopped.value.code == 0 and expected in capsys.readouterr().out


@pytest.fixture
def layers(tmp_path):
    """A network file: relu(u - 0.5) and relu(v) in two outputs, integrals 1/8 and 1/2."""
    path = tmp_path / "layers.npz"
    np.savez(
        path,
        weights0=np.eye(2),
        biases0=np.array([-0.5, 0.0]),
        weights1=np.eye(2),
        biases1=np.zeros(2),
    )
    return path


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_subdivide_draws_a_network(layers, one_device, suffix, capsys):
    picture = layers.with_suffix(suffix)
    device = ["--device", str(one_device.index)]
    assert main(["subdivide", str(layers), "-o", str(picture), *device]) == 0
    assert "2 faces" in capsys.readouterr().out and picture.stat().st_size > 200


def test_integrate_prints_or_writes_integrals(layers, one_device, capsys):
    command = ["integrate", str(layers), "--device", str(one_device.index)]
    assert main(command) == 0
    assert [float(x) for x in capsys.readouterr().out.split()] == pytest.approx([0.125, 0.5])
    assert main([*command, "-o", str(layers.with_suffix(".npy"))]) == 0
    np.testing.assert_allclose(np.load(layers.with_suffix(".npy")), [[0.125, 0.5]], rtol=1e-6)


@pytest.mark.parametrize("content", [{}, {"weights0": np.eye(2)}, {"weights0": 1, "biases0": 1}])
def test_files_without_layers_are_refused_by_name(tmp_path, content, capsys):
    np.savez(tmp_path / "other.npz", **content)
    assert main(["integrate", str(tmp_path / "other.npz")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_saved_network_renders_again_without_training(cli):
    assert cli("-o", "a.exr", "--save-network", "network.npz")[0] == 0
    status, _, _ = cli("-o", "b.exr", "--network", "network.npz", "--json", "b.json")
    assert status == 0
    stats = json.loads(Path("b.json").read_text())
    assert "train" not in stats["seconds"] and stats["samples_per_point_range"] == [4, 8]
    # The same control variate whatever samples are drawn.
    options = ("--network", "network.npz", "--seed", "9", "--save-network", "copy.npz")
    assert cli("-o", "c.exr", *options)[0] == 0
    first, second = Image.read("b.exr"), Image.read("c.exr")
    # The unshadowed means that it is multiplied by come from samples.
    np.testing.assert_allclose(first.layers["G"], second.layers["G"], rtol=1e-2, atol=1e-6)
    assert not np.array_equal(first.pixels, second.pixels)
    with np.load("network.npz") as trained, np.load("copy.npz") as copied:
        assert all(np.array_equal(trained[name], copied[name]) for name in trained.files)


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["--integrand", "ao"], "channels"),
        (["--network", "none.npz"], r"none\.npz"),
    ],
)
def test_a_network_that_does_not_fit_is_refused(cli, arguments, said):
    assert cli("-o", "first.exr", "--save-network", "network.npz")[0] == 0
    status, _, err = cli("-o", "a.exr", "--network", "network.npz", *arguments)
    assert status == 2 and re.search(said, err) and not Path("a.exr").exists()


def test_a_network_of_other_inputs_is_refused(cli):
    assert cli("-o", "first.exr", "--save-network", "network.npz")[0] == 0
    status, _, err = cli("-o", "a.exr", "--network", "network.npz", scene="plane_light")
    assert status == 2 and "position, normal, albedo" in err and not Path("a.exr").exists()


def test_bench_runs_a_checkouts_benchmarks(tmp_path, capfd):
    pytest.importorskip("matplotlib", reason="the report needs matplotlib")
    pytest.importorskip("jinja2", reason="the report needs jinja2")
    assert main(["bench", "report", "--out", str(tmp_path / "out")]) == 0
    assert {"report.html", "report.md"} <= {path.name for path in (tmp_path / "out").iterdir()}
    assert main(["bench", "nothing"]) == 2
    assert "no part 'nothing'" in capfd.readouterr().err


def test_bench_of_an_installed_wheel_points_to_a_checkout(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("ncv_cl.cli._BENCH", tmp_path)
    assert main(["bench", "--quick"]) == 2
    assert "checkout" in capsys.readouterr().err
