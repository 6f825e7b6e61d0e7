"""Two pictures side by side: how far apart they are, where, and whether noise explains it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import OpenImageIO as oiio

from .image import Image, error_metrics, float_pixels, png_bytes, show_png

# White in maps of errors, as a percentile: a few fireflies leave the rest visible.
_WHITE = 99.0
# Between panels, in pixels.
_GAP = 4


@dataclass(frozen=True, eq=False)
class Comparison:
    """What `compare` finds; a notebook shows it as four panels.

    Attributes
    ----------
    mse, relmse : float
        Mean squared error, and the same relative to the reference; see `error_metrics`.
    flip : float or None
        Mean of `flip_map`.
    deviations : float or None
        Root mean square of the difference over its standard error, of pixels that have one: about 1
        where noise alone explains what differs, large where it does not. None where neither picture
        knows its variance.
    error : ndarray
        float64 (height, width): picture minus reference, mean of the channels.
    flip_map : ndarray or None
        float32 (height, width) in [0, 1]: the difference as a viewer sees it who flips between the two,
        clamped to [0, 1] (Andersson et al. 2020, FLIP). None where OpenImageIO is too old for it.
    pictures : tuple of ndarray
        float (height, width, 3): picture and reference.
    """

    mse: float
    relmse: float
    flip: float | None
    deviations: float | None
    error: np.ndarray = field(repr=False)
    flip_map: np.ndarray | None = field(repr=False)
    pictures: tuple[np.ndarray, np.ndarray] = field(repr=False)

    def panels(self) -> np.ndarray:
        """Picture, reference, absolute error, FLIP if known: linear RGB, (height, width, 3)."""
        found = list(self.pictures)
        for one in (np.abs(self.error), self.flip_map):
            if one is not None:
                found.append(_coloured(one / max(float(np.percentile(one, _WHITE)), 1e-12)))
        gap = np.ones((len(self.error), _GAP, 3), np.float32)
        parts = [part for panel in found for part in (gap, panel.astype(np.float32))]
        return np.concatenate(parts[1:], axis=1)

    def show(self) -> None:
        """Open the panels in the viewer of the desktop."""
        show_png(self._repr_png_())

    def _repr_png_(self) -> bytes:
        return png_bytes(self.panels())


def compare(picture: Image | np.ndarray, reference: Image | np.ndarray) -> Comparison:
    """How far a picture is from a reference.

    Parameters
    ----------
    picture, reference : Image or array (height, width, 3)
        Linear RGB.

    Raises
    ------
    ValueError
        If shapes differ, a value is not finite, or the reference is black everywhere.
    """
    ours, theirs = (_pixels(one) for one in (picture, reference))
    metrics = error_metrics(ours, theirs)
    found = flip_map(theirs, ours)
    variances = [one.variance for one in (picture, reference) if isinstance(one, Image)]
    deviations = None
    if variances:
        variance = np.sum(np.array(variances, np.float64), axis=0)
        known = np.isfinite(variance) & (variance > 0)
        if known.any():
            difference = ours.astype(np.float64) - theirs
            deviations = float(np.sqrt((difference[known] ** 2 / variance[known]).mean()))
    error = (ours.astype(np.float64) - theirs).mean(axis=2)
    mean = None if found is None else float(found.mean())
    return Comparison(**metrics, flip=mean, deviations=deviations, error=error, flip_map=found,
                      pictures=(ours, theirs))  # fmt: skip


def has_flip() -> bool:
    """Whether this OpenImageIO compares images by FLIP."""
    return hasattr(oiio.ImageBufAlgo, "FLIP_diff")


def flip_map(reference: np.ndarray, pixels: np.ndarray) -> np.ndarray | None:
    """FLIP of linear RGB clamped to [0, 1]: (height, width), or None where OpenImageIO lacks it."""
    if not has_flip():
        return None
    first, second = (
        oiio.ImageBuf(np.ascontiguousarray(np.clip(one, 0, 1), dtype=np.float32))
        for one in (reference, pixels)
    )
    found = oiio.ImageBufAlgo.FLIP_diff(first, second, hdr=0)
    return float_pixels(found, "FLIP")[:, :, 0]


def _pixels(one: Image | np.ndarray) -> np.ndarray:
    found = one.pixels if isinstance(one, Image) else np.asarray(one)
    if found.ndim != 3 or found.shape[2] != 3 or found.dtype.kind not in "fiu":
        raise ValueError(
            f"expected an Image or numbers (height, width, 3), got {found.dtype} {found.shape}"
        )
    return found


def _coloured(values: np.ndarray) -> np.ndarray:
    """Numbers in [0, 1] as colours, linear RGB."""
    one = oiio.ImageBuf(np.ascontiguousarray(np.clip(values, 0, 1)[:, :, None], dtype=np.float32))
    mapped = oiio.ImageBufAlgo.color_map(one, 0, "magma")
    # The map's colours are for the screen: as linear light they look the same there.
    srgb = float_pixels(mapped, "colouring")[:, :, :3]
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
