"""The cells into which a ReLU network cuts the unit square, and pictures of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pyopencl as cl

from ..opencl.choose import choose_device
from ..opencl.device import Device, open_device
from ..opencl.memory import HostArray
from ..opencl.program import build
from .clip import Cell, clipped_cells
from .integrate import activation_slope, plain_arrays
from .integrator import Integrator, check_options
from .stage import layer_arguments, memory_of

# A face must be wider than so many roundings of its corners.
SLIVER_ROUNDINGS = 8
# Light to dark as layers go deeper; the border of the square is black.
LAYER_COLOURS = np.array([[0, 0, 0], [20, 20, 20], [200, 40, 40], [240, 140, 20], [250, 220, 90]])
# Anchors of the face colours, from the lowest value to the highest (after matplotlib's viridis).
VALUE_COLOURS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]])


@dataclass(frozen=True)
class Subdivision:
    """A network as what it is: affine functions on convex polygons.

    Attributes
    ----------
    vertices : array (v, 2)
        Corners in the unit square. A corner of one face may lie inside a side of another one.
    faces : list of int array
        Indices into `vertices`, counter-clockwise.
    affine : array (faces, channels, 3)
        (a, b, c) of g(u, v) = a u + b v + c in the face.
    area : array (faces,)
    edges : int array (e, 2)
        Every side of every face once, as indices into `vertices`.
    edge_layer : int array (e,)
        The hidden layer, from 1, whose neuron vanishes on the edge; 0 on the border of the square.
    """

    vertices: np.ndarray
    faces: list[np.ndarray]
    affine: np.ndarray
    area: np.ndarray
    edges: np.ndarray
    edge_layer: np.ndarray

    def integral(self) -> np.ndarray:
        """The integral of every channel over the square, (channels,)."""
        total = np.zeros(self.affine.shape[1])
        for face, affine in zip(self.faces, self.affine, strict=True):
            corners = self.vertices[face]
            first, second = corners[1:-1] - corners[0], corners[2:] - corners[0]
            areas = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
            centres = corners[0] + (first + second) / 3
            total += areas @ (centres @ affine[:, :2].T + affine[:, 2])
        return total

    def face_values(self, channel: int = 0) -> np.ndarray:
        """The value at the mean of each face's corners, (faces,)."""
        means = np.array([self.vertices[face].mean(0) for face in self.faces])
        affine = self.affine[:, channel]
        return (affine[:, :2] * means).sum(-1) + affine[:, 2]


def subdivide(
    weights: Sequence[np.ndarray],
    biases: Sequence[np.ndarray],
    *,
    precision: str | None = None,
    activation: str = "relu",
    negative_slope: float = 0.01,
    device: Device | str | int | None = None,
) -> Subdivision:
    """Cut the unit square into the cells in which one network is affine.

    Parameters
    ----------
    weights, biases : sequence of array
        As for `integrate`, without a points axis.
    precision : {"float32", "float64"}, optional
        By default float64 where the device has it.
    activation : {"relu", "leaky_relu"}
    negative_slope : float
    device : Device, str or int, optional

    Raises
    ------
    ValueError
        As `integrate`; also if an array has a points axis.

    Notes
    -----
    The subdivision certifies itself as `integrate` does. Where rounding in single precision leads a
    line astray it is made in double precision, where that happens in double, by cutting polygons on
    the host. Faces that are thinner than rounding are left out: those that lines through one point, or
    equal ones, leave behind.
    """
    device = choose_device(device)
    precision = precision or ("float64" if device.has_float64 else "float32")
    slope = activation_slope(activation, negative_slope)
    check_options("full", precision, slope, device)
    # One network is one work-item's work.
    single = open_device(device.cl_device, device.index, device.vector_width, 1, device.use_fma)
    dtype = np.dtype(np.float64 if precision == "float64" else np.float32)
    weights, biases, _ = plain_arrays(weights, biases, dtype)
    if any(w.ndim == 3 for w in weights) or any(b.ndim == 2 for b in biases):
        raise ValueError(
            "subdivide takes one network: pass the arrays of one point, without points axis"
        )
    widths = (2, *(len(bias) for bias in biases))
    if len(widths) == 2:
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype)
        affine = np.concatenate([weights[0], biases[0][:, None]], 1)[None]
        return _assemble(np.array([0]), np.ones(1), affine, corners, np.zeros(4, np.int32))
    return _assemble(*_without_slivers(*_certified(single, widths, precision, slope, weights, biases)))


def _certified(
    device: Device,
    widths: tuple[int, ...],
    precision: str,
    slope: float,
    weights: list[np.ndarray],
    biases: list[np.ndarray],
) -> tuple[np.ndarray, ...]:
    """The cells in the precision asked for, else in double, else by cutting polygons."""
    double = ("float64",) if precision == "float32" and device.has_float64 else ()
    for one in (precision, *double):
        integrator = Integrator(device, widths, method="full", precision=one, negative_slope=slope)
        cells = _emit(
            device,
            integrator,
            [array.astype(integrator.dtype) for array in weights],
            [array.astype(integrator.dtype) for array in biases],
        )
        if cells is not None:
            return cells
    return _joined(list(clipped_cells(weights, biases, slope)))


def _joined(cells: list[Cell]) -> tuple[np.ndarray, ...]:
    """Clipped cells as the kernel writes them."""
    sizes = [len(cell.corners) for cell in cells]
    areas = []
    for cell in cells:
        x, y = (cell.corners - cell.corners[0]).T
        areas.append(0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
    return (
        np.cumsum([0, *sizes[:-1]]),
        np.array(areas),
        np.stack([cell.affine for cell in cells]),
        np.concatenate([cell.corners for cell in cells]),
        np.concatenate([cell.layers for cell in cells]),
    )


def _without_slivers(
    first_corner: np.ndarray,
    area: np.ndarray,
    affine: np.ndarray,
    corners: np.ndarray,
    layers: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Drop faces that are thinner than the rounding of their corners; see `_emit` for the arrays."""
    sizes = np.diff([*first_corner, len(corners)])
    low = np.minimum.reduceat(corners, first_corner)
    high = np.maximum.reduceat(corners, first_corner)
    thinnest = SLIVER_ROUNDINGS * np.finfo(corners.dtype).eps * np.max(high - low, axis=1)
    keep = area > thinnest
    kept = np.repeat(keep, sizes)
    first_corner = np.cumsum([0, *sizes[keep][:-1]])
    return first_corner, area[keep], affine[keep], corners[kept], layers[kept]


def _emit(
    device: Device, integrator: Integrator, weights: list[np.ndarray], biases: list[np.ndarray]
) -> tuple[np.ndarray, ...] | None:
    """Run the traversal twice: to count, then to write.

    Returns
    -------
    tuple of array, or None if the subdivision does not certify itself
        First corner and area of each cell, affine functions (cells, channels, 3), corners (n, 2), and
        the layer of the side that starts at each corner.
    """
    files, defines = integrator.programs()[0]
    strides = [int(stride) for stride in str(defines["STRIDES"]).split(",")]
    # The output layer's affine functions are one more layer of lines.
    defines = defines | {"LINE_LAYERS": len(strides), "LINE_STRIDE": max(strides)}
    program = build(device, (*files, "subdivide"), defines)
    work_bytes, table_bytes = memory_of(program, "integrate_memory")
    flags = cl.mem_flags.READ_WRITE
    work = cl.Buffer(device.context, flags, size=work_bytes)
    tables = cl.Buffer(device.context, flags, size=table_bytes)
    layers = ([HostArray.of(device, array) for array in arrays] for arrays in (weights, biases))
    parameters = layer_arguments(*layers)
    counts = HostArray(device, 3, np.int32)
    channels = integrator.widths[-1]
    cells = corners = 0
    for _ in range(2):
        outputs = {
            "first_corner": HostArray(device, cells, np.int32),
            "areas": HostArray(device, cells, integrator.dtype),
            "affine": HostArray(device, (cells, channels, 3), integrator.dtype),
            "corners": HostArray(device, (corners, 2), integrator.dtype),
            "layers": HostArray(device, corners, np.int32),
        }
        program.kernel("subdivide")(
            1,
            counts=counts,
            cell_capacity=cells,
            corner_capacity=corners,
            **outputs,
            work=work,
            tables=tables,
            **parameters,
            group=1,
        )
        cells, corners, doubt = (int(count) for count in counts.read())
        if doubt:
            return None
    return tuple(array.read() for array in outputs.values())


def _assemble(
    first_corner: np.ndarray,
    area: np.ndarray,
    affine: np.ndarray,
    corners: np.ndarray,
    layers: np.ndarray,
) -> Subdivision:
    """Give corners with equal coordinates one index, and sides with equal ends."""
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    index = index.reshape(-1)
    faces = np.split(index, first_corner[1:])
    following = np.concatenate([np.roll(face, -1) for face in faces])
    sides = np.sort(np.stack([index, following], 1), axis=1)
    keep = sides[:, 0] != sides[:, 1]
    edges, position = np.unique(sides[keep], axis=0, return_index=True)
    return Subdivision(vertices, faces, affine, area, edges, layers[keep][position])


def draw_subdivision(
    subdivision: Subdivision, path: str | Path, *, channel: int = 0, size: int = 768
) -> None:
    """Draw the faces coloured by value and the edges by layer.

    Parameters
    ----------
    subdivision : Subdivision
    path : str or Path
        Ends in ``.svg`` or ``.png``. v points up.
    channel : int
        The output that colours the faces.
    size : int
        Width and height in pixels.

    Raises
    ------
    ValueError
        Another suffix, or a channel that does not exist.
    OSError
        The file cannot be written.
    """
    path = Path(path)
    channels = subdivision.affine.shape[1]
    if not 0 <= channel < channels:
        raise ValueError(f"channel {channel} does not exist, the network has {channels}")
    if path.suffix == ".svg":
        path.write_text(_svg(subdivision, channel, size), encoding="utf-8")
    elif path.suffix == ".png":
        _write_png(_raster(subdivision, channel, size), path)
    else:
        raise ValueError(f"{path} must end in .svg or .png")


def _colours(values: np.ndarray) -> np.ndarray:
    """RGB in [0, 255] for values from their minimum to their maximum."""
    span = np.ptp(values)
    position = (values - values.min()) / span if span > 0 else np.full_like(values, 0.5)
    anchors = np.linspace(0, 1, len(VALUE_COLOURS))
    return np.stack([np.interp(position, anchors, column) for column in VALUE_COLOURS.T], -1)


def _svg(subdivision: Subdivision, channel: int, size: int) -> str:
    colours = _colours(subdivision.face_values(channel)).round().astype(int)
    points = subdivision.vertices * [1, -1] + [0, 1]
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{size}" height="{size}" viewBox="0 0 1 1" '
        'stroke-linecap="round" shape-rendering="geometricPrecision">'
    ]
    for face, (red, green, blue) in zip(subdivision.faces, colours, strict=True):
        corners = " ".join(f"{u:.6f},{v:.6f}" for u, v in points[face])
        lines.append(f'<polygon points="{corners}" fill="rgb({red},{green},{blue})"/>')
    for layer in sorted(set(subdivision.edge_layer), reverse=True):
        red, green, blue = LAYER_COLOURS[layer]
        width = 0.0008 if layer > 1 else 0.0018
        ends = points[subdivision.edges[subdivision.edge_layer == layer]]
        path = "".join(f"M{a[0]:.6f} {a[1]:.6f}L{b[0]:.6f} {b[1]:.6f}" for a, b in ends)
        lines.append(f'<path d="{path}" stroke="rgb({red},{green},{blue})" stroke-width="{width}"/>')
    return "\n".join([*lines, "</svg>", ""])


def _raster(subdivision: Subdivision, channel: int, size: int) -> np.ndarray:
    """The picture as (size, size, 3) in [0, 255]: values per pixel, then edges over them."""
    pixels = subdivision.vertices * size
    values = np.zeros((size, size))
    for face, affine in zip(subdivision.faces, subdivision.affine[:, channel], strict=True):
        window, u, v = _window(pixels[face], size, 0)
        inside = np.ones(u.shape, bool)
        for start, end in zip(pixels[face], np.roll(pixels[face], -1, axis=0), strict=True):
            (du, dv), (pu, pv) = end - start, start
            inside &= du * (v - pv) - dv * (u - pu) >= 0
        values[window][inside] = ((affine[0] * u + affine[1] * v) / size + affine[2])[inside]
    picture = _colours(values)
    for layer in sorted(set(subdivision.edge_layer), reverse=True):
        half_width = 0.3 if layer > 1 else 0.8
        for start, end in pixels[subdivision.edges[subdivision.edge_layer == layer]]:
            window, u, v = _window(np.stack([start, end]), size, 2)
            along = end - start
            t = ((u - start[0]) * along[0] + (v - start[1]) * along[1]) / max(along @ along, 1e-12)
            t = np.clip(t, 0, 1)
            distance = np.hypot(u - start[0] - t * along[0], v - start[1] - t * along[1])
            cover = np.clip(half_width + 0.5 - distance, 0, 1)[..., None]
            picture[window] = picture[window] * (1 - cover) + LAYER_COLOURS[layer] * cover
    return picture[::-1]


def _window(
    corners: np.ndarray, size: int, margin: int
) -> tuple[tuple[slice, slice], np.ndarray, np.ndarray]:
    """The pixels around some corners: slices of the picture, and the pixels' centres."""
    low = np.clip(np.floor(corners.min(0)).astype(int) - margin, 0, size)
    high = np.clip(np.ceil(corners.max(0)).astype(int) + margin, 0, size)
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]] + 0.5
    return (slice(low[1], high[1]), slice(low[0], high[0])), u, v


def _write_png(picture: np.ndarray, path: Path) -> None:
    height, width, channels = picture.shape
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        raise OSError(f"cannot write {path}: {oiio.geterror()}")
    spec = oiio.ImageSpec(width, height, channels, "uint8")
    if not output.open(str(path), spec) or not output.write_image(picture.round().astype(np.uint8)):
        raise OSError(f"cannot write {path}: {output.geterror()}")
    output.close()
