"""Irradiance at points on the only device there is: what test_oclgrind.py runs under the simulator.

Usage: oclgrind_points.py SCENE VEC LANES
"""

import sys

import numpy as np
from oclgrind_run import avoid_false_reports

from ncv_cl import irradiance
from ncv_cl.opencl.device import list_cl_devices, open_device


def main(scene: str, vec: str, lanes: str) -> None:
    avoid_false_reports()
    (simulator,) = list_cl_devices()
    device = open_device(simulator, vector_width=int(vec), lanes=int(lanes))
    # On the floor, in the air, and on a lamp.
    at = np.array([[[0.5, 0, 0], [0, 1, 0], [1.4, 1.7, -2.5], [-3, 0, 0]]])
    up = np.broadcast_to([0.0, 1, 0], at.shape)
    found = irradiance(scene, at, up, spp=4, method="mc", both_sides=True, device=device)
    print(f"{device.name}: {found.stats['points_detached']} detached, mean {found.values.mean()!r}")


if __name__ == "__main__":
    main(*sys.argv[1:])
