"""The scattering function against float64, its reciprocity, and the energy it may not create."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from reference import bare_kernel, scattering, tangent_frame, unit

from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import SURFACE, surface_defines

KERNEL = """
kernel void bare_scattering(const uint count, global const float *surface, global const float *incident,
                            global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const ShadingPoint p = load_shading_point(surface, 1u, 0u);
  const Scatterer s = scatterer_of(&p);
  const triple towards = {LOAD(incident + first), LOAD(incident + count + first),
                          LOAD(incident + 2 * count + first)};
  real f_r[3];
  scattering(&s, towards, f_r);
  for (int channel = 0; channel < 3; ++channel) STORE(f_r[channel], result + channel * count + first);
}
"""
ROUGHNESS = [0.01, 0.012, 0.02, 0.05, 0.1, 0.3, 0.6, 1.0]


@functools.cache
def scattering_kernel(device, has_specular):
    defines = {**surface_defines(), "HAS_SPECULAR": has_specular}
    return bare_kernel(device, ("common", "surface", "bsdf"), defines, KERNEL, "bare_scattering")


def evaluate(device, normal, outgoing, incident, albedo, reflectance, roughness, has_specular=1):
    """f_r (n, 3) of the device for incident directions (n, 3)."""
    surface = np.zeros(SURFACE.size, np.float32)
    rows = {
        "normal": normal, "geometric_normal": normal, "outgoing": outgoing, "albedo": albedo,
        "reflectance": reflectance,
    }  # fmt: skip
    for name, value in rows.items():
        surface[SURFACE[name]] = value
    surface[SURFACE["roughness"]] = roughness
    padded = -(-len(incident) // device.vector_width) * device.vector_width
    towards = np.zeros((3, padded), np.float32)
    towards[:, : len(incident)] = np.asarray(incident).T
    kernel = scattering_kernel(device, has_specular)
    result = HostArray(device, (3, padded), np.float32)
    kernel(
        padded // device.vector_width,
        count=padded,
        surface=HostArray.of(device, surface),
        incident=HostArray.of(device, towards),
        result=result,
    )
    return result.read()[:, : len(incident)].T.astype(np.float64)


def half_vector_grid(outgoing, alpha, side):
    """Incident directions about z whose half vectors are spread as GGX, (side², 3)."""
    cell = (np.arange(side) + 0.5) / side
    share, azimuth = (grid.ravel() for grid in np.meshgrid(cell, 2 * np.pi * cell))
    cosine = np.sqrt((1 - share) / (1 + (alpha**2 - 1) * share))
    sine = np.sqrt(np.maximum(0, 1 - cosine**2))
    half = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], -1)
    return 2 * (half @ outgoing)[:, None] * half - outgoing


def half_vector_density(incident, outgoing, alpha):
    half = unit(incident + outgoing)
    slope = half[:, 0] ** 2 + half[:, 1] ** 2 + alpha**2 * half[:, 2] ** 2
    return alpha**2 * half[:, 2] / (np.pi * slope**2) / (4 * np.abs(half @ outgoing))


def cosine_grid(side):
    cell = (np.arange(side) + 0.5) / side
    share, azimuth = (grid.ravel() for grid in np.meshgrid(cell, 2 * np.pi * cell))
    radius = np.sqrt(share)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.sqrt(1 - share)], -1)


def frame(normal):
    """Rows: tangent, bitangent, normal."""
    return np.stack([*tangent_frame(normal), normal])


NORMAL = unit([0.3, -0.8, 0.45])


@pytest.mark.parametrize("roughness", ROUGHNESS)
@pytest.mark.parametrize("cosine_o", [1.0, 0.6, 0.05])
def test_scattering_matches_float64(device, roughness, cosine_o):
    generator = np.random.default_rng(4)
    colours = (0.2, 0.5, 0.9), (0.04, 0.0, 0.8)
    outgoing = np.array([np.sqrt(1 - cosine_o**2), 0, cosine_o])
    incident = np.concatenate(
        [
            half_vector_grid(outgoing, roughness**2, 12),
            unit(generator.normal(size=(101, 3))),
            [outgoing * [-1, 1, 1], outgoing, [0, 0, 1]],
        ]
    )
    axes = frame(NORMAL)
    directions = [(v @ axes).astype(np.float32) for v in (axes[2] * 0 + [0, 0, 1], outgoing, incident)]
    value = evaluate(device, *directions, *colours, roughness)
    expected = scattering(*directions, *colours, roughness)
    # Rounding turns the half vector by some 1e-7, which a lobe of width alpha feels as 1e-7 / alpha.
    tolerance = 3e-5 + 2e-6 / roughness**2
    clear = np.abs(incident[:, 2]) > 1e-3
    np.testing.assert_allclose(value[clear], expected[clear], rtol=tolerance, atol=1e-7)
    assert np.isfinite(value).all() and (value >= 0).all()
    assert not value[incident[:, 2] < -1e-6].any()


def test_without_reflectance_it_is_lambert(device):
    incident = unit(np.random.default_rng(1).normal(size=(33, 3)))
    incident[:, 2] = np.abs(incident[:, 2])
    albedo = np.array([0.2, 0.5, 1.0])
    arguments = ([0, 0, 1], unit([1, 1, 2]), incident, albedo, [0, 0, 0], 0.5)
    plain = evaluate(device, *arguments, has_specular=0)
    np.testing.assert_allclose(plain, np.tile(albedo / np.pi, (33, 1)), rtol=1e-6)
    np.testing.assert_allclose(evaluate(device, *arguments), plain, rtol=1e-6)


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_scattering_is_reciprocal(device, roughness):
    generator = np.random.default_rng(2)
    colours = (0.2, 0.5, 0.9), (0.04, 0.5, 0.9)
    for _ in range(3):
        first, second = unit(np.array([0, 0, 1.5]) + generator.normal(size=(2, 3)))
        first[2], second[2] = np.abs([first[2], second[2]])
        there = evaluate(device, [0, 0, 1], first, second[None], *colours, roughness)
        back = evaluate(device, [0, 0, 1], second, first[None], *colours, roughness)
        np.testing.assert_allclose(there, back, rtol=3e-5 + 2e-6 / roughness**2)


@pytest.mark.parametrize("roughness", ROUGHNESS)
@pytest.mark.parametrize("cosine_o", [1.0, 0.6, 0.2, 0.01])
def test_no_direction_reflects_more_than_it_receives(device, roughness, cosine_o):
    reflectance = np.array([0.02, 0.2, 1.0])
    alpha, side = roughness**2, 256
    outgoing = np.array([np.sqrt(1 - cosine_o**2), 0, cosine_o])
    incident = np.concatenate([half_vector_grid(outgoing, alpha, side), cosine_grid(side)])
    incident = incident[incident[:, 2] > 0]
    value = evaluate(device, [0, 0, 1], outgoing, incident, [1, 1, 1], reflectance, roughness)
    # Both grids together, weighted by the balance heuristic.
    density = half_vector_density(incident, outgoing, alpha) + incident[:, 2] / np.pi
    reflected = (value * (incident[:, 2] / density)[:, None]).sum(0) / side**2
    assert (reflected <= 1 + 1e-3).all()
    # The whole lobe is in the sum: a mirror that is nearly smooth loses next to nothing.
    if roughness <= 0.1 and cosine_o >= 0.4:
        assert reflected[2] > 0.98
