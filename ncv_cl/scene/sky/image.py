"""Images of skies: high dynamic range, so in single precision."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ..textures.image_file import LARGEST_SIDE
from ..textures.texture import linear_from_srgb

# Pixels: 384 MiB of them.
MOST_PIXELS = 1 << 25


class SkyError(ValueError):
    """An image is no sky."""


def read_sky(path: Path) -> NDArray[np.float32]:
    """An image's radiance, float32 (height, width, 3); integers are taken for sRGB.

    Raises
    ------
    SkyError
        If it cannot be read, is too large, or a number in it is negative or not finite.
    """
    source = oiio.ImageInput.open(str(path)) if path.is_file() else None
    if source is None:
        reason = oiio.geterror() if path.is_file() else ""
        raise SkyError(f"cannot read the image: {reason or 'there is no such file'}")
    try:
        spec = source.spec()
        if max(spec.width, spec.height) > LARGEST_SIDE or spec.width * spec.height > MOST_PIXELS:
            raise SkyError(
                f"an image of {spec.width} × {spec.height} pixels is too large, {MOST_PIXELS:,} pixels "
                "are read: scale it down"
            )
        is_integer = spec.format.basetype not in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
        pixels = source.read_image(0, 0, 0, min(spec.nchannels, 3), oiio.FLOAT)
    finally:
        source.close()
    if pixels is None or not pixels.size:
        raise SkyError("cannot read the image: its pixels are damaged")
    pixels = pixels.reshape(spec.height, spec.width, -1)
    pixels = pixels[:, :, [0, 0, 0] if pixels.shape[2] < 3 else [0, 1, 2]]
    if is_integer:
        pixels = linear_from_srgb(pixels)
    pixels = np.ascontiguousarray(pixels, np.float32)
    check_sky(pixels)
    return pixels


def check_sky(pixels: NDArray[np.float32]) -> None:
    """Raise `SkyError` where radiance is negative or not finite."""
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(pixels) & (pixels >= 0)
    if not usable.all():
        row, column, channel = np.argwhere(~usable)[0]
        raise SkyError(
            f"the pixel in row {row}, column {column}, counted from 0 at the upper left, is "
            f"{pixels[row, column, channel]}: radiance must be finite and not negative"
        )


def aspect_remark(pixels: NDArray[np.float32]) -> str | None:
    """What is odd about an image's shape, if it is."""
    height, width = pixels.shape[:2]
    if width == 2 * height:
        return None
    return (
        f"the image has {width} × {height} pixels; one in latitude and longitude is twice as wide as it "
        "is high, so it is stretched"
    )
