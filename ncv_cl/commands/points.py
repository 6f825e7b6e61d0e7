"""The command `ncv-cl sense`: values at points of a file."""

from __future__ import annotations

import argparse

from ..host.console import point_summary, say
from ..host.files import check_paths
from ..host.interrupt import StopOnSignal
from ..integrands import AmbientOcclusion
from ..output.point_files import check_suffix, read_points, write_values
from ..sensing.point_estimate import POINT_GROUPS
from ..sensing.sense import ambient_occlusion, irradiance
from ..settings.arguments import add_arguments, read_arguments
from ..settings.options import GROUPS
from .common import Help, add_common, add_scene, load, workers, write_json


def add_sense(commands: argparse._SubParsersAction) -> None:
    """The command and its arguments."""
    text = "irradiance or ambient occlusion at points, with standard errors"
    parser = commands.add_parser("sense", help=text, description=text, formatter_class=Help)
    add = parser.add_argument
    add_scene(parser, is_seen=False)
    add("points", help="positions and normals: .csv (x,y,z,nx,ny,nz), .npy (n, 6) or .ply")
    add(
        "--integrand",
        choices=("direct", "gi", "ao"),
        default="direct",
        help="irradiance by light straight from lights, by all light, or ambient occlusion",
    )
    add("--both-sides", action="store_true", help="add the irradiance of the sensors' other sides")
    add("--radius", type=float, help="ambient occlusion: farthest occluder (default: any)")
    add("-o", "--output", required=True, metavar="FILE", help=".csv, .npy or .ply")
    add("--target-error", type=float, metavar="E", help="end at this root mean square standard error")
    add_common(parser)
    for name in POINT_GROUPS:
        add_arguments(parser, GROUPS[name])
    parser.set_defaults(command=_sense)


def _sense(options: argparse.Namespace) -> int:
    check_suffix(options.output)
    check_paths(
        {"--output": options.output, "--json": options.json},
        {"the scene": options.scene, "the points": options.points},
    )
    points = read_points(options.points)
    own = {}
    if options.integrand != AmbientOcclusion.name:
        own = {"integrand": options.integrand, "both_sides": options.both_sides}
    elif options.both_sides:
        raise ValueError("--both-sides is for irradiance")
    if options.radius is not None:
        if options.integrand != AmbientOcclusion.name:
            raise ValueError("--radius is for --integrand ao only")
        own["radius"] = options.radius
    chosen = [read_arguments(options, GROUPS[name]) for name in POINT_GROUPS]
    names = ("method", "spp", "seed", "device", "target_error")
    with workers(options) as executor, StopOnSignal() as stop:
        found = (ambient_occlusion if options.integrand == AmbientOcclusion.name else irradiance)(
            load(options),
            points[:, :3],
            points[:, 3:],
            progress=True,
            stop=stop,
            executor=executor,
            **own,
            **{name: getattr(options, name) for name in names},
            **{name: value for group in chosen for name, value in group.items()},
        )
    write_values(options.output, points, found.values, found.standard_error)
    if options.json:
        write_json(options.json, found.stats)
    say(point_summary(found.stats))
    say(f"wrote {options.output}")
    return 0
