"""Guided bounces: what is learned, that it changes no expectation, and that it lowers variance."""

from __future__ import annotations

import numpy as np
import pytest
from reference import grey, sampling, shadowed_values, unpack_records
from test_gi import GLOSSY, assert_same, room

from ncv_cl import GlobalIllumination, load_scene, render
from ncv_cl.points.sampler import Stream
from ncv_cl.sampling.guide import BINS, GUIDE_CELLS, Guide, GuideRecorder
from ncv_cl.sampling.warp import DENSITY_WORDS, pack_records


def test_light_from_one_side_is_learned():
    recorder = GuideRecorder()
    place = 5 * BINS + np.repeat(np.arange(BINS), 100)
    radiance = np.where(place % BINS < BINS // 2, 3.0, 1.0)
    recorder.add(place, np.stack([radiance, radiance, 0 * radiance]))
    guide = recorder.guide()
    cells = unpack_records(guide.densities[5:6])[0]
    assert cells[: BINS // 2].sum() > 0.6
    np.testing.assert_allclose(guide.means[5], [2, 2, 0], rtol=0.01)
    assert guide.densities.shape == (GUIDE_CELLS, DENSITY_WORDS)


def test_a_dark_scene_is_guided_uniformly():
    cells = unpack_records(GuideRecorder().guide().densities)
    np.testing.assert_array_equal(cells, 1 / BINS)


def anything():
    """A guide that fits no scene: right for the expectation, wrong for all else."""
    generator = np.random.default_rng(2)
    probability = 0.3 / BINS + 0.7 * generator.dirichlet(np.full(BINS, 0.3), GUIDE_CELLS)
    means = generator.uniform(0, 0.3, (GUIDE_CELLS, 3)).astype(np.float32)
    return Guide(pack_records(probability), means)


@pytest.mark.parametrize("depth", [4, None])
@pytest.mark.parametrize("material", [grey((0.3, 0.6, 0.9)), GLOSSY])
def test_no_guide_changes_the_expectation(device, depth, material):
    scene, samples = room(material), 4000
    found = []
    for guide in (None, anything()):
        points, source, _ = sampling(
            device,
            scene,
            GlobalIllumination(depth),
            (4, 3),
            samples,
            "independent",
            len(found),
        )
        if guide is not None:
            source.use_guide(guide)
        parts = source.parts(range(points.active), range(samples))
        sums = np.zeros((2, 3, points.active))
        for part, run in parts:
            values = shadowed_values(source.draw(part, run, Stream.RESIDUAL), 3)
            sums[:, :, part.start : part.stop] += values.sum(2), (values**2).sum(2)
        mean = sums[0] / samples
        found.append((mean, (sums[1] / samples - mean**2) / samples))
    (first, variance), (second, others) = found
    assert_same(first, second, variance + others)


def test_a_learned_guide_lowers_the_nested_noise(device, scenes):
    scene, samples = load_scene(scenes / "cornell_box.toml"), 512
    points, source, _ = sampling(device, scene, GlobalIllumination(), (7, 7), samples, "independent")
    everything = range(points.active), range(samples)

    def noise():
        once, twice = (
            shadowed_values(source.draw(*everything, Stream.RESIDUAL, paths=paths), 3)
            for paths in (Stream.RESIDUAL, Stream.RESIDUAL_AGAIN)
        )
        return np.mean((once - twice) ** 2)

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
