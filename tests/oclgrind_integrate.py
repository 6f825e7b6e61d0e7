"""Integrate a few small networks on the only device there is: what test_oclgrind.py simulates.

Usage: oclgrind_integrate.py METHOD HIDDEN VEC LANES, HIDDEN as in 5x4
"""

import itertools
import sys

import numpy as np
from oclgrind_run import avoid_false_reports

from ncv_cl import integrate
from ncv_cl.opencl.device import list_cl_devices, open_device


def main(method: str, hidden: str, vec: str, lanes: str) -> None:
    avoid_false_reports()
    (simulator,) = list_cl_devices()
    device = open_device(simulator, vector_width=int(vec), lanes=int(lanes))
    widths = [2, *map(int, hidden.split("x")), 2]
    generator = np.random.default_rng(0)
    weights = [generator.normal(size=(3, n, m)) for m, n in itertools.pairwise(widths)]
    biases = [0.3 * generator.normal(size=(3, n)) for n in widths[1:]]
    integrals = integrate(weights, biases, method=method, device=device)
    print(f"{device.name}: {integrals.tolist()}")


if __name__ == "__main__":
    main(*sys.argv[1:])
