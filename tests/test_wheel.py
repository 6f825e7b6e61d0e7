"""The wheel, installed into a fresh environment away from the checkout, renders."""

import itertools
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parent.parent
RENDER = {
    "--integrand": "direct",
    "--method": "ncv",
    "--spp": "4",
    "--train-spp": "4",
    "--size": "32x32",
    "--seed": "1",
    "--json": "out.json",
}
OUTPUTS = ("-o", "out.exr", "-o", "out.png")

pytestmark = pytest.mark.slow


def run(*command, **options):
    """Run a command; on failure show all that it printed."""
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    probe = ["download", "--quiet", "--no-deps", "--retries", "0", "--timeout", "15", "tqdm"]
    index = subprocess.run([sys.executable, "-m", "pip", *probe, "-d", folder / "probe"])
    if index.returncode:
        pytest.skip("pip reaches no package index")
    # Built from a copy: a build folder left in the checkout would put stale files in the wheel.
    leave = shutil.ignore_patterns(".*", "build", "dist", "*.egg-info", "__pycache__", "bench")
    source = shutil.copytree(CHECKOUT, folder / "source", ignore=leave)
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, source)
    (built,) = folder.glob("ncv_cl-*.whl")
    return built


def test_wheel_renders_in_a_fresh_environment(wheel, tmp_path):
    run(sys.executable, "-m", "venv", tmp_path / "venv")
    programs = tmp_path / "venv" / "bin"
    run(programs / "pip", "install", "--quiet", f"{wheel}[pocl]")
    shutil.copy(CHECKOUT / "scenes" / "cornell_box.toml", tmp_path)

    # Nothing of the caller's: no checkout on the path, no device choice, no system OpenCL.
    leave = ("PYTHONPATH", "PYTHONHOME", "NCV_CL_DEVICE", "PYOPENCL_CTX", "PYOPENCL_TEST")
    environment = {key: value for key, value in os.environ.items() if key not in leave}
    ask = "import pathlib, ncv_cl; print(pathlib.Path(ncv_cl.__file__).parent)"
    package = Path(run(programs / "python", "-c", ask, cwd=tmp_path, env=environment).strip())
    assert package.is_relative_to(tmp_path / "venv")
    ours, installed = (
        {kernel.relative_to(folder) for kernel in folder.glob("*/*.cl")}
        for folder in (CHECKOUT / "cl", package / "cl")
    )
    assert ours and installed == ours

    alone = {"OCL_ICD_VENDORS": f"{package.parent / 'pyopencl' / '.libs'}{os.sep}"}
    listed = run(programs / "ncv-cl", "devices", cwd=tmp_path, env=environment | alone)
    # Where the runtime of pip is too old for this CPU, the system's has to do.
    environment |= alone if "not used" not in listed else {}
    options = [*itertools.chain(*RENDER.items()), *OUTPUTS]
    run(programs / "ncv-cl", "render", "cornell_box.toml", *options, cwd=tmp_path, env=environment)
    statistics = json.loads((tmp_path / "out.json").read_text())
    assert statistics["seconds"]["total"] > 0
    assert (tmp_path / "out.exr").read_bytes()[:4] == b"\x76\x2f\x31\x01"
    assert (tmp_path / "out.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
