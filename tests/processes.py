"""What tests in processes of their own share."""

from __future__ import annotations

import os
from pathlib import Path

from ncv_cl.host.caches import cache_folder

ROOT = Path(__file__).parent.parent
# Longer than any of these programs takes on a busy machine; what hangs takes for ever.
PATIENCE = 240


def environment(**changes: str | None) -> dict[str, str]:
    """Ours with changes; None takes a variable away."""
    changed = {"PYTHONPATH": str(ROOT), **changes}
    kept = {name: value for name, value in os.environ.items() if name not in changed}
    return kept | {name: value for name, value in changed.items() if value is not None}


def cache_in(folder: Path) -> dict[str, str]:
    """Another folder for all caches but PoCL's, which only saves time."""
    usual = os.environ.get("POCL_CACHE_DIR") or str(cache_folder("pocl") / "kcache")
    return {"XDG_CACHE_HOME": str(folder), "POCL_CACHE_DIR": usual}
