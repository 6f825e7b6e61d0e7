"""Where caches may be written: ours, pyopencl's and PoCL's; and what to do where nothing may be.

A home that is missing, read-only or somebody else's costs time, never a render.
"""

from __future__ import annotations

import atexit
import importlib
import os
import shutil
import sqlite3
import tempfile
from pathlib import Path

import platformdirs
import pyopencl as cl

_POCLS_VARIABLE = "POCL_CACHE_DIR"


def cache_folder(name: str) -> Path | None:
    """The user's folder for the caches of a program; None where there is no home to hold it."""
    try:
        folder = Path(platformdirs.user_cache_dir(name, name))
    except RuntimeError:
        return None
    # Older versions leave "~" as it is, where neither HOME nor the system's list of users knows a home.
    return folder if folder.is_absolute() else None


def prepare_caches() -> None:
    """Turn off or move what could not be written; to be called before runtimes are loaded."""
    _prepare_pyopencls()
    _prepare_pocls()


def _prepare_pyopencls() -> None:
    """pyopencl keeps binaries, and in a database of pytools how kernels are called."""
    if all(_writable(cache_folder(name)) for name in ("pytools", "pyopencl")):
        try:
            importlib.import_module("pyopencl.invoker")
            return
        except (OSError, sqlite3.Error):
            # A database that is damaged, or on a disk that is full.
            pass
    # What PYOPENCL_NO_CACHE sets, which is read only when pyopencl is imported.
    cl._PYOPENCL_NO_CACHE = True


def _prepare_pocls() -> None:
    """PoCL has no device where it cannot write, so it gets a folder that goes with the process."""
    named = os.environ.get(_POCLS_VARIABLE)
    folder = Path(named) if named else cache_folder("pocl")
    if _writable(folder):
        if not any(os.environ.get(name) for name in (_POCLS_VARIABLE, "XDG_CACHE_HOME", "HOME")):
            # PoCL knows homes by these variables only, and would share a folder with all users.
            os.environ[_POCLS_VARIABLE] = str(folder / "kcache")
        return
    temporary = tempfile.mkdtemp(prefix="ncv_cl-pocl-")
    os.environ[_POCLS_VARIABLE] = temporary
    owner = os.getpid()

    def remove() -> None:
        # A forked process ends without taking its parent's folder along.
        if os.getpid() == owner:
            shutil.rmtree(temporary, ignore_errors=True)

    atexit.register(remove)


def _writable(folder: Path | None) -> bool:
    """Whether files can be made in a folder, and those that are there be changed."""
    if folder is None:
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            # Asks for space as well.
            file.write(bytes(4096))
            file.flush()
        # Other processes may take theirs away meanwhile.
        return all(os.access(path, os.W_OK) or not path.exists() for path in folder.iterdir())
    except OSError:
        return False
