"""Scene files of Mitsuba's, made by hand."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

import ncv_cl as ncv

CAMERA = (
    '<sensor type="perspective"><float name="fov" value="40"/><string name="fov_axis" value="y"/>'
    '<transform name="to_world"><lookat origin="0, 0, 5" target="0, 0, 0" up="0, 1, 0"/></transform>'
    "</sensor>"
)


def scene(content: str, version: str = "3.0.0", camera: str = CAMERA) -> str:
    """The text of a scene file."""
    return f'<scene version="{version}">{camera}{content}</scene>'


def rectangle(content: str = "", transform: str = "") -> str:
    placed = f'<transform name="to_world">{transform}</transform>' if transform else ""
    return f'<shape type="rectangle">{placed}{content}</shape>'


def matrix_text(matrix: np.ndarray) -> str:
    return f'<matrix value="{" ".join(map(repr, np.asarray(matrix, float).ravel().tolist()))}"/>'


def load(path: Path) -> ncv.Scene:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return ncv.load_scene(path)
