"""What a scene's description says of its environment, checked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...host.reach import OutsideError, Reach
from ..table import SceneError, Table
from .environment import SUN_DIAMETER, UP, Environment, Sun
from .image import SkyError, aspect_remark, check_sky, read_sky

KEYS = ("radiance", "file", "scale", "rotation", "up", "sky", "zenith", "sun")
DIRECTIONAL = "directional"
DIRECTIONAL_KEYS = ("kind", "direction", "irradiance", "angle")
SKIES = ("overcast", "clear")
# Every sample looks at all of them.
MOST_SUNS = 16
# Angles within which a disc is smaller than what single precision resolves well.
_SMALLEST_DIAMETER = 0.01


def read_environment(root: Table, folder: Path, reach: Reach) -> tuple[Environment | None, list[str]]:
    """The table ``environment``, if there is one, and warnings; files are relative to `folder`."""
    if "environment" not in root:
        return None, []
    table = Table(root.source, "environment", root.raw("environment"), KEYS)
    kinds = [key for key in ("radiance", "file", "sky") if key in table]
    if len(kinds) > 1:
        raise table.error(kinds[1], f"cannot be combined with {kinds[0]}; give one or the other")
    if not kinds and "sun" not in table:
        raise SceneError(f"{root.source}: environment: give radiance, file, sky or sun")
    _check_used(table, kinds)
    up = table.vector("up", UP)
    if not np.any(up):
        raise table.error("up", "has no length")
    rotation = table.number("rotation", 0.0)
    blank = Environment(np.zeros(3, np.float32), rotation, up)
    sun = _read_sun(table, blank.axes) if "sun" in table else None
    suns = (sun,) if sun is not None and np.any(sun.irradiance) else ()
    warnings: list[str] = []
    if "radiance" in table:
        return replace(blank, radiance=table.colour("radiance"), suns=suns), warnings
    if "file" in table:
        texels = _read_file(table, folder, reach, warnings)
        return replace(blank, radiance=texels, suns=suns), warnings
    if "sky" not in table:
        return replace(blank, suns=suns), warnings
    zenith = table.colour("zenith", 1.0)
    if table.choice("sky", SKIES, "") == "overcast":
        return replace(Environment.overcast(zenith, up), suns=suns), warnings
    if sun is None:
        raise table.error("sky", "the clear sky is brightest about the sun: give [environment.sun]")
    if blank.axes[1] @ sun.towards <= 0:
        raise table.error("sun", "is below the horizon, which a clear sky is not made for")
    found = Environment.clear(sun, zenith, up, rotation)
    return replace(found, suns=suns), warnings


def directional(table: Table) -> Sun:
    """A light of ``kind = "directional"``: a sun without a sky."""
    direction = table.vector("direction")
    if not np.any(direction):
        raise table.error("direction", "has no length")
    return Sun(-direction, table.colour("irradiance"), _diameter(table, "angle"))


def with_suns(
    source: Path | str, environment: Environment | None, suns: list[Sun]
) -> Environment | None:
    """The environment and more suns; those that are dark are left out."""
    suns = [sun for sun in suns if np.any(sun.irradiance)]
    if suns:
        own = environment or Environment(np.zeros(3, np.float32))
        environment = replace(own, suns=(*own.suns, *suns))
    if environment is not None and len(environment.suns) > MOST_SUNS:
        raise SceneError(
            f"{source}: there are {len(environment.suns)} suns and directional lights; at most "
            f"{MOST_SUNS} are rendered"
        )
    return environment


def checked(source: str, environment: Environment) -> tuple[Environment, list[str]]:
    """An environment that was made in Python, in the types that are documented, and warnings."""
    if not isinstance(environment, Environment):
        raise SceneError(f"{source}: environment: expected an Environment, got {environment!r}")
    data = {"up": environment.up, "rotation": environment.rotation}
    table = Table(source, "environment", data, KEYS)
    up, rotation = table.vector("up"), table.number("rotation")
    if not np.any(up):
        raise table.error("up", "has no length")
    radiance = np.asarray(environment.radiance)
    if radiance.shape not in ((), (3,)) and (radiance.ndim != 3 or radiance.shape[2] != 3):
        raise table.error("radiance", f"must be (3,) or (height, width, 3), is {radiance.shape}")
    if radiance.dtype.kind not in "fiu" or not radiance.size:
        raise table.error("radiance", f"must be numbers, is {radiance.dtype} {radiance.shape}")
    with np.errstate(over="ignore"):
        radiance = np.array(np.broadcast_to(radiance, radiance.shape or (3,)), np.float32)
    try:
        check_sky(radiance.reshape(-1, radiance.size // 3, 3) if radiance.ndim == 1 else radiance)
    except SkyError as error:
        raise table.error("radiance", str(error)) from error
    remark = aspect_remark(radiance) if radiance.ndim == 3 and radiance.shape[1] > 1 else None
    suns = [_checked_sun(source, index, sun) for index, sun in enumerate(environment.suns)]
    suns = [sun for sun in suns if np.any(sun.irradiance)]
    radiance.setflags(write=False)
    warnings = [str(table.error("radiance", remark))] if remark else []
    return Environment(radiance, rotation, up, tuple(suns)), warnings


def _check_used(table: Table, kinds: list[str]) -> None:
    """Raise where a key has nothing to do."""
    owners = {"scale": ("file",), "zenith": ("sky",)}
    for key, of in owners.items():
        if key in table and not set(of) & set(kinds):
            raise table.error(key, f"is for {' and '.join(of)}; there is none")
    if "rotation" in table and not ({"file", "sky"} & set(kinds) or "sun" in table):
        raise table.error("rotation", "turns an image or a sun's azimuth; there is none")


def _read_file(table: Table, folder: Path, reach: Reach, warnings: list[str]) -> NDArray[np.float32]:
    name, scale = table.text("file"), table.number("scale", 1.0, low=0.0)
    try:
        found = read_sky(reach.checked(folder / name))
        with np.errstate(over="ignore"):
            found = found * np.float32(scale)
        check_sky(found)
    except (SkyError, OutsideError) as error:
        raise table.error(f"file: {Path(name).name}", str(error)) from error
    remark = aspect_remark(found)
    if remark:
        warnings.append(str(table.error(f"file: {Path(name).name}", remark)))
    found.setflags(write=False)
    return found


def _read_sun(table: Table, axes: NDArray[np.float64]) -> Sun:
    keys = ("direction", "elevation", "azimuth", "angular_diameter", "irradiance")
    sun = Table(table.source, "environment.sun", table.raw("sun"), keys)
    if "direction" in sun:
        for key in ("elevation", "azimuth"):
            if key in sun:
                raise sun.error(key, "cannot be combined with direction; give one or the other")
        direction = sun.vector("direction")
        if not np.any(direction):
            raise sun.error("direction", "has no length")
    else:
        elevation = np.radians(sun.number("elevation", low=-90.0, high=90.0))
        azimuth = np.radians(sun.number("azimuth", 0.0))
        level = np.cos(elevation)
        own = [level * np.sin(azimuth), np.sin(elevation), -level * np.cos(azimuth)]
        direction = np.array(own) @ axes
    return Sun(direction, sun.colour("irradiance"), _diameter(sun, "angular_diameter"))


def _diameter(table: Table, key: str) -> float:
    return table.number(key, SUN_DIAMETER, low=_SMALLEST_DIAMETER, high=90.0)


def _checked_sun(source: str, index: int, sun: Sun) -> Sun:
    where = f"environment.suns[{index}]"
    if not isinstance(sun, Sun):
        raise SceneError(f"{source}: {where}: expected a Sun, got {sun!r}")
    table = Table(source, where, dict(vars(sun)), tuple(vars(sun)))
    direction = table.vector("direction")
    if not np.any(direction):
        raise table.error("direction", "has no length")
    return Sun(direction, table.colour("irradiance"), _diameter(table, "angular_diameter"))
