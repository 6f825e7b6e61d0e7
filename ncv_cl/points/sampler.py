"""Samplers of the unit square: names, streams of random numbers, and points for the host.

All random numbers come from here: on the device by `Stream`, on the host by `HostStream`.
"""

from __future__ import annotations

import enum
import numbers

import numpy as np

from ..opencl.device import Device
from ..opencl.memory import HostArray
from ..opencl.program import build

SAMPLERS = ("independent", "sobol")


class Stream(enum.IntEnum):
    """What a sample is for; samples of different streams are independent.

    No two stages of a render share one, because their estimates are combined as independent ones.
    """

    # f by plain Monte Carlo.
    PLAIN = 0
    PILOT = 1
    UNSHADOWED = 2
    # A second, independent scramble for points that are estimated twice.
    PLAIN_AGAIN = 3
    # f - g, and its second scramble.
    RESIDUAL = 4
    RESIDUAL_AGAIN = 5
    TRAINING = 6
    HELD_OUT = 7
    # Drawn so that kernels get compiled; the values are not used.
    WARM_UP = 8
    # The constant that is subtracted from a callable.
    OFFSET = 9
    # Direct light that is estimated apart from the rest, and its second scramble.
    DIRECT = 10
    DIRECT_AGAIN = 11
    # Points on surfaces, from which view factors are measured.
    PATCHES = 14
    # Directions from there.
    PATCH_RAYS = 15


class HostStream(enum.IntEnum):
    """What a random number of the host is for."""

    NETWORK = 0
    MINIBATCHES = 1
    TRAINING_POINTS = 2
    POINTS_DONE_TWICE = 3
    DENSITY = 4
    # The order of directions from points on surfaces.
    PATCH_RAYS = 8


def host_generator(seed: int, stream: HostStream) -> np.random.Generator:
    """A generator for the host; its numbers are the same on every machine."""
    return np.random.Generator(np.random.Philox([seed, int(stream)]))


def sampler_defines(sampler: str) -> dict[str, int]:
    """The `-D` constants of sampler.cl.

    Raises
    ------
    ValueError
        If `sampler` is not one of `SAMPLERS`.
    """
    if sampler not in SAMPLERS:
        raise ValueError(f"sampler must be one of {', '.join(SAMPLERS)}, got {sampler!r}")
    defines = {f"SAMPLER_{name.upper()}": number for number, name in enumerate(SAMPLERS)}
    return {**defines, "SAMPLER": SAMPLERS.index(sampler)}


def seed_words(seed: int) -> dict[str, int]:
    """The two 32-bit words of Philox's key, as kernels call them.

    Raises
    ------
    ValueError
        If `seed` is not an integer in [0, 2**64).
    """
    is_number = isinstance(seed, numbers.Real) and not isinstance(seed, bool)
    if not is_number or not 0 <= seed < 2**64 or seed != seed // 1:
        raise ValueError(f"seed must be an integer from 0 to 2**64 - 1, got {seed!r}")
    return {"seed_low": int(seed) & 0xFFFFFFFF, "seed_high": int(seed) >> 32}


def square_samples(
    device: Device,
    sampler: str,
    points: range,
    samples: range,
    seed: int,
    stream: int = Stream.PLAIN,
) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates u and v in [0, 1)², float32 (points, samples), the same that renders use."""
    count = len(samples)
    stride = -(-count // device.vector_width) * device.vector_width
    u = HostArray(device, (len(points), stride), np.float32)
    v = HostArray(device, (len(points), stride), np.float32)
    kernel = build(device, ("common", "sampler"), sampler_defines(sampler)).kernel("square_samples")
    kernel(
        len(points) * stride // device.vector_width,
        first_point=points.start,
        point_count=len(points),
        first_sample=samples.start,
        stride=stride,
        stream=stream,
        **seed_words(seed),
        u=u,
        v=v,
    )
    return u.read()[:, :count], v.read()[:, :count]
