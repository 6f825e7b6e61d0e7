"""The reference of the Python interface, as `pdoc --docformat numpy --math ncv_cl` makes it."""

from __future__ import annotations

import inspect

import pytest

import ncv_cl as ncv

pdoc = pytest.importorskip("pdoc")


def test_every_public_name_has_its_text(tmp_path):
    pdoc.render.configure(docformat="numpy", math=True)
    pdoc.pdoc("ncv_cl", output_directory=tmp_path)
    page = (tmp_path / "ncv_cl.html").read_text(encoding="utf-8")
    for name in ncv.__all__:
        assert f'id="{name}"' in page, name
        found = inspect.getdoc(getattr(ncv, name))
        # pdoc takes what a class inherits; a dataclass without a text has its signature.
        assert found and not found.startswith(f"{name}("), name


def test_parameters_are_those_of_the_signature():
    """Numpydoc's list names every parameter that has a name of its own, in any order."""
    for name in ncv.__all__:
        one = getattr(ncv, name)
        if not inspect.isfunction(one):
            continue
        text = inspect.getdoc(one)
        for parameter in inspect.signature(one).parameters.values():
            if parameter.kind is parameter.VAR_KEYWORD:
                continue
            assert parameter.name in text, f"{name}: {parameter.name}"
