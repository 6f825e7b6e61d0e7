"""Comparisons of pictures, and what notebooks show of them."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
import OpenImageIO as oiio
import pytest

import ncv_cl as ncv
from ncv_cl.output.compare import has_flip

SHAPE = (24, 32, 3)


def image(rng: np.random.Generator, truth: np.ndarray, deviation: float, claimed: float) -> ncv.Image:
    pixels = truth + rng.normal(0, deviation, truth.shape)
    return ncv.Image(pixels, np.full(truth.shape, claimed**2))


def decoded(content: bytes, folder: Path) -> np.ndarray:
    (folder / "shown.png").write_bytes(content)
    return oiio.ImageBuf(str(folder / "shown.png")).get_pixels(oiio.FLOAT)


def test_numbers_and_maps():
    rng = np.random.default_rng(3)
    truth = rng.uniform(0.2, 0.8, SHAPE)
    ours, theirs = (image(rng, truth, 0.01, 0.01) for _ in range(2))
    found = ncv.compare(ours, theirs)
    difference = ours.pixels.astype(np.float64) - theirs.pixels
    assert found.mse == pytest.approx((difference**2).mean(), rel=1e-12)
    assert np.allclose(found.error, difference.mean(axis=2), atol=1e-15)
    # Two independent pictures differ by their noise: a chi-square of many degrees of freedom.
    assert found.deviations == pytest.approx(1, abs=4 / np.sqrt(2 * truth.size))
    biased = ncv.Image(theirs.pixels + 0.1, theirs.variance)
    assert ncv.compare(biased, theirs).deviations > 5
    # A picture against one that is known exactly.
    assert ncv.compare(ours, truth).deviations == pytest.approx(1, abs=4 / np.sqrt(2 * truth.size))
    plain = ncv.compare(np.asarray(ours.pixels), truth)
    assert plain.deviations is None and plain.relmse > 0


@pytest.mark.skipif(not has_flip(), reason="this OpenImageIO has no FLIP_diff")
def test_flip_grows_with_what_is_seen():
    truth = np.full(SHAPE, 0.5)
    means = [ncv.compare(truth + offset, truth).flip for offset in (0, 0.02, 0.1)]
    assert means[0] == 0 and 0 < means[1] < means[2] < 1
    assert ncv.compare(truth, truth).flip_map.shape == SHAPE[:2]


def test_pictures_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="agree in shape"):
        ncv.compare(np.ones(SHAPE), np.ones((3, 4, 3)))
    with pytest.raises(ValueError, match="height, width, 3"):
        ncv.compare(np.ones((4, 4)), np.ones(SHAPE))
    with pytest.raises(ValueError, match="black everywhere"):
        ncv.compare(np.ones(SHAPE), np.zeros(SHAPE))


def test_a_notebook_shows_what_a_file_would_hold(tmp_path):
    rng = np.random.default_rng(4)
    one = image(rng, rng.uniform(0, 1, SHAPE), 0, 1)
    one.write(tmp_path / "written.png")
    written = oiio.ImageBuf(str(tmp_path / "written.png")).get_pixels(oiio.FLOAT)
    assert np.array_equal(decoded(one._repr_png_(), tmp_path), written)


def test_panels_stand_side_by_side(tmp_path):
    truth = np.full(SHAPE, 0.25)
    ours = truth.copy()
    ours[5, 7] += 0.5
    found = ncv.compare(ours, truth)
    shown = decoded(found._repr_png_(), tmp_path)
    panels = 4 if has_flip() else 3
    assert shown.shape == (SHAPE[0], panels * SHAPE[1] + (panels - 1) * 4, 3)
    error = shown[:, 2 * (SHAPE[1] + 4) :][:, : SHAPE[1]].sum(axis=2)
    assert np.unravel_index(error.argmax(), error.shape) == (5, 7) and np.median(error) < 0.1
    assert np.array_equal(shown[:, : SHAPE[1]] != shown[:, SHAPE[1] + 4 :][:, : SHAPE[1]], ours != truth)


def test_show_opens_a_file_that_stays(monkeypatch, tmp_path):
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    one = ncv.Image(np.ones(SHAPE), np.ones(SHAPE))
    one.show()
    ncv.compare(one, one).show()
    files = [Path(url2pathname(urlsplit(url).path)) for url in opened]
    assert len(files) == 2 and all(file.read_bytes()[:4] == b"\x89PNG" for file in files)
