"""What a scene does not need is left out, counted, and changes no pixel."""

from __future__ import annotations

import numpy as np
import pytest

from ncv_cl.integrands import AmbientOcclusion, DirectLight
from ncv_cl.output.image import Image
from ncv_cl.points.points import find_points
from ncv_cl.points.sampler import Stream
from ncv_cl.points.trace import Tracer
from ncv_cl.rendering.render import render
from ncv_cl.sampling.samples import SampleSource
from ncv_cl.scene.load import load_scene

SIZE = (32, 32)


def dark_points(scene, points):
    return DirectLight().dark(scene, points)


@pytest.mark.parametrize("name", ["cornell_box", "occluders", "knot", "veach_plates"])
def test_dark_points_have_no_sample_with_a_value_and_others_do(device, scenes, name):
    scene = load_scene(scenes / f"{name}.toml")
    tracer = Tracer(scene)
    points = find_points(device, scene, tracer, *SIZE)
    dark = dark_points(scene, points)
    source = SampleSource(device, scene, tracer, points, DirectLight(), "sobol", 1, 256)
    largest = np.zeros(points.active)
    for part in source.batches():
        batch = source.draw(part, range(256), Stream.RESIDUAL)
        values = batch.value.read().ravel()[: 3 * len(part) * batch.stride]
        largest[part.start : part.stop] = values.reshape(3, len(part), -1).max(axis=(0, 2))
    assert not largest[dark].any()
    # A light that stands edge-on may be missed by all samples, but not at many points.
    assert np.mean(largest[~dark] > 0) > 0.99


def test_dark_points_come_last_with_all_that_belongs_to_them(device, scenes):
    scene = load_scene(scenes / "cornell_box.toml")
    points = find_points(device, scene, Tracer(scene), *SIZE)
    dark = dark_points(scene, points)
    ordered = points.with_dark_last(dark)
    assert 0 < dark.sum() < points.active
    assert dark_points(scene, ordered)[-dark.sum() :].all()
    by_cell = [np.argsort(one.cell) for one in (points, ordered)]
    for name in ("position", "albedo", "offset"):
        before, after = points.rows(name)[:, by_cell[0]], ordered.rows(name)[:, by_cell[1]]
        np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(points.light[by_cell[0]], ordered.light[by_cell[1]])


def test_ambient_occlusion_has_no_dark_points(one_device, scenes):
    scene = load_scene(scenes / "cornell_box.toml")
    points = find_points(one_device, scene, Tracer(scene), *SIZE)
    assert AmbientOcclusion().dark(scene, points) is None


def render_both(device, scenes, **options) -> tuple[Image, Image]:
    options = {"size": SIZE, "spp": 16, "sampler": "independent", "device": device, **options}
    return tuple(
        render(scenes / "cornell_box.toml", "direct", skip_dark=skip, **options)
        for skip in (True, False)
    )


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_leaving_out_dark_points_changes_no_pixel(device, scenes, method, tmp_path):
    options = {"method": method}
    if method == "ncv":
        # One network for both: which points are trained on is drawn from the active ones.
        options["network"] = tmp_path / "network.npz"
        render(
            scenes / "cornell_box.toml", "direct", "ncv", spp=4, train_spp=4, size=SIZE, device=device,
            save_network=options["network"], density="none",
        )  # fmt: skip
        options |= {"density": "none", "allocation": "uniform"}
    skipped, computed = render_both(device, scenes, **options)
    np.testing.assert_array_equal(skipped.pixels, computed.pixels)
    assert skipped.stats["skipped"]["points_without_light"] > 0
    assert computed.stats["skipped"]["points_without_light"] == 0
    assert skipped.stats["rays_traced"] == computed.stats["rays_traced"]
    assert skipped.stats["points"] < computed.stats["points"]


def test_statistics_say_what_was_skipped(one_device, scenes):
    image = render(
        scenes / "occluders.toml", "direct", "ncv", spp=8, train_spp=8, size=SIZE, device=one_device,
        visibility="points",
    )  # fmt: skip
    skipped, points = image.stats["skipped"], image.stats["points"]
    assert skipped["background_points"] > 0 and skipped["rays"] == image.stats["rays_skipped"]
    assert skipped["background_points"] + skipped["points_without_light"] + points == SIZE[0] * SIZE[1]
    assert skipped["ray_seconds"] > 0 and skipped["inputs"] == []
    assert 0 < skipped["dead_neurons"] <= skipped["lines"] < 1
    assert 0 <= skipped["networks"] < points
    assert 0 < skipped["converged_points"] < points and skipped["converged_samples"] > 0
