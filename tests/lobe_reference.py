"""Samples of the lobe's strip in float64: directions, densities, and what they meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from reference import light_samples, scattering, tangent_frame, unit


def lobe_directions(normal, outgoing, roughness, u, v):
    """GGX's visible normals by a spherical cap (Dupuy and Benyoub 2023), reflected, float64 (n, 3)."""
    axes = np.stack([*tangent_frame(normal), normal])
    stretch = np.array([roughness**2, roughness**2, 1.0])
    local = axes @ outgoing
    start = unit(local * stretch)
    height = (1 - v) * (1 + start[2]) - start[2]
    radius = np.sqrt(np.maximum(1 - height**2, 0))
    cap = np.stack([radius * np.cos(2 * np.pi * u), radius * np.sin(2 * np.pi * u), height], -1)
    half = unit((cap + start) * stretch)
    return (2 * (half @ local)[:, None] * half - local) @ axes


def lobe_density(normal, outgoing, incident, roughness):
    """Its density, D G1 / (4 cos_o)."""
    alpha2 = roughness**4
    half = unit(incident + outgoing)
    slope = np.sum(np.cross(normal, half) ** 2, -1) + alpha2 * (half @ normal) ** 2
    cosine = outgoing @ normal
    return alpha2 / (np.pi * slope**2) / 2 / (cosine + np.sqrt(alpha2 + (1 - alpha2) * cosine**2))


def places_on(light, position, directions):
    """Where directions meet a light's plane, in its square's coordinates, and how far away."""
    corner, edge1, edge2 = (np.asarray(e, float) for e in (light.corner, light.edge1, light.edge2))
    normal = unit(np.cross(edge1, edge2))
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((corner - position) @ normal) / (directions @ normal)
        met = position + distance[:, None] * directions - corner
        return *(np.linalg.pinv(np.stack([edge1, edge2], axis=1)) @ met.T), distance


def density_of_light(light, position, towards, s, t):
    """Of directions that meet the light at (s, t) of its square, by samples of the light."""
    edge1, edge2 = light.edge1.astype(float), light.edge2.astype(float)
    middle = light.corner + (edge1 + edge2) / 2 - position
    at = light.corner + s[:, None] * edge1 + t[:, None] * edge2 - position
    distance = np.linalg.norm(at, axis=1)
    if edge1 @ edge1 + edge2 @ edge2 <= middle @ middle:
        return distance**2 / np.abs(towards @ light.normal.astype(float)) / light.area
    along = unit(edge2)
    across = np.cross(along, light.normal.astype(float))
    z = abs((light.corner - position) @ light.normal.astype(float))
    begin = light.corner + s[:, None] * edge1 - position
    radius = np.hypot(begin @ across, z)
    sines = [end @ along / np.hypot(end @ along, radius) for end in (begin, begin + edge2)]
    sides = [(light.corner + edge - position) @ across for edge in (0 * edge1, edge1)]
    return 1 / ((np.arctan2(sides[1], z) - np.arctan2(sides[0], z)) * (sines[1] - sines[0]))


@dataclass(frozen=True)
class Expected:
    """A point's samples in float64; `clear` where rounding does not decide what they meet."""

    value: np.ndarray
    end: np.ndarray
    lit: np.ndarray
    clear: np.ndarray


def expected_samples(light, material, point, u, v, share) -> Expected:
    """`point` holds position, normal and direction to the viewer."""
    position, normal, outgoing = point
    in_lobe = u < share
    towards = lobe_directions(normal, outgoing, material.roughness, u / share, v)
    at, _ = light_samples(light, position, (u - share) / (1 - share), v)
    towards[~in_lobe] = unit(at - position)[~in_lobe]
    s, t, distance = places_on(light, position, towards)
    off_middle = np.maximum(np.abs(s - 0.5), np.abs(t - 0.5))
    meets = ~in_lobe | (off_middle < 0.5) & (distance > 0)
    facing = -towards @ light.normal.astype(float)
    cosine = towards @ normal
    lit = meets & (cosine > 0) & ((facing > 0) | light.two_sided)
    own = density_of_light(light, position, towards, s, t)
    density = share * lobe_density(normal, outgoing, towards, material.roughness) + (1 - share) * own
    f_r = scattering(
        normal, outgoing, towards, material.albedo, material.reflectance, material.roughness
    )
    value = np.where(lit, cosine / density, 0)[:, None] * f_r * light.radiance
    clear = ~in_lobe | (np.abs(off_middle - 0.5) > 1e-3)
    return Expected(value, position + distance[:, None] * towards, lit, clear)
