"""New processes, forked ones, those of users without a home, and those of other systems."""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from processes import PATIENCE, ROOT, cache_in, environment

import ncv_cl

PROGRAM = """
import hashlib, sys
import ncv_cl as ncv

def picture(method="ncv", seed=5):
    image = ncv.render({scene!r}, method=method, size=(16, 12), spp=16, seed=seed, device={device})
    return hashlib.sha256(image.pixels.tobytes()).hexdigest()
"""


@pytest.fixture
def run(scenes, one_device):
    """Runs a program after `PROGRAM` in a process of its own; returns what it prints, line by line."""
    head = PROGRAM.format(scene=str(scenes / "cornell_box.toml"), device=one_device.index)

    def run_one(text: str, **changes: str | None) -> list[str]:
        done = subprocess.run(
            [sys.executable, "-c", head + text],
            env=environment(**changes), capture_output=True, text=True, timeout=PATIENCE,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout.split("\n")[:-1]

    return run_one


# ---- the same bits ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_neither_caches_nor_the_clock_nor_pythons_hashes_change_the_image(run, tmp_path):
    text = "print(picture('mc'), picture('ncv'), picture('auto'))"
    first = run(text, **cache_in(tmp_path / "a"), PYTHONHASHSEED="1")
    # What an earlier process noted, turned round.
    (kept,) = (tmp_path / "a").rglob("probe.json")
    noted = json.loads(kept.read_text())
    for found in noted.values():
        found["use_fma"] = not found["use_fma"]
    other = tmp_path / "b" / kept.relative_to(tmp_path / "a")
    other.parent.mkdir(parents=True)
    other.write_text(json.dumps(noted))
    assert run(text, **cache_in(tmp_path / "b"), PYTHONHASHSEED="2") == first
    # A clock that jumps.
    jumps = """
import time
real, count = time.perf_counter, [0]
def jumping():
    count[0] += 1
    return real() + 3600 * count[0]
time.perf_counter = jumping
"""
    assert run(jumps + text, **cache_in(tmp_path / "c")) == first


# ---- forks --------------------------------------------------------------------------------------------

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")


@needs_fork
def test_a_pool_forked_after_a_render_gets_an_error_that_says_what_to_do(run):
    said = run("""
import multiprocessing
picture("mc")
with multiprocessing.get_context("fork").Pool(2) as pool:
    for _ in range(2):
        try:
            print(pool.map_async(picture, ["mc", "ncv"]).get(timeout=120))
        except ncv.DeviceError as error:
            print(error)
""")
    assert len(said) == 2
    assert all("forked" in line and "'spawn'" in line and "'forkserver'" in line for line in said)


@needs_fork
def test_a_fork_ends_by_itself_and_its_parent_renders_on(run):
    said = run("""
import os
import numpy as np
before = picture()
device = ncv.choose_device()
held = ncv.opencl.memory.HostArray.of(device, np.zeros(3))
child = os.fork()
if child == 0:
    calls = (picture, held.read, ncv.devices, lambda: device.context, lambda: ncv.choose_device(device))
    for number, call in enumerate(calls):
        try:
            call()
        except ncv.DeviceError as error:
            print(number, "forked" in str(error), flush=True)
    sys.exit(7)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), picture() == before, held.read().sum())
""")
    assert said == [*(f"{number} True" for number in range(5)), "7 True 0.0"]


@needs_fork
@pytest.mark.skipif(not os.path.exists("/proc/self/maps"), reason="the system does not tell")
def test_a_fork_of_somebody_who_used_pyopencl_gets_the_error_as_well(run):
    said = run("""
import os
import pyopencl
from ncv_cl.opencl.runtimes import loaded_libraries

def forked():
    child = os.fork()
    if child == 0:
        try:
            picture("mc")
        except ncv.DeviceError as error:
            os._exit(7 if "forked" in str(error) else 1)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

print(loaded_libraries(), forked())
for platform in pyopencl.get_platforms():
    platform.get_devices()
print(len(loaded_libraries()) > 0, forked())
""")
    assert said == ["[] 0", "True 7"]


@needs_fork
def test_a_fork_in_the_middle_of_a_render_does_not_hang(run):
    said = run("""
import os, threading
import numpy as np
before = picture()
seen = []
rendering = threading.Thread(target=lambda: seen.append(picture()))
rendering.start()
codes = []
while rendering.is_alive():
    child = os.fork()
    if child == 0:
        try:
            picture()
        except ncv.DeviceError:
            os._exit(7)
        os._exit(1)
    codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
print(set(codes), seen == [before])
""")
    assert said == ["{7} True"]


@needs_fork
def test_a_pool_forked_before_the_first_render_renders_the_same(run):
    said = run("""
import multiprocessing
with multiprocessing.get_context("fork").Pool(2) as pool:
    found = pool.map_async(picture, ["mc", "ncv"]).get(timeout=200)
print(found == [picture("mc"), picture("ncv")])
""")
    assert said == ["True"]


def test_a_spawned_process_renders_the_same(run, tmp_path, scenes, one_device):
    # Spawned processes import their work from a file.
    text = PROGRAM.format(scene=str(scenes / "cornell_box.toml"), device=one_device.index)
    (tmp_path / "work.py").write_text(text)
    said = run(
        """
import multiprocessing, work
if __name__ == "__main__":
    before = picture("mc")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        print(pool.map_async(work.picture, ["mc"]).get(timeout=200) == [before])
""",
        PYTHONPATH=f"{tmp_path}{os.pathsep}{ROOT}",
    )
    assert said == ["True"]


# ---- no home ------------------------------------------------------------------------------------------


def locked_away(folder: Path, kind: str) -> dict[str, str | None]:
    """Variables of a user whose caches cannot be written."""
    folder.mkdir()
    (folder / "a file").write_text("in the way")
    nowhere = str(folder / "a file" / "below")
    return {
        "nowhere": {"HOME": nowhere, "XDG_CACHE_HOME": None, "POCL_CACHE_DIR": None},
        "XDG": {"XDG_CACHE_HOME": nowhere, "POCL_CACHE_DIR": None},
        "PoCL": {"POCL_CACHE_DIR": nowhere},
    }[kind]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nowhere", "XDG", "PoCL"])
def test_caches_that_cannot_be_written_cost_no_bits(run, tmp_path, kind):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    variables = locked_away(tmp_path / "user", kind)
    text = "print(picture('mc'))"
    assert run(text, **variables, TMPDIR=str(temporary)) == run(text)
    assert list(temporary.iterdir()) == [], "a temporary cache goes with its process"
    assert [path.name for path in (tmp_path / "user").iterdir()] == ["a file"]


def test_a_damaged_database_of_pytools_costs_no_render(run, tmp_path):
    cache = cache_in(tmp_path)
    text = "print(picture('mc'))"
    first = run(text, **cache)
    (database,) = (tmp_path / "pytools").glob("pdict*invoker*.sqlite")
    database.write_bytes(b"not a database" * 1000)
    assert run(text, **cache) == first


@pytest.mark.slow
@pytest.mark.skipif(
    not (hasattr(os, "geteuid") and os.geteuid() == 0 and shutil.which("setpriv")),
    reason="needs to be root, to be somebody else",
)
@pytest.mark.parametrize("home", [None, "/", "/nonexistent"])
def test_a_user_whom_the_system_does_not_know_renders(scenes, one_device, tmp_path, home):
    for place in (Path(sys.executable), Path(ncv_cl.__file__)):
        if not all(parent.stat().st_mode & stat.S_IXOTH for parent in place.parents):
            pytest.skip(f"other users cannot read {place}")
    # tmp_path lies in a folder of root's own.
    folder = Path("/tmp") / f"ncv_cl-test-{os.getpid()}-{home is None}-{len(home or '')}"
    folder.mkdir()
    folder.chmod(0o777)
    shutil.copy(scenes / "cornell_box.toml", folder)
    try:
        done = subprocess.run(
            [
                "setpriv", "--reuid", "12345", "--regid", "12345", "--clear-groups",
                sys.executable, "-m", "ncv_cl.cli", "render", "cornell_box.toml", "-o", "out.exr",
                "--size", "16x16", "--spp", "4", "--method", "mc", "--device", str(one_device.index),
            ],
            env=environment(HOME=home, XDG_CACHE_HOME=None, POCL_CACHE_DIR=None, TMPDIR=None),
            cwd=folder, capture_output=True, text=True, timeout=PATIENCE,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        # Nothing but the picture: no folder named ~ either.
        assert sorted(path.name for path in folder.iterdir()) == ["cornell_box.toml", "out.exr"]
    finally:
        shutil.rmtree(folder)


# ---- other systems -----------------------------------------------------------------------------------

ELSEWHERE = """
import os, signal, sys
# What Windows or macOS does not have.
for module, names in {
    os: ["sched_getaffinity", "sched_setaffinity", "fork", "register_at_fork"],
    signal: ["SIGHUP", "SIGALRM", "SIGUSR1", "pthread_sigmask", "sigwait"],
}.items():
    for name in names:
        if hasattr(module, name):
            delattr(module, name)
for name in ("fcntl", "resource", "termios", "grp", "syslog"):
    sys.modules[name] = None

real = os.replace

def replace(source, target):
    # As on Windows, where an open file is neither moved nor replaced.
    for number in os.listdir("/proc/self/fd"):
        try:
            held = os.readlink(f"/proc/self/fd/{number}")
        except OSError:
            continue
        if held in (os.path.abspath(source), os.path.abspath(target)):
            raise PermissionError(32, f"{held} is used by another process")
    return real(source, target)

os.replace = replace
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/fd"), reason="asks Linux which files are open")
def test_nothing_that_only_linux_has_is_needed(run, tmp_path, scenes, one_device):
    folder = tmp_path / "out"
    folder.mkdir()
    arguments = [
        "render", str(scenes / "cornell_box.toml"), "--size", "16x16", "--spp", "8", "--method", "ncv",
        "--train-spp", "4", "--device", str(one_device.index), "-o", "a.exr", "-o", "a.png",
        "--json", "a.json", "--save-network", "a.npz", "--checkpoint", "c.npz",
    ]  # fmt: skip
    text = f"""
from ncv_cl.cli import main
os.chdir({str(folder)!r})
print(main({arguments!r}), main(["devices"]))
"""
    program = f"{ELSEWHERE}{PROGRAM.format(scene='', device=0)}{text}"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=environment(**cache_in(tmp_path / "cache")),
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0 and done.stdout.endswith("0 0\n"), done.stderr
    names = ["a.exr", "a.json", "a.npz", "a.png", "c.npz"]
    assert sorted(path.name for path in folder.iterdir()) == names
    assert list((tmp_path / "cache").rglob("probe.json"))
