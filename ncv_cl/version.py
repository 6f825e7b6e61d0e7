"""What of the program decides an image's bits: its version and its kernels."""

from __future__ import annotations

import functools
import hashlib
from importlib.metadata import PackageNotFoundError, version

from .program import kernel_folder


@functools.cache
def package_version() -> str:
    """The installed version of ncv_cl."""
    try:
        return version("ncv_cl")
    except PackageNotFoundError:
        return "unpackaged"


@functools.cache
def kernel_hash() -> str:
    """Hexadecimal digest of all kernel files, which differ between builds of one version."""
    digest = hashlib.sha256()
    for path in sorted(kernel_folder().glob("*.cl")):
        # As text: a checkout may have the line ends of another system.
        digest.update(f"{path.name}\0{path.read_text(encoding='utf-8')}\0".encode())
    return digest.hexdigest()[:16]
