"""Direct light that global illumination estimates apart: the same image, by samples of its own."""

from __future__ import annotations

import numpy as np
import pytest
from reference import grey, light_at, mesh_scene, sampling
from test_gi import (
    GLOSSY,
    MANY,
    SEEN_AND_HIDDEN,
    SEVERAL_LIGHTS,
    assert_same,
    glowing,
    room,
    traced,
)

from ncv_cl import GlobalIllumination, render
from ncv_cl.estimation import tuning
from ncv_cl.estimation.direct import direct_edges, direct_samples


def against(images, truth, variance):
    """The mean of images of several seeds is the truth, pixel by pixel."""
    found = np.array([image.pixels for image in images], float)
    own = np.mean([image.variance for image in images], axis=0)
    between = np.maximum(found.var(axis=0, ddof=1), own)
    assert_same(found.mean(axis=0), truth, between / len(images) + variance)


@pytest.mark.parametrize("method", ["mc", "ncv"])
@pytest.mark.parametrize("lights", [None, SEVERAL_LIGHTS, SEEN_AND_HIDDEN])
def test_direct_light_apart_matches_an_independent_path_tracer(one_device, method, lights):
    scene = room(grey((0.3, 0.6, 0.9)), lights)
    size, device = (4, 3), one_device
    images = [
        render(scene, GlobalIllumination(4), method, spp=128, size=size, seed=s, device=device)
        for s in range(8)
    ]
    assert all("direct" in image.stats for image in images)
    points, _, _ = sampling(device, scene, GlobalIllumination(4), size, 1)
    mean, variance = (np.zeros((size[1] * size[0], 3)) for _ in range(2))
    for values, into in zip(
        traced(scene, points, 4, 8000, np.random.default_rng(3)), (mean, variance), strict=True
    ):
        into[points.cell[: points.active]] = values.T
    emitted = np.zeros((points.total, 3))
    on = points.light >= 0
    emitted[on] = GlobalIllumination().emitted(scene, points.light[on], points.rows("outgoing")[:, on])
    mean[points.cell] += emitted
    against(images, mean.reshape(*size[::-1], 3), variance.reshape(*size[::-1], 3))


MIRROR = grey(0.05, 0.8, 0.03)


def emissive_room():
    """The room with a shelf that glows, under a light."""
    scene = room(GLOSSY)
    surfaces = scene.vertices[scene.triangles[scene.triangle_light < 0]]
    index = np.zeros(len(surfaces), int)
    index[-2:] = 1
    lights = (light_at([-1, 1.5, -1], [2, 0, 0], [0, 0, 2], (5, 4, 3)),)
    return mesh_scene(surfaces, scene.camera, lights, (GLOSSY, glowing(0.4, 0.7)), material=index)


SCENES = {
    "glossy": lambda: room(GLOSSY),
    "mirror": lambda: room(MIRROR),
    "emissive": emissive_room,
    "many lights": lambda: room(GLOSSY, MANY),
    "hidden": lambda: room(grey(0.6), SEEN_AND_HIDDEN),
}


@pytest.mark.parametrize("method", ["mc", "ncv"])
@pytest.mark.parametrize("name", SCENES)
def test_direct_light_apart_is_the_same_image(one_device, name, method):
    scene, depth = SCENES[name](), 5
    common = {"size": (6, 5), "device": one_device}
    whole = [
        render(scene, GlobalIllumination(depth), "mc", spp=512, seed=s, split_direct="off", **common)
        for s in range(4)
    ]
    images = [
        render(
            scene, GlobalIllumination(depth), method, spp=256, seed=10 + s, split_direct="on", **common
        )
        for s in range(4)
    ]
    truth = np.array([image.pixels for image in whole], float)
    own = np.mean([image.variance for image in whole], axis=0)
    against(images, truth.mean(axis=0), np.maximum(truth.var(axis=0, ddof=1), own) / 4)
    assert all("direct" not in image.stats for image in whole)
    assert all(image.stats["direct"]["samples_per_point"] > 1 for image in images)


@pytest.mark.parametrize("depth", [3, 4])
def test_emission_is_found_where_direct_light_is_apart_and_paths_are_short(one_device, depth):
    scene = emissive_room()
    options = {
        "method": "mc",
        "sampler": "independent",
        "spp": 1024,
        "size": (6, 5),
        "device": one_device,
    }
    whole, apart = (
        render(scene, GlobalIllumination(depth), split_direct=split, seed=s, **options)
        for s, split in enumerate(("off", "on"))
    )
    z = (whole.pixels - apart.pixels) / np.sqrt(whole.variance + apart.variance + 1e-12)
    assert np.mean(z**2) < 1 + 5 * np.sqrt(2 / (z.size / 3)) and np.abs(z).max() < 6


def test_the_layers_of_the_parts_add_up(one_device):
    image = render(
        room(GLOSSY), "gi", "ncv", spp=64, train_spp=1, size=(8, 6), preset="slides", device=one_device,
        supersample=2,
    )  # fmt: skip
    parts = image.layers["G"] + image.layers["residual"] + image.layers["direct"]
    lit = image.layers["direct"].sum(axis=2) > 0
    # Training samples count too, each as one sample.
    assert lit.any() and np.abs(parts - image.pixels)[lit].max() < 0.2 * image.pixels[lit].mean()
    assert image.metadata["direct_spp"] == image.stats["direct"]["samples_per_point"]


def test_many_lights_are_sampled_with_the_paths_unless_asked_for(one_device):
    scene = room(grey(0.5), MANY)
    options = {"method": "mc", "spp": 4, "size": (6, 4), "device": one_device}
    assert "direct" not in render(scene, "gi", **options).stats
    assert "direct" in render(scene, "gi", split_direct="on", **options).stats
    for visibility in ("points", "embree"):
        image = render(room(grey(0.5)), "gi", visibility=visibility, **options)
        assert "direct" not in image.stats and "direct" not in image.layers


@pytest.mark.parametrize(
    "integrand", ["direct", "ao", GlobalIllumination(direct=False), GlobalIllumination(2)]
)
def test_what_cannot_be_split_is_refused(one_device, integrand):
    with pytest.raises(ValueError, match="split"):
        render(room(GLOSSY), integrand, spp=1, size=(4, 4), split_direct="on", device=one_device)


def test_depth_two_is_not_split(one_device):
    image = render(room(GLOSSY), GlobalIllumination(2), "mc", spp=4, size=(4, 4), device=one_device)
    assert "direct" not in image.stats


def test_samples_of_direct_light_follow_those_of_paths():
    assert [direct_samples(n) for n in (1, 16, 64, 256, 1024)] == [8, 32, 64, 128, 256]
    for first, samples in ((1, 1), (8, 16), (128, 512), (3, 1000)):
        edges = direct_edges(first, samples)
        assert edges[0] == 0 and edges[2] == 2 * edges[1] == direct_samples(first)
        assert np.all(np.diff(np.log2(edges[1:])) == 1)
        assert max(direct_samples(samples), 4 * samples) / 2 < edges[-1] or edges[-1] == edges[2]
        assert edges[-1] <= max(direct_samples(first), direct_samples(samples), 4 * samples)
        # A checkpoint's own edges are gone on from.
        assert direct_edges(first, samples, [0, 3, 6])[:4] == [0, 3, 6, 12]


def test_direct_light_gets_more_samples_where_its_error_counts(one_device, scenes, monkeypatch):
    """On glossy plates all of the error is that of highlights; in a matte box it is that of paths."""
    monkeypatch.setattr(tuning, "DIRECT_SAMPLES", 1.0)
    shares = []
    for name in ("veach_plates", "cornell_box"):
        image = render(scenes / f"{name}.toml", "gi", "mc", spp=64, size=(24, 24), device=one_device)
        direct = image.stats["direct"]
        shares.append(direct["samples_per_point"])
        enough = direct["estimated_mse"] <= tuning.DIRECT_ERROR * image.stats["estimated_mse"]
        assert enough or direct["samples_per_point"] >= tuning.MOST_DIRECT * 64
    assert shares[0] > 4 * shares[1]
