"""The console script `ncv-cl`."""

from __future__ import annotations

import argparse
import functools
import itertools
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from .commands.bake import add_bake
from .commands.common import Help, add_common, add_scene, load, workers, write_json
from .commands.points import add_sense
from .commands.scene_files import add_import, add_info
from .host.console import EXPECTED, complain, one_line, run, say, summary
from .host.files import check_paths, read_arrays, write_whole
from .host.interrupt import StopOnSignal
from .host.version import package_version
from .integrands import INTEGRANDS, AmbientOcclusion, GlobalIllumination, Integrand
from .integrands.ao import MAPPINGS
from .integrands.named import named_integrand
from .integration.certificate import PRECISIONS
from .integration.integrate import integrate
from .integration.integrator import INTEGRATION_METHODS
from .integration.subdivide import draw_subdivision, subdivide
from .opencl.choose import devices
from .output.image import Image, check_output_path
from .rendering.render import render
from .settings.arguments import add_arguments, read_arguments
from .settings.options import GROUPS

# Beside the package in a checkout and in an editable install.
_BENCH = Path(__file__).parent.parent / "bench"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit status (2 for bad input)."""
    options = _parser().parse_args(arguments)
    return run(lambda: options.command(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ncv-cl", description="Neural control variates for light transport, in OpenCL."
    )
    parser.add_argument("--version", action="version", version=f"ncv_cl {package_version()}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_render(commands)
    add_sense(commands)
    add_bake(commands)
    _add_subdivide(commands)
    _add_integrate(commands)
    add_info(commands)
    add_import(commands)
    listing = commands.add_parser("devices", help="list the OpenCL devices and how fast they are")
    listing.set_defaults(command=_devices)
    _add_bench(commands)
    return parser


def _add_render(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "render",
        help="render a scene",
        formatter_class=Help,
    )
    add = parser.add_argument
    add_scene(parser)
    add(
        "--integrand",
        type=_integrand_name,
        default="direct",
        metavar="NAME",
        help=f"what to integrate: {', '.join(sorted(INTEGRANDS))}, or your own class, FILE.py:CLASS",
    )
    add_common(parser)
    add("--size", type=_size, default=(512, 512), metavar="WxH", help="pixels")
    add(
        "-o",
        "--output",
        action="append",
        required=True,
        metavar="FILE",
        help=".exr or .png; repeatable",
    )
    _add_integrand_options(parser)
    for group in GROUPS.values():
        add_arguments(parser, group)
    parser.set_defaults(command=_render)


def _add_integrand_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("options of integrands").add_argument
    add("--radius", type=float, help="ambient occlusion: farthest occluder (default: any)")
    add("--mapping", choices=MAPPINGS, help="ambient occlusion: hemisphere mapping (default: height)")
    add(
        "--max-depth", type=int, metavar="D", help="global illumination: most edges of a path, 2: direct"
    )
    add("--clamp", type=float, metavar="L", help="global illumination: most that a path brings (biased)")


_LAYERS_HELP = "arrays weights0, biases0, weights1, ... of a ReLU network of (u, v) (.npz)"


def _add_subdivide(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("subdivide", help="draw the cells in which a network is affine")
    parser.add_argument("network", help=_LAYERS_HELP)
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=".png or .svg")
    parser.add_argument("--channel", type=int, default=0, metavar="C", help="output to colour by")
    parser.add_argument("--device", metavar="D", help="as for render")
    parser.set_defaults(command=_subdivide)


def _add_integrate(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("integrate", help="integrate a network over the unit square")
    parser.add_argument("network", help=_LAYERS_HELP + "; any with a leading points axis")
    parser.add_argument("-o", "--output", metavar="FILE", help="write the integrals here (.npy)")
    parser.add_argument("--method", choices=INTEGRATION_METHODS, default="decoupled")
    parser.add_argument("--precision", choices=tuple(PRECISIONS), default="float32")
    parser.add_argument("--device", metavar="D", help="as for render")
    parser.set_defaults(command=_integrate)


def _read_layers(path: str) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weights and biases from an ``.npz``; `integrate` checks shapes and values."""
    arrays = read_arrays(path)
    layers = itertools.takewhile(lambda k: f"weights{k}" in arrays, itertools.count())
    names = [(f"weights{k}", f"biases{k}") for k in layers]
    missing = [bias for _, bias in names if bias not in arrays] if names else ["weights0"]
    others = set(arrays) - set(itertools.chain(*names))
    if missing or others:
        found = f"there is no {missing[0]}" if missing else f"{sorted(others)[0]} is none of these"
        raise ValueError(f"{path} does not hold {_LAYERS_HELP}: {found}")
    return [arrays[weight] for weight, _ in names], [arrays[bias] for _, bias in names]


def _add_bench(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("bench", help="measure run time against error and write a report")
    add = parser.add_argument
    add("parts", nargs="*", metavar="PART", help="curves, planar, mitsuba, ...; default: all of them")
    add("--quick", action="store_true", help="all at reduced size, in less than ten minutes")
    add("--out", metavar="DIR", help="where results and report go (default: bench-report)")
    add("--device", metavar="D", help="as for render")
    add("--options", metavar="TEXT", help="for one part's script, as --options='--size 128'")
    parser.set_defaults(command=_bench)


def _bench(options: argparse.Namespace) -> int:
    script = _BENCH / "run_all.py"
    if not script.is_file():
        raise ValueError(
            "the benchmarks are not part of the installed package; run this from a checkout, after "
            'pip install -e ".[pocl,bench]"'
        )
    command = [sys.executable, str(script), *options.parts]
    command += ["--quick"] if options.quick else []
    command += ["--out", options.out] if options.out else []
    command += ["--device", options.device] if options.device else []
    command += [f"--options={options.options}"] if options.options else []
    return subprocess.call(command)


def _subdivide(options: argparse.Namespace) -> int:
    if Path(options.output).suffix not in (".png", ".svg"):
        raise ValueError(f"{options.output} must end in .svg or .png")
    check_paths({"--output": options.output}, {"the network": options.network})
    subdivision = subdivide(*_read_layers(options.network), device=options.device)
    draw_subdivision(subdivision, options.output, channel=options.channel)
    say(f"{len(subdivision.faces)} faces, integral {subdivision.integral().tolist()}")
    say(f"wrote {options.output}")
    return 0


def _integrate(options: argparse.Namespace) -> int:
    check_paths({"--output": options.output}, {"the network": options.network})
    integrals, statistics = integrate(
        *_read_layers(options.network),
        method=options.method,
        precision=options.precision,
        device=options.device,
        return_stats=True,
    )
    if options.output:
        # An open file, since numpy adds a suffix to names that have another one.
        write_whole(options.output, lambda file: np.save(file, integrals))
        say(f"wrote {options.output}")
    else:
        say("\n".join(" ".join(map(repr, map(float, row))) for row in integrals))
    print(
        f"{statistics.points} points, {statistics.faces} faces, {statistics.robust_points} done again "
        "on the robust path",
        file=sys.stderr,
    )
    return 0


def _size(text: str) -> tuple[int, int]:
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT such as 512x512, got {text!r}")
    return int(width), int(height)


def _integrand_name(text: str) -> str:
    if text not in INTEGRANDS and ":" not in text:
        known = ", ".join(sorted(INTEGRANDS))
        raise argparse.ArgumentTypeError(
            f"invalid choice: {text!r} (choose from {known}, or a class of your own, FILE.py:CLASS)"
        )
    return text


def _integrand(options: argparse.Namespace) -> Integrand:
    if options.integrand == AmbientOcclusion.name:
        given = {name: getattr(options, name) for name in ("radius", "mapping")}
        return AmbientOcclusion(**{k: v for k, v in given.items() if v is not None})
    if options.integrand == GlobalIllumination.name:
        return GlobalIllumination(options.max_depth, clamp=options.clamp)
    return named_integrand(options.integrand)


def _check_render(options: argparse.Namespace) -> None:
    """Raise for bad options and paths before the work begins."""
    own = {"radius": "ao", "mapping": "ao", "max_depth": "gi", "clamp": "gi"}
    for name, integrand in own.items():
        if getattr(options, name) is not None and options.integrand != integrand:
            raise ValueError(f"--{name.replace('_', '-')} is for --integrand {integrand} only")
    for path in options.output:
        check_output_path(path)
    outputs = {f"output {number}": path for number, path in enumerate(options.output, 1)}
    check_paths(
        {
            **outputs,
            "--json": options.json,
            "--save-network": options.save_network,
            "--checkpoint": options.checkpoint,
        },
        {"the scene": options.scene, "--reference": options.reference},
    )


def _render(options: argparse.Namespace) -> int:
    _check_render(options)
    with workers(options) as executor, StopOnSignal() as stop:
        return _render_and_write(options, stop, executor)


def _render_and_write(options: argparse.Namespace, stop: StopOnSignal, executor: Executor | None) -> int:
    chosen = [read_arguments(options, group) for group in GROUPS.values()]
    image = render(
        load(options),
        _integrand(options),
        method=options.method,
        spp=options.spp,
        size=options.size,
        seed=options.seed,
        device=options.device,
        progress=True,
        stop=stop,
        executor=executor,
        **{name: value for group in chosen for name, value in group.items()},
    )
    failed = _write_all(image, options)
    if stop.asked:
        say(f"stopped early: {image.stats['samples_per_point']} samples a point are in the image")
    say(summary(image.stats))
    say("wrote " + (", ".join(path for path in options.output if path not in failed) or "nothing"))
    return 2 if failed or image.stats.get("not_written") else 0


def _write_all(image: Image, options: argparse.Namespace) -> list[str]:
    """Write every file that can be; returns those that could not, after a line on each."""
    writers: dict[str, Callable[[], None]] = {
        path: functools.partial(image.write, path) for path in options.output
    }
    if options.json:
        writers[options.json] = lambda: write_json(options.json, image.stats)
    failed = []
    for path, write in writers.items():
        try:
            write()
        except EXPECTED as error:
            complain(one_line(error))
            failed.append(path)
    return failed


def _devices(options: argparse.Namespace) -> int:
    say(str(devices()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
