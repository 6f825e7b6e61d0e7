"""Forms of a kernel, which are judged apart: what most scenes take is not to hide behind what few do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from every_program import Built

# Of a scene: what is more than matte or glossy surfaces and a few parallelograms as lights.
_RARE = ("HAS_GLASS", "HAS_TEXTURES", "HAS_NORMAL_MAPS", "HAS_COLOURS", "HAS_EMISSION", "HAS_SHAPES")
_OF_SCENES = (
    *("draw_samples", "unshadowed_means", "find_lobe_shares", "find_occluders"),
    *("begin_paths", "shade_hits", "share_rays", "share_paths"),
)
_OF_NETWORKS = ("accumulate", "column_moments", "gradients", "fold")
_MOST_LIGHTS, _MOST_NEURONS = 2, 16
# Constants that say which code there is, not how much of it.
_KINDS = ("SAMPLER", "HEMISPHERE", "DOUBLE", "LONE", "LISTED", "METHOD_FULL", "WARPED", "WEIGHTED")


def form_of(kernel: str, one: Built) -> str:
    """The form that a program has of a kernel, in words; nothing for kernels of one form."""
    words = []
    if kernel == "draw_samples":
        words += ["lines"] if "along" in one.files else ["slices"] if "slices" in one.files else []
    if kernel in _OF_SCENES:
        words += ["any scene"] if _is_rare(one) else []
    if kernel == "accumulate":
        words += ["shared paths"] if _number(one, "ENTRIES") > 1 else []
    if kernel in _OF_NETWORKS:
        words += ["wide network"] if _number(one, "HIDDEN1") > _MOST_NEURONS else []
    if kernel == "integrate":
        words += ["a work-item a point" if _number(one, "LONE") else "a group a point"]
        words += ["double"] if _number(one, "DOUBLE") else []
    return ", ".join(words)


def _is_rare(one: Built) -> bool:
    rare = any(_number(one, name) for name in (*_RARE, "HAS_ENVIRONMENT", "HAS_CLUSTERS"))
    return rare or _number(one, "LIGHT_COUNT") > _MOST_LIGHTS


def _number(one: Built, name: str) -> float:
    return _as_number(one.defines.get(name, 0)) or 0.0


def _as_number(value: int | str) -> float | None:
    try:
        return float(str(value).rstrip("uf"))
    except ValueError:
        return None


def worst_programs(programs: Sequence[Built]) -> list[Built]:
    """Programs with those of their kernels that may take most of their form.

    Left out are kernels that another program has in the same form, with all their code and more.
    """
    found = []
    for one in programs:
        others = [other for other in programs if _holds(other, one)]
        own = {name: group for name, group in one.groups.items() if not _any_has(others, name, one)}
        if own:
            found.append(replace(one, groups=own))
    return found


def _any_has(others: Sequence[Built], kernel: str, one: Built) -> bool:
    """Whether some of the programs launches a kernel in the same form."""
    return any(
        other.groups.get(kernel) == one.groups[kernel] and form_of(kernel, other) == form_of(kernel, one)
        for other in others
    )


def _holds(more: Built, less: Built) -> bool:
    """Whether one program has all the code that another has, and something more."""
    if more.files != less.files or more.defines.keys() != less.defines.keys():
        return False
    has_more = False
    for name, own in less.defines.items():
        other = more.defines[name]
        if own == other:
            continue
        numbers = _as_number(own), _as_number(other)
        if name in _KINDS or None in numbers or numbers[0] > numbers[1]:
            return False
        has_more = True
    return has_more
