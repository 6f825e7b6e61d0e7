"""The pages of docs/: every block of code does what the page says."""

from __future__ import annotations

import re
import runpy
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from reference import render_plain

import ncv_cl as ncv
from ncv_cl.cli import main

CHECKOUT = Path(__file__).parent.parent
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# What a block of a file begins with.
FILE = re.compile(r"(?:# |/\* )(\w+\.(?:py|cl))\b")


def blocks(page: str) -> list[tuple[str, str]]:
    """(language, text) of every block of code, in order."""
    return BLOCK.findall((CHECKOUT / "docs" / page).read_text(encoding="utf-8"))


@pytest.fixture
def folder(tmp_path, monkeypatch, scenes, one_device):
    """An empty working directory with the shipped scenes, in which modules can be imported."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("NCV_CL_DEVICE", str(one_device.index))
    (tmp_path / "scenes").symlink_to(scenes)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def run(page: str) -> dict[str, object]:
    """Run a page's blocks in one namespace, which is returned; files are written to the folder."""
    namespace: dict[str, object] = {"__name__": "__main__"}
    for language, text in blocks(page):
        file = FILE.match(text)
        if file:
            Path(file[1]).write_text(text, encoding="utf-8")
        elif language == "bash":
            for line in text.strip().splitlines():
                program, *arguments = shlex.split(line)
                assert program == "ncv-cl" and main(arguments) == 0
        else:
            assert language == "python", language
            exec(compile(text, page, "exec"), namespace)
    return namespace


def test_the_page_on_python_does_what_it_says(folder, one_device, capsys):
    found = run("python.md")
    for picture in ("ring.png", "cone.png", "knot_cone.png"):
        assert (folder / picture).read_bytes()[:4] == b"\x89PNG"
    code = "".join(text for _, text in blocks("python.md"))
    promised, printed = re.findall(r"print\(.*?\)  # (.*)", code), capsys.readouterr().out
    assert promised and all(text in printed for text in promised)
    # Within its own deviation the control variate is what plain Monte Carlo finds.
    image, cone = found["image"], found["Cone"]
    plain, _ = render_plain(one_device, found["scene"], cone(half_angle=45), (64, 48), 256)
    spread = np.sqrt((image.variance + plain.variance)[..., 0].sum())
    assert abs((image.pixels - plain.pixels)[..., 0].sum()) < 3 * spread
    assert 0.9 < np.median(plain.pixels[plain.pixels > 0]) <= 1


@pytest.mark.parametrize("page", sorted(path.name for path in (CHECKOUT / "docs").glob("*.md")))
def test_links_and_paths_of_a_page_exist(page):
    text = (CHECKOUT / "docs" / page).read_text(encoding="utf-8")
    named = re.findall(r"`((?:cl|ncv_cl|tests|examples|bench|scenes)/[\w./]*)`", text)
    named += [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    assert named
    for path in named:
        assert (CHECKOUT / path).exists() or (CHECKOUT / "docs" / path).exists(), path


@pytest.mark.parametrize("name", ["scene_from_arrays.py", "my_integrand/sky.py"])
def test_examples_render(folder, monkeypatch, name):
    """In a fresh process each takes seconds; here they run with smaller pictures."""
    text = (CHECKOUT / "examples" / name).read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    render = ncv.render
    monkeypatch.setattr(ncv, "render", lambda *a, **options: render(*a, **{**options, "size": (16, 12)}))
    monkeypatch.setattr(sys, "argv", [name])
    runpy.run_path(str(CHECKOUT / "examples" / name), run_name="__main__")
    pictures = sorted(folder.glob("*.png"))
    assert pictures and all(path.read_bytes()[:4] == b"\x89PNG" for path in pictures)
