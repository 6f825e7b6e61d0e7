"""The version of ncv_cl that is installed."""

from __future__ import annotations

import functools
from importlib.metadata import PackageNotFoundError, version


@functools.cache
def package_version() -> str:
    """The installed version of ncv_cl, read once."""
    try:
        return version("ncv_cl")
    except PackageNotFoundError:
        return "unpackaged"
