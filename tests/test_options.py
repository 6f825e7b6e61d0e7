"""Options: declared once, found in the API, on the command line and in the metadata; none is dropped."""

from __future__ import annotations

import argparse
import dataclasses
import inspect

import numpy as np
import pytest

import ncv_cl as ncv
from ncv_cl.cli import _parser
from ncv_cl.settings import options as options_module
from ncv_cl.settings.arguments import add_arguments, descriptions, read_arguments
from ncv_cl.settings.options import GROUPS, Sampling, Stopping, Training, gathered

TINY = {"method": "mc", "spp": 2, "size": (4, 4)}


@dataclasses.dataclass(frozen=True)
class MoreStopping(Stopping):
    """When a render ends, and one thing more.

    Attributes
    ----------
    target_mse : float, optional
        An error.
    time_limit : float, optional
        Seconds.
    stop : callable, optional
        Asked.
    patience : float
        How long to wait, 100 % made up.
    """

    patience: float = 2.5


def test_an_option_is_added_in_one_place(one_device, scenes, monkeypatch):
    monkeypatch.setitem(options_module.GROUPS, "stopping", MoreStopping)
    scene = scenes / "plane_light.toml"
    by_name = ncv.render(scene, device=one_device, patience=7.0, **TINY)
    assert by_name.metadata["patience"] == 7.0
    by_group = ncv.render(scene, device=one_device, stopping=MoreStopping(patience=8.0), **TINY)
    assert by_group.metadata["patience"] == 8.0
    parsed = _parser().parse_args(["render", str(scene), "-o", "a.exr", "--patience", "9"])
    assert read_arguments(parsed, MoreStopping)["patience"] == 9.0
    with pytest.raises(SystemExit):
        _parser().parse_args(["render", "-h"])


def test_render_has_few_parameters():
    assert len(inspect.signature(ncv.render).parameters) <= 14


@pytest.mark.parametrize("group", GROUPS.values(), ids=GROUPS)
def test_every_option_is_described(group):
    told = descriptions(group)
    assert list(told) == [option.name for option in dataclasses.fields(group)]
    assert all(text.endswith(".") and "\n" not in text for text in told.values())


@pytest.mark.parametrize("group", GROUPS.values(), ids=GROUPS)
def test_an_empty_command_line_gives_the_defaults(group):
    parser = argparse.ArgumentParser()
    add_arguments(parser, group)
    assert group(**read_arguments(parser.parse_args([]), group)) == group()


def test_texts_become_options():
    parser = argparse.ArgumentParser()
    for group in GROUPS.values():
        add_arguments(parser, group)
    text = "--sampler independent --supersample 3 --no-skip-dark --train-spp 0.5 --time-limit 2"
    parsed = parser.parse_args(text.split(" "))
    assert Sampling(**read_arguments(parsed, Sampling)) == Sampling("independent", 3, skip_dark=False)
    assert read_arguments(parsed, Training)["train_spp"] == 0.5
    assert read_arguments(parsed, Stopping)["time_limit"] == 2.0
    for wrong in (["--sampler", "best"], ["--train-spp", "some"], ["--supersample", "1.5"]):
        with pytest.raises(SystemExit):
            parser.parse_args(wrong)


def test_options_go_by_group_or_by_name():
    groups = {"sampling": Sampling(supersample=2), "training": None}
    found = gathered(groups, {"sampler": "independent", "train_spp": 3.0})
    assert found == {"sampling": Sampling("independent", 2), "training": Training(train_spp=3.0)}
    with pytest.raises(TypeError, match="did you mean 'supersample'"):
        gathered(groups, {"supersamples": 2})
    with pytest.raises(TypeError, match="sampling must be a Sampling"):
        gathered({"sampling": Training()}, {})


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"train_spp": 2.0}, "train_spp"),
        ({"preset": "wide"}, "preset"),
        ({"density": "table"}, "density"),
        ({"network": "n.npz"}, "network"),
        ({"save_network": "n.npz"}, "no network to save"),
        ({"allocation": "magnitude"}, "magnitude"),
    ],
)
def test_what_plain_monte_carlo_would_drop_is_refused(scenes, options, said):
    with pytest.raises(ValueError, match=said):
        ncv.render(scenes / "plane_light.toml", **TINY, **options)


def test_auto_honours_options_of_training_where_it_trains(one_device, scenes, monkeypatch):
    options = {"spp": 8, "size": (6, 4), "device": one_device, "train_spp": 2.0, "density": "none"}
    for enough, chosen in ((0, "ncv"), (1e30, "mc")):
        monkeypatch.setattr("ncv_cl.estimation.tuning.LIGHT_SAMPLES_THAT_PAY", enough)
        image = ncv.render(scenes / "plane_light.toml", "direct", "auto", **options)
        assert image.stats["method"] == chosen and np.isfinite(image.pixels).all()


def test_lines_are_refused_where_there_are_none(scenes):
    with pytest.raises(ValueError, match="'lines' is for integrands direct and ao"):
        ncv.render(scenes / "plane_light.toml", "gi", visibility="lines", **TINY)


def test_numbers_may_be_of_any_type(one_device, scenes):
    scene = scenes / "plane_light.toml"
    plain = ncv.render(scene, "direct", "mc", 4, (4, 4), 7, one_device, supersample=2)
    for spp, size in ((4.0, np.array([4, 4])), (np.float32(4), (np.int64(4), 4.0))):
        found = ncv.render(
            scene, "direct", "mc", spp, size, np.uint64(7), one_device, supersample=np.int64(2)
        )
        np.testing.assert_array_equal(found.pixels, plain.pixels)


@pytest.mark.parametrize(
    "options",
    [
        {"visibility": None},
        {"skip_dark": "no"},
        {"stop": 5},
        {"preset": ["wide"], "method": "ncv"},
        {"sampler": 3},
        {"network": "n.npz", "train_spp": 4, "method": "ncv"},
    ],
)
def test_what_is_no_value_of_an_option_is_refused(scenes, options):
    with pytest.raises(ValueError, match=next(iter(options)).replace("network", "train_spp")):
        ncv.render(scenes / "plane_light.toml", **(TINY | options))


@pytest.mark.parametrize("split", ["on", "off"])
@pytest.mark.parametrize("integrand", ["direct", "ao", ncv.GlobalIllumination(direct=False)])
def test_splitting_direct_light_is_for_what_has_it_and_more(scenes, integrand, split):
    with pytest.raises(ValueError, match="split_direct is for integrand gi"):
        ncv.render(scenes / "plane_light.toml", integrand, split_direct=split, **TINY)
