"""Groups of 64 work-items, as AMD's waves may be, compute what groups of 32 do."""

from __future__ import annotations

import numpy as np

import ncv_cl as ncv
from ncv_cl.opencl.device import open_device


def test_a_wave_of_64_makes_the_picture_of_a_warp(one_device, scenes):
    pixels = []
    for lanes in (32, 64):
        device = open_device(one_device.cl_device, one_device.index, 1, lanes)
        image = ncv.render(
            scenes / "cornell_box.toml", "direct", "ncv",
            device=device, size=(8, 6), spp=96, train_spp=16, density="subdivision", seed=5,
        )  # fmt: skip
        pixels.append(image.pixels)
    # Sums over a group's work-items are taken in another order, nothing else differs.
    np.testing.assert_allclose(pixels[1], pixels[0], rtol=1e-4, atol=1e-6)
