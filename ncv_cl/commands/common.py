"""What commands share: help that says defaults, arguments of every estimate, statistics as a file."""

from __future__ import annotations

import argparse
import contextlib
import json
from collections.abc import Iterator
from concurrent.futures import Executor
from typing import Any

from ..host.files import write_whole
from ..machines.processes import Processes
from ..scene.load import load_scene
from ..scene.model import Scene
from ..settings.settings import METHODS


class Help(argparse.HelpFormatter):
    """Says defaults, where there are any."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default in (None, argparse.SUPPRESS) or action.required or action.nargs == 0:
            return action.help
        default = (
            "x".join(map(str, action.default)) if isinstance(action.default, tuple) else "%(default)s"
        )
        return f"{action.help} (default: {default})"


def add_scene(parser: argparse.ArgumentParser, is_seen: bool = True) -> None:
    """The scene file, as the first argument, and how it is read; `is_seen`: by a camera."""
    add = parser.add_argument
    add("scene", help="scene file: .toml, .gltf, .glb, .obj, .ply, .stl or Mitsuba's .xml")
    add_reading(parser, is_seen)


def add_reading(parser: argparse.ArgumentParser, is_seen: bool = True) -> None:
    """How a scene file is read."""
    add = parser.add_argument_group("scene file").add_argument
    if is_seen:
        add("--camera", metavar="NAME", help="one of the file's cameras (default: the first)")
    add("--allow-outside", action="store_true", help="read files outside of the scene file's folder")


def read_options(options: argparse.Namespace) -> dict[str, Any]:
    """Keywords of `load_scene`."""
    camera = getattr(options, "camera", None)
    return {"camera": camera, "allow_outside": options.allow_outside}


def load(options: argparse.Namespace) -> Scene:
    """The scene that is asked for."""
    return load_scene(options.scene, **read_options(options))


def add_common(parser: argparse.ArgumentParser) -> None:
    """Arguments of all that is estimated."""
    add = parser.add_argument
    add(
        "--method",
        choices=METHODS,
        default="auto",
        help="neural control variate, Monte Carlo, or by a rule what reaches an error sooner",
    )
    add("--spp", type=int, default=256, metavar="N", help="samples a shading point; see --visibility")
    add("--seed", type=int, default=0, metavar="S", help="from 0 to 2**64 - 1")
    add("--device", metavar="D", help="index or part of a name, see `ncv-cl devices`")
    add("--json", metavar="FILE", help="write the statistics here")
    add("--processes", type=int, metavar="N", help="draw the samples by so many processes")
    add("--dask", metavar="ADDRESS", help="by the workers of a Dask scheduler, such as tcp://HOST:8786")


@contextlib.contextmanager
def workers(options: argparse.Namespace) -> Iterator[Executor | None]:
    """The executor that the command line asks for, if it does.

    Raises
    ------
    ValueError
        If both are asked for, or Dask is not installed or does not answer.
    """
    if options.processes is not None and options.dask is not None:
        raise ValueError("give either --processes or --dask, not both")
    if options.processes is not None:
        with Processes(options.processes) as executor:
            yield executor
    elif options.dask is not None:
        with _dask(options.dask) as executor:
            yield executor
    else:
        yield None


@contextlib.contextmanager
def _dask(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise ValueError("--dask needs Dask: pip install 'ncv_cl[dask]'") from error
    try:
        client = Client(address)
    except (OSError, ValueError) as error:
        raise ValueError(f"--dask: no scheduler answers at {address} ({error})") from error
    with client:
        yield client.get_executor()


def write_json(path: str, stats: dict[str, Any]) -> None:
    """Write statistics, in which nothing is NaN or infinite."""
    text = json.dumps(stats, indent=1, allow_nan=False) + "\n"
    write_whole(path, lambda file: file.write(text.encode()))
