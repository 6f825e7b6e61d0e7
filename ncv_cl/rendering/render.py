"""From a scene to its image: points, the pipeline, pixels."""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import numpy as np

from ..estimation.control_variate import Trained
from ..host.clock import Clock, Run, never
from ..host.files import check_paths, read_arrays
from ..integrands import Integrand
from ..integrands.named import named_integrand
from ..learning.density import DensityNetwork
from ..network.network import Network, NetworkError
from ..opencl.choose import choose_device
from ..opencl.device import Device
from ..output.checkpoint import Checkpoint, guide_of
from ..output.image import Image, checked_reference, read_reference
from ..output.keep import Keep
from ..output.report import about_values, identity
from ..output.resolve import resolve_image
from ..sampling.problem import Problem
from ..scene.load import Scene, load_scene
from ..settings.options import Files, Machine, Sampling, Stopping, Training, gathered
from ..settings.settings import Settings
from .carried.passes import carried
from .describe import describe
from .pipeline import Outcome, estimate_integrals
from .prepare import prepare


def render(
    scene: Scene | str | Path,
    integrand: str | Integrand = "direct",
    method: str = "auto",
    spp: int = 256,
    size: tuple[int, int] = (512, 512),
    seed: int = 0,
    device: Device | int | str | None = None,
    progress: bool = False,
    sampling: Sampling | None = None,
    training: Training | None = None,
    stopping: Stopping | None = None,
    files: Files | None = None,
    machine: Machine | None = None,
    **options: object,
) -> Image:
    """Render an image of a scene.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, or the path of its TOML file.
    integrand : {"ao", "direct", "gi"}, str or Integrand
        Ambient occlusion, direct light or global illumination; an `Integrand` object carries options,
        and may be of a class of your own (docs/python.md), which ``FILE.py:CLASS`` names as well.
    method : {"auto", "ncv", "mc"}
        Neural control variate, plain Monte Carlo, or by a rule whichever reaches an error sooner.
    spp : int
        Samples a shading point on average: of the residual for "ncv", of the integrand for "mc". Where
        visibility "auto" takes slices of the hemisphere (ambient occlusion) there are fewer of them: as
        many as take the time of so many rays.
    size : (int, int)
        Width and height, pixels.
    seed : int
        From 0 to 2**64 − 1. Same seed, device and scene: the same image, bit for bit.
    device : Device, int or str, optional
        As `choose_device` takes it.
    progress : bool
        Draw a progress bar where standard error is a terminal.
    sampling, training, stopping, files, machine : optional
        Groups of options.
    **options
        Single options of these groups by their names, such as ``supersample=2``, ``time_limit=60``
        or ``executor=ncv.Processes(4)``.

    Returns
    -------
    Image

    Raises
    ------
    ValueError
        For bad arguments (`SceneError` for scenes, `IntegrandError` for integrands, `NetworkError` for
        networks that do not fit, `CheckpointError` for checkpoints of other renders), and for options
        that would have no effect with the method.
    TypeError
        For an option that does not exist.
    DeviceError
        If there is no such OpenCL device.
    RuntimeError
        If a kernel of one's own does not compile; says file, line and what the compiler said.
    TaskError
        If workers fail again and again; the checkpoint, if there is to be one, holds what was done.
    """
    started = time.perf_counter()
    groups = gathered(
        {
            "sampling": sampling,
            "training": training,
            "stopping": stopping,
            "files": files,
            "machine": machine,
        },
        options,
    )
    files, machine = groups.pop("files"), groups.pop("machine")
    machine.check()
    check_paths({"checkpoint": files.checkpoint, "save_network": files.save_network})
    if not isinstance(scene, Scene):
        scene = load_scene(scene)
    settings = Settings(integrand_of(integrand), method, spp, size, seed, **groups)
    settings.check_files(files)
    # Fails for scenes that do not suit the integrand before anything is traced.
    settings.integrand.check(scene)
    reference = reference_of(files.reference, settings.size)
    given = given_network(settings.training.network)
    device = choose_device(device)
    keep = _keep(files, identity(scene, settings, device, given.network if given else None))
    limit = settings.stopping.time_limit
    run = Run(clock=Clock(limit, started), stop=settings.stopping.stop or never, progress=progress)
    problem = prepare(device, scene, settings, machine.threads, run.watch)
    settings = problem.sampled(settings)
    with carried(problem, machine, run, scene, resumed=keep.resumed) as problem:
        outcome = estimate_integrals(problem, settings, run, keep, given)
    image = _image(scene, settings, run, problem, outcome)
    describe(image, scene, settings, problem, outcome, run.watch, time.perf_counter() - started)
    if keep.not_written:
        image.stats["not_written"] = keep.not_written
    about_values(image, reference)
    _remark(scene, settings, problem, image)
    return image


def _remark(scene: Scene, settings: Settings, problem: Problem, image: Image) -> None:
    """Warn of a picture that is seldom meant as it came out, or that leaves out what is seen."""
    width, height = settings.size
    seen = problem.points.total / (width * height * settings.sampling.supersample**2)
    remark = settings.integrand.remark(float(image.pixels.mean()) / seen) if seen else None
    unseen = None
    if problem.points.material is not None:
        unseen = settings.integrand.unseen(scene, problem.points.material)
    for said in (remark, unseen):
        if said is not None:
            warnings.warn(said, stacklevel=3)


def integrand_of(integrand: str | Integrand) -> Integrand:
    """An integrand by its name, or itself."""
    if isinstance(integrand, str):
        integrand = named_integrand(integrand)
    if not isinstance(integrand, Integrand):
        raise ValueError(f"integrand must be a name or an Integrand, got {integrand!r}")
    return integrand


def reference_of(given: np.ndarray | str | Path | None, size: tuple[int, int]) -> np.ndarray | None:
    """A reference for an image of this width and height, read if it is a file."""
    if given is None:
        return None
    if isinstance(given, (str, Path)):
        return read_reference(given, (size[1], size[0]))
    return checked_reference(given, size)


def given_network(network: Network | str | Path | None) -> Trained | None:
    """The network that is to be used, with its density and guide if it comes from a file."""
    if network is None:
        return None
    if isinstance(network, Network):
        return Trained(network)
    trained = Network.load(network), DensityNetwork.load(network)
    try:
        return Trained(*trained, guide=guide_of(read_arrays(network)))
    except ValueError as error:
        raise NetworkError(f"{network} is not a network saved by ncv_cl: {error}") from error


def _keep(files: Files, asked: dict[str, object]) -> Keep:
    resumed = None
    if files.resume is not None:
        resumed = Checkpoint.load(files.resume)
        resumed.check(asked)
    return Keep(files.checkpoint, files.save_network, asked, resumed)


def _image(scene: Scene, settings: Settings, run: Run, problem: Problem, outcome: Outcome) -> Image:
    drawn = outcome.drawn
    with run.watch("resolve"):
        return resolve_image(
            scene,
            settings,
            problem.points,
            drawn.plain,
            outcome.before,
            drawn.residual,
            outcome.integral,
            outcome.by_count,
            drawn.direct,
        )
