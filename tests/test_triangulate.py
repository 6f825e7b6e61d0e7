"""Densities on a network's triangles: records match float64, samples follow them, strata survive."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from reference import camera_at, light_at, mesh_scene, quad, unpack_records
from scipy import stats
from test_warp import BINS

from ncv_cl import render
from ncv_cl.integrands import DirectLight
from ncv_cl.learning import triangulate
from ncv_cl.learning.density import Density
from ncv_cl.learning.triangulate import VERTEX_BITS, TriangleWarp
from ncv_cl.network.encode import Encoding
from ncv_cl.network.network import NetworkDescription, NetworkError
from ncv_cl.opencl import program
from ncv_cl.opencl.device import CutShortError
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import find_points
from ncv_cl.points.sampler import Stream
from ncv_cl.points.trace import Tracer
from ncv_cl.sampling.samples import SampleSource
from ncv_cl.sampling.warp import pack_records

SHARE = 0.1
LINES = 16
# Points of the square nearer to a triangle's side may be found on either side of it.
NEAR_A_SIDE = 1e-4


def random_lines(points, lines=LINES, seed=3):
    """Through the square or past it: weights (points, lines, 2), biases (points, lines)."""
    generator = np.random.default_rng(seed)
    weights = generator.normal(size=(points, lines, 2))
    through = generator.uniform(-0.2, 1.2, size=(points, lines, 2))
    return weights, -np.sum(weights * through, axis=2)


def random_magnitudes(points, seed=1):
    """Probabilities of a table's cells, (points, BINS, BINS), a share of them uniform."""
    weight = np.random.default_rng(seed).gamma(0.5, size=(points, BINS, BINS))
    probability = (1 - SHARE) * weight / weight.sum(axis=(1, 2), keepdims=True) + SHARE / BINS**2
    return unpack_records(pack_records(probability)).reshape(weight.shape)


def warp_of(device, lines, probability):
    weights, biases = lines
    description = NetworkDescription(
        Encoding(("position",), grid_levels=1, grid_features=1), 1, (weights.shape[1], 4), ("W1", "B1")
    )
    groups = {
        name: HostArray.of(device, array.astype(np.float32))
        for name, array in (("W1", weights), ("B1", biases))
    }
    folded = SimpleNamespace(network=SimpleNamespace(description=description), groups=groups)
    density = Density(HostArray.of(device, pack_records(probability)), np.ones(len(weights)), SHARE)
    return TriangleWarp(device, folded, density)


def built_records(device, warp, count):
    order = HostArray.of(device, np.arange(count, dtype=np.uint32))
    return warp.records(order, range(count)).read()[:count].view(np.float32)


class Decoded:
    """One record in float64: corners (triangles, 3, 2), values at them, probabilities, area, density."""

    def __init__(self, record, defines):
        words, at = record.view(np.uint32), {k[7:].lower(): v for k, v in defines.items()}
        count = int(words[0])
        packed = words[at["corners"] : at["corners"] + count]
        corner = np.stack([packed >> (VERTEX_BITS * k) & ((1 << VERTEX_BITS) - 1) for k in range(3)], 1)
        with np.errstate(invalid="ignore"):
            # Words that are no numbers among them.
            numbers = record.astype(np.float64)
        x, y, values = (numbers[at[name] + corner] for name in ("x", "y", "values"))
        self.corners = np.stack([x, y], 2)
        self.values, self.scale = values, numbers[at["scales"] : at["scales"] + count]
        self.cumulative = numbers[at["cumulative"] : at["cumulative"] + count + 1]
        self.probability = np.diff(self.cumulative)
        first, second = self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0]
        self.area = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
        self.shape = self.scale[:, None] * values + SHARE
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = self.probability / self.area / self.shape.mean(1)
        self.density = np.where(self.probability > 0, factor, 0)[:, None] * self.shape

    def locate(self, u, v):
        """The triangle of each point, its barycentric coordinates, and whether it is no near call."""
        origin, sides = self.corners[:, 0], self.corners[:, 1:] - self.corners[:, :1]
        determinant = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
        flat = np.abs(determinant) < 1e-12
        inverse = 1 / np.where(flat, 1, determinant)
        x, y = u[:, None] - origin[:, 0], v[:, None] - origin[:, 1]
        second = (x * sides[:, 1, 1] - y * sides[:, 1, 0]) * inverse
        third = (y * sides[:, 0, 0] - x * sides[:, 0, 1]) * inverse
        weights = np.stack([1 - second - third, second, third], 2)
        inside = np.where(flat, -1, weights.min(2))
        triangle = inside.argmax(1)
        own = weights[np.arange(len(u)), triangle]
        return triangle, own, own.min(1) > NEAR_A_SIDE


def bilinear(cells, u, v):
    s, t = (np.clip(x * BINS - 0.5, 0, BINS - 1) for x in (u, v))
    i, j = (np.minimum(x.astype(int), BINS - 2) for x in (s, t))
    a, b = s - i, t - j
    low = (1 - b) * cells[i, j] + b * cells[i, j + 1]
    return (1 - a) * low + a * ((1 - b) * cells[i + 1, j] + b * cells[i + 1, j + 1])


def hilbert_curve(side):
    """Cells (side², 2) in the order of the curve, by its rule of four copies."""
    if side == 1:
        return np.zeros((1, 2), int)
    part, half = hilbert_curve(side // 2), side // 2
    turned = part[:, ::-1]
    up, last = np.array([0, half]), np.array([2 * half - 1, half - 1])
    return np.concatenate([turned, part + up, part + half, last - turned])


# ---- records ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("lines", [1, 16, 32])
def test_triangles_cover_the_square_and_no_line_cuts_one(device, lines):
    weights, biases = random_lines(12, lines)
    warp = warp_of(device, (weights, biases), random_magnitudes(12))
    for number, record in enumerate(built_records(device, warp, 12)):
        found = Decoded(record, warp.defines)
        assert found.area.sum() == pytest.approx(1, abs=1e-6)
        values = found.corners @ weights[number].T + biases[number]
        values /= np.linalg.norm(weights[number], axis=1)
        cut = (values.min(1) < -1e-5) & (values.max(1) > 1e-5)
        # Of many lines at random some make too many slivers.
        assert not cut.any() or len(found.area) == 2
    assert warp.undivided <= (2 if lines > LINES else 0)


def test_groups_that_are_cut_short_are_an_error(one_device, monkeypatch):
    loop = "for (; i < count; i += (uint)get_num_groups(0)) {"
    limited = loop.replace("i < count", "i < count && i < (uint)get_num_groups(0)")
    original = program.source

    def source(files):
        text = original(files)
        assert "triangulate" not in files or text.count(loop) == 1
        return text.replace(loop, limited)

    monkeypatch.setattr(program, "source", source)
    # So that the program is built anew, and not kept.
    monkeypatch.setattr(program, "_programs", {})
    # Each group takes one point.
    points = 2 * one_device.cl_device.max_compute_units
    warp = warp_of(one_device, random_lines(points), random_magnitudes(points))
    with pytest.raises(CutShortError, match=f"cut the square of {points // 2} of {points} points"):
        built_records(one_device, warp, points)


def test_records_match_float64(device):
    probability = random_magnitudes(12)
    warp = warp_of(device, random_lines(12), probability)
    curve = hilbert_curve(16)
    place = np.zeros((16, 16), int)
    place[tuple(curve.T)] = np.arange(256)
    for record, own in zip(built_records(device, warp, 12), probability, strict=True):
        found, cells = Decoded(record, warp.defines), np.maximum(own * BINS**2 - SHARE, 0)
        values = bilinear(cells, *np.moveaxis(found.corners, 2, 0))
        np.testing.assert_allclose(found.values, values, atol=2e-4)
        assert (found.values[:, :1] <= found.values).all()
        mean, centre = found.values.mean(1), found.corners.mean(1)
        integral = mean / 4 + 3 / 4 * bilinear(cells, *centre.T)
        normalisation = (1 - SHARE) / np.sum(found.area * integral)
        np.testing.assert_allclose(found.scale * mean, normalisation * integral, rtol=1e-3, atol=1e-4)
        expected = found.area * (normalisation * integral + SHARE)
        np.testing.assert_allclose(found.probability, expected, atol=2e-6)
        # Neighbours in the list are neighbours in the square; rounding decides at a cell's border.
        clear = np.abs(centre * 16 - np.round(centre * 16)).min(1) > 1e-3
        places = place[tuple((centre[clear] * 16).astype(int).T)]
        assert (np.diff(places) >= 0).all()


def test_the_density_of_a_record_integrates_to_one(device):
    warp = warp_of(device, random_lines(50), random_magnitudes(50))
    for record in built_records(device, warp, 50):
        found = Decoded(record, warp.defines)
        assert np.sum(found.area * found.density.mean(1)) == pytest.approx(1, abs=1e-6)
        assert found.area.sum() == pytest.approx(1, abs=1e-6)
        # What is too small to be chosen is next to nothing.
        assert found.area[found.probability == 0].sum() < 1e-6
        # The uniform share bounds every weight, but for what rounding does to the smallest triangles.
        assert found.density[found.probability > 1e-4].min() > 0.99 * SHARE


def test_a_points_record_does_not_depend_on_its_batch(device):
    warp = warp_of(device, random_lines(30), random_magnitudes(30))
    whole = built_records(device, warp, 30)
    order = np.random.default_rng(0).permutation(30).astype(np.uint32)
    part = warp.records(HostArray.of(device, order), range(7, 12)).read()[:5].view(np.float32)
    for own, number in zip(part, order[7:12], strict=True):
        one, other = (Decoded(record, warp.defines) for record in (own, whole[number]))
        for name in ("corners", "values", "scale", "cumulative"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_few_records_at_a_time_change_no_bit(one_device, scenes, monkeypatch):
    def picture():
        options = {"spp": 8, "train_spp": 4, "size": (12, 10), "density": "subdivision"}
        return render(scenes / "occluders.toml", "ao", "ncv", device=one_device, **options).pixels

    whole = picture()
    monkeypatch.setattr(triangulate, "RECORD_BYTES", 1 << 15)
    np.testing.assert_array_equal(picture(), whole)


def test_a_layer_of_too_many_neurons_is_refused(one_device):
    with pytest.raises(NetworkError, match="use density 'table'"):
        warp_of(one_device, random_lines(1, 64), random_magnitudes(1))


# ---- samples ---------------------------------------------------------------------------------------


def draw(device, warp, sampler, samples, points=range(4), seed=5):
    """u, v (points, samples) without a density, then u, v, weights with it."""
    light = light_at([-1, -1, 2], [0, 2, 0], [2, 0, 0], (1, 1, 1))
    floor, camera = quad([-1, -1, 0], [2, 0, 0], [0, 2, 0]), camera_at([0, 0, 1.5], [0, 0, 0])
    scene = mesh_scene(floor, camera, (light,))
    tracer = Tracer(scene, 1)
    shading = find_points(device, scene, tracer, 6, 6)
    assert shading.active >= points.stop
    source = SampleSource(device, scene, tracer, shading, DirectLight(), sampler, seed, samples)
    found = []
    for density in (None, warp):
        batch = source.draw(points, range(samples), Stream.RESIDUAL, None, density)
        arrays = (batch.u, batch.v) if density is None else (batch.u, batch.v, batch.weight)
        shape = (len(points), batch.stride)
        found += [
            array.read()[: shape[0] * shape[1]].reshape(shape)[:, :samples].astype(np.float64)
            for array in arrays
        ]
    return found


def invert(record, s, t):
    """The warp in float64: (u, v) and one over the density."""
    triangle = np.searchsorted(record.cumulative, s, side="right") - 1
    x = (s - record.cumulative[triangle]) / record.probability[triangle]
    shape, corners = record.shape[triangle], record.corners[triangle]
    k = shape[:, 0] / shape.sum(1)
    lower, upper = np.zeros_like(x), np.ones_like(x)
    for _ in range(60):
        r = (lower + upper) / 2
        below = 3 * k * r**2 + (1 - 3 * k) * r**3 < x
        lower, upper = np.where(below, r, lower), np.where(below, upper, r)
    first, last = ((1 - r) * shape[:, 0] + r * shape[:, n] for n in (1, 2))
    # (first q + (last - first) q² / 2) / ((first + last) / 2) = t
    q = np.where(
        np.abs(last - first) < 1e-9 * first, t, (np.sqrt(first**2 + (last**2 - first**2) * t) - first)
    ) / np.where(np.abs(last - first) < 1e-9 * first, 1, last - first)
    weights = np.stack([1 - r, r * (1 - q), r * q], 1)
    place = np.sum(weights[..., None] * corners, axis=1)
    density = np.sum(weights * record.density[triangle], axis=1)
    return *place.T, 1 / density


@pytest.mark.parametrize("sampler", ["independent", "sobol"])
def test_samples_match_float64(device, sampler):
    warp = warp_of(device, random_lines(36), random_magnitudes(36))
    found = [Decoded(record, warp.defines) for record in built_records(device, warp, 36)]
    s, t, u, v, weight = draw(device, warp, sampler, 512)
    assert ((u >= 0) & (u < 1) & (v >= 0) & (v < 1)).all()
    for number in range(4):
        own_u, own_v, own_weight = invert(found[number], s[number], t[number])
        np.testing.assert_allclose(u[number], own_u, atol=2e-5)
        np.testing.assert_allclose(v[number], own_v, atol=2e-5)
        np.testing.assert_allclose(weight[number], own_weight, rtol=1e-3)


def test_weights_are_one_over_the_density(device):
    warp = warp_of(device, random_lines(36), random_magnitudes(36))
    found = [Decoded(record, warp.defines) for record in built_records(device, warp, 36)]
    *_, u, v, weight = draw(device, warp, "sobol", 512)
    for number in range(4):
        triangle, own, clear = found[number].locate(u[number], v[number])
        density = np.sum(own * found[number].density[triangle], axis=1)
        assert clear.mean() > 0.9
        np.testing.assert_allclose((weight[number] * density)[clear], 1, rtol=2e-3)


def test_independent_points_follow_the_density(device):
    """Each triangle cut into four at the middles of its sides: probabilities of these are exact."""
    samples = 20000
    warp = warp_of(device, random_lines(36), random_magnitudes(36))
    found = [Decoded(record, warp.defines) for record in built_records(device, warp, 36)]
    *_, u, v, _ = draw(device, warp, "independent", samples)
    for number in range(4):
        record = found[number]
        triangle, own, _ = record.locate(u[number], v[number])
        # Part k lies at corner k, part 3 in the middle.
        part = np.where(own.max(1) > 0.5, own.argmax(1), 3)
        counts = np.bincount(triangle * 4 + part, minlength=4 * len(record.area))
        corner = record.density
        middles = (corner + np.roll(corner, -1, 1)) / 2
        near = (corner + middles + np.roll(middles, 1, 1)) / 3
        means = np.concatenate([near, middles.mean(1, keepdims=True)], 1)
        expected = (means * record.area[:, None] / 4).ravel() * samples
        assert expected.sum() == pytest.approx(samples, rel=1e-6)
        large = expected > 8
        observed = np.append(counts[large], counts[~large].sum())
        wanted = np.append(expected[large], expected[~large].sum())
        assert stats.chisquare(observed, wanted, sum_check=False).pvalue > 1e-4


def test_sobol_points_stay_spread(device):
    """The mean of a smooth function varies less between scrambles than that of independent points."""
    lines = [np.broadcast_to(array[:1], (36, *array.shape[1:])) for array in random_lines(1)]
    warp = warp_of(device, lines, np.broadcast_to(random_magnitudes(1), (36, BINS, BINS)))
    variance = {}
    for sampler in ("sobol", "independent"):
        means = []
        for seed in range(4):
            *_, u, v, weight = draw(device, warp, sampler, 256, range(36), seed)
            means.append(((1 + np.sin(3 * u) * np.cos(2 * v)) * weight).mean(1))
        variance[sampler] = np.var(means)
    assert variance["sobol"] < 0.2 * variance["independent"]


# ---- what must not break ---------------------------------------------------------------------------


def strange_lines():
    """Coincident, parallel and concurrent lines, some along the border; then lines that are none."""
    weights, biases = random_lines(6)
    weights[0], biases[0] = [1, 0], -0.5
    weights[1], biases[1] = [1, 1], -1 - 1e-7 * np.arange(LINES)
    biases[2] = -weights[2].sum(1) / 2
    weights[3, ::2], biases[3, ::2] = [0, 1], 0
    weights[3, 1::2], biases[3, 1::2] = [1, 0], -1
    weights[4], biases[4] = 0, 0
    weights[5, 3], biases[5, 3] = np.nan, np.inf
    return weights, biases


def test_degenerate_subdivisions_stay_densities(device):
    probability = random_magnitudes(36)
    probability[3] = 1 / BINS**2
    weights, biases = random_lines(36)
    weights[:6], biases[:6] = strange_lines()
    warp = warp_of(device, (weights, biases), probability)
    found = [Decoded(record, warp.defines) for record in built_records(device, warp, 36)]
    for one in found[:6]:
        assert one.area[one.probability == 0].sum() < 1e-6
        assert np.sum(one.area * one.density.mean(1)) == pytest.approx(1, abs=1e-6)
    samples = 4096
    *_, u, v, weight = draw(device, warp, "independent", samples, range(6))
    assert np.isfinite(weight).all() and (weight > 0).all()
    assert ((u >= 0) & (u < 1) & (v >= 0) & (v < 1)).all()
    # The integrals of 1, u and v.
    for function, integral in ((u**0, 1), (u, 0.5), (v, 0.5)):
        values = function * weight
        score = (values.mean(1) - integral) / (values.std(1) / np.sqrt(samples) + 1e-7)
        assert np.abs(score).max() < 4.5


def test_an_even_magnitude_is_sampled_uniformly(device):
    probability = np.full((36, BINS, BINS), 1 / BINS**2)
    warp = warp_of(device, random_lines(36), probability)
    *_, weight = draw(device, warp, "sobol", 64)
    np.testing.assert_allclose(weight, 1, rtol=2e-3)
