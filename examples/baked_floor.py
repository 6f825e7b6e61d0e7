"""The floor of a room as maps over its UVs: ambient occlusion above, all light below."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import ncv_cl as ncv

SCENE = Path(__file__).parent.parent / "scenes" / "interior.toml"


def floor() -> ncv.UVMesh:
    """The floor of both rooms; u goes along x, v along z."""
    corner, along_z, along_x = np.array([-5.0, 0, -3]), np.array([0.0, 0, 5]), np.array([7.0, 0, 0])
    corners = [corner, corner + along_z, corner + along_z + along_x, corner + along_x]
    uv = [[0, 0], [0, 1], [1, 1], [1, 0]]
    return ncv.UVMesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]), np.array(uv, float))


def draw(output: str, width: int = 210, spp: int = 16) -> None:
    scene, size = ncv.load_scene(SCENE), (width, width * 5 // 7)
    open_part = ncv.bake(scene, floor(), size, integrand=ncv.AmbientOcclusion(1.0), spp=spp)
    light = ncv.bake(scene, floor(), size, integrand="gi", spp=spp)
    for name, image in (("occlusion", open_part), ("light", light)):
        stats = image.stats
        print(f"{name}: {stats['texels']} texels, {stats['places_inside']} of {stats['places']} places "
              f"inside of things, standard error {stats['mean_standard_error']:.3g}")  # fmt: skip
    # In one picture, the light four times as bright.
    pixels = np.concatenate([open_part.pixels, 4 * light.pixels])
    ncv.Image(pixels, np.zeros_like(pixels)).write(output)


if __name__ == "__main__":
    draw(sys.argv[1] if len(sys.argv) > 1 else "baked_floor.png")
