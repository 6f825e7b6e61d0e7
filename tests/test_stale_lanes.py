"""Lanes of a wave past its last ray hold any bits, and nothing comes of them."""

from __future__ import annotations

import numpy as np
import pytest

import ncv_cl as ncv
from ncv_cl.sampling.waves.wave import HEADER, Wave

# Numbers that are none, that overflow, and that are no place of any table.
STALE = (np.nan, np.inf, 3e38, -1e9)


@pytest.mark.parametrize("name", ["sky_room", "textured_room", "lit_mesh", "glass"])
def test_what_a_wave_held_before_changes_nothing(one_device, scenes, monkeypatch, name):
    def pixels() -> np.ndarray:
        options = {"spp": 4, "size": (10, 7), "seed": 3, "rays": "embree", "device": one_device}
        return ncv.render(scenes / f"{name}.toml", "gi", "mc", **options).pixels

    expected, make_room = pixels(), Wave.make_room
    assert one_device.vector_width > 1 and (expected > 0).any()
    for stale in STALE:

        def spoilt(self, count, stale=stale):
            make_room(self, count)
            with self.words.mapped(update=True) as words:
                words[HEADER:] = stale

        monkeypatch.setattr(Wave, "make_room", spoilt)
        np.testing.assert_array_equal(pixels(), expected)
        monkeypatch.undo()
