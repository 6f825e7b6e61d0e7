"""The options of a render that few people set, in groups; each is declared only here.

`gathered` accepts them by group or by name, `arguments.py` makes them options of the command line, and
`Settings.options` lists them for metadata and checkpoints.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import numbers
import typing
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Literal

import numpy as np

from ..machines.crew import check_executor
from ..network.network import Network
from .presets import PRESETS

# Limits of the kernels' 32-bit indices.
MOST_SAMPLES = 1 << 31
MOST_CELLS = (1 << 31) - 1


@dataclass(frozen=True)
class Sampling:
    """Where and how samples are drawn.

    Attributes
    ----------
    sampler : {"sobol", "independent"}
        Owen-scrambled Sobol points (one scramble a shading point) or independent ones.
    supersample : int
        k makes k × k shading points a pixel, averaged by `filter`.
    filter : {"box", "tent", "blackman-harris"}
        What averages shading points to pixels: those of the pixel alike ("box"), or those about its
        middle, weighted: up to 1 pixel away ("tent") or 1.5 ("blackman-harris"), which leaves the fewest
        stairs at edges. These need `supersample` of 2 at least.
    allocation : {"magnitude", "relative", "pilot", "uniform"}, optional
        How `spp` is spent over the image: by each point's predicted residual ("magnitude", for ncv), by
        this over what is expected of its pixel's value ("relative", for ncv), by its variance in a
        quarter of the samples, at most 64 ("pilot", for mc), or alike everywhere. By default "uniform"
        for mc and for global illumination, else what the preset says.
    visibility : {"auto", "lines", "points", "embree"}
        "lines": find what is seen of whole lines on the lights (direct light), or in whole slices of the
        hemisphere (ambient occlusion), and sample only that: no shadow rays, less error. "points": test
        shadow rays that few triangles can block on the device. "embree": trace all of them; pixels
        differ from those by points where a ray grazes an edge. "auto": lines in direct light, where
        `spp` is large for the number of triangles before the lights; slices in ambient occlusion, where
        they reach an error sooner and method "ncv" is not asked for; else points. A slice takes the time
        of 2 to 15 rays, which "auto" counts it for: `spp` 256 is 16 or 128 slices, in no more time than
        256 rays, with less error. Under "lines" `spp` is the number of slices.
    rays : {"auto", "embree", "device"}
        Who traces rays of samples and paths. "embree": the host. "device": kernels, through boxes of
        boxes of triangles; the host then waits for the device once a pass only (of a CPU, in global
        illumination, once a bounce, which costs nothing there). Pixels differ where a ray grazes an
        edge. "auto": the device if it is a GPU, but not under `visibility` "embree" and not where
        textures make holes, which the host looks up. Camera rays are always embree's.
    split_direct : {"auto", "on", "off"}
        Global illumination: estimate direct light apart from the light of paths ("on"), by samples of
        its own, or both by the same samples ("off"). "auto": apart where it can be sampled along lines.
    skip_dark : bool
        Leave out points that face away from every light, whose value is zero, or, to compare,
        compute them as well.
    """

    sampler: Literal["sobol", "independent"] = "sobol"
    supersample: int = 1
    filter: Literal["box", "tent", "blackman-harris"] = "box"
    allocation: Literal["magnitude", "relative", "pilot", "uniform"] | None = None
    visibility: Literal["auto", "lines", "points", "embree"] = "auto"
    rays: Literal["auto", "embree", "device"] = "auto"
    split_direct: Literal["auto", "on", "off"] = "auto"
    skip_dark: bool = True

    def __post_init__(self) -> None:
        check_choices(self)
        if self.visibility == "embree" and self.rays == "device":
            raise ValueError("visibility 'embree' has embree trace all rays: leave out rays 'device'")
        supersample = checked_whole("supersample", self.supersample, MOST_CELLS)
        object.__setattr__(self, "supersample", supersample)
        if self.filter != "box" and supersample == 1:
            raise ValueError(
                f"filter {self.filter!r} would not smooth edges with one shading point a pixel: "
                "take supersample 2 or more"
            )
        if not isinstance(self.skip_dark, (bool, np.bool_)):
            raise ValueError(f"skip_dark must be True or False, got {self.skip_dark!r}")


@dataclass(frozen=True)
class Training:
    """The control variate's network, and how it is trained and used.

    Attributes
    ----------
    preset : {"default", "wide", "slides"}
        Network and schedule: "default" measured best in time to error, "wide" has twice as many neurons
        a layer, "slides" is the slides' own.
    train_spp : float or "auto"
        Training samples a shading point on average; small numbers are drawn as more samples at fewer
        points. "auto" draws rounds, each as large as all before, while the next one is predicted to pay:
        from 2^18 samples in all to 2^21, at most `spp` / 4 a point.
    density : {"table", "subdivision", "none"}, optional
        Sampling density of the residual, large where a second network predicts a large residual:
        constant on 8 × 8 cells ("table"), linear on the triangles into which the first layer cuts the
        square ("subdivision"), or uniform ("none"). The default is the preset's.
    network : Network, str or Path, optional
        A trained network, or its file, to use instead of training one, as for another view of the same
        scene. A file also holds the density's network and, for global illumination, what guides bounces;
        a `Network` does not, and the residual is then sampled uniformly. Control coefficients are 1.
    """

    preset: str = "default"
    train_spp: float | Literal["auto"] = "auto"
    density: Literal["table", "subdivision", "none"] | None = None
    network: Network | str | Path | None = None

    def __post_init__(self) -> None:
        check_choices(self)
        if self.train_spp != "auto":
            check_real("train_spp", self.train_spp, MOST_SAMPLES, " or 'auto'")
        if not isinstance(self.preset, str) or self.preset not in PRESETS:
            raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {self.preset!r}")


@dataclass(frozen=True)
class Stopping:
    """When a render ends before all of its samples are drawn.

    Attributes
    ----------
    target_mse : float, optional
        End after the pass in which the image's mean square error is estimated to be this or less. An
        estimate is believed only when every light is expected to have got thousands of samples.
    time_limit : float, optional
        Seconds. End before a pass that would exceed them; passes are short then, and training ends in
        time. One pass, and the compilation of kernels that the driver has not kept, cannot be
        interrupted. The image's bits then depend on the clock.
    stop : callable, optional
        Asked between passes; True ends rendering with the passes done so far.
    """

    target_mse: float | None = None
    time_limit: float | None = None
    stop: Callable[[], bool] | None = None

    def __post_init__(self) -> None:
        for name in ("target_mse", "time_limit"):
            if getattr(self, name) is not None:
                check_real(name, getattr(self, name), math.inf)
        if self.stop is not None and not callable(self.stop):
            raise ValueError(f"stop must be a function that says whether to end, got {self.stop!r}")


@dataclass(frozen=True)
class Files:
    """Files that a render reads and writes beside its scene and its picture.

    Attributes
    ----------
    save_network : str or Path, optional
        Write the trained network and its density here (.npz).
    checkpoint : str or Path, optional
        Write the render's state here after training and after every pass; a process that is killed loses
        one pass at most.
    resume : str or Path, optional
        Go on from this checkpoint, to the bits of a render without interruption. All options must be as
        they were, but for the groups stopping, files and machine.
    reference : ndarray, str or Path, optional
        An image, float (height, width, 3), or its file, to measure the error against: adds `mse` and
        `relmse` to the statistics.
    """

    save_network: str | Path | None = None
    checkpoint: str | Path | None = None
    resume: str | Path | None = None
    reference: np.ndarray | str | Path | None = None


@dataclass(frozen=True)
class Machine:
    """Use of the host, and of other machines.

    Attributes
    ----------
    threads : int, optional
        Host threads that trace rays; all cores by default.
    executor : concurrent.futures.Executor, optional
        Workers that draw the samples, on this machine or on others (docs/clusters.md): `Processes`,
        Dask's ``client.get_executor()``, `MPIPoolExecutor`. The bits are those without.
    task_points : int, optional
        With workers: points of a task; by default as many as take some seconds, or fewer where there
        would be less than 16 tasks. Pixels do not depend on it.
    task_limit : float
        With workers: seconds after which a task is given to another worker.
    mixed_devices : bool
        With workers: let them have other devices than this process, whose bits may differ.
    shared : str or Path, optional
        With workers: a folder that all of them see under this name. Scene and network are then files
        there, which stay; else they are sent, once to each worker.
    """

    threads: int | None = None
    executor: Executor | None = None
    task_points: int | None = None
    task_limit: float = 600.0
    mixed_devices: bool = False
    shared: str | Path | None = None

    def __post_init__(self) -> None:
        for name in ("threads", "task_points"):
            if getattr(self, name) is not None:
                whole = checked_whole(name, getattr(self, name), MOST_CELLS)
                object.__setattr__(self, name, whole)
        check_real("task_limit", self.task_limit, math.inf)
        if not isinstance(self.mixed_devices, (bool, np.bool_)):
            raise ValueError(f"mixed_devices must be True or False, got {self.mixed_devices!r}")
        if self.shared is not None and not Path(self.shared).is_dir():
            raise ValueError(f"shared must be a folder that exists, {self.shared} is none")

    def check(self) -> None:
        """Raise for options that have no effect without workers, and for what is no executor."""
        if self.executor is not None:
            check_executor(self.executor)
            return
        unused = [name for name in changed(self) if name != "threads"]
        if unused:
            raise ValueError(
                f"{unused[0]} is for renders by workers: give an executor too, or on the command line "
                "--processes or --dask"
            )


GROUPS: dict[str, type[Any]] = {
    "sampling": Sampling,
    "training": Training,
    "stopping": Stopping,
    "files": Files,
    "machine": Machine,
}


def gathered(groups: Mapping[str, object | None], options: Mapping[str, object]) -> dict[str, Any]:
    """The groups of options, by name: each as it was given or by default, with single options set.

    Parameters
    ----------
    groups : mapping
        Instances of some of `GROUPS`, or None, by the group's name.
    options : mapping
        Single options by their own names.

    Raises
    ------
    TypeError
        For a group of another type, and an option that no group has.
    """
    found = {}
    left = dict(options)
    for name, group in groups.items():
        kind = GROUPS[name]
        given = kind() if group is None else group
        if not isinstance(given, kind):
            raise TypeError(f"{name} must be a {kind.__name__}, got {given!r}")
        own = {one.name for one in dataclasses.fields(kind)} & left.keys()
        found[name] = dataclasses.replace(given, **{one: left.pop(one) for one in own})
    if left:
        known = [one.name for name in groups for one in dataclasses.fields(GROUPS[name])]
        unknown = sorted(left)[0]
        near = difflib.get_close_matches(unknown, known, 1)
        hint = f"; did you mean {near[0]!r}?" if near else f"; there are {', '.join(sorted(known))}"
        raise TypeError(f"there is no option {unknown!r}{hint}")
    return found


def changed(group: Any) -> list[str]:
    """Names of the options that differ from their defaults."""
    default = type(group)()
    names = [one.name for one in dataclasses.fields(group)]
    return [name for name in names if getattr(group, name) is not getattr(default, name)
            and getattr(group, name) != getattr(default, name)]  # fmt: skip


def choices_of(hint: object) -> tuple[str, ...]:
    """The texts that are values of this type."""
    if typing.get_origin(hint) is Literal:
        return typing.get_args(hint)
    return tuple(text for part in typing.get_args(hint) for text in choices_of(part))


def check_choices(group: Any) -> None:
    """Raise for a text that is not one of an option's choices."""
    hints = typing.get_type_hints(type(group))
    for one in dataclasses.fields(group):
        value, choices = getattr(group, one.name), choices_of(hints[one.name])
        numeric = float in typing.get_args(hints[one.name])
        if not choices or numeric or (value is None and NoneType in typing.get_args(hints[one.name])):
            continue
        if not isinstance(value, str) or value not in choices:
            raise ValueError(f"{one.name} must be one of {', '.join(choices)}, got {value!r}")


def checked_whole(name: str, value: object, most: int) -> int:
    """A whole number from 1 to `most`, whatever type of number it was; raises for anything else."""
    # Not 1 <= value: Real declares the other order alone.
    if (
        isinstance(value, numbers.Real)
        and not isinstance(value, bool)
        and not value < 1
        and value <= most
    ):
        # Every Real converts, which its hints leave out.
        whole = int(value)  # type: ignore[call-overload]
        if whole == value:
            return whole
    raise ValueError(f"{name} must be a whole number of at least 1 and at most {most}, got {value!r}")


def check_real(name: str, value: object, most: float, other: str = "") -> None:
    """Raise for anything but a positive finite number up to `most`."""
    if (
        not isinstance(value, numbers.Real)
        or isinstance(value, bool)
        or value <= 0
        or not value <= most
        or value == math.inf
    ):
        raise ValueError(f"{name} must be a positive number{other}, got {value!r}")
