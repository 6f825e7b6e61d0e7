"""What tasks name and workers are sent once: the problem, its estimate, and each task's own points."""

from __future__ import annotations

import pickle
import zlib
from dataclasses import dataclass

import numpy as np

from ...host.version import package_version
from ...opencl.device import Device
from ...output.report import kernel_digest, tuning_digest
from ...points.sampler import Stream
from ...sampling.problem import Decisions
from ...sampling.samples import RayCount
from ...settings.options import Sampling, Training
from .travel import TravellingIntegrand


@dataclass(frozen=True)
class ProblemSpec:
    """All that decides how samples are drawn, beside the values `scene`, `learned` and `function`.

    Attributes
    ----------
    integrand : TravellingIntegrand
    integrand_digest : str, optional
        Of what kernels get from a class that is not the package's.
    method, spp, size, seed, sampling, training
        Those of `Settings`, once the render is planned.
    decisions : Decisions
    offset : ndarray, optional
        Of a function of the user, as `CallableSource` has it.
    sensors : bool, optional
        Whether points given are plane sensors, or of a surface; None: they are what a camera sees.
    build : tuple of str
        Version of the package, digests of its kernels and tuned numbers: workers must have the same.
    device, shape : str
        Identity and shape of the parent's device.
    widths : (int, int, bool)
        The same shape: vector width, lanes, and whether kernels use `fma`.
    mixed : bool
        Whether workers may have other devices.
    threads : int, optional
        Of the host.
    scene, learned, function : str, optional
        Digests of values.
    """

    integrand: TravellingIntegrand
    integrand_digest: str | None
    method: str
    spp: int
    size: tuple[int, int]
    seed: int
    sampling: Sampling
    training: Training
    decisions: Decisions
    offset: np.ndarray | None
    sensors: bool | None
    build: tuple[str, str, str]
    device: str
    shape: str
    widths: tuple[int, int, bool]
    mixed: bool
    threads: int | None
    scene: str | None
    learned: str | None
    function: str | None


@dataclass(frozen=True)
class EstimateSpec:
    """An `ImageEstimate`: of direct light apart, or of the rest.

    Attributes
    ----------
    apart : bool
    edges : list of int
        Of passes.
    at_once : int
        As `Allocation` has it.
    twice : ndarray
        uint32, points that are estimated twice.
    streams : list of Stream
        One a target.
    grouped : bool
        Whether points share paths, as the sample source groups them.
    """

    apart: bool
    edges: list[int]
    at_once: int
    twice: np.ndarray
    streams: list[Stream]
    grouped: bool


@dataclass(frozen=True)
class TileData:
    """What belongs to a task's points alone.

    Attributes
    ----------
    counts : int or ndarray
        Samples of each point, where they differ an array; 0 for points that get none.
    alpha : ndarray, optional
        float32 (channels, points), control coefficients.
    steps : ndarray, optional
        uint32, from each point's sub-pixel to the next one's, from 0 on: most are 1.
    vectors : tuple of ndarray, optional
        Positions, normals and outgoing directions of points given, float32 (points, 3).
    """

    counts: int | np.ndarray
    alpha: np.ndarray | None = None
    steps: np.ndarray | None = None
    vectors: tuple[np.ndarray, ...] | None = None

    def pack(self) -> bytes:
        """As short as it is quickly made."""
        return zlib.compress(pickle.dumps(self, pickle.HIGHEST_PROTOCOL), 1)

    @staticmethod
    def unpack(data: bytes) -> TileData:
        """What `pack` made."""
        return pickle.loads(zlib.decompress(data))


@dataclass(frozen=True)
class Request:
    """A task: passes `first` to before `last` of the points from `begin` to before `end`.

    Attributes
    ----------
    spec, estimate : str
        Digests.
    wanted : list of int
        Numbers of passes after which the means are to be kept.
    own : bytes
        A `TileData`.
    states : list of (ndarray, ndarray), optional
        What the passes before have left of each target, as `Accumulator.part` gives it.
    """

    spec: str
    estimate: str
    begin: int
    end: int
    first: int
    last: int
    wanted: list[int]
    own: bytes
    states: list[tuple[np.ndarray, np.ndarray]] | None


@dataclass(frozen=True)
class TileResult:
    """What came of a `Request`.

    Attributes
    ----------
    device : str
        Identity and shape.
    states : list of (ndarray, ndarray)
        Each target's sums, as `Accumulator.take` takes them, and uint32 numbers of samples.
    means : list of ndarray
        float64 (quantities, channels, points), after the passes wanted.
    rays : RayCount
    seconds : dict of float
        By stage.
    """

    device: str
    states: list[tuple[np.ndarray, np.ndarray]]
    means: list[np.ndarray]
    rays: RayCount
    seconds: dict[str, float]


def device_line(device: Device) -> str:
    """What tells devices apart whose bits may differ."""
    return f"{device.identity}, {device.shape}"


def this_build() -> tuple[str, str, str]:
    """What workers must have the same."""
    return package_version(), kernel_digest(), tuning_digest()
