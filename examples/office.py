"""Daylight on the desks of an office with two windows: a thousand sensors, contours and error bars."""

from __future__ import annotations

import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import trimesh

import ncv_cl as ncv

# Metres; x along the windows' wall, which is at z = 0, y up.
ROOM, DESK = (6.0, 2.8, 4.0), 0.75


def office() -> ncv.Scene:
    walls = trimesh.creation.box(bounds=[(0, 0, 0), ROOM])
    desks = [trimesh.creation.box(bounds=[(x, 0.7, z), (x + 1.4, DESK, z + 0.7)])
             for x in (0.6, 2.3, 4.0) for z in (0.8, 2.4)]  # fmt: skip
    shelf = trimesh.creation.box(bounds=[(2.8, 0, 0.05), (3.2, 2.2, 0.5)])
    meshes = [ncv.TriangleMesh(walls.vertices, walls.faces, "plaster")]
    meshes += [ncv.TriangleMesh(one.vertices, one.faces, "wood") for one in [*desks, shelf]]
    # A window is a light just before the wall, as bright as an overcast sky.
    windows = [ncv.QuadLight((x, 0.9, 0.01), (1.6, 0, 0), (0, 1.5, 0), 1.0) for x in (0.8, 3.6)]
    return ncv.build_scene(
        ncv.Camera((3, 1.6, 3.9), (3, 1, 0), 60),
        {"plaster": ncv.Material(0.7), "wood": ncv.Material((0.5, 0.4, 0.3))},
        meshes,
        windows,
    )


def draw(output: str, spp: int = 128) -> None:
    x, z = np.meshgrid(np.linspace(0.1, 5.9, 40), np.linspace(0.1, 3.9, 25))
    sensors = np.stack([x, np.full_like(x, DESK + 1e-3), z], axis=-1)
    up = np.broadcast_to([0.0, 1.0, 0.0], sensors.shape)
    found = ncv.irradiance(office(), sensors, up, integrand="gi", spp=spp, seed=1)
    value, error = found.values.mean(axis=-1), found.standard_error.mean(axis=-1)
    figure, (plan, line) = plt.subplots(1, 2, figsize=(11, 3.8), constrained_layout=True)
    drawn = plan.contourf(x, z, value, levels=np.geomspace(0.05, 1.6, 16), norm="log")
    plan.set(xlabel="x, m", ylabel="distance from the windows, m", aspect="equal")
    figure.colorbar(drawn, ax=plan, label="irradiance, sky radiance × sr", format="%.2f")
    for row in (3, 12, 21):
        line.errorbar(x[row], value[row], 2 * error[row], capsize=2, label=f"at {z[row, 0]:.1f} m")
    line.set(xlabel="x, m", yscale="log", title="with two standard errors")
    line.legend(loc="center right")
    figure.savefig(output, dpi=100)
    print(f"{value.size} sensors, relative error {error.sum() / value.sum():.2g}")


if __name__ == "__main__":
    draw(sys.argv[1] if len(sys.argv) > 1 else "office.png")
