"""Image files as textures."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from ...host.reach import Reach
from .texture import LARGEST_HALF, Texture, linear_from_srgb

# Pixels of an image's side, and of all images of a scene: 1 GiB of texels.
LARGEST_SIDE = 1 << 14
MOST_TEXELS = 1 << 27
# Bytes of pixels, in single precision, that any file may announce, and that one may for each of its own.
_SMALL_IMAGE, _DENSEST = 1 << 28, 1 << 14
_FLOATS = (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
ENCODINGS = ("auto", "srgb", "linear")


class ImageTooLargeError(ValueError):
    """An image, or all of a scene, would take too much memory."""


class ImageFiles:
    """Images of a scene, each decoded once.

    Parameters
    ----------
    reach : Reach, optional
        Which files may be read; any by default.
    """

    def __init__(self, reach: Reach | None = None) -> None:
        self.reach = reach or Reach()
        self._texels: dict[object, NDArray[np.float16] | None] = {}
        self._count = 0
        self._opacities: dict[int, NDArray[np.float16]] = {}

    def texels(self, image: Path | bytes, encoding: str = "auto") -> NDArray[np.float16] | None:
        """An image file or its content as texels of a `Texture`, or None if it cannot be read.

        Parameters
        ----------
        image : Path or bytes
        encoding : {"auto", "srgb", "linear"}
            Of its colours. By "auto" integers are taken for sRGB, floating-point numbers for linear.

        Raises
        ------
        ImageTooLargeError
            If a side is beyond `LARGEST_SIDE`, or all images together are beyond `MOST_TEXELS`.
        OutsideError
            If the file is beyond `reach`.
        """
        if not isinstance(image, bytes):
            self.reach.checked(image)
        key = (image if isinstance(image, bytes) else image.resolve(), encoding)
        if key not in self._texels:
            found = self._texels[key] = _decode(image, encoding, MOST_TEXELS - self._count)
            self._count += 0 if found is None else found.shape[0] * found.shape[1]
        return self._texels[key]

    def opacity(self, image: Path | bytes) -> NDArray[np.float16] | None:
        """An image's opacity as the alpha of `texels`: the image's own, or where it has none its red."""
        texels = self.texels(image, "linear")
        if texels is None or (texels[:, :, 3] < 1).any():
            return texels
        # Texels are kept here, so an array's id stays its own.
        if id(texels) not in self._opacities:
            red = np.broadcast_to(texels[:, :, :1], texels.shape)
            self._opacities[id(texels)] = np.ascontiguousarray(red)
        return self._opacities[id(texels)]

    def texture(
        self,
        image: Path | bytes,
        encoding: str = "auto",
        wrap: tuple[str, str] = ("repeat", "repeat"),
        nearest: bool = False,
    ) -> Texture | None:
        """A texture of `texels`."""
        texels = self.texels(image, encoding)
        return None if texels is None else Texture(texels, wrap, nearest)


def _decode(image: Path | bytes, encoding: str, most: int) -> NDArray[np.float16] | None:
    """An image's texels; it may have so many pixels, which is asked before any is read."""
    if isinstance(image, bytes):
        with tempfile.TemporaryDirectory() as folder:
            # The reader finds the format by the content.
            path = Path(folder) / "image"
            path.write_bytes(image)
            return _decode(path, encoding, most)
    # Else colours come multiplied by alpha.
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(image), config)
    if source is None:
        oiio.geterror()
        return None
    try:
        spec = source.spec()
        if max(spec.width, spec.height) > LARGEST_SIDE or spec.depth > 1:
            raise ImageTooLargeError(
                f"an image of {spec.width} × {spec.height} pixels is too large, {LARGEST_SIDE} a side "
                "are read: scale it down"
            )
        if spec.width * spec.height > most:
            raise ImageTooLargeError(
                f"the images have more than {MOST_TEXELS:,} pixels in all: scale them down"
            )
        announced = spec.width * spec.height * min(spec.nchannels, 4) * 4
        if announced > max(_SMALL_IMAGE, _DENSEST * image.stat().st_size):
            raise ImageTooLargeError(
                f"the file is too small for an image of {spec.width} × {spec.height} pixels: was it cut "
                "off?"
            )
        is_float = spec.format.basetype in _FLOATS
        kind = oiio.UINT8 if spec.format.basetype == oiio.UINT8 else oiio.FLOAT
        pixels = source.read_image(0, 0, 0, min(spec.nchannels, 4), kind)
    finally:
        source.close()
    if pixels is None or not pixels.size:
        return None
    encoded = not is_float if encoding == "auto" else encoding == "srgb"
    return _texels(pixels.reshape(spec.height, spec.width, -1), encoded)


def _texels(pixels: NDArray, encoded: bool) -> NDArray[np.float16]:
    """Texels of an image's pixels, uint8 or float32 (height, width, 1 to 4)."""
    channels = pixels.shape[2]
    texels = np.ones((*pixels.shape[:2], 4), np.float16)
    sources = [0, 0, 0] if channels < 3 else [0, 1, 2]
    for target, source in enumerate(sources):
        texels[:, :, target] = _linear(pixels[::-1, :, source], encoded)
    if channels in (2, 4):
        texels[:, :, 3] = _linear(pixels[::-1, :, -1], False)
    texels.setflags(write=False)
    return texels


def _linear(channel: NDArray, encoded: bool) -> NDArray[np.float16]:
    if channel.dtype == np.uint8:
        decoded = np.arange(256) / 255.0
        return (linear_from_srgb(decoded) if encoded else decoded).astype(np.float16)[channel]
    values = linear_from_srgb(np.clip(channel, 0.0, 1.0)) if encoded else channel
    return np.clip(np.nan_to_num(values), -LARGEST_HALF, LARGEST_HALF).astype(np.float16)
