"""The mean colour of an image, which stands for a texture as long as textures are not read."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from .common import Colour, linear_from_srgb, three


def mean_colour(image: Path | bytes | None) -> Colour | None:
    """Mean linear RGB of an image file or its content, or None if it cannot be read.

    Integer formats are taken for sRGB, floating-point ones for linear. Pixels count by their alpha.
    """
    if image is None:
        return None
    if isinstance(image, bytes):
        with tempfile.TemporaryDirectory() as folder:
            # The reader finds the format by the content.
            path = Path(folder) / "image"
            path.write_bytes(image)
            return mean_colour(path)
    # Else colours come multiplied by alpha.
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(image), config)
    if source is None:
        oiio.geterror()
        return None
    try:
        linear = source.spec().format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
        pixels = source.read_image(oiio.FLOAT if linear else oiio.UINT8)
    finally:
        source.close()
    if pixels is None:
        return None
    pixels = pixels.reshape(-1, pixels.shape[-1])
    n_channels = pixels.shape[1]
    alpha = pixels[:, -1] if n_channels in (2, 4) and pixels[:, -1].any() else None
    mean = [_mean(channel, alpha, linear) for channel in pixels.T[: 3 if n_channels > 2 else 1]]
    return three(mean) if np.isfinite(mean).all() else None


def _mean(channel: NDArray, alpha: NDArray | None, linear: bool) -> float:
    """Weighted mean of float32 (n,), or of the light that sRGB uint8 (n,) stand for."""
    if linear:
        return float(np.average(channel.astype(np.float64), weights=alpha))
    decoded = linear_from_srgb(np.arange(256) / 255.0)
    weights = np.bincount(channel, alpha, minlength=256)
    return float(weights @ decoded / weights.sum())
