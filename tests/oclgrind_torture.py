"""Integrate the torture networks on the only device there is: what test_oclgrind.py simulates.

Usage: oclgrind_torture.py METHOD PRECISION VEC LANES NETWORK [CAPACITY VALUE]

With a capacity (a `-D` constant of arrangement.py) that is too small, the robust path has to be taken.
"""

import sys
from pathlib import Path

import numpy as np
from oclgrind_run import avoid_false_reports

from ncv_cl import integrate
from ncv_cl.integration import integrator
from ncv_cl.opencl.device import list_cl_devices, open_device

LIMIT = {"float32": 1e-6, "float64": 1e-13}


def main(method: str, precision: str, vec: str, lanes: str, name: str, *capacity: str) -> None:
    avoid_false_reports()
    (simulator,) = list_cl_devices()
    device = open_device(simulator, vector_width=int(vec), lanes=int(lanes))
    if capacity:
        original = integrator.shape_constants
        room = int(capacity[1]) if capacity[1].isdigit() else capacity[1]
        integrator.shape_constants = lambda *shape: original(*shape) | {capacity[0]: room}
    arrays = np.load(Path(__file__).with_name("torture_networks.npz"))
    layers = sum(key.startswith(f"{name}/W") for key in arrays.files)
    weights, biases = ([arrays[f"{name}/{letter}{k}"] for k in range(layers)] for letter in "WB")
    options = {"method": method, "precision": precision, "device": device}
    values, statistics = integrate(weights, biases, return_stats=True, **options)
    error = np.abs(values[0] - arrays[f"{name}/exact"]) / arrays[f"{name}/scale"]
    print(f"{device.name}: {error.max():.1e} {statistics}")
    assert error.max() <= LIMIT[precision]
    assert not capacity or statistics.walk == statistics.clipped_points == 1


if __name__ == "__main__":
    main(*sys.argv[1:])
