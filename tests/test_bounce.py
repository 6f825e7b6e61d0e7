"""Directions sampled by the surface's scattering: their distribution, and the map of the square."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from reference import bare_kernel, tangent_frame, unit
from scipy.stats import chi2

from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import SURFACE, surface_defines

KERNEL = """
kernel void bare_bounce(const uint count, global const float *surface, global const float *rows,
                        global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const ShadingPoint p = load_shading_point(surface, 1u, 0u);
  const Scatterer s = scatterer_of(&p);
  const triple towards = sample_scattering(&s, LOAD(rows + first), LOAD(rows + count + first));
  STORE(towards.x, result + first);
  STORE(towards.y, result + count + first);
  STORE(towards.z, result + 2 * count + first);
  STORE(scattering_density(&s, towards), result + 3 * count + first);
}
kernel void bare_density(const uint count, global const float *surface, global const float *rows,
                         global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const ShadingPoint p = load_shading_point(surface, 1u, 0u);
  const Scatterer s = scatterer_of(&p);
  const triple towards = {LOAD(rows + first), LOAD(rows + count + first),
                          LOAD(rows + 2 * count + first)};
  STORE(scattering_density(&s, towards), result + first);
}
"""
TURNS = """
kernel void turns(const uint count, global const float *angle, global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  real cosine;
  STORE(sincos_of_turns(LOAD(angle + first), &cosine), result + first);
  STORE(cosine, result + count + first);
}
"""
NORMAL = unit([0.3, -0.8, 0.45])
MATTE = ((0.4, 0.5, 0.6), (0.0, 0.0, 0.0), 1.0)
SURFACES = [MATTE] + [((0.3, 0.2, 0.1), (0.3, 0.5, 0.4), roughness) for roughness in (0.3, 0.6, 1.0)]


@functools.cache
def kernel_of(device, name):
    defines = {**surface_defines(), "HAS_SPECULAR": 1}
    return bare_kernel(device, ("common", "surface", "bsdf", "bounce"), defines, KERNEL, name)


def run(device, name, rows, surface_of, cosine_o):
    """The kernel's outputs for columns of `rows` (n, …), about NORMAL with an outgoing direction."""
    albedo, reflectance, roughness = surface_of
    outgoing = outgoing_at(cosine_o)
    surface = np.zeros(SURFACE.size, np.float32)
    known = {"normal": NORMAL, "outgoing": outgoing, "albedo": albedo, "reflectance": reflectance}
    for row, value in known.items():
        surface[SURFACE[row]] = value
    surface[SURFACE["roughness"]] = roughness
    count = -(-len(rows) // device.vector_width) * device.vector_width
    padded = np.zeros((rows.shape[1], count), np.float32)
    padded[:, : len(rows)] = rows.T
    result = HostArray(device, (4, count), np.float32)
    result.fill(0.0)
    kernel_of(device, name)(
        count // device.vector_width,
        count=count,
        surface=HostArray.of(device, surface),
        rows=HostArray.of(device, padded),
        result=result,
    )
    return result.read()[:, : len(rows)].astype(float)


def axes():
    return np.stack([*tangent_frame(NORMAL), NORMAL])


def outgoing_at(cosine):
    return np.array([np.sqrt(1 - cosine**2), 0, cosine]) @ axes()


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("cosine_o", [0.95, 0.3])
def test_directions_follow_their_density(device, surface, cosine_o):
    generator, samples, side, fine = np.random.default_rng(3), 200_000, (12, 24), 24
    found = run(device, "bare_bounce", generator.uniform(size=(samples, 2)), surface, cosine_o)
    local = axes() @ found[:3]
    np.testing.assert_allclose(np.linalg.norm(local, axis=0), 1, atol=2e-5)
    # Cells of equal solid angle over the upper hemisphere; what goes below is the last one.
    height = np.clip((local[2] * side[0]).astype(int), -1, side[0] - 1)
    azimuth = ((np.arctan2(local[1], local[0]) / (2 * np.pi) % 1) * side[1]).astype(int) % side[1]
    below = local[2] < 0
    cell = np.where(below, side[0] * side[1], height * side[1] + azimuth)
    counts = np.bincount(cell, minlength=side[0] * side[1] + 1)
    # The density, integrated over each cell by the midpoint rule.
    z = (np.arange(side[0] * fine) + 0.5) / (side[0] * fine)
    angle = (np.arange(side[1] * fine) + 0.5) / (side[1] * fine) * 2 * np.pi
    z, angle = (grid.ravel() for grid in np.meshgrid(z, angle, indexing="ij"))
    sine = np.sqrt(1 - z**2)
    incident = np.stack([sine * np.cos(angle), sine * np.sin(angle), z], -1) @ axes()
    density = run(device, "bare_density", incident, surface, cosine_o)[0]
    mass = density.reshape(side[0], fine, side[1], fine).mean((1, 3)).ravel() * 2 * np.pi
    expected = samples * np.append(mass / side[0] / side[1], 0)
    expected[-1] = max(samples - expected.sum(), 0)
    # Cells that expect little count as one.
    few = expected < 20
    counts = np.append(counts[~few], counts[few].sum())
    expected = np.append(expected[~few], expected[few].sum())
    kept = expected > 0
    statistic = np.sum((counts[kept] - expected[kept]) ** 2 / expected[kept])
    assert chi2.sf(statistic, kept.sum() - 1) > 1e-4, (statistic, kept.sum())


@pytest.mark.parametrize("surface", SURFACES)
def test_sampled_and_asked_densities_agree(device, surface):
    square = np.random.default_rng(1).uniform(size=(1000, 2))
    found = run(device, "bare_bounce", square, surface, 0.6)
    asked = run(device, "bare_density", found[:3].T, surface, 0.6)[0]
    np.testing.assert_allclose(found[3], asked, rtol=1e-5)
    assert (found[3] >= 0).all() and np.isfinite(found).all()


def test_neighbours_on_the_square_are_neighbours_on_the_hemisphere(device):
    side = 64
    cell = (np.arange(side) + 0.5) / side
    square = np.stack(np.meshgrid(cell, cell, indexing="ij"), -1).reshape(-1, 2)
    directions = run(device, "bare_bounce", square, MATTE, 0.9)[:3].T.reshape(side, side, 3)
    # On the disc: the hemisphere itself is steep at its rim.
    disc = directions @ axes()[:2].T
    for axis in (0, 1):
        assert np.linalg.norm(np.diff(disc, axis=axis), axis=-1).max() < 4 / side


def test_sine_and_cosine_of_turns(device):
    defines = {**surface_defines(), "HAS_SPECULAR": 1}
    kernel = bare_kernel(device, ("common", "surface", "bsdf", "bounce"), defines, TURNS, "turns")
    count = 1 << 12
    angle = np.linspace(-1.25, 1.25, count).astype(np.float32)
    angle[:9] = np.arange(-4, 5) / 4
    result = HostArray(device, (2, count), np.float32)
    kernel(count // device.vector_width, count=count, angle=HostArray.of(device, angle), result=result)
    exact = 2 * np.pi * angle.astype(float)
    np.testing.assert_allclose(result.read(), [np.sin(exact), np.cos(exact)], rtol=0, atol=2e-7)
