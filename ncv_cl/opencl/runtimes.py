"""Which OpenCL runtimes the loader sees: those of the system, and Intel's where pip installed it."""

from __future__ import annotations

import functools
import os
import shutil
import tempfile
import threading
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pyopencl as cl

from ..host.caches import prepare_caches

# The loader that comes with pyopencl; where it looks; the variable that names another folder or file.
_LOADER = Path(cl.__file__).with_name(".libs")
_VENDORS = Path("/etc/OpenCL/vendors")
_VARIABLE = "OCL_ICD_VENDORS"
_INTEL_PACKAGE, _INTEL_LIBRARY = "intel-opencl-rt", "libintelocl.so"
INTEL_PLATFORM = "Intel(R) OpenCL"
# On Linux, the list of files that this process has mapped.
_MAPS = Path("/proc/self/maps")


# Id of the process that loaded the runtimes and has their threads; None: not loaded.
_home: int | None = None
_lock = threading.Lock()


def loaded_elsewhere() -> bool:
    """Whether this process was forked from one that had loaded OpenCL: then no call may be made.

    A fork does not copy the runtimes' threads, so the next call would wait for them for ever.
    """
    return _home is not None and _home != os.getpid()


def _look_in_fork() -> None:
    """In a new fork: notice a runtime that other code, such as pyopencl, loaded in the parent."""
    global _home
    if _home is None and loaded_libraries():
        _home = os.getppid()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_look_in_fork)


def loaded_libraries() -> list[str]:
    """Libraries of registered runtimes that this process has loaded, if the system tells."""
    named = Path(os.environ.get(_VARIABLE) or _VENDORS)
    entries = [named] if named.suffix == ".icd" else [*named.glob("*.icd"), *_LOADER.glob("*.icd")]
    libraries = [named.name, _INTEL_LIBRARY]
    try:
        libraries += [Path(entry.read_text(encoding="utf-8").strip()).name for entry in entries]
        loaded = _MAPS.read_text(encoding="utf-8", errors="replace")
    except (OSError, UnicodeDecodeError):
        return []
    # What follows `.so` is a version, which may differ between an entry and the file it names.
    stems = {name.partition(".so")[0] for name in libraries if ".so" in name}
    return sorted(stem for stem in stems if f"/{stem}.so" in loaded)


def platforms() -> list[cl.Platform]:
    """Every OpenCL platform; Intel's, if only pip installed it, comes last.

    pip's package of Intel's CPU runtime cannot register itself with the system. So while the loader
    looks for runtimes, which it does once a process, `OCL_ICD_VENDORS` names a temporary folder with the
    system's entries and Intel's. If the user has set that variable, it is left as it is.

    Raises
    ------
    pyopencl.Error
        If there is none.
    """
    global _home
    # One thread at a time, since the variable belongs to the whole process.
    with _lock:
        _home = os.getpid()
        return _platforms()


@functools.cache
def _platforms() -> list[cl.Platform]:
    prepare_caches()
    library = _intel_library()
    if library is None or os.environ.get(_VARIABLE) or not _LOADER.is_dir():
        return cl.get_platforms()
    with tempfile.TemporaryDirectory(prefix="ncv_cl-") as folder:
        for entry in sorted(_VENDORS.glob("*.icd")):
            # The loader cannot read such an entry either.
            with suppress(OSError):
                shutil.copy(entry, folder)
        (Path(folder) / "ncv_cl-intel.icd").write_text(f"{library}\n", encoding="utf-8")
        # The slash tells the loader that this is a folder; to one it adds pyopencl's own.
        os.environ[_VARIABLE] = f"{folder}{os.sep}"
        try:
            found = cl.get_platforms()
        finally:
            os.environ.pop(_VARIABLE, None)
    return sorted(found, key=lambda platform: platform.name.strip() == INTEL_PLATFORM)


def _intel_library() -> Path | None:
    """Intel's CPU runtime in this Python environment, unless the system knows one already."""
    try:
        files = distribution(_INTEL_PACKAGE).files or []
    except PackageNotFoundError:
        return None
    found = [Path(file.locate()).resolve() for file in files if file.name == _INTEL_LIBRARY]
    with suppress(OSError, UnicodeDecodeError):
        if any(_INTEL_LIBRARY in e.read_text(encoding="utf-8") for e in _VENDORS.glob("*.icd")):
            return None
    return next((library for library in found if library.is_file()), None)
