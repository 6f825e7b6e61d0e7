"""Rendered images: EXR layers, tone-mapped PNG, references and error metrics."""

from __future__ import annotations

import json
import os
import tempfile
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import OpenImageIO as oiio

from ..host.files import PREFIX, check_writable

# The channel names that viewers and denoisers look for.
_RGB, _XYZ = ("R", "G", "B"), ("X", "Y", "Z")
LAYER_CHANNELS = {"albedo": _RGB, "N": _XYZ, "depth": ("Z",), "G": _RGB, "residual": _RGB}
LAYER_CHANNELS |= {"direct": _RGB, "coverage": ("A",)}
OUTPUT_SUFFIXES = (".exr", ".png")

# EXR attributes hold only 32-bit numbers. Each metadata entry is written as one of its own for
# viewers; this one holds them all as JSON, so that what is read is what was written.
_METADATA_ATTRIBUTE = "ncv_cl_metadata"

# The colour spaces of OpenImageIO's built-in configuration, whatever $OCIO names.
_COLOR_CONFIG, _LINEAR, _SRGB = "ocio://default", "lin_rec709", "srgb"


# Of a picture, by name.
Metadata: TypeAlias = dict[str, str | int | float]


@dataclass
class Image:
    """A rendered image with its variance, layers and statistics.

    Attributes
    ----------
    pixels : (height, width, 3) float32
        Linear RGB radiance; ambient occlusion is the same number in all three channels.
    variance : (height, width, 3) float32
        Variance of the pixel's mean, in the square of the pixel's unit.
    layers : dict of arrays
        Any of "albedo" (h, w, 3), clamped to [0, 1] in files; "N" (h, w, 3), the shading normal
        in world space; "depth" (h, w), the distance from the camera in scene units; "G"
        (h, w, 3), the integrated network; "residual" (h, w, 3); "coverage" (h, w), of a map, the part
        of each texel that is on the mesh. They are float64, of more than 2^22 pixels float32, as files
        hold them.
    stats : dict
        JSON-able statistics of the rendering; not written by `write`.
    metadata : dict of str, int or float
        Seed, samples, scene, version; EXR attributes ``ncv_cl:seed`` and so on.

    Raises
    ------
    ValueError
        If `pixels` is not (height, width, 3) or `variance` has another shape.
    """

    pixels: np.ndarray
    variance: np.ndarray
    layers: dict[str, np.ndarray] = field(default_factory=dict)
    stats: dict[str, Any] = field(default_factory=dict)
    metadata: Metadata = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.pixels = np.asarray(self.pixels, dtype=np.float32)
        self.variance = np.asarray(self.variance, dtype=np.float32)
        if self.pixels.ndim != 3 or self.pixels.shape[2] != 3 or self.pixels.size == 0:
            raise ValueError(f"pixels must be (height, width, 3), not {self.pixels.shape}")
        if self.variance.shape != self.pixels.shape:
            raise ValueError(
                f"variance {self.variance.shape} and pixels {self.pixels.shape} must agree in shape"
            )

    def write(self, path: str | Path) -> None:
        """Write an EXR with every layer, or an 8-bit sRGB PNG of the pixels.

        The EXR holds float32 ``R,G,B``, ``variance.R`` ..., ``albedo.R`` ..., ``N.X`` ...,
        ``depth.Z``, ``G.R`` ... and ``residual.R`` ... bit for bit. The PNG is clamped to [0, 1]
        without exposure; NaN becomes black. The file appears under its name only when complete:
        after a failure an older file is still there.

        Raises
        ------
        ValueError
            If the suffix is neither .exr nor .png, or a layer or metadata entry is not as
            documented in `Image`.
        OSError
            If the folder is missing or the file cannot be written.
        """
        path = Path(path)
        check_output_path(path)
        if path.suffix.lower() == ".exr":
            names, data = self._channels()
            attributes = _exr_attributes(self.metadata)
        else:
            names, data, attributes = _RGB, _tone_map(self.pixels), {"oiio:ColorSpace": "srgb"}
        # A folder, not a file of tempfile's: the image then gets the permissions of the umask.
        with tempfile.TemporaryDirectory(prefix=PREFIX, dir=path.parent) as folder:
            complete = Path(folder) / path.name
            _write_file(complete, path, names, data, attributes)
            os.replace(complete, path)

    def show(self) -> None:
        """Open the picture, tone-mapped as a PNG is, in the viewer of the desktop."""
        show_png(self._repr_png_())

    def _repr_png_(self) -> bytes:
        """What a notebook shows."""
        return png_bytes(self.pixels)

    def _channels(self) -> tuple[tuple[str, ...], np.ndarray]:
        height, width, _ = self.pixels.shape
        names = [*_RGB, *(f"variance.{channel}" for channel in _RGB)]
        planes = [self.pixels, self.variance]
        for layer, values in self.layers.items():
            if layer not in LAYER_CHANNELS:
                known = ", ".join(LAYER_CHANNELS)
                raise ValueError(f"unknown layer {layer!r}; the layers are {known}")
            channels = LAYER_CHANNELS[layer]
            shape = (height, width) if len(channels) == 1 else (height, width, len(channels))
            plane = np.asarray(values, dtype=np.float32)
            if plane.shape != shape:
                raise ValueError(f"layer {layer!r} must be {shape}, not {plane.shape}")
            if layer == "albedo":
                plane = np.clip(plane, 0.0, 1.0)
            names += [f"{layer}.{channel}" for channel in channels]
            planes.append(plane.reshape(height, width, len(channels)))
        return tuple(names), np.concatenate(planes, axis=2)

    @classmethod
    def read(cls, path: str | Path) -> Image:
        """Read an EXR written by `write`: pixels, variance, layers and metadata.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            If it is not an image, or lacks the channels or metadata of an ncv_cl EXR.
        """
        spec, data = _read_file(path)
        # OpenImageIO returns the channels in an order of its own.
        planes = {name: data[:, :, index] for index, name in enumerate(spec.channelnames)}

        def stack(names: list[str]) -> np.ndarray:
            return np.stack([planes[name] for name in names], axis=2)

        pixel_names = list(_RGB)
        variance_names = [f"variance.{channel}" for channel in _RGB]
        metadata = spec.getattribute(_METADATA_ATTRIBUTE)
        missing = [name for name in pixel_names + variance_names if name not in planes]
        if metadata is None:
            missing.append(_METADATA_ATTRIBUTE)
        if missing:
            raise ValueError(f"{path} was not written by ncv_cl: it has no {', '.join(missing)}")
        layers = {}
        for layer, channels in LAYER_CHANNELS.items():
            names = [f"{layer}.{channel}" for channel in channels]
            if all(name in planes for name in names):
                layers[layer] = planes[names[0]].copy() if len(names) == 1 else stack(names)
        return cls(stack(pixel_names), stack(variance_names), layers, {}, json.loads(metadata))


def check_output_path(path: str | Path) -> None:
    """Raise if an image cannot be written to `path`; call it before a long rendering.

    Raises
    ------
    ValueError
        If the suffix is neither .exr nor .png.
    OSError
        As `files.check_writable` raises them.
    """
    path = Path(path)
    if path.suffix.lower() not in OUTPUT_SUFFIXES:
        raise ValueError(f"cannot write {path}: the name must end in {' or '.join(OUTPUT_SUFFIXES)}")
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise ValueError(f"cannot write {str(path)!r}: the name must be valid UTF-8") from error
    check_writable(path)


def read_reference(path: str | Path, shape: tuple[int, int]) -> np.ndarray:
    """Read the linear RGB of a reference image: EXR, PFM, HDR or any float image.

    Parameters
    ----------
    path : path
        A floating-point image with channels R, G and B, or with one channel (grey).
    shape : (height, width)
        Size that the reference must have, in pixels.

    Returns
    -------
    (height, width, 3) float32

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is not a floating-point image of that size with usable channels, if a pixel is not
        finite, or if it is black everywhere.
    """
    spec, data = _read_file(path)
    if spec.format.basetype not in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE):
        raise ValueError(
            f"reference {path} holds integers ({spec.format}), which are tone-mapped; "
            "give a floating-point image (EXR, PFM, HDR)"
        )
    if data.shape[:2] != tuple(shape[:2]):
        raise ValueError(
            f"reference {path} is {data.shape[1]}x{data.shape[0]} pixels, "
            f"but the image is {shape[1]}x{shape[0]}"
        )
    channels = list(spec.channelnames)
    if all(channel in channels for channel in _RGB):
        pixels = data[:, :, [channels.index(channel) for channel in _RGB]]
    elif len(channels) == 1:
        pixels = np.repeat(data, 3, axis=2)
    else:
        raise ValueError(f"reference {path} has no channels R, G, B; it has {', '.join(channels)}")
    _check_finite(f"reference {path}", pixels)
    _check_not_black(f"reference {path}", pixels)
    return np.ascontiguousarray(pixels)


def checked_reference(reference: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A reference for an image of this width and height, float (height, width, 3).

    Raises
    ------
    ValueError
        If it has another shape, is not of real numbers, holds NaN or infinity, or is black everywhere.
    """
    found = np.asarray(reference)
    if found.dtype.kind not in "fiu" or found.shape != (size[1], size[0], 3):
        raise ValueError(
            f"reference must be numbers of shape {(size[1], size[0], 3)}, is {found.dtype} {found.shape}"
        )
    _check_finite("reference", found)
    _check_not_black("reference", found)
    return found


def error_metrics(pixels: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    r"""Mean squared error and relative mean squared error, in double precision.

    With x the pixels, r the reference and m the mean of r over all pixels and channels,

    .. math:: \mathrm{mse} = \overline{(x - r)^2}, \qquad
        \mathrm{relmse} = \overline{(x - r)^2 / (r^2 + 0.01\,m^2)}.

    This is the relative error of Rousselle et al. 2011, *Adaptive sampling and reconstruction
    using greedy error minimization*, with the offset in proportion to the image's brightness, so
    that relmse does not change when image and reference are scaled together.

    Parameters
    ----------
    pixels, reference : (height, width, 3)
        Linear RGB.

    Returns
    -------
    dict
        "mse" and "relmse".

    Raises
    ------
    ValueError
        If the shapes differ, either holds NaN or infinity, or the reference is black everywhere.
    """
    x, r = np.asarray(pixels, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if x.shape != r.shape:
        raise ValueError(f"image {x.shape} and reference {r.shape} must agree in shape")
    _check_finite("image", x)
    _check_finite("reference", r)
    _check_not_black("reference", r)
    squared = (x - r) ** 2
    relative = squared / (r**2 + 1e-2 * r.mean() ** 2)
    return {"mse": float(squared.mean()), "relmse": float(relative.mean())}


def _check_finite(what: str, values: np.ndarray) -> None:
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        raise ValueError(
            f"{what}: {len(bad)} of {values.size} values are NaN or infinite, "
            f"the first at (row, column, channel) {tuple(int(index) for index in bad[0])}"
        )


def _check_not_black(what: str, values: np.ndarray) -> None:
    if not np.any(values):
        raise ValueError(f"{what} is black everywhere, so relative errors have no scale")


def png_bytes(pixels: np.ndarray) -> bytes:
    """Linear RGB as the bytes of a PNG, as `Image.write` makes one."""
    with tempfile.TemporaryDirectory(prefix=PREFIX) as folder:
        file = Path(folder) / "shown.png"
        _write_file(file, file, _RGB, _tone_map(pixels), {"oiio:ColorSpace": "srgb"})
        return file.read_bytes()


def show_png(content: bytes) -> None:
    """Open a PNG in the viewer of the desktop; its file, a temporary one, stays for it."""
    with tempfile.NamedTemporaryFile(prefix="ncv_cl-", suffix=".png", delete=False) as file:
        file.write(content)
    webbrowser.open(Path(file.name).as_uri())


def _tone_map(pixels: np.ndarray) -> np.ndarray:
    """Clamp linear RGB to [0, 1] and apply the sRGB curve."""
    clamped = np.ascontiguousarray(np.clip(np.nan_to_num(pixels, nan=0.0), 0.0, 1.0))
    converted = oiio.ImageBufAlgo.colorconvert(
        oiio.ImageBuf(clamped), _LINEAR, _SRGB, colorconfig=_COLOR_CONFIG
    )
    return float_pixels(converted, "sRGB conversion")


def float_pixels(image: oiio.ImageBuf, what: str) -> np.ndarray:
    """What OpenImageIO has made, float32 (height, width, channels); an error says that `what` failed."""
    found = None if image.has_error else image.get_pixels(oiio.FLOAT)
    if found is None:
        raise RuntimeError(f"{what} failed: {image.geterror()}")
    return found


def _exr_attributes(metadata: Metadata) -> Metadata:
    plain = {}
    for key, value in metadata.items():
        value = value.item() if isinstance(value, np.generic) else value
        if not isinstance(key, str) or not isinstance(value, (str, int, float)):
            raise ValueError(f"metadata {key!r} must be a str, int or float, not {value!r}")
        plain[key] = value
    attributes: Metadata = {"compression": "zip"}
    attributes[_METADATA_ATTRIBUTE] = json.dumps(plain)
    for key, value in plain.items():
        fits = not isinstance(value, int) or -(2**31) <= value < 2**31
        attributes[f"ncv_cl:{key}"] = value if fits else str(value)
    return attributes


def _write_file(
    file: Path,
    shown: Path,
    names: tuple[str, ...],
    data: np.ndarray,
    attributes: Metadata,
) -> None:
    """Write float channels to `file` (8 bits in a PNG); errors name the path `shown`."""
    height, width, count = data.shape
    png = file.suffix.lower() == ".png"
    spec = oiio.ImageSpec(width, height, count, oiio.UINT8 if png else oiio.FLOAT)
    spec.channelnames = names
    for key, value in attributes.items():
        spec.attribute(key, value)
    output = oiio.ImageOutput.create(str(file))
    if output is None:
        raise OSError(f"cannot write {shown}: {oiio.geterror()}")
    opened = output.open(str(file), spec)
    written = opened and output.write_image(np.ascontiguousarray(data, dtype=np.float32))
    # Closing writes too; and the PNG writer reports a full disk in its message alone.
    error = output.geterror()
    closed = output.close()
    error = error or output.geterror()
    if error or not (opened and written and closed):
        raise OSError(f"cannot write {shown}: {error or 'unknown error'}")
    # What the C library still buffered is lost in silence when the disk fills up at the close.
    try:
        _read_file(file)
    except ValueError as cut_short:
        raise OSError(f"cannot write {shown}: the file is incomplete, disk full?") from cut_short


def _read_file(path: str | Path) -> tuple[oiio.ImageSpec, np.ndarray]:
    """Return the specification and the (height, width, channels) float32 data of an image."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no image file {path}")
    # A PFM's rows go from bottom to top; OpenImageIO 3.2 turns them only when told to.
    config = oiio.ImageSpec()
    config.attribute("pnm:pfmflip", 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise ValueError(f"{path} is not an image that OpenImageIO reads: {oiio.geterror()}")
    try:
        spec = source.spec()
        data = source.read_image("float")
        if data is None:
            raise ValueError(f"{path} cannot be read, it may be cut short: {source.geterror()}")
    finally:
        source.close()
    return spec, data.reshape(spec.height, spec.width, spec.nchannels)
