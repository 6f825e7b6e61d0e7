"""Our scenes as Mitsuba's dictionaries and back: the same scene; and both renderers' images agree."""

from __future__ import annotations

import itertools
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, Phase, given, reject, settings
from hypothesis import strategies as st
from mitsuba_tables import scene_dict

import ncv_cl as ncv
from ncv_cl.host.reach import Reach
from ncv_cl.scene.imports import Found
from ncv_cl.scene.imports.mitsuba_scene import tables_of
from ncv_cl.scene.load import scene_from
from ncv_cl.scene.meshes.common import Notes
from ncv_cl.scene.textures.image_file import ImageFiles

pytest.importorskip("mitsuba", reason="mitsuba is not installed")
pytest.importorskip("defusedxml", reason="defusedxml is not installed")
from ncv_cl.scene.imports.mitsuba_xml import read_dict

MATERIALS = {
    "white": {"albedo": [0.8, 0.8, 0.8]},
    "red": {"albedo": [0.7, 0.2, 0.1]},
    "black": {"albedo": [0.0, 0.0, 0.0]},
    "gold": {"albedo": [0.0, 0.0, 0.0], "reflectance": [0.9, 0.7, 0.3], "roughness": 0.4},
    "steel": {"albedo": [0.0, 0.0, 0.0], "reflectance": [0.6, 0.6, 0.6], "roughness": 0.2},
    "mirror": {"albedo": [0.0, 0.0, 0.0], "reflectance": [0.8, 0.8, 0.8], "roughness": 0.01},
    "gloss": {"albedo": [0.4, 0.3, 0.2], "reflectance": [0.04] * 3, "roughness": 0.3},
    "wet": {"albedo": [0.2, 0.5, 0.3], "reflectance": [0.04] * 3, "roughness": 0.01},
    "glass": {"albedo": 0.0, "transmission": [0.9, 1.0, 0.8], "ior": 1.5, "roughness": 0.01},
    "frosted": {"albedo": 0.0, "transmission": [1.0, 1.0, 1.0], "ior": 1.3, "roughness": 0.5},
    "pane": {"albedo": 0.0, "transmission": [0.5, 1.0, 1.0], "ior": 1.5, "thin": True},
}
PUNCTUAL = ("point", "spot", "directional")
CAMERA = {
    "position": [0.2, 1.0, 7.0],
    "target": [0.0, 0.5, 0.0],
    "up": [0.0, 1.0, 0.0],
    "vertical_fov": 50,
}


def number(low: float, high: float) -> st.SearchStrategy:
    # Not floats: Mitsuba makes the processor flush small numbers to zero, which Hypothesis refuses.
    return st.integers(round(1000 * low), round(1000 * high)).map(lambda x: x / 1000)


def vector(low: float = -3, high: float = 3) -> st.SearchStrategy:
    return st.lists(number(low, high), min_size=3, max_size=3)


direction = vector(-1, 1).filter(lambda v: np.linalg.norm(v) > 0.1)
colour = vector(0.1, 9)
# Points on surfaces become lights of no size.
away = vector(5, 6)
material = st.sampled_from(sorted(MATERIALS))


@st.composite
def quads(draw, **keys: st.SearchStrategy) -> dict:
    edge1, edge2 = draw(direction), draw(direction)
    sine = np.linalg.norm(np.cross(edge1, edge2)) / (np.linalg.norm(edge1) * np.linalg.norm(edge2))
    edge2 = edge2 if sine > 0.2 else np.roll(edge1, 1).tolist()
    if np.linalg.norm(np.cross(edge1, edge2)) < 0.05:
        edge1, edge2 = [1.0, 0.0, 0.0], [0.0, 0.5, 0.5]
    corner = draw(vector())
    return {"corner": corner, "edge1": edge1, "edge2": edge2} | {k: draw(v) for k, v in keys.items()}


spheres = st.fixed_dictionaries(
    {"center": vector(), "radius": number(0.1, 1), "subdivisions": st.just(4), "material": material}
)


@st.composite
def meshes(draw) -> dict:
    linear = np.array([draw(vector(-1, 1)) for _ in range(3)]) + 2 * np.eye(3)
    matrix = np.vstack([np.column_stack([linear, draw(vector())]), [0, 0, 0, 1]])
    own = {"file": draw(st.sampled_from(["ball.ply", "ball.obj"])), "smooth": draw(st.booleans())}
    return own | {"material": draw(material), "transform": matrix.tolist()}


lights = st.one_of(
    quads(radiance=colour),
    st.builds(
        lambda c, n, r, e: {"kind": "disc", "centre": c, "normal": n, "radius": r, "radiance": e},
        vector(), direction, number(0.1, 1), colour,
    ),
    st.builds(
        lambda c, r, e: {"kind": "sphere", "centre": c, "radius": r, "radiance": e},
        vector(-2, 2), number(0.1, 1), colour,
    ),
    st.builds(lambda p, i: {"kind": "point", "position": p, "intensity": i}, away, colour),
    st.builds(
        lambda p, d, i, inner, outer: {
            "kind": "spot", "position": p, "direction": d, "intensity": i, "inner_angle": inner,
            "outer_angle": outer,
        },
        away, direction, colour, number(5, 20), number(25, 60),
    ),
    st.builds(
        lambda d, e: {"kind": "directional", "direction": d, "irradiance": e}, direction, colour
    ),
)  # fmt: skip


@st.composite
def scenes(draw) -> dict:
    some = {"min_size": 1, "max_size": 4}
    tables = {
        "camera": CAMERA | {"vertical_fov": draw(number(20, 90))},
        "materials": MATERIALS,
        "quads": draw(st.lists(quads(material=material), **some)),
        "spheres": draw(st.lists(spheres, max_size=2)),
        "meshes": draw(st.lists(meshes(), max_size=2)),
        # Those that are shapes come back first.
        "lights": sorted(
            draw(st.lists(lights, max_size=4)), key=lambda one: one.get("kind") in PUNCTUAL
        ),
    }
    if draw(st.booleans()):
        tables["environment"] = {"radiance": draw(colour)}
    return tables


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    found = tmp_path_factory.mktemp("round_trip")
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.5)
    for suffix in ("ply", "obj"):
        ball.export(found / f"ball.{suffix}")
    return found


def imported(mi, tables: dict, folder: Path) -> dict:
    """Our tables of Mitsuba's dictionary of our tables."""
    root = read_dict(scene_dict(mi, tables, folder))
    return tables_of(root, folder / "x.xml", ImageFiles(Reach(folder)), Notes()).tables


def built(tables: dict, folder: Path) -> ncv.Scene:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = Found({"name": "x"} | tables)
        return scene_from(found, folder / "x.toml", ImageFiles(Reach(folder)))


def looks(scene: ncv.Scene) -> np.ndarray:
    """Each triangle's material as numbers."""
    rows = [
        [*m.albedo, *m.reflectance, m.roughness, *m.emission, *m.transmission, m.ior or 0, m.thin]
        for m in scene.materials
    ]
    return np.array(rows, np.float64)[scene.triangle_material]


# Shrinking a scene takes minutes.
@settings(
    max_examples=40,
    suppress_health_check=list(HealthCheck),
    deadline=None,
    phases=(Phase.explicit, Phase.generate),
)
@given(tables=scenes())
def test_a_scene_comes_back_the_same(scalar, folder: Path, tables: dict) -> None:
    try:
        here = built(tables, folder)
    except ncv.SceneError:
        # Such as a camera inside of a light.
        reject()
    back = built(imported(scalar, tables, folder), folder)
    close = {"rtol": 1e-5, "atol": 2e-5}
    np.testing.assert_allclose(
        back.vertices[back.triangles] + back.origin, here.vertices[here.triangles] + here.origin, **close
    )
    np.testing.assert_allclose(
        back.vertex_normals[back.triangles], here.vertex_normals[here.triangles], rtol=1e-4, atol=1e-4
    )
    np.testing.assert_allclose(looks(back), looks(here), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(back.triangle_light, here.triangle_light)
    assert [type(one) for one in back.lights] == [type(one) for one in here.lights]
    for one, other in zip(back.lights, here.lights, strict=True):
        assert vars(one).keys() == vars(other).keys()
        for key, value in vars(one).items():
            np.testing.assert_allclose(value, vars(other)[key], rtol=1e-4, atol=2e-5)
    for key in ("position", "up", "vertical_fov"):
        ours, theirs = (getattr(one.camera, key) for one in (here, back))
        np.testing.assert_allclose(theirs, ours, atol=1e-5) if key != "up" else None
    ahead = [one.camera.target - one.camera.position for one in (here, back)]
    np.testing.assert_allclose(*(one / np.linalg.norm(one) for one in ahead), atol=1e-6)
    _same_environment(here, back)


def _same_environment(here: ncv.Scene, back: ncv.Scene) -> None:
    assert (here.environment is None) == (back.environment is None)
    if here.environment is not None:
        np.testing.assert_allclose(back.environment.radiance, here.environment.radiance, rtol=1e-6)
        suns = list(itertools.zip_longest(here.environment.suns, back.environment.suns))
        for one, other in suns:
            np.testing.assert_allclose(other.towards, one.towards, atol=1e-6)
            np.testing.assert_allclose(other.irradiance, one.irradiance, rtol=1e-6)


ROOM = {
    "quads": [
        {"corner": [-2, -1, 2], "edge1": [4, 0, 0], "edge2": [0, 0, -4], "material": "white"},
        {"corner": [-2, -1, -2], "edge1": [4, 0, 0], "edge2": [0, 3, 0], "material": "red"},
        {"corner": [-2, -1, 2], "edge1": [0, 0, -4], "edge2": [0, 3, 0], "material": "white"},
    ],
    "spheres": [{"center": [0.6, -0.3, 0.3], "radius": 0.7, "subdivisions": 4, "material": "red"}],
    "meshes": [
        {
            "file": "ball.ply",
            "smooth": True,
            "material": "white",
            "transform": [[1.4, 0, 0, -0.8], [0, 1.4, 0, -0.3], [0, 0, 1.4, 0.6], [0, 0, 0, 1]],
        }
    ],
}
# Out of sight: their edges would be most of the noise.
LAMPS = {
    "lamp": {
        "corner": [-0.7, 3, -0.7],
        "edge1": [1.4, 0, 0],
        "edge2": [0, 0, 1.4],
        "radiance": [8, 7, 6],
    },
    "disc": {"kind": "disc", "centre": [0, 3, 0], "normal": [0, -1, 0.2], "radius": 0.6, "radiance": 9},
    "ball": {"kind": "sphere", "centre": [0.5, 3, 0.9], "radius": 0.5, "radiance": [20, 15, 10]},
    "point": {"kind": "point", "position": [0.3, 3, 1.0], "intensity": [6, 5, 4]},
    "sun": {"kind": "directional", "direction": [0.3, -1, -0.4], "irradiance": [3, 3, 2]},
}
CASES = {
    "lamp": ({"lights": [LAMPS["lamp"]]}, 2),
    "disc and point": ({"lights": [LAMPS["disc"], LAMPS["point"]]}, 2),
    "ball, gi": ({"lights": [LAMPS["ball"]]}, 4),
    "sky, sun, gi": ({"lights": [LAMPS["sun"]], "environment": {"radiance": [0.4, 0.5, 0.7]}}, 3),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_images_agree(one_device: ncv.Device, scalar, folder: Path, case: str) -> None:
    """Means over all pixels within 0.5 % or four standard errors of independent renders."""
    lit, depth = CASES[case]
    tables = {"camera": CAMERA | {"vertical_fov": 24}, "materials": MATERIALS} | ROOM | lit
    scene = built(imported(scalar, tables, folder), folder)
    size, batches = (24, 18), 5
    path = scalar.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1000})
    there = scalar.load_dict(scene_dict(scalar, tables, folder, size))
    theirs = [np.array(scalar.render(there, integrator=path, spp=96, seed=s)) for s in range(batches)]
    integrand = "direct" if depth == 2 else ncv.GlobalIllumination(depth)
    ours = [
        ncv.render(
            scene, integrand, "mc", spp=32, size=size, supersample=4, seed=s, device=one_device
        ).pixels
        for s in range(batches)
    ]
    means = [np.array([image.mean(axis=(0, 1)) for image in images], float) for images in (ours, theirs)]
    error = np.sqrt(sum(mean.var(axis=0, ddof=1) / batches for mean in means))
    here, reference = (mean.mean(axis=0) for mean in means)
    print(case, here / reference - 1, error / reference)
    assert np.all(np.abs(here - reference) <= np.maximum(0.005 * reference, 4 * error))
    assert np.all(error < 0.01 * reference)
