"""The mean colour of an image, which stands for a texture as long as textures are not read."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from .common import Colour, linear_from_srgb, three


def mean_colour(image: Path | bytes | None) -> Colour | None:
    """Mean linear RGB of an image file or its content, or None if it cannot be read.

    Integer formats are taken for sRGB, floating-point ones for linear. Alpha does not matter.
    """
    if image is None:
        return None
    if isinstance(image, bytes):
        with tempfile.TemporaryDirectory() as folder:
            # The reader finds the format by the content.
            path = Path(folder) / "image"
            path.write_bytes(image)
            return mean_colour(path)
    source = oiio.ImageInput.open(str(image))
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
    channels = pixels.reshape(-1, pixels.shape[-1])
    channels = channels[:, :3] if channels.shape[1] >= 3 else channels[:, :1]
    if linear:
        mean = channels.mean(axis=0, dtype=np.float64)
        return three(mean) if np.isfinite(mean).all() else None
    decoded = linear_from_srgb(np.arange(256) / 255.0)
    counts = [np.bincount(channel, minlength=256) for channel in channels.T]
    return three([float(count @ decoded) / len(channels) for count in counts])
