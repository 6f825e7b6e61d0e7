"""What a scene does not need is left out, counted, and changes no pixel."""

from __future__ import annotations

import numpy as np
import pytest
from every_program import DARK, GLOWING, ROUND
from test_network import knot_points, random_network

from ncv_cl.estimation import control_variate
from ncv_cl.integrands import AmbientOcclusion, DirectLight
from ncv_cl.integrands.light_sources import light_sources
from ncv_cl.network.fold import FoldedNetwork
from ncv_cl.network.network import WEIGHT_GROUPS
from ncv_cl.output.image import Image
from ncv_cl.points.points import ShadingPoints, find_points
from ncv_cl.points.sampler import Stream
from ncv_cl.points.trace import Tracer
from ncv_cl.rendering.render import render
from ncv_cl.sampling.samples import SampleSource
from ncv_cl.scene.load import load_scene

SIZE = (32, 32)
# Lights of every shape, a sun beside them, and a sun alone.
SUN = "\n[environment.sun]\nelevation = 20\nirradiance = 2\n"
LIT = {"round": ROUND, "round, sun": ROUND + SUN, "sun": DARK + SUN}


def dark_points(scene, points):
    return DirectLight().dark(scene, points)


def dark_reference(scene, points: ShadingPoints) -> np.ndarray:
    """The same in numpy, float64, light by light."""
    position, *normals = (
        points.active_rows(name).astype(np.float64)
        for name in ("position", "normal", "geometric_normal")
    )
    lights = light_sources(scene).lights.bounds()
    dark = np.ones(points.active, bool)
    for light in range(lights.strips):
        below = np.zeros(points.active, bool)
        for normal in normals:
            highest = (lights.corners[:, light] @ normal).max(axis=0) + lights.reach[light]
            below |= highest <= (normal * position).sum(axis=0)
        if not lights.two_sided[light]:
            side = lights.normal[light]
            below |= side @ position <= side @ lights.corner[light]
        dark &= below
    suns = scene.environment.suns if scene.environment is not None else ()
    unseen = [
        np.all([sun.towards @ normal <= -np.sin(sun.half_angle) - 1e-6 for sun in suns], axis=0)
        for normal in normals
    ]
    return dark & (unseen[0] | unseen[1]) if suns else dark


@pytest.mark.parametrize("is_double", [True, False])
@pytest.mark.parametrize("name", ["cornell_box", "knot", *LIT])
def test_dark_points_are_those_of_float64(device, scenes, tmp_path, monkeypatch, name, is_double):
    path = scenes / f"{name}.toml"
    if name in LIT:
        path = tmp_path / "lit.toml"
        # Some of the ball is seen from the side and from below.
        ball = '[[spheres]]\ncenter = [0, 1, 0]\nradius = 0.5\nmaterial = "floor"\n'
        path.write_text(LIT[name] + ball, encoding="utf-8")
    scene = load_scene(path)
    points = find_points(device, scene, Tracer(scene), *SIZE)
    expected = dark_reference(scene, points)
    assert name == "knot" or 0 < expected.sum() < points.active
    if is_double and device.has_float64:
        assert np.array_equal(dark_points(scene, points), expected)
        return
    monkeypatch.setattr(type(device), "has_float64", False)
    found = dark_points(scene, points)
    # No point that something reaches, and nearly all of the others.
    assert not found[~expected].any()
    assert found.sum() >= 0.99 * expected.sum()


def test_clusters_of_lights_are_taken_for_balls(device, tmp_path):
    """Of more pieces than strips the point must be beyond all of a strip's."""
    path = tmp_path / "glowing.toml"
    path.write_text(GLOWING, encoding="utf-8")
    scene = load_scene(path)
    assert light_sources(scene).lights.has_clusters
    points = find_points(device, scene, Tracer(scene), *SIZE, emitters_active=True)
    assert np.array_equal(dark_points(scene, points), dark_reference(scene, points))


@pytest.mark.parametrize("modulated", [("B1",), WEIGHT_GROUPS])
def test_idle_neurons_are_those_that_corners_tell(device, scenes, modulated, monkeypatch):
    monkeypatch.setattr(control_variate, "POINTS_LOOKED_AT", 100)
    scene, points = knot_points(device, scenes)
    network = random_network(scene, hidden=(17, 5), modulated=modulated)
    # Some biases far off: neurons that are zero at all points, or have no line.
    network.parameters[...] *= 3
    folded = FoldedNetwork(device, network, points)
    chosen = np.linspace(0, points.active, 100, endpoint=False).astype(int)
    weights, biases = (folded.groups[group].read() for group in ("W1", "B1"))
    weights = weights[chosen] if "W1" in modulated else weights[None]
    corners = np.array([(0, 0), (1, 0), (0, 1), (1, 1)], np.float32)
    values = np.einsum("pji,ki->pjk", weights, corners) + biases[chosen][..., None]
    dead = np.all(values <= 0, axis=2)
    found = control_variate.idle_neurons(folded, points.active)
    assert found == {
        "lines": float(np.mean(dead | np.all(values >= 0, axis=2))),
        "dead_neurons": float(np.mean(dead)),
        "dead_in_image": int(dead.all(axis=0).sum()),
    }
    assert 0 < found["lines"] < 1


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
