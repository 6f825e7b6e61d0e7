"""Where single precision is finest: the scene is moved towards its viewer, and huge triangles are cut.

Everything from the mesh on is in single precision, whose steps grow with a coordinate's size: half a
metre at map coordinates of some thousand kilometres, a millimetre at the corners of a ground of twenty.
What the camera sees, and from how near, decides what error can be tolerated. So in double precision,
before anything is rounded, the scene is moved until its origin is near the camera. Triangles that are
huge as seen from there are cut, because a ray tracer's error grows with the triangle's size.

Functions here know nothing of scene files.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from trimesh.triangles import closest_point

from .geometry import Mesh
from .model import Camera

Vectors = NDArray[np.float64]

# The scene is moved if coordinates exceed this multiple of the distance to the nearest surface or of the
# scene's size; a triangle is cut if an edge exceeds this multiple of its distance from the camera.
LARGEST_RATIO = 64.0
# However narrow the view, an edge that is no longer than this multiple of that distance is not cut.
SMALLEST_RATIO = 1.0
# An edge is cut where the ray tracer's error for it exceeds this part of a pixel.
LOST_BY_EDGE = 0.25
# A camera on a surface counts as this far off it, as a part of the longest edge or of the scene's size.
SMALLEST_DISTANCE = 2.0**-32
# Steps of single precision that are lost, of a vertex's coordinates to the ray that leaves a surface
# there, and of its distance to the ray that comes from the camera; and a picture's rows: where the
# steps are larger than a pixel, the scene is not resolved.
STEPS_LOST, STEPS_LOST_BY_DISTANCE = 32, 2
PIXELS = 1024
# What part of the vertices in view has to be unresolved for a warning.
UNRESOLVED_PART = 0.01
# A mesh file is coarse where its coordinates are this many times its object's size.
COARSE_RATIO = 1e4


def scene_origin(corners: Vectors, camera: Camera) -> Vectors:
    """The point that becomes the scene's origin, float64 (3,).

    It is the point of the surfaces' bounds that is nearest to the camera: the camera itself, for one
    that is inside. Relative to it, coordinates of what is in view are at most twice the distance from
    the camera, and at most the scene's size. It is rounded to multiples of about a quarter of the
    tolerance, so that a camera that moves a little keeps the same origin. It is 0 for scenes that need
    not be moved.

    Parameters
    ----------
    corners : ndarray
        float64 (triangles, 3, 3), of all surfaces; lights may be far away.
    """
    lower, upper = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    nearest = np.clip(camera.position, lower, upper)
    size = float((upper - lower).max())
    distance = min(max(nearest_distance(corners, camera.position), SMALLEST_DISTANCE * size), size)
    # A scene without size shows nothing; an error says so later.
    if size == 0 or np.abs(nearest).max() <= LARGEST_RATIO * distance:
        return np.zeros(3)
    step = 2.0 ** np.floor(np.log2(LARGEST_RATIO * distance / 4))
    return np.round(nearest / step) * step


def moved(camera: Camera, origin: Vectors) -> Camera:
    """The camera about `origin`."""
    return replace(camera, position=camera.position - origin, target=camera.target - origin)


def cut_huge(mesh: Mesh, camera: Camera) -> Mesh:
    """The same surface, without triangles that are huge as seen from the camera.

    Triangles are halved along their longest edge until none is longer than `LARGEST_RATIO` times its
    distance from the camera, less where the view is narrow. A neighbour is cut at the same points,
    whether or not it shares vertices: there are no gaps, and no triangle gets much narrower than those
    of the mesh (Rivara 1984).
    """
    viewer, longest_of_all = camera.position, None
    ratio = LOST_BY_EDGE * _pixel(camera) / (2.0**-24 * STEPS_LOST)
    ratio = min(max(ratio, SMALLEST_RATIO), LARGEST_RATIO)
    # A quick test that most meshes pass: the whole is short enough for its own distance.
    lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    away = np.maximum(np.maximum(lower - viewer, viewer - upper), 0.0)
    if np.linalg.norm(upper - lower) <= ratio * np.linalg.norm(away):
        return mesh
    while len(mesh.triangles):
        corners = mesh.vertices[mesh.triangles]
        lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        longest = lengths.argmax(axis=1)
        if longest_of_all is None:
            longest_of_all = lengths.max()
        reach = lengths.max(axis=1) / ratio
        # A triangle's box is at least as near as the triangle: most triangles pass by their box.
        huge = reach > np.maximum(_box_distances(corners, viewer), SMALLEST_DISTANCE * longest_of_all)
        huge[huge] = reach[huge] > _distances(corners[huge], viewer)
        if not huge.any():
            break
        # Triangles with shorter edges only cannot share an edge that is cut.
        concerned = lengths.max(axis=1) >= lengths[huge].max(axis=1).min()
        parts = _halved(mesh, mesh.triangles[concerned], longest[concerned], huge[concerned])
        mesh = replace(parts, triangles=np.concatenate([mesh.triangles[~concerned], parts.triangles]))
    return mesh


def is_coarse(mesh: Mesh) -> bool:
    """Whether a mesh seems to have been rounded to single precision far from the origin."""
    largest = np.abs(mesh.vertices).max()
    if largest <= COARSE_RATIO * np.ptp(mesh.vertices, axis=0).max():
        return False
    return bool(np.all(mesh.vertices == mesh.vertices.astype(np.float32)))


def unresolved_steps(vertices: Vectors, origin: Vectors, camera: Camera) -> float:
    """By how many pixels single precision moves what is in view, if that is too much, else 0.

    It is compared with pixels of a picture of `PIXELS` rows, at the vertices in view.

    Parameters
    ----------
    vertices : ndarray
        float64 (n, 3), after the move.
    origin : ndarray
        float64 (3,), what they and the camera were moved by.
    camera : Camera
    """
    forward = camera.target - camera.position
    towards = vertices - camera.position
    depth = towards @ (forward / np.linalg.norm(forward))
    across = np.sqrt(np.maximum(np.sum(towards**2, axis=1) - depth**2, 0))
    # In the circle around a square picture.
    seen = (depth > 0) & (across <= 0.75 * PIXELS * _pixel(camera) * depth)
    if not seen.any():
        return 0.0
    pixel = _pixel(camera) * depth[seen]
    own, distant, world = (
        np.abs(points).max(axis=1) for points in (vertices[seen], towards[seen], vertices[seen] + origin)
    )
    steps = 2.0**-24 * (STEPS_LOST * own + STEPS_LOST_BY_DISTANCE * distant)
    lost = (steps + 2.0**-53 * STEPS_LOST * world) / pixel
    return float(np.median(lost[lost > 1])) if np.mean(lost > 1) > UNRESOLVED_PART else 0.0


def _pixel(camera: Camera) -> float:
    """A pixel's height at distance 1, of a picture of `PIXELS` rows."""
    return float(2 * np.tan(np.radians(camera.vertical_fov) / 2) / PIXELS)


def _halved(
    mesh: Mesh, triangles: NDArray[np.int64], longest: NDArray[np.intp], huge: NDArray[np.bool_]
) -> Mesh:
    """Some of a mesh's `triangles`, those that are `huge` halved along their `longest` edge.

    So are their neighbours, as far as that is needed; `longest` is the number of a triangle's edge.
    """
    vertices = mesh.vertices
    turn = (longest[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(triangles, turn, axis=1)
    # Edges by the positions they join: 0 the longest, then the others in order.
    used, index = np.unique(turned, return_inverse=True)
    _, place = np.unique(vertices[used], axis=0, return_inverse=True)
    place = place.reshape(-1)[index.reshape(turned.shape)]
    ends = np.stack([place, np.roll(place, -1, axis=1)])
    edges = ends.min(axis=0) * len(vertices) + ends.max(axis=0)
    marked = np.unique(edges[huge, 0])
    while True:
        is_cut = np.isin(edges, marked)
        more = is_cut.any(axis=1) & ~is_cut[:, 0]
        if not more.any():
            break
        marked = np.union1d(marked, edges[more, 0])
    own, is_cut = turned[is_cut[:, 0]], is_cut[is_cut[:, 0]]
    # Middles: vertex 3 + k of each is that of its edge k. A sum is the same in either order.
    following = np.roll(own, -1, axis=1)
    corners = np.concatenate([own, len(vertices) + np.arange(own.size).reshape(own.shape)], axis=1)
    a, b, c, m, q, r = corners.T
    second, third = is_cut[:, 1], is_cut[:, 2]
    parts = [
        np.stack([a, m, c], axis=1)[~third],
        np.stack([a, m, r], axis=1)[third],
        np.stack([r, m, c], axis=1)[third],
        np.stack([m, b, c], axis=1)[~second],
        np.stack([m, b, q], axis=1)[second],
        np.stack([m, q, c], axis=1)[second],
    ]
    kept = triangles[~np.isin(edges[:, 0], marked)]

    def with_middles(rows: Vectors) -> Vectors:
        return np.concatenate([rows, (0.5 * (rows[own] + rows[following])).reshape(-1, rows.shape[1])])

    return mesh.with_rows(with_middles, np.concatenate([kept, *parts]))


def _box_distances(corners: Vectors, point: Vectors) -> Vectors:
    """From `point` to the triangles' boxes, float64 (triangles,)."""
    nearest = np.clip(point, corners.min(axis=1), corners.max(axis=1))
    return np.linalg.norm(nearest - point, axis=1)


def _distances(corners: Vectors, point: Vectors) -> Vectors:
    """From `point` to the triangles, float64 (triangles,); infinite for those without area."""
    # Relative to the point: far from the world's origin the distances would be lost in rounding.
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = closest_point(corners - point, np.zeros((len(corners), 3)))
    return np.nan_to_num(np.linalg.norm(nearest, axis=1), nan=np.inf)


def nearest_distance(corners: Vectors, point: Vectors) -> float:
    """From `point` to the nearest triangle."""
    boxes = _box_distances(corners, point)
    first = int(boxes.argmin())
    bound = _distances(corners[first : first + 1], point)[0]
    return float(_distances(corners[boxes <= bound], point).min(initial=bound))
