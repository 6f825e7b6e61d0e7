"""Tables as the text of a TOML file."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

# Whole numbers below are written without a point.
_WHOLE = 1e15
_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(tables: Mapping[str, Any]) -> str:
    """The text of a scene file: values first, then tables and arrays of tables, in their order.

    Tables in tables become sections too, but for those in arrays and for images, which are inline.
    """
    plain = {k: v for k, v in tables.items() if not _is_section(v)}
    parts = [_pairs(plain)] if plain else []
    for key, value in tables.items():
        if isinstance(value, Mapping):
            parts += _sections(_key(key), value)
        elif _is_section(value):
            parts += [f"[[{_key(key)}]]\n{_pairs(entry)}" for entry in value]
    return "\n\n".join(parts) + "\n"


def quoted(text: str) -> str:
    """A basic string of TOML: one of JSON, which does not escape DEL; half of a pair is no character."""
    whole = text.encode("utf-8", errors="replace").decode("utf-8")
    return json.dumps(whole, ensure_ascii=False).replace("\x7f", "\\u007f")


def _sections(name: str, table: Mapping[str, Any]) -> list[str]:
    """A table, and tables in it, which are sections of their own unless they are images."""
    inner = {k: v for k, v in table.items() if isinstance(v, Mapping) and "file" not in v}
    own = {k: v for k, v in table.items() if k not in inner}
    parts = [f"[{name}]\n{_pairs(own)}"] if own or not inner else []
    for key, value in inner.items():
        parts += _sections(f"{name}.{_key(key)}", value)
    return parts


def _is_section(value: object) -> bool:
    if isinstance(value, Mapping):
        return True
    return isinstance(value, list) and bool(value) and all(isinstance(one, Mapping) for one in value)


def _pairs(table: Mapping[str, Any]) -> str:
    return "\n".join(f"{_key(key)} = {_value(value)}" for key, value in table.items())


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else quoted(key)


def _value(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{_key(k)} = {_value(v)}' for k, v in value.items())} }}"
    if isinstance(value, (list, tuple, np.ndarray)):
        return f"[{', '.join(map(_value, value))}]"
    number = float(value)
    return repr(int(number)) if number.is_integer() and abs(number) < _WHOLE else repr(number)
