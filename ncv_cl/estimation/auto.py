"""Whether a control variate pays: predicted from a first pass of plain Monte Carlo."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from ..opencl.device import Device
from ..opencl.probe import cached_probe
from ..sampling.accumulate import Estimate

# Samples a point of the first pass, on which the choice rests; they stay in the image.
FIRST_SAMPLES = 16
# The same of nested estimates, whose prediction goes by counts of rays and by seconds alone.
NESTED_FIRST_SAMPLES = 4
# Training in inference samples of the probe's network; then what folding, tabulating, integrating and
# resolving take at a point (PoCL 3.1, 96 x 96 to 512 x 512 points).
FIXED_INFERENCE_SAMPLES = 1.75e7
INFERENCE_SAMPLES_A_POINT = 200.0
# What a sample's ray costs more where the shadows' edges are; and what warping and inference add to it,
# in inference samples of the probe's network.
RAY_COST = 1.2
SAMPLE_INFERENCE = 0.8
# By how much the variance falls where all points are alike, as for the shipped scenes' ambient
# occlusion; allocation brings the rest. All were set on the scenes that bench_curves.py reports.
DENSITY_GAIN = 1.6
# Allocation brings no more than this, however few points are seen to differ: 4 for the Cornell box, 2.5
# for others, and two estimates of some points are a coarse look at a rare thing.
LARGEST_ALLOCATION_GAIN = 4.0
# Shadows of so many triangles are learned half as well: seen 1.5 to 2.2 for the Cornell box's direct
# light (4 occluders where the error is), 0.7 to 0.8 and 0.3 to 0.5 for occluders and knot (27 to 56).
HALVING_OCCLUDERS = 24.0
# No sample of plain Monte Carlo is thought to take longer, in inference samples of the probe's network,
# where its visibility is tested on the device, and where a ray is traced (PoCL 3.1: 15 and 300 ns).
LONGEST_SAMPLE = 1.0
LONGEST_RAY = 20.0
# Errors of Sobol points fall as samples to this power, so samples as variance to its inverse.
VARIANCE_EXPONENT = 1.5
# Where samples are nested estimates, noise that no spreading lowers is most of the error: variance falls
# as samples do, and concentration says nothing. Guided paths lower it the more the longer paths are: by
# half of the rays a sample traces. Their rays cost more, and training costs a little, and more for each
# sample. Set by variances and processor seconds on the shipped scenes, 48 x 48 to 96 x 96 points.
NESTED_GAIN = 0.5
NESTED_EXPONENT = 1.0
NESTED_RAY_COST = 1.4
NESTED_FIXED_INFERENCE_SAMPLES = 5e6
NESTED_TRAINING_INFERENCE_SAMPLES = 40.0
# The gain must be this clear, as predictions err; by less for nested samples, whose gain goes by counts
# of rays, and only the costs by the clock.
MARGIN = 0.85
NESTED_MARGIN = 0.92


@dataclass(frozen=True)
class Prediction:
    """What was predicted for an image, and chosen.

    Attributes
    ----------
    method : {"mc", "ncv"}
    mc_seconds : float
        Plain Monte Carlo to the end.
    ncv_seconds : float
        Control variate to the same error, training included.
    variance_gain : float
        Variance of plain Monte Carlo over that of the control variate at as many samples.
    first_pass : bool
        Whether a first pass was asked. Without one `mc_seconds` is a bound, and `ncv_seconds` training.
    """

    method: str
    mc_seconds: float
    ncv_seconds: float
    variance_gain: float
    first_pass: bool = True

    def as_dict(self) -> dict[str, object]:
        return asdict(self)


def too_short(
    device: Device, known: float, traced: float, seconds: float = math.inf
) -> Prediction | None:
    """Plain Monte Carlo where it cannot take longer than training, whatever its variance; else None.

    Parameters
    ----------
    known, traced : float
        Samples of the image whose visibility is tested on the device, and others.
    seconds : float
        The most that the image may take from now on.
    """
    inference = 1e-9 * cached_probe(device).nanoseconds
    longest = min(inference * (LONGEST_SAMPLE * known + LONGEST_RAY * traced), max(seconds, 0.0))
    training = inference * FIXED_INFERENCE_SAMPLES
    return Prediction("mc", longest, training, 1.0, False) if longest < training else None


def predict(
    device: Device,
    first: Estimate,
    difference: np.ndarray | None,
    seconds: float,
    spp: float,
    nested_rays: float | None = None,
    training_samples: float = 0.0,
    occluders: float = 0.0,
) -> Prediction:
    """Choose a method from the estimate and the seconds of a first pass.

    Parameters
    ----------
    first : Estimate
        Of f, from a few samples a point.
    difference : ndarray, optional
        (channels, points done twice), between two estimates of some points. Well spread samples leave
        errors at far fewer points than have a variance, and only differences show where.
    seconds : float
        What that pass took.
    spp : float
        Samples a point that are wanted in all.
    nested_rays : float, optional
        Rays a sample, where samples are estimates themselves, whose noise is learned to be lowered.
    training_samples : float
        Samples a point that training takes, where they are dear enough to count.
    occluders : float
        Triangles that can shade a point from the lights, on average over points by their error; zero
        where that is not known.

    Notes
    -----
    Samples given by magnitude multiply the sum of variances s² by (mean s)² / mean s² (Lagrange
    multiplier), which is small where few points have the variance. That is known before training.
    """
    drawn = float(first.samples.mean())
    mc_seconds = seconds * max(spp - drawn, 0) / drawn
    # What is not known speaks for nothing.
    variance = np.nan_to_num(first.variance.sum(axis=0))
    if difference is None:
        deviation, normal = np.sqrt(variance), 1.0
    else:
        # The mean of a normal variable's absolute value is sqrt(2 / pi) of its deviation.
        deviation, normal = np.sqrt((difference**2).sum(axis=0)), np.pi / 2
    concentration = 1.0
    if deviation.any():
        concentration = min(1.0, normal * float(deviation.mean() ** 2 / np.mean(deviation**2)))
    inference = 1e-9 * cached_probe(device).nanoseconds
    if nested_rays is None:
        learned = DENSITY_GAIN / (1.0 + occluders / HALVING_OCCLUDERS)
        gain = learned * min(1.0 / max(concentration, 1e-3), LARGEST_ALLOCATION_GAIN)
        cost, exponent = RAY_COST, VARIANCE_EXPONENT
        once, margin = FIXED_INFERENCE_SAMPLES, MARGIN
    else:
        gain, cost, exponent = max(1.0, NESTED_GAIN * nested_rays), NESTED_RAY_COST, NESTED_EXPONENT
        once = NESTED_TRAINING_INFERENCE_SAMPLES * training_samples * len(variance)
        once += NESTED_FIXED_INFERENCE_SAMPLES
        margin = NESTED_MARGIN
    fixed = inference * (once + INFERENCE_SAMPLES_A_POINT * len(variance))
    fixed += training_samples * seconds / drawn
    network = inference * SAMPLE_INFERENCE * len(variance) * max(spp - drawn, 0)
    ncv_seconds = fixed + (mc_seconds * cost + network) * gain ** (-1 / exponent)
    method = "ncv" if variance.any() and ncv_seconds < margin * mc_seconds else "mc"
    return Prediction(method, mc_seconds, ncv_seconds, gain)
