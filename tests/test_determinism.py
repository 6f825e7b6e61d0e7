"""Same seed, device and scene: the same image bit for bit, whatever the batches and threads."""

from __future__ import annotations

import numpy as np
import pytest
from fitting import fitting

from ncv_cl import render
from ncv_cl.integrands import INTEGRANDS
from ncv_cl.points import trace
from ncv_cl.points.sampler import SAMPLERS
from ncv_cl.sampling import samples

SIZE = (16, 12)


def picture(scenes, device, scene="cornell_box", method="ncv", integrand="direct", **options):
    options = {"spp": 8, "train_spp": 4, "size": SIZE, "seed": 3, **options}
    return render(scenes / f"{scene}.toml", integrand, device=device, **fitting(method, **options))


def layers(image):
    return {"pixels": image.pixels, "variance": image.variance, **image.layers}


def assert_same_bits(first, second):
    assert layers(first).keys() == layers(second).keys()
    for name, values in layers(first).items():
        np.testing.assert_array_equal(values, layers(second)[name], err_msg=name)


@pytest.mark.parametrize("integrand", sorted(INTEGRANDS))
@pytest.mark.parametrize("method, sampler", [("mc", "independent"), ("mc", "sobol"), ("ncv", "sobol")])
def test_a_seed_gives_the_same_bits_and_another_seed_others(device, scenes, integrand, method, sampler):
    options = {"method": method, "integrand": integrand, "sampler": sampler}
    first = picture(scenes, device, **options)
    assert_same_bits(first, picture(scenes, device, **options))
    assert np.any(first.pixels != picture(scenes, device, **options, seed=4).pixels)


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_both_words_of_the_seed_count(one_device, scenes, method):
    low = picture(scenes, one_device, method=method, seed=3)
    assert np.any(low.pixels != picture(scenes, one_device, method=method, seed=3 + 2**32).pixels)


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_threads_do_not_change_the_image(one_device, scenes, monkeypatch, method):
    # Chunks so small that there are many for the threads to share.
    monkeypatch.setattr(trace, "CHUNK", 64)
    images = [picture(scenes, one_device, method=method, threads=threads) for threads in (1, 2)]
    assert_same_bits(*images)


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_batches_do_not_change_the_image(device, scenes, monkeypatch, method, sampler):
    # Batches hold one such run at least.
    monkeypatch.setattr(samples, "LONGEST_RUN", 64)
    whole = picture(scenes, device, method=method, sampler=sampler)
    monkeypatch.setattr(samples, "SAMPLES_PER_BATCH", 100)
    draws = []
    draw = samples.SampleSource.draw
    monkeypatch.setattr(
        samples.SampleSource, "draw", lambda *arguments: draws.append(1) or draw(*arguments)
    )
    cut = picture(scenes, device, method=method, sampler=sampler)
    assert len(draws) > 4
    assert_same_bits(whole, cut)


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("integrand", sorted(INTEGRANDS))
def test_supersampling_is_the_box_filter_of_the_larger_image(one_device, scenes, integrand, sampler):
    options = {"method": "mc", "integrand": integrand, "sampler": sampler}
    small = picture(scenes, one_device, **options, supersample=2)
    large = picture(scenes, one_device, **options, size=(2 * SIZE[0], 2 * SIZE[1]))
    blocks = large.pixels.astype(np.float64).reshape(SIZE[1], 2, SIZE[0], 2, 3)
    # The same points and samples; only the order of rounding to float32 differs.
    np.testing.assert_allclose(small.pixels, blocks.mean(axis=(1, 3)), rtol=3e-7, atol=0)
    variance = large.variance.astype(np.float64).reshape(SIZE[1], 2, SIZE[0], 2, 3)
    np.testing.assert_allclose(small.variance, variance.mean(axis=(1, 3)) / 4, rtol=3e-7, atol=1e-30)
