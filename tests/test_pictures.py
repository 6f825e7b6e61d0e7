"""Pictures keep their bits while the code around the method changes.

`pictures.json` holds a digest of each, by device. Where the method itself changes, record them anew:
``python tests/test_pictures.py`` prints which digests changed, and writes the file.
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
from pathlib import Path

import numpy as np
import pytest

import ncv_cl as ncv

HERE = Path(__file__).parent
RECORDED = HERE / "pictures.json"
SCENES = HERE.parent / "scenes"
SMALL = {"size": (24, 16), "spp": 32, "seed": 7, "threads": 1}
# Every integrand by every method, and every way of sampling once.
PICTURES = {
    "ao mc": ("occluders", "ao", {"method": "mc"}),
    "ao ncv": ("occluders", "ao", {"method": "ncv"}),
    "direct mc": ("cornell_box", "direct", {"method": "mc"}),
    "direct ncv": ("cornell_box", "direct", {"method": "ncv"}),
    "gi mc": ("cornell_box", "gi", {"method": "mc"}),
    "gi ncv": ("cornell_box", "gi", {"method": "ncv"}),
    "gi mc, one part": ("cornell_box", "gi", {"method": "mc", "split_direct": "off"}),
    "gi ncv, one part": ("cornell_box", "gi", {"method": "ncv", "split_direct": "off"}),
    "direct ncv, several lights": ("interior", "direct", {"method": "ncv"}),
    "direct mc, points": ("cornell_box", "direct", {"method": "mc", "visibility": "points"}),
    "direct mc, embree": ("occluders", "direct", {"method": "mc", "visibility": "embree"}),
    "direct mc, glossy": ("veach_plates", "direct", {"method": "mc"}),
    "direct mc, pilot": ("interior", "direct", {"method": "mc", "allocation": "pilot"}),
    "direct ncv, independent": ("knot", "direct", {"method": "ncv", "sampler": "independent"}),
    "direct ncv, subdivision": ("cornell_box", "direct", {"method": "ncv", "density": "subdivision"}),
    "direct ncv, no density": ("cornell_box", "direct", {"method": "ncv", "density": "none"}),
    "direct ncv, slides": ("cornell_box", "direct", {"method": "ncv", "preset": "slides"}),
    "direct ncv, wide": ("cornell_box", "direct", {"method": "ncv", "preset": "wide", "train_spp": 4}),
    "gi ncv, supersampled": ("interior", "gi", {"method": "ncv", "supersample": 2, "size": (12, 8)}),
    "ao mc, rays by kernels": ("knot", "ao", {"method": "mc", "visibility": "points", "rays": "device"}),
    "gi mc, rays by kernels": ("interior", "gi", {"method": "mc", "rays": "device"}),
    "gi mc, embree": ("interior", "gi", {"method": "mc", "visibility": "embree"}),
}


def _digest(*arrays: np.ndarray) -> str:
    return hashlib.sha256(
        b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    ).hexdigest()[:16]


def _render(device: ncv.Device, name: str) -> str:
    scene, integrand, options = PICTURES[name]
    image = ncv.render(SCENES / f"{scene}.toml", integrand, device=device, **(SMALL | options))
    return _digest(image.pixels, image.variance, *(image.layers[name] for name in sorted(image.layers)))


def _estimate(device: ncv.Device) -> str:
    found = ncv.estimate(
        lambda u, v, point: np.where(u + v < 0.9 + 0.01 * point, u, 0.0),
        points=20,
        features=np.arange(20.0)[:, None],
        spp=64,
        device=device,
    )
    return _digest(found.mean, found.variance, found.network_integral)


def _all(device: ncv.Device) -> dict[str, object]:
    renders = {name: lambda name=name: _render(device, name) for name in PICTURES}
    return {**renders, "estimate": lambda: _estimate(device)}


def _key(device: ncv.Device) -> str:
    """What bits depend on: the device, and the host's arithmetic."""
    cpu = Path("/proc/cpuinfo")
    text = cpu.read_text(encoding="utf-8") if cpu.is_file() else ""
    model = ", ".join(re.findall(r"^(?:cpu family|model)\s*:\s*(\d+)$", text, re.MULTILINE)[:2])
    host = f"CPU {model or platform.processor()}, numpy {np.__version__}"
    return f"{device.identity}, VEC {device.vector_width}, LANES {device.lanes}, {host}"


@pytest.mark.parametrize("name", [*PICTURES, "estimate"])
def test_a_picture_has_the_bits_that_were_recorded(device, name):
    recorded = json.loads(RECORDED.read_text(encoding="utf-8")).get(_key(device))
    if recorded is None:
        pytest.skip(f"no pictures are recorded for {_key(device)}")
    assert _all(device)[name]() == recorded[name]


def main() -> None:
    """Record the pictures of every device, and say which changed."""
    known = json.loads(RECORDED.read_text(encoding="utf-8")) if RECORDED.is_file() else {}
    for listed in ncv.devices():
        if listed.problem is not None:
            continue
        key, found = _key(listed.device), {name: make() for name, make in _all(listed.device).items()}
        for name, digest in found.items():
            if known.get(key, {}).get(name) != digest:
                print(f"{key}: {name}: {known.get(key, {}).get(name)} -> {digest}")
        known[key] = found
    RECORDED.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
