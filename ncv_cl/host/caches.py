"""Which cache folders are writable (pyopencl's, PoCL's), and what to do where none is.

A home that is missing, read-only or somebody else's makes a render slower, but does not make it fail.
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
    """Turn off or move the caches that cannot be written. Call this before a runtime is loaded."""
    _prepare_pyopencls()
    _prepare_pocls()


def _prepare_pyopencls() -> None:
    """pyopencl keeps compiled programs, and in a database of pytools its generated call code."""
    if all(_writable(cache_folder(name)) for name in ("pytools", "pyopencl")):
        try:
            importlib.import_module("pyopencl.invoker")
            return
        except (OSError, sqlite3.Error):
            # A database that is damaged, or on a disk that is full.
            pass
    # The variable PYOPENCL_NO_CACHE sets this too, but it is read only when pyopencl is imported.
    cl._PYOPENCL_NO_CACHE = True


def _prepare_pocls() -> None:
    """PoCL offers no device where it cannot write: give it a folder until the process ends."""
    named = os.environ.get(_POCLS_VARIABLE)
    folder = Path(named) if named else cache_folder("pocl")
    if folder is not None and _writable(folder):
        if not any(os.environ.get(name) for name in (_POCLS_VARIABLE, "XDG_CACHE_HOME", "HOME")):
            # PoCL knows homes by these variables only, and would share a folder with all users.
            os.environ[_POCLS_VARIABLE] = str(folder / "kcache")
        return
    temporary = tempfile.mkdtemp(prefix="ncv_cl-pocl-")
    os.environ[_POCLS_VARIABLE] = temporary
    owner = os.getpid()

    def remove() -> None:
        # A forked process must not remove its parent's folder when it ends.
        if os.getpid() == owner:
            shutil.rmtree(temporary, ignore_errors=True)

    atexit.register(remove)


def _writable(folder: Path | None) -> bool:
    """Whether new files can be made in a folder and the existing ones changed."""
    if folder is None:
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            # Fails on a full disk, which creating a file does not.
            file.write(bytes(4096))
            file.flush()
        # Another process may have deleted a file since it was listed.
        return all(os.access(path, os.W_OK) or not path.exists() for path in folder.iterdir())
    except OSError:
        return False
