"""README and docs/: every block of code runs or says why not, every path exists, tables are complete."""

from __future__ import annotations

import ast
import itertools
import re
import runpy
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh
from reference import render_plain
from test_architecture import FOLDERS

import ncv_cl as ncv
from ncv_cl import cli
from ncv_cl.machines.inline import Inline
from ncv_cl.output.image import LAYER_CHANNELS

CHECKOUT = Path(__file__).parent.parent
PAGES = ["README.md", *sorted(f"docs/{path.name}" for path in (CHECKOUT / "docs").glob("*.md"))]
BLOCK = re.compile(
    r"^(?:<!-- not run:(?P<reason>.*?)-->\n)?[ ]*```(?P<language>\w*)\n(?P<text>.*?)^[ ]*```$",
    re.MULTILINE | re.DOTALL,
)
# What a block of a file begins with.
FILE = re.compile(r"(?:# |/\* )(\w+\.(?:py|cl))\b")
# What a line begins with that is to be run.
COMMAND = re.compile(r"^\s*(?:ncv-cl|pip|python\d?|pytest|import|from) ", re.MULTILINE)
# Blocks by page that need what a test does not have.
NOT_RUN = {"README.md": 1, "docs/benchmarks.md": 1, "docs/clusters.md": 3, "docs/import.md": 1}
# Pages that have a test of their own.
OWN_TESTS = ("docs/python.md", "docs/integrands.md")
# Renders of the pages in which pictures are not looked at.
SIZE = (16, 12)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page; `reason` is why it is not run, None where it is."""

    reason: str | None
    language: str
    text: str


def blocks(page: str) -> list[Block]:
    """Every block of a page, in order."""
    text = (CHECKOUT / page).read_text(encoding="utf-8")
    return [Block(**found.groupdict()) for found in BLOCK.finditer(text)]


def commands(text: str) -> list[str]:
    """The commands of a block for a shell."""
    return [one.strip() for line in text.strip().splitlines() for one in line.split("&&")]


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


@pytest.fixture
def small(monkeypatch):
    """Whatever size a render is asked for."""
    render = ncv.render
    for module in (ncv, cli):
        monkeypatch.setattr(
            module, "render", lambda *a, **options: render(*a, **{**options, "size": SIZE})
        )


def run(page: str) -> dict[str, object]:
    """Run a page's blocks in one namespace, which is returned; files are written to the folder."""
    namespace: dict[str, object] = {"__name__": "__main__"}
    for block in blocks(page):
        language, text = block.language, block.text
        if block.reason is not None:
            continue
        file = FILE.match(text)
        if file:
            Path(file[1]).write_text(text, encoding="utf-8")
        elif language == "bash":
            for line in commands(text):
                program, *arguments = shlex.split(line)
                if program == "ncv-cl":
                    assert cli.main(arguments) == 0
        elif language == "toml":
            Path("page.toml").write_text(text, encoding="utf-8")
            trimesh.creation.box().export("model.obj")
            assert len(ncv.load_scene("page.toml").lights) == 1
        elif language == "python":
            exec(compile(text, page, "exec"), namespace)
        else:
            # A drawing in letters, in which nobody looks for commands.
            assert language == "text" and not COMMAND.search(text), text
    return namespace


def test_blocks_that_are_not_run_say_why():
    """A reason each, and no more of them than these; what is Python must at least be Python."""
    left = {page: [block for block in blocks(page) if block.reason is not None] for page in PAGES}
    assert {page: len(found) for page, found in left.items() if found} == NOT_RUN
    for block in itertools.chain(*left.values()):
        assert len(block.reason.split()) > 1, block.text
        if block.language == "python":
            compile(block.text, "a block that is not run", "exec")
    # Each fence of the pages opens or closes a block that was found.
    for page in PAGES:
        fences = re.findall(
            r"^\s*(?:```|~~~)", (CHECKOUT / page).read_text(encoding="utf-8"), re.MULTILINE
        )
        assert len(fences) == 2 * len(blocks(page)), page


@pytest.mark.parametrize("page", [page for page in PAGES if page not in OWN_TESTS])
def test_blocks_of_a_page_run(folder, small, page, capsys):
    run(page)
    if page == "README.md":
        for picture in ("cornell_box.png", "gi.png", "ao.png", "cells.png"):
            assert (folder / picture).read_bytes()[:4] == b"\x89PNG"
        worst = float(re.search(r"^(\d\S*)$", capsys.readouterr().out, re.MULTILINE)[1])
        assert 0 < worst < 0.05


def test_the_page_on_python_does_what_it_says(folder, capsys):
    run("docs/python.md")
    assert (folder / "ring.png").read_bytes()[:4] == b"\x89PNG"
    code = "".join(block.text for block in blocks("docs/python.md"))
    promised, printed = re.findall(r"print\(.*?\)  # (.*)", code), capsys.readouterr().out
    assert promised and all(text in printed for text in promised)


def test_the_page_on_integrands_does_what_it_says(folder, one_device):
    found = run("docs/integrands.md")
    for picture in ("cone.png", "knot_cone.png"):
        assert (folder / picture).read_bytes()[:4] == b"\x89PNG"
    # Within its own deviation the control variate is what plain Monte Carlo finds.
    image, cone = found["image"], found["Cone"]
    plain, _ = render_plain(one_device, found["scene"], cone(half_angle=45), (64, 48), 256)
    spread = np.sqrt((image.variance + plain.variance)[..., 0].sum())
    assert abs((image.pixels - plain.pixels)[..., 0].sum()) < 3 * spread
    assert 0.9 < np.median(plain.pixels[plain.pixels > 0]) <= 1


@pytest.mark.skipif(not (CHECKOUT / ".ci" / "run").is_file(), reason="not in the sdist")
def test_other_commands_of_the_pages_are_run_by_ci():
    """Each command's words are found in their order in one command of .ci/run, options between them."""
    text = (CHECKOUT / ".ci" / "run").read_text(encoding="utf-8").replace("\\\n", " ")
    ran = [shlex.split(line, comments=True) for line in text.splitlines() if line.count('"') % 2 == 0]
    # Those of a cluster, and of the reader's files, have no place there.
    pages = [page for page in PAGES if page not in ("docs/clusters.md", "docs/import.md")]
    shells = [block for page in pages for block in blocks(page) if block.language == "bash"]
    asked = [one for block in shells for one in commands(block.text) if not one.startswith("ncv-cl ")]
    assert len(asked) >= 5
    for command in asked:
        for words in ran:
            left = iter(words)
            if all(word in left for word in shlex.split(command)):
                break
        else:
            raise AssertionError(f".ci/run does not run {command!r}")


def table(page: str, heading: str) -> list[str]:
    """The names in the first column of the first table after a heading or line, in order."""
    text = (CHECKOUT / page).read_text(encoding="utf-8").split(heading, 1)[1]
    rows = re.search(r"^\|.*\n\|[-| ]+\n((?:\|.*\n)+)", text, re.MULTILINE)[1]
    return [name for row in rows.splitlines() for name in re.findall(r"`(\w+)`", row.split("|")[1])]


def test_tables_of_results_are_complete(folder, one_device, scenes):
    """No key of a render is missing in them, and none of theirs is never there."""
    grey = np.ones((*SIZE[::-1], 3), np.float32)
    box, knot = scenes / "cornell_box.toml", scenes / "knot.toml"
    common = {"size": SIZE, "device": one_device}
    images = [
        ncv.render(box, "direct", "ncv", spp=16, reference=grey, time_limit=600, **common),
        ncv.render(box, "direct", "auto", spp=1, **common),
        ncv.render(box, "gi", "ncv", spp=4, checkpoint="kept.npz", **common),
        ncv.render(knot, "ao", "mc", spp=4, visibility="lines", **common),
        ncv.render(box, "ao", "mc", spp=64, **common),
        ncv.render(box, "ao", "mc", spp=4, executor=Inline(), **common),
    ]
    ours = {key for image in images for key in image.stats}
    stages = {key for image in images for key in image.stats["seconds"]}
    skipped = {key for image in images for key in image.stats["skipped"]}
    corners = np.array([[0, 0, 0], [0, 0, 500], [500, 0, 500], [500, 0, 0.0]])
    floor = ncv.UVMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), corners[:, ::2] / 500)
    baked = ncv.bake(box, floor, 4, spp=4, device=one_device)
    layers = {key for image in (*images, baked) for key in image.layers}
    # What goes wrong is not made to here: full disks, and pixels that are not finite.
    assert {*ours, "not_written", "pixels_not_finite"} == set(table("docs/results.md", "## Statistics"))
    assert stages == set(table("docs/results.md", "Stages of"))
    assert skipped == set(table("docs/results.md", "Keys of `skipped`"))
    assert list(LAYER_CHANNELS) == table("docs/results.md", "## Pixels and layers")
    assert layers == set(LAYER_CHANNELS)


def test_the_tree_of_the_readme_is_that_of_the_package():
    tree = next(block.text for block in blocks("README.md") if block.language == "text")
    named = [line.split(maxsplit=1) for line in tree.splitlines()]
    assert [name for name, _ in named] == FOLDERS
    for name, subject in named:
        module = (CHECKOUT / "ncv_cl" / name / "__init__.py").read_text(encoding="utf-8")
        assert ast.get_docstring(ast.parse(module)) == subject


@pytest.mark.parametrize("page", PAGES)
def test_links_and_paths_of_a_page_exist(page):
    text = (CHECKOUT / page).read_text(encoding="utf-8")
    named = re.findall(r"`((?:cl|ncv_cl|tests|examples|bench|scenes)/[\w./]*)`", text)
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    assert named or links
    for path in named:
        assert (CHECKOUT / path).exists(), path
    for link in links:
        assert (CHECKOUT / page).parent.joinpath(link).exists(), link


def test_kernel_files_that_the_source_names_exist():
    """Comments and docstrings name files by their base names, or by their paths."""
    kernels = {path.name: path for path in (CHECKOUT / "cl").glob("*/*.cl")}
    for source in [*(CHECKOUT / "ncv_cl").rglob("*.py"), *kernels.values()]:
        for name in re.findall(r"[\w/]*\w\.cl\b", source.read_text(encoding="utf-8")):
            found = CHECKOUT / name if "/" in name else kernels.get(name)
            assert found is not None and found.exists(), f"{source} names {name}"


EXAMPLES = ["scene_from_arrays.py", "my_integrand/sky.py", "same_seconds.py", "baked_floor.py"]


@pytest.mark.parametrize("name", [*EXAMPLES, "office.py", "furnace.py", "turntable.py"])
def test_examples_render(folder, small, monkeypatch, name):
    """In a fresh process each takes seconds; here they run with smaller pictures."""
    if name not in EXAMPLES:
        pytest.importorskip("matplotlib")
    text = (CHECKOUT / "examples" / name).read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    monkeypatch.setattr(sys, "argv", [name])
    bake = ncv.bake
    monkeypatch.setattr(ncv, "bake", lambda *a, **options: bake(*a[:2], SIZE, *a[3:], **options))
    runpy.run_path(str(CHECKOUT / "examples" / name), run_name="__main__")
    pictures = sorted(folder.glob("*.png"))
    assert pictures and all(path.read_bytes()[:4] == b"\x89PNG" for path in pictures)
