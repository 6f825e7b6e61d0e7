"""Directions in which glass scatters: their distribution, their worth, refraction, both sides."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from reference import bare_kernel, tangent_frame, unit
from scipy.stats import chi2

from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.panes import fresnel
from ncv_cl.points.points import SURFACE, surface_defines

KERNEL = """
kernel void bare_glass(const uint count, const int is_first, global const float *surface,
                       global const float *rows, global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const ShadingPoint p = load_shading_point(surface, 1u, 0u);
  const Scatterer s = scatterer_of(&p);
  const triple normal = to_triple(p.geometric_normal);
  const real u = LOAD(rows + first);
  real choice = LOAD(rows + 2 * count + first);
  const GlassRay ray = sample_glass(&s, normal, u, LOAD(rows + count + first), &choice, is_first);
  STORE(ray.direction.x, result + first);
  STORE(ray.direction.y, result + count + first);
  STORE(ray.direction.z, result + 2 * count + first);
  STORE(ray.throughput.x, result + 3 * count + first);
  STORE(ray.throughput.y, result + 4 * count + first);
  STORE(ray.density, result + 5 * count + first);
  real f_r[3];
  scattering(&s, ray.direction, f_r);
  STORE(f_r[0], result + 6 * count + first);
  STORE(glass_light_weight(&s, ray.direction, (real)1.0f, is_first), result + 7 * count + first);
  STORE(choice, result + 8 * count + first);
}
"""
NORMAL = unit([0.3, -0.8, 0.45])
TINT = (0.5, 0.25, 1.0)
SMOOTH, UNMATCHED = 0.01, 1e30
# Index of refraction and roughness: into glass and out of it.
ROUGH = [(1.5, 0.3), (1.5, 0.7), (1 / 1.5, 0.3), (1 / 1.5, 0.7)]


@functools.cache
def kernel_of(device):
    defines = {
        **surface_defines(),
        "HAS_SPECULAR": 1,
        "HAS_GLASS": 1,
        "SMOOTH_GLASS": f"{SMOOTH * 1.000001!r}f",
    }
    files = ("common", "surface", "bsdf", "bounce", "dielectric")
    return bare_kernel(device, files, defines, KERNEL, "bare_glass")


def axes():
    return np.stack([*tangent_frame(NORMAL), NORMAL])


def outgoing_at(cosine):
    return np.array([np.sqrt(1 - cosine**2), 0, cosine]) @ axes()


def run(device, square, eta, roughness, cosine, is_first=False, geometric=NORMAL):
    """Directions (3, n) in the normal's frame, throughputs (2, n), densities, f_r, weights, choices."""
    surface = np.zeros(SURFACE.size, np.float32)
    for row, value in {
        "normal": NORMAL, "geometric_normal": geometric, "outgoing": outgoing_at(cosine),
        "albedo": TINT,
    }.items():  # fmt: skip
        surface[SURFACE[row]] = value
    surface[SURFACE["roughness"]], surface[SURFACE["eta"]] = roughness, eta
    count = -(-len(square) // device.vector_width) * device.vector_width
    padded = np.zeros((3, count), np.float32)
    padded[:, : len(square)] = square.T
    result = HostArray(device, (9, count), np.float32)
    kernel_of(device)(
        count // device.vector_width,
        count=count,
        is_first=int(is_first),
        surface=HostArray.of(device, surface),
        rows=HostArray.of(device, padded),
        result=result,
    )
    found = result.read()[:, : len(square)].astype(float)
    return axes() @ found[:3], found[3:5], found[5], found[6], found[7], found[8]


def grid(side):
    """Points of the square, and the first coordinate once more, to choose by."""
    cell = (np.arange(side) + 0.5) / side
    u, v = (one.ravel() for one in np.meshgrid(cell, cell, indexing="ij"))
    return np.stack([u, v, u], -1)


# ------------------------------------------------------------------- Walter et al. 2007, float64


def facets(alpha, normals):
    """D of unit normals (n, 3) about z."""
    slope = normals[:, 0] ** 2 + normals[:, 1] ** 2 + alpha**2 * normals[:, 2] ** 2
    return np.where(normals[:, 2] > 0, alpha**2 / (np.pi * slope**2), 0.0)


def masked(alpha, cosine):
    """G1."""
    cosine = np.abs(cosine)
    return 2 * cosine / (cosine + np.sqrt(alpha**2 + (1 - alpha**2) * cosine**2))


def brdf(o, i, eta, alpha):
    """Equation 20, for o (3,) and i (n, 3) above the surface."""
    half = unit(o + i)
    shadow = masked(alpha, o[2]) * masked(alpha, i[:, 2])
    return fresnel(half @ o, np.full(len(i), eta)) * facets(alpha, half) * shadow / (4 * o[2] * i[:, 2])


def btdf(o, i, eta, alpha):
    """Equation 21: light comes from i below and leaves to o; eta is the index below over that above."""
    half = unit(o + eta * i)
    half *= np.sign(half[:, 2:])
    oh, ih = half @ o, np.sum(half * i, 1)
    shadow = masked(alpha, o[2]) * masked(alpha, i[:, 2])
    value = (1 - fresnel(np.maximum(oh, 0), np.full(len(i), eta))) * facets(alpha, half) * shadow
    value *= np.abs(oh * ih / (o[2] * i[:, 2])) / (oh + eta * ih) ** 2
    return np.where((oh > 0) & (ih < 0), value, 0.0)


def sphere(rows, columns):
    """Directions of cells of equal solid angle, (cells, 3), height by height from -1 to 1."""
    z = (np.arange(rows) + 0.5) / rows * 2 - 1
    angle = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    z, angle = (one.ravel() for one in np.meshgrid(z, angle, indexing="ij"))
    sine = np.sqrt(1 - z**2)
    return np.stack([sine * np.cos(angle), sine * np.sin(angle), z], -1)


def cells_of(directions, rows, columns):
    height = np.clip(((directions[2] + 1) / 2 * rows).astype(int), 0, rows - 1)
    azimuth = (np.arctan2(directions[1], directions[0]) / (2 * np.pi) % 1 * columns).astype(
        int
    ) % columns
    return height * columns + azimuth


@pytest.mark.parametrize("is_first", [False, True])
@pytest.mark.parametrize(("eta", "roughness"), ROUGH)
@pytest.mark.parametrize("cosine", [0.9, 0.4])
def test_directions_are_worth_the_scattering_times_the_cosine(device, eta, roughness, cosine, is_first):
    """Throughput summed over samples that fall into a cell of the sphere is ∫ f |cos| of Walter's f."""
    samples, rows, columns, fine, alpha = 200_000, 16, 12, 16, roughness**2
    square = np.random.default_rng(3).uniform(size=(samples, 3))
    directions, throughput, *_ = run(device, square, eta, roughness, cosine, is_first)
    o = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    at = sphere(rows * fine, columns * fine)
    above = at[:, 2] > 0
    f = np.zeros(len(at))
    f[above] = brdf(o, at[above], eta, alpha)
    f[~above] = btdf(o, at[~above], eta, alpha)
    # What is below is tinted.
    f[~above] *= TINT[0]
    mean = (f * np.abs(at[:, 2])).reshape(rows, fine, columns, fine).mean((1, 3)).ravel()
    expected = mean * 4 * np.pi / (rows * columns)
    cell = cells_of(directions, rows, columns)
    found = np.bincount(cell, throughput[0], rows * columns) / samples
    squares = np.bincount(cell, throughput[0] ** 2, rows * columns) / samples
    error = np.sqrt((squares - found**2) / samples)
    # Of what the surface swallows there is no error to tell.
    known = (np.bincount(cell, minlength=rows * columns) > 100) & (error > 0)
    assert known.sum() >= 15
    z = (found - expected)[known] / np.hypot(error[known], 2e-3 * expected[known])
    assert chi2.sf(np.sum(z**2), known.sum()) > 1e-4, np.abs(z).max()
    assert found[~known].sum() == pytest.approx(expected[~known].sum(), abs=2e-3)


@pytest.mark.parametrize("is_first", [False, True])
@pytest.mark.parametrize(("eta", "roughness"), ROUGH)
def test_a_reflection_has_the_density_that_its_weight_says(device, eta, roughness, is_first):
    square = np.random.default_rng(1).uniform(size=(20_000, 3))
    found = run(device, square, eta, roughness, 0.6, is_first)
    directions, throughput, density, f_r, weight, choice = found
    kept = (density < UNMATCHED) & (throughput[0] > 0)
    passed = (directions[2] < 0) & (throughput[0] > 0)
    assert kept.any() and passed.any() and (density[passed] == np.float32(UNMATCHED)).all()
    # f cos / density, and light of density 1 weighs 1 / (1 + density).
    np.testing.assert_allclose(
        (f_r * directions[2] / density)[kept], throughput[0][kept], rtol=2e-3, atol=1e-6
    )
    np.testing.assert_allclose(weight[kept], 1 / (1 + density[kept]), rtol=2e-4)
    # What chose is as good as new, for roulette.
    counts = np.histogram(square[:, 2] if is_first else choice, 16, (0, 1))[0]
    assert counts.sum() == len(square) and chi2.sf(np.sum((counts - 1250.0) ** 2 / 1250), 15) > 1e-4
    if not is_first:
        worth = throughput[0] / np.where(directions[2] > 0, 1, TINT[0] / eta**2)
        assert worth.max() < 1 + 1e-4


@pytest.mark.parametrize("is_first", [False, True])
@pytest.mark.parametrize("eta", [1.5, 1 / 1.5, 2.4, 1.0, -1.5])
@pytest.mark.parametrize("cosine", [0.95, 0.5, 0.1])
def test_smooth_glass_mirrors_and_bends_by_fresnel_and_snell(device, eta, cosine, is_first):
    square = grid(64)
    directions, throughput, density, _, weight, _ = run(device, square, eta, SMOOTH, cosine, is_first)
    reflected = fresnel(np.array([cosine]), np.array([abs(eta)]))[0]
    if eta < 0:
        reflected = 2 * reflected / (1 + reflected)
    up = directions[2] > 0
    sine = np.sqrt(1 - cosine**2)
    np.testing.assert_allclose(
        directions[:, up].T, np.tile([-sine, 0, cosine], (up.sum(), 1)), atol=2e-6
    )
    below = directions[:, ~up & (throughput[0] > 0)]
    inner = sine / eta if eta > 0 else sine
    if inner < 1:
        expected = [-inner, 0, -np.sqrt(1 - inner**2)]
        np.testing.assert_allclose(below.T, np.tile(expected, (below.shape[1], 1)), atol=3e-6)
    # As much as Fresnel says, the rest tinted, and less radiant where it comes from the denser side.
    radiance = eta**-2 if eta > 0 else 1.0
    assert throughput[0][up].sum() / len(square) == pytest.approx(reflected, abs=0.02)
    for channel in (0, 1):
        passed = throughput[channel][~up].sum() / len(square)
        assert passed == pytest.approx((1 - reflected) * TINT[channel] * radiance, rel=0.03, abs=1e-6)
    assert (density == np.float32(UNMATCHED)).all() and not weight.any()


def test_the_boundary_of_first_hits_is_dyadic(device):
    square = grid(64)
    for cosine in (0.9, 0.4, 0.15, 0.05):
        directions, *_ = run(device, square, 1.5, SMOOTH, cosine, True)
        share = np.mean(directions[2] > 0)
        assert 8 * share == round(8 * share) and 0 < share < 1


@pytest.mark.parametrize("cosine", [0.8, 0.3])
def test_refraction_is_reciprocal(cosine):
    """The reference itself: f(o, i) / n_o² = f(i, o) / n_i² (Veach 1997, equation 5.14)."""
    o = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    i = sphere(20, 10)[:100]
    there = btdf(o, i, 1.5, 0.2)
    back = [btdf(-one * [1, 1, 1], -o[None] * 1.0, 1 / 1.5, 0.2)[0] for one in i]
    assert (there > 0).any()
    np.testing.assert_allclose(there * 1.5**2, back, rtol=1e-9)


@pytest.mark.parametrize("eta", [1.5, 1 / 1.5])
def test_no_direction_leaves_on_the_wrong_side_of_the_triangle(device, eta):
    """Shading normals far off the triangle's: the side tells whether a path is inside of the glass."""
    geometric = unit(NORMAL + 0.8 * tangent_frame(NORMAL)[0])
    square, o = grid(64), outgoing_at(0.25)
    assert geometric @ o > 0
    for normal in (geometric, unit(NORMAL - 0.2 * tangent_frame(NORMAL)[0])):
        directions, throughput, *_ = run(device, square, eta, SMOOTH, 0.25, geometric=normal)
        height = (directions.T @ axes()) @ normal
        share = np.mean(height > 0)
        assert (np.abs(height) > 5e-4).all() and 0 < share <= 1
        total = throughput[0][height > 0].sum() / len(square)
        expected = fresnel(np.array([0.25]), np.array([eta]))[0]
        assert total == pytest.approx(expected, abs=0.02)
