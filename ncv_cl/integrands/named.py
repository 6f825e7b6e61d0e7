"""Integrands by name: those of the package, and classes in other people's files."""

from __future__ import annotations

import hashlib
import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType

from . import INTEGRANDS
from .base import Integrand, IntegrandError

# Begins the names of modules that are files of other people.
FILE_MODULE = "ncv_cl_integrand_"


def named_integrand(name: str) -> Integrand:
    """The integrand of that name with its default options.

    Parameters
    ----------
    name : str
        One of `INTEGRANDS`, or ``FILE.py:NAME``: in that Python file, a class that is made without
        arguments, or an object. The file is read anew each time.

    Raises
    ------
    ValueError
        If it is neither (`IntegrandError`: if there is no such file or class, or Python fails there).
    """
    if name in INTEGRANDS:
        return INTEGRANDS[name]()
    file, separator, attribute = name.rpartition(":")
    if not separator:
        known = ", ".join(INTEGRANDS)
        raise ValueError(f"integrand must be one of {known}, or FILE.py:CLASS, got {name!r}")
    module = module_of(Path(file))
    found = getattr(module, attribute, None)
    if isinstance(found, type) and issubclass(found, Integrand):
        try:
            found = found()
        except TypeError as error:
            raise IntegrandError(
                f"{name} cannot be made without arguments: {error}. Make an object in the file and name "
                "that, or render from Python"
            ) from error
    if not isinstance(found, Integrand):
        there = ", ".join(_integrands_in(module)) or "none"
        raise IntegrandError(f"{file} has no integrand {attribute!r}; those it has: {there}")
    return found


def module_of(path: Path) -> ModuleType:
    """The file, run as a module of a name that no other file has."""
    if path.suffix != ".py":
        raise IntegrandError(f"an integrand's file must end in .py: {path}")
    if not path.is_file():
        raise IntegrandError(f"there is no file {path}")
    digest = hashlib.sha256(str(path.resolve()).encode()).hexdigest()
    name = f"{FILE_MODULE}{digest[:16]}"
    spec = importlib.util.spec_from_file_location(name, path.resolve())
    if spec is None or spec.loader is None:
        raise IntegrandError(f"{path} cannot be loaded as Python")
    module = importlib.util.module_from_spec(spec)
    # Classes find their folder, and dataclasses their names, by way of this.
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise IntegrandError(f"{_place(path, error)}: {type(error).__name__}: {error}") from error
    return module


def _place(path: Path, error: Exception) -> str:
    """The file, and the line of it in which running it failed."""
    if isinstance(error, SyntaxError):
        return f"{path}:{error.lineno}"
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == str(path.resolve())]
    return f"{path}:{lines[-1]}" if lines else str(path)


def _integrands_in(module: ModuleType) -> list[str]:
    """Names of the classes and objects that a file defines."""
    found = []
    for name, value in vars(module).items():
        is_class = isinstance(value, type) and issubclass(value, Integrand)
        if isinstance(value, Integrand) or (is_class and value.__module__ == module.__name__):
            found.append(name)
    return found
