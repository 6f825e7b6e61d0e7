"""The tutorial runs, and shows what it promises."""

from __future__ import annotations

import base64
from pathlib import Path

import pytest

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")
pytest.importorskip("ipykernel")

TUTORIAL = Path(__file__).parent.parent / "examples" / "tutorial.ipynb"


def test_tutorial_runs(tmp_path):
    notebook = nbformat.read(TUTORIAL, as_version=4)
    nbformat.validate(notebook)
    # What is committed has no output: it would age.
    assert not any(cell.get("outputs") for cell in notebook.cells)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    shown = [one.data["image/png"] for one in outputs if "image/png" in one.get("data", {})]
    assert len(shown) == 4 and all(base64.b64decode(one).startswith(b"\x89PNG") for one in shown)
    text = "".join(one.get("text", "") for one in outputs)
    assert text.count("deviations=") == 2 and text.count("+-") == 11
