"""Options for renders by any method."""

from __future__ import annotations

TRAINING = ("train_spp", "preset", "density", "network")


def fitting(method: str, **options: object) -> dict[str, object]:
    """The options, but for those of training where there is none."""
    kept = {name: value for name, value in options.items() if method != "mc" or name not in TRAINING}
    return {"method": method, **kept}
