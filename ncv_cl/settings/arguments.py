"""Groups of options as arguments of a command line, described by the groups' own docstrings."""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import re
import typing
from collections.abc import Callable
from pathlib import Path
from types import NoneType
from typing import Any

from .options import choices_of


def descriptions(group: type[Any]) -> dict[str, str]:
    """What a group's docstring says of each option, one line each."""
    _, _, attributes = (inspect.getdoc(group) or "").partition("Attributes\n----------\n")
    found: dict[str, str] = {}
    name = ""
    for line in attributes.splitlines():
        head = re.match(r"(\w+) : ", line)
        if head:
            name = head.group(1)
            found[name] = ""
        elif name:
            found[name] = f"{found[name]} {line.strip()}".strip()
    return found


def add_arguments(parser: argparse.ArgumentParser, group: type[Any]) -> None:
    """An argument for each option that a text can give."""
    title = (inspect.getdoc(group) or group.__name__).splitlines()[0].rstrip(".")
    own = parser.add_argument_group(title)
    hints, texts = typing.get_type_hints(group), descriptions(group)
    for option in dataclasses.fields(group):
        hint = hints[option.name]
        flag, about = f"--{option.name.replace('_', '-')}", texts[option.name].replace("%", "%%")
        if hint is bool and option.default:
            own.add_argument(f"--no-{flag[2:]}", dest=option.name, action="store_false", help=about)
        elif hint is bool:
            own.add_argument(flag, action="store_true", help=about)
        elif _reader(hint) is not None:
            choices = choices_of(hint)
            plain = bool(choices) and float not in typing.get_args(hint)
            form: dict[str, Any] = {"type": _reader(hint), "metavar": _metavar(hint)}
            if plain:
                form = {"choices": choices}
            own.add_argument(flag, default=option.default, **form, help=about)


def read_arguments(options: argparse.Namespace, group: type[Any]) -> dict[str, Any]:
    """The options of a group that `add_arguments` has put into a command line."""
    names = [option.name for option in dataclasses.fields(group)]
    return {name: getattr(options, name) for name in names if hasattr(options, name)}


def _reader(hint: object) -> Callable[[str], object] | None:
    """What makes an option of a text; None for options that no text can give."""
    kinds = {hint, *typing.get_args(hint)} - {NoneType}
    choices = choices_of(hint)
    if float in kinds and choices:
        return lambda text: text if text in choices else _number(text, choices)
    if choices or str in kinds or Path in kinds:
        return str
    return next((kind for kind in (int, float) if kind in kinds), None)


def _metavar(hint: object) -> str:
    if hint is str:
        return "NAME"
    return "FILE" if str in typing.get_args(hint) else "N"


def _number(text: str, choices: tuple[str, ...]) -> float:
    try:
        return float(text)
    except ValueError:
        expected = " or ".join(("a number", *choices))
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}") from None
