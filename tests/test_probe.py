"""The benchmark that lists of devices show."""

from __future__ import annotations

import numpy as np

from ncv_cl.opencl.memory import HostArray
from ncv_cl.opencl.program import build


def test_chains_of_multiply_adds_match_float64(device):
    count, steps = 64 * device.vector_width, 8
    start = np.linspace(-3, 3, count).astype(np.float32)
    values = HostArray.of(device, start)
    program = build(device, ("common", "probe"), {"STEPS": f"{2 * steps}u"})
    program.kernel("multiply_add")(64, a=0.75, b=-1.5, values=values)
    first, second = start.astype(np.float64), start + 1.0
    for _ in range(steps):
        first, second = 0.75 * first - 1.5, 0.75 * second - 1.5
    np.testing.assert_allclose(values.read(), 0.5 * (first + second), rtol=1e-5, atol=1e-5)
