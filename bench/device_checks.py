"""Every kernel against its reference on one device: the repository's own tests, called one by one.

The table names a test function and the arguments that pytest would have given it. It is kept honest by
counting: kernels that no check launched are reported by name.
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np

import ncv_cl as ncv
from ncv_cl.integrands import DirectLight, GlobalIllumination
from ncv_cl.opencl.device import Device
from ncv_cl.opencl.limits import DeviceMemory
from ncv_cl.opencl.program import Kernel, kernel_folder
from ncv_cl.points.sampler import Stream
from ncv_cl.sampling.samples import MEAN_SAMPLES

ROOT = Path(__file__).parent.parent
TESTS, SCENES = ROOT / "tests", ROOT / "scenes"
ALL_GROUPS = ("W1", "B1", "B2", "W3", "B3")

# Subjects of which a quick run needs every check, to reach every kernel.
WHOLE_SUBJECTS = ("direct light", "left out", "density", "integration", "control coefficient")
# Subject, test module, test function, and the arguments that are no fixtures (or a function of the
# module that gives them). Of most subjects a quick run does the first check only.
CHECKS: tuple[tuple[str, str, str, dict | Callable[[ModuleType], dict]], ...] = (
    ("sampler", "test_sampler", "test_every_device_draws_the_reference_bits",
     {"sampler": "sobol", "points": range(3, 40), "samples": range(5, 70), "seed": 7, "stream": 1}),
    ("sampler", "test_sampler", "test_every_device_draws_the_reference_bits",
     {"sampler": "independent", "points": range(0, 9), "samples": range(0, 64), "seed": 7, "stream": 0}),
    ("points", "test_points", "test_points_match_brute_force",
     {"scale": 1, "offset": 0, "smooth": True}),
    ("points", "test_points", "test_points_match_brute_force",
     {"scale": 1e3, "offset": 1e5, "smooth": False}),
    ("scattering", "test_bsdf", "test_scattering_matches_float64", {"roughness": 0.3, "cosine_o": 0.6}),
    ("scattering", "test_bsdf", "test_scattering_matches_float64",
     {"roughness": 0.02, "cosine_o": 0.05}),
    ("ambient occlusion", "test_ao", "test_an_open_point_sees_everything_in_the_stated_density",
     {"mapping": "height", "normal": (0.3, -0.5, 0.2)}),
    ("ambient occlusion", "test_ao", "test_an_open_point_sees_everything_in_the_stated_density",
     {"mapping": "cosine", "normal": (0, 0, -1)}),
    ("direct light", "test_direct", "test_every_sample_matches_float64",
     lambda tests: {"lights": tests.LIGHTS}),
    ("direct light", "test_gloss", "test_every_sample_matches_float64",
     lambda tests: {"light": tests.LARGE, "roughness": 0.3}),
    ("direct light", "test_direct", "test_quadrature_gives_lamberts_form_factor",
     {"scale": 1, "offset": 0, "count": 3}),
    ("direct light", "device_checks", "unshadowed_means_are_those_of_the_samples", {}),
    ("left out", "test_skip", "test_dark_points_are_those_of_float64",
     {"name": "cornell_box", "is_double": True, "tmp_path": None}),
    ("left out", "test_skip", "test_dark_points_come_last_with_all_that_belongs_to_them", {}),
    ("left out", "test_skip", "test_idle_neurons_are_those_that_corners_tell",
     {"modulated": ALL_GROUPS}),
    ("shadow rays", "test_shaft", "test_occluders_answer_as_embree_does",
     lambda tests: {"count": 40, "lights": tests.LIGHTS}),
    ("shadow rays", "test_shadow", "test_rays_are_answered_as_in_double_precision",
     {"place": 1e4, "scale": 1.0, "count": 20}),
    ("rays", "test_rays", "test_samples_are_embrees", {"integrand": GlobalIllumination(4)}),
    ("rays", "test_trace_device", "test_answers_are_embrees_but_for_rounding", {"name": "interior"}),
    ("rays", "test_trace_device", "test_no_ray_leaves_a_closed_mesh",
     {"shape": "sphere", "scale": 1.0, "place": 50.0}),
    ("paths run ahead", "test_rays",
     "test_paths_that_run_ahead_are_those_whose_rays_are_counted",
     {"scene": "interior", "split": "on"}),
    ("global illumination", "test_gi", "test_matte_scenes_match_an_independent_path_tracer",
     {"depth": 3, "lights": None}),
    ("followed paths", "device_checks", "paths_followed_to_their_ends_are_those_of_waves", {}),
    ("shared paths", "test_share", "test_sharing_changes_no_expectation",
     {"kind": "smooth", "depth": None}),
    ("control coefficient", "test_alpha", "test_moments_of_each_column_match_float64", {}),
    ("control coefficient", "test_alpha", "test_a_coefficient_of_zero_leaves_plain_monte_carlo", {}),
    ("slices", "test_slices_auto", "test_refused_slices_are_those_of_a_draw", {}),
    ("points of arrays", "test_sense", "test_irradiance_without_shadows_is_lamberts", {}),
    ("samples", "test_samples", "test_each_sample_finds_its_own_rays_answer", {}),
    ("estimate", "test_accumulate", "test_means_and_variances_match_float64",
     {"channels": 3, "lengths": (1, 1, 200, 3), "mean": 1e3, "spread": 1e-1}),
    ("estimate", "test_accumulate", "test_residuals_are_taken_against_the_network",
     {"modulated": ALL_GROUPS}),
    ("features", "test_network", "test_features_match_reference",
     {"inputs": ("position", "normal", "outgoing", "albedo", "roughness"), "grid": {}}),
    ("lists of a hash grid", "test_grid_index", "test_lists_are_those_of_the_definition",
     lambda tests: {"build": tests.on_device, "edges": (0, 1, 20, 37)}),
    ("inference", "test_network", "test_inference_matches_reference",
     {"hidden": (16, 16), "modulated": ALL_GROUPS}),
    ("inference", "test_network", "test_inference_matches_reference",
     {"hidden": (17, 5), "modulated": ("B1",)}),
    ("demodulation", "test_network", "test_a_demodulated_network_is_multiplied_by_the_factor",
     {"channels": 3}),
    ("training", "test_train", "test_gradients_match_finite_differences",
     {"hidden": (16, 16), "options": {}}),
    ("training", "test_train", "test_two_runs_are_bit_equal", {"demodulated": True}),
    ("density", "test_density", "test_gradients_match_finite_differences", {}),
    ("density", "test_density", "test_the_magnitude_is_learned_and_tabulated", {}),
    ("warp", "test_warp", "test_weights_are_one_over_the_density", {"sampler": "sobol"}),
    ("triangles", "test_triangulate", "test_samples_match_float64", {"sampler": "sobol"}),
    ("triangles", "test_triangulate", "test_records_match_float64", {}),
    ("integration", "test_integrate", "test_methods_meet_rational_arithmetic",
     {"widths": (2, 5, 17, 3), "method": "decoupled"}),
    ("integration", "test_integrate", "test_methods_meet_rational_arithmetic",
     {"widths": (2, 4, 5, 3, 2), "method": "full"}),
    ("integration", "test_integrate", "test_robust_path_agrees",
     {"widths": (2, 6, 9, 3), "precision": "float32"}),
    ("subdivision", "test_subdivide", "test_affine_functions_are_the_network",
     {"widths": (2, 6, 2)}),
    ("probe", "test_probe", "test_chains_of_multiply_adds_match_float64", {}),
    ("other integrands", "test_callable", "test_channels_and_signs", {}),
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What a check found; `error` is empty where the kernel met its reference."""

    subject: str
    test: str
    seconds: float
    error: str


def validate(device: Device, quick: bool) -> tuple[list[Outcome], list[str]]:
    """Run the checks; also the kernels that none of them launched.

    Parameters
    ----------
    quick : bool
        One check a subject, where the others reach no kernel that it does not.
    """
    for folder in (str(TESTS), str(Path(__file__).parent)):
        if folder not in sys.path:
            sys.path.insert(0, folder)
    outcomes, launched = [], set()
    with _recording(launched):
        for number, check in enumerate(CHECKS):
            first = all(check[0] != earlier[0] for earlier in CHECKS[:number])
            if first or not quick or check[0] in WHOLE_SUBJECTS:
                outcomes.append(_run(device, *check))
    return outcomes, sorted(set(kernel_names()) - launched)


def kernel_names() -> list[str]:
    """Every kernel that the `.cl` files define."""
    found = []
    for path in sorted(kernel_folder().glob("*/*.cl")):
        text = re.sub(r"/\*.*?\*/", " ", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        found += re.findall(r"\bkernel\b[^{;]*?\bvoid\s+(\w+)\s*\(", text.replace("__kernel", "kernel"))
    return found


def unshadowed_means_are_those_of_the_samples(device: Device) -> None:
    """The mean of what draw_samples, which has a reference of its own, gives for the same samples."""
    import reference
    import test_direct

    scene = test_direct.floor_scene(test_direct.LIGHTS)
    points, source, _ = reference.sampling(device, scene, DirectLight(), (9, 7), MEAN_SAMPLES)
    means = source.unshadowed_means().read()
    batch = source.draw(range(points.active), range(MEAN_SAMPLES), Stream.UNSHADOWED)
    values = reference.batch_arrays(batch, DirectLight.channels)["value"]
    np.testing.assert_allclose(means, values.mean(axis=-1, dtype=np.float64), rtol=1e-5)


def paths_followed_to_their_ends_are_those_of_waves(device: Device) -> None:
    """Where memory is not shared kernels follow the last paths; on a CPU the host counts them else."""
    memory, pictures = device.memory, []
    for shared in (True, False):
        own = replace(device, memory=DeviceMemory(shared, memory.largest, memory.total))
        image = ncv.render(
            SCENES / "cornell_box.toml", "gi", "mc", spp=2, size=(16, 16), rays="device", device=own
        )
        pictures.append(image.pixels)
    np.testing.assert_array_equal(*pictures)


def _run(
    device: Device,
    subject: str,
    module: str,
    test: str,
    arguments: dict | Callable[[ModuleType], dict],
) -> Outcome:
    begun = time.perf_counter()
    error = ""
    try:
        tests = importlib.import_module(module)
        function = getattr(tests, test)
        arguments = arguments(tests) if callable(arguments) else arguments
        with _fixtures(device, function, arguments) as given:
            function(**given)
    # Whatever goes wrong on a strange device belongs into the report, and the next check goes on.
    except Exception as problem:
        error = f"{type(problem).__name__}: {' '.join(str(problem).split())[:300]}"
    return Outcome(subject, f"{module}.{test}", time.perf_counter() - begun, error)


@contextmanager
def _fixtures(device: Device, function: Callable, arguments: dict) -> Iterator[dict]:
    """The function's arguments: those of the table, and what pytest's fixtures would give it."""
    import pytest
    import test_warp

    known = {
        "device": lambda: device,
        "one_device": lambda: device,
        "scenes": lambda: SCENES,
        "plane": lambda: inspect.unwrap(test_warp.plane)(),
        "monkeypatch": lambda: patch,
    }
    with pytest.MonkeyPatch.context() as patch:
        names = set(inspect.signature(function).parameters) - set(arguments)
        yield arguments | {name: known[name]() for name in names}


@contextmanager
def _recording(launched: set[str]) -> Iterator[None]:
    """Note the names of kernels that are launched while the block lasts."""
    plain_call, plain_repeat = Kernel.__call__, Kernel.repeat

    def call(kernel: Kernel, work_items: object, **given: object) -> object:
        launched.add(kernel.name)
        return plain_call(kernel, work_items, **given)

    def repeat(kernel: Kernel, *given: object) -> None:
        launched.add(kernel.name)
        plain_repeat(kernel, *given)

    Kernel.__call__, Kernel.repeat = call, repeat
    try:
        yield
    finally:
        Kernel.__call__, Kernel.repeat = plain_call, plain_repeat
