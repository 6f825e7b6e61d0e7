"""Guided bounces: what is learned, that it changes no expectation, and that it lowers variance."""

from __future__ import annotations

import numpy as np
import pytest
from reference import grey, sampling, shadowed_values, unpack_records
from test_gi import GLOSSY, assert_same, room

from ncv_cl import GlobalIllumination, load_scene, render
from ncv_cl.points.sampler import Stream
from ncv_cl.sampling import tuning
from ncv_cl.sampling.guide import BINS, GUIDE_CELLS, Guide, GuideRecorder
from ncv_cl.sampling.warp import DENSITY_WORDS, pack_records


def test_light_from_one_side_is_learned():
    recorder = GuideRecorder()
    place = 5 * BINS + np.repeat(np.arange(BINS), 100)
    radiance = np.where(place % BINS < BINS // 2, 3.0, 1.0)
    light = np.stack([radiance, radiance, 0 * radiance])
    recorder.add(place, light, np.ones_like(light))
    guide = recorder.guide()
    cells = unpack_records(guide.densities[5:6])[0]
    assert cells[: BINS // 2].sum() > 0.6
    np.testing.assert_allclose(guide.means[5], [2, 2, 0], rtol=0.01)
    assert guide.densities.shape == (GUIDE_CELLS, DENSITY_WORDS)


def test_a_dark_scene_is_guided_uniformly():
    cells = unpack_records(GuideRecorder().guide().densities)
    np.testing.assert_array_equal(cells, 1 / BINS)


def test_what_few_samples_tell_is_completed_by_the_boxes_around():
    """One box of eight knows the light, another has a single sample, one is far away."""
    recorder, side = GuideRecorder(), round((GUIDE_CELLS // 6) ** (1 / 3))
    lit, beside = 5, 6 + 5
    far = GUIDE_CELLS - 1
    assert side > 2 and far % 6 == lit % 6
    place = lit * BINS + np.repeat(np.arange(BINS), 100)
    radiance = np.where(place % BINS < BINS // 2, 3.0, 1.0) * np.ones((3, 1))
    recorder.add(place, radiance, np.ones_like(radiance))
    recorder.add(np.array([beside * BINS]), np.full((3, 1), 6.0), np.ones((3, 1)))
    guide = recorder.guide()
    cells = unpack_records(guide.densities)
    for cell in (beside, far):
        np.testing.assert_allclose(cells[cell], cells[lit], atol=0.01)
    prior = tuning.GUIDE_PRIOR_SAMPLES
    np.testing.assert_allclose(guide.means[beside], (6 + 2 * prior) / (1 + prior), rtol=0.01)
    np.testing.assert_allclose(guide.means[far], 2, rtol=0.01)


def test_needs_are_deviations_of_guided_samples_from_the_mean():
    recorder, cell, count = GuideRecorder(), 7, 4000
    generator = np.random.default_rng(5)
    place = cell * BINS + np.repeat(np.arange(BINS), count)
    radiance = np.where(place % BINS < BINS // 4, 4.0, 1.0) * generator.exponential(size=len(place))
    recorder.add(place, radiance * np.ones((3, 1)), np.full((3, len(place)), 0.5))
    guide = recorder.guide()
    probability = unpack_records(guide.densities[cell : cell + 1])[0].ravel()
    # A sample of part b, drawn with probability p, counts radiance / (p * BINS).
    level = np.where(np.arange(BINS) < BINS // 4, 4.0, 1.0)
    square = np.sum(2 * level**2 / probability) / BINS**2
    deviation = np.sqrt(square - level.mean() ** 2)
    usual = 0.5 * np.sqrt(np.mean(2 * level**2))
    np.testing.assert_allclose(guide.needs[cell], deviation / usual, rtol=0.03)


NONSENSE = {
    "anything": {"most": 0.3, "needs": (0.0, 2.0)},
    # Nearly all paths end at the first chance, and few count for them.
    "too little": {"most": 0.0, "needs": (0.0, 0.05)},
    "too much": {"most": 1e3, "needs": (1e6, 1e30)},
}


def nonsense(most, needs):
    """A guide that fits no scene: right for the expectation, wrong for all else."""
    generator = np.random.default_rng(2)
    probability = 0.3 / BINS + 0.7 * generator.dirichlet(np.full(BINS, 0.3), GUIDE_CELLS)
    means = generator.uniform(0, most, (GUIDE_CELLS, 3)).astype(np.float32)
    return Guide(
        pack_records(probability), means, generator.uniform(*needs, GUIDE_CELLS).astype(np.float32)
    )


def sample_means(device, scene, depth, samples, guide, seed):
    """Means of values, and their variances, float64 (3, points)."""
    integrand = GlobalIllumination(depth)
    points, source, _ = sampling(device, scene, integrand, (4, 3), samples, "independent", seed)
    if guide is not None:
        source.use_guide(guide)
    sums = np.zeros((2, 3, points.active))
    for part, run in source.parts(range(points.active), range(samples)):
        values = shadowed_values(source.draw(part, run, Stream.RESIDUAL), 3).astype(float)
        sums[:, :, part.start : part.stop] += values.sum(2), (values**2).sum(2)
    mean = sums[0] / samples
    return mean, (sums[1] / samples - mean**2) / samples


@pytest.mark.parametrize("depth", [4, None])
@pytest.mark.parametrize("material", [grey((0.3, 0.6, 0.9)), GLOSSY])
@pytest.mark.parametrize("kind", NONSENSE)
def test_no_guide_changes_the_expectation(device, depth, material, kind, monkeypatch):
    if kind == "too much":
        # What is promised is taken back by the paths that end: one in a hundred of 4000 are too few for
        # the means to be normal.
        monkeypatch.setattr(tuning, "MOST_SURVIVE", 0.95)
    scene, samples = room(material), 4000
    first, variance = sample_means(device, scene, depth, samples, None, 0)
    second, others = sample_means(device, scene, depth, samples, nonsense(**NONSENSE[kind]), 1)
    assert_same(first, second, variance + others)


@pytest.mark.parametrize("material", [grey((0.3, 0.6, 0.9)), GLOSSY])
def test_branches_change_no_expectation_and_lower_variance(device, material, monkeypatch):
    found = []
    for seed, branches in enumerate((1, 3)):
        monkeypatch.setattr(tuning, "BRANCHES", branches)
        guide = nonsense(**NONSENSE["anything"])
        found.append(sample_means(device, room(material), 5, 4000, guide, seed))
    (first, variance), (second, others) = found
    assert_same(first, second, variance + others)
    assert others.mean() < 0.9 * variance.mean()


def test_a_learned_guide_lowers_the_nested_noise_of_as_many_rays(device, scenes):
    scene, samples = load_scene(scenes / "cornell_box.toml"), 512
    points, source, _ = sampling(device, scene, GlobalIllumination(), (7, 7), samples, "independent")
    everything = range(points.active), range(samples)

    def noise():
        """Mean square of what other paths change, times rays."""
        before = source.rays.traced + source.rays.on_device
        once, twice = (
            shadowed_values(source.draw(*everything, Stream.RESIDUAL, paths=paths), 3)
            for paths in (Stream.RESIDUAL, Stream.RESIDUAL_AGAIN)
        )
        rays = source.rays.traced + source.rays.on_device - before
        return rays * np.mean((once - twice) ** 2)

    plain = noise()
    source.record_guide()
    for first in range(0, 8192, 512):
        source.draw(range(points.active), range(first, first + 512), Stream.TRAINING)
    source.learn_guide()
    assert noise() < 0.8 * plain


def test_a_resumed_render_is_guided_as_the_whole_was(one_device, tmp_path):
    scene, file = room(GLOSSY), tmp_path / "checkpoint.npz"
    options = {"method": "ncv", "spp": 256, "train_spp": 16, "size": (5, 4), "device": one_device}
    whole = render(scene, "gi", **options)
    render(scene, "gi", checkpoint=file, stop=lambda: True, **options)
    again = render(scene, "gi", resume=file, **options)
    np.testing.assert_array_equal(whole.pixels, again.pixels)
