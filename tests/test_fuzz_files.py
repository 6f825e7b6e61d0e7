"""Broken files of every kind: an error with the file's name, never a crash, a hang or a gigabyte.

`pytest --hypothesis-profile explore tests/test_fuzz_files.py` looks further.
"""

from __future__ import annotations

import signal
import tracemalloc
import warnings
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutations import mutated, write_seeds

import ncv_cl as ncv

KINDS = (
    "a.toml", "a.obj", "a.mtl", "a.ply", "b.ply", "a.stl", "b.stl", "a.gltf", "a.glb", "a.xml",
    "a.serialized", "t.png", "t.exr", "t.hdr", "t.tif",
)  # fmt: skip
# The valid files take less than a megabyte and a tenth of a second.
MOST_BYTES, MOST_SECONDS = 1 << 28, 20


class Seeds(dict):
    """By kind, the scene file to load, the file to break, and that one's content."""

    def __repr__(self) -> str:
        return "seeds"


@pytest.fixture(scope="module")
def seeds(tmp_path_factory) -> Seeds:
    found = write_seeds(tmp_path_factory.mktemp("fuzz"))
    return Seeds({name: (*paths, paths[1].read_bytes()) for name, paths in found.items()})


def needs(name: str) -> None:
    if name in ("a.xml", "a.serialized") and not (find_spec("mitsuba") and find_spec("defusedxml")):
        pytest.skip("mitsuba is not installed")


def load(path: Path) -> str:
    """Load a scene; what is wrong with it, or nothing. Raises whatever else happens."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            ncv.load_scene(path)
        except ncv.SceneError as error:
            return str(error)
    return ""


@pytest.mark.parametrize("name", KINDS)
def test_the_seeds_are_valid(seeds, name: str) -> None:
    needs(name)
    assert load(seeds[name][0]) == ""


@pytest.mark.parametrize("name", KINDS)
@settings(suppress_health_check=list(HealthCheck), deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_broken_file_is_an_error_with_its_name(seeds, name: str, seed: int) -> None:
    needs(name)
    scene, file, data = seeds[name]
    file.write_bytes(mutated(data, name, seed))
    before = signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(MOST_SECONDS)
    tracemalloc.start()
    try:
        said = load(scene)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        file.write_bytes(data)
    assert not said or said.startswith(f"{scene}: ")
    assert peak < MOST_BYTES


def _too_long(*_: object) -> None:
    raise TimeoutError(f"it takes more than {MOST_SECONDS} s")
