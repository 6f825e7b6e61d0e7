"""The network in plain numpy, float64: encoding, forward pass and loss."""

from __future__ import annotations

import numpy as np

from ncv_cl.network.network import Network
from ncv_cl.points.points import ShadingPoints


def one_blob(x: np.ndarray, bins: int, wraps: bool) -> np.ndarray:
    """(points,) angles in [0, 1] -> (bins, points)."""
    distance = np.abs(x - (np.arange(bins)[:, None] + 0.5) / bins)
    if wraps:
        distance = np.minimum(distance, 1 - distance)
    return np.exp(-0.5 * (distance * bins) ** 2)


def direction_blobs(direction: np.ndarray, bins: int) -> np.ndarray:
    """(3, points) unit vectors -> (2 bins, points)."""
    polar = np.arccos(np.clip(direction[2], -1, 1)) / np.pi
    azimuth = np.arctan2(direction[1], direction[0]) / (2 * np.pi) + 0.5
    return np.concatenate([one_blob(polar, bins, False), one_blob(azimuth, bins, True)])


def corners(network: Network, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Table entries and trilinear weights, (levels, 8, points), of (3, points) positions."""
    encoding = network.description.encoding
    lower = np.array(network.cube.lower, np.float32).astype(float)[:, None]
    unit = np.clip((position - lower) / np.float32(network.cube.side), 0, 1)
    entries, weights = [], []
    for level in range(encoding.grid_levels):
        cells = encoding.grid_base << level
        cell = np.minimum(np.floor(unit * cells), cells - 1)
        part = unit * cells - cell
        for k in range(8):
            step = np.array([k & 1, (k >> 1) & 1, k >> 2])[:, None]
            x, y, z = (cell + step).astype(np.uint64)
            if (cells + 1) ** 3 <= encoding.grid_entries:
                entry = (z * (cells + 1) + y) * (cells + 1) + x
            else:
                wrapped = x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)
                entry = wrapped % encoding.grid_entries
            entries.append(level * encoding.grid_entries + entry)
            weights.append(np.prod(np.where(step == 1, part, 1 - part), axis=0))
    shape = (encoding.grid_levels, 8, -1)
    return np.array(entries, np.int64).reshape(shape), np.array(weights).reshape(shape)


def features(network: Network, points: ShadingPoints, table: np.ndarray | None = None) -> np.ndarray:
    """(features, points.active), in the kernels' order."""
    encoding = network.description.encoding
    table = network.table if table is None else table
    rows = {name: points.rows(name)[:, : points.active].astype(float) for name in encoding.inputs}
    entries, weights = corners(network, rows["position"])
    grid = np.einsum("lkp,lkpf->lfp", weights, table.astype(float)[entries])
    parts = [grid.reshape(encoding.grid_rows, -1)]
    for name in encoding.inputs[1:]:
        is_direction = name in ("normal", "outgoing")
        parts.append(direction_blobs(rows[name], encoding.blob_bins) if is_direction else rows[name])
    return np.concatenate(parts)


def groups(network: Network, feature: np.ndarray, parameters=None) -> dict[str, np.ndarray]:
    """Each group's weights at each of the columns of `feature`, (columns, *shape); W2 once."""
    description = network.description
    chosen = (network.parameters if parameters is None else parameters).astype(float)
    w2, heads, bases = description.unpack(chosen)
    ones = np.ones((1, feature.shape[1]))
    rows = np.concatenate([heads @ np.concatenate([feature, ones]), bases[:, None] * ones]).T
    found = {"W2": w2}
    for group, shape in description.group_shapes.items():
        first = description.group_rows[group]
        found[group] = rows[:, first : first + int(np.prod(shape))].reshape(-1, *shape)
    return found


def forward(network: Network, feature: np.ndarray, uv: np.ndarray, parameters=None) -> np.ndarray:
    """g, (channels, columns, samples), of (features, columns) and (2, columns, samples)."""
    p = groups(network, feature, parameters)
    h1 = np.maximum(np.einsum("pji,ips->jps", p["W1"], uv) + p["B1"].T[..., None], 0)
    h2 = np.maximum(np.einsum("kj,jps->kps", p["W2"], h1) + p["B2"].T[..., None], 0)
    return np.einsum("pck,kps->cps", p["W3"], h2) + p["B3"].T[..., None]
