"""Errors of one scene's renders by each kind of visibility, for the benchmarks of lines and slices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from training import SCENES

import ncv_cl as ncv


class Case:
    """Renders of one scene, and their errors.

    Parameters
    ----------
    name : str
        Of a shipped scene, or of `scene`.
    integrand : str or Integrand
    size : int
        Pixels a side.
    samples : int
        Lines or slices of the reference, which is compared with samples traced by embree.
    scene : Scene, optional
        Another than a shipped one.
    judged : int
        How many samples embree traces.
    """

    def __init__(
        self,
        name: str,
        integrand: str | ncv.Integrand,
        size: int,
        samples: int,
        scene: ncv.Scene | None = None,
        judged: int = 4096,
    ) -> None:
        self.name, self._integrand, self._size = name, integrand, size
        self._scene = scene or ncv.load_scene(SCENES / f"{name}.toml")
        self._truth = self.render("lines", samples, 991).pixels.astype(np.float64)
        judge = self.render("embree", judged, 992)
        print(
            f"{name}: {samples} by lines and {judged} by embree differ by {self.error(judge):.2e}; "
            f"estimated {judge.stats['estimated_mse']:.2e}",
            flush=True,
        )

    def render(self, visibility: str, spp: int, seed: int, **options: object) -> ncv.Image:
        size = (self._size, self._size)
        options = {"method": "mc", "visibility": visibility, "spp": spp, "seed": seed, **options}
        return ncv.render(self._scene, self._integrand, size=size, **options)

    def error(self, image: ncv.Image) -> float:
        return float(np.mean((image.pixels - self._truth) ** 2))

    def print_errors(self, visibility: str, numbers: tuple[int, ...], seeds: int) -> None:
        """Mean square errors by the number of samples, and the power by which they fall."""
        found = [
            np.mean([self.error(self.render(visibility, n, seed)) for seed in range(seeds)])
            for n in numbers
        ]
        falls = -np.diff(np.log(found)) / np.diff(np.log(numbers))
        row = " ".join(f"{n}: {e:.2e}" for n, e in zip(numbers, found, strict=True))
        print(f"  {visibility:6} {row}  falls by {np.round(falls, 2)}", flush=True)


def cut_in_four(scene: ncv.Scene) -> ncv.Scene:
    """Every triangle by the middles of its edges; no corner is shared."""
    a, b, c = scene.vertices[scene.triangles].transpose(1, 0, 2)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    corners = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    indices = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
    return replace(
        scene,
        vertices=corners,
        vertex_normals=np.zeros_like(corners),
        triangles=indices,
        triangle_material=np.repeat(scene.triangle_material, 4),
        triangle_light=np.repeat(scene.triangle_light, 4),
    )
