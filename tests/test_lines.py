"""Lines on lights: what is free of them against embree, closed forms, and pictures that stay the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import (
    bare_kernel,
    batch_arrays,
    camera_at,
    grey,
    light_at,
    light_corners,
    mesh_scene,
    polygon_irradiance,
    quad,
    sampling,
    shadowed_values,
)
from test_shaft import CAMERA, FLOOR, LIGHTS, SEVERAL_LIGHTS, soup

from ncv_cl.integrands import DirectLight
from ncv_cl.opencl.device import HostArray, open_device
from ncv_cl.points.points import surface_defines
from ncv_cl.rendering.render import render
from ncv_cl.sampling.samples import NO_RAY, SEEN
from ncv_cl.visibility.lines import line_defines

# Of samples (u, v): whether v is in a gap of its line, and how far from the next end of one.
KERNEL = """
kernel void free_of_lines(const uint samples, const uint point_count, const uint total_points, const uint corner_stride,
                          global const float *surface, global const float *lights, global const uint *starts,
                          global const uint *lists, global const float *corners, global const float *u,
                          global const float *v, global float *is_free, global float *margin) {
  const uint blocks = samples / VEC;
  const uint point = (uint)get_global_id(0) / blocks;
  const ulong at = (ulong)get_global_id(0) * VEC;
  if (point >= point_count || lists[starts[point]] == TOO_MANY) return;
  const ShadingPoint p = load_shading_point(surface, total_points, point);
  global const float *strips = strips_at(lights, &p);
  real found = (real)0.0f;
  real apart = (real)FAR_AWAY;
  for (uint light = 0; light < LIGHT_COUNT; ++light) {
    const float first = strips[2 * light];
    const float width = strips[2 * light + 1];
    const real own_u = LOAD(u + at);
    const whole here = (own_u >= first) && (own_u < first + width);
    const LightLines lines = lines_of(&p, lights + light * LIGHT_FLOATS);
    Block block[BLOCKS_A_ITEM];
    begin_block(&lines, (own_u - first) / width, here, &block[0]);
    cut_lines(&lines, lists + starts[point], corners, corner_stride, ray_origin(&p), 1, block);
    const Gaps *gaps = &block[0].gaps;
    const LightView *view = &lines.view;
    const real squared = FMA(block[0].x, block[0].x, view->z * view->z);
    const real all = sine_between(squared, block[0].begin, block[0].begin + view->length);
    for (uint k = 0; k < gaps->used; ++k) {
      const whole is_gap = here && (gaps->low[k] < gaps->high[k]);
      real low = (gaps->low[k] - block[0].begin) / view->length;
      real high = (gaps->high[k] - block[0].begin) / view->length;
      if (lines.large) {
        low = sine_between(squared, block[0].begin, gaps->low[k]) / all;
        high = sine_between(squared, block[0].begin, gaps->high[k]) / all;
      }
      const real own_v = LOAD(v + at);
      found = SELECT(found, (real)1.0f, is_gap && (own_v >= low) && (own_v <= high));
      apart = SELECT(apart, min(apart, min(fabs(own_v - low), fabs(own_v - high))), is_gap);
    }
    /* What no line could hold is left to points. */
    found = SELECT(found, (real)2.0f, here && gaps->refused);
  }
  STORE(found, is_free + at);
  STORE(apart, margin + at);
}
"""


@dataclass(frozen=True)
class Compared:
    """Samples that bring light but for shadows: whether embree and lines see it, and edges' distances in v."""

    embree: np.ndarray
    lines: np.ndarray
    margin: np.ndarray
    refused: int

    @property
    def disagreements(self) -> np.ndarray:
        """Distances of those about which they disagree."""
        return self.margin[self.embree != self.lines]


def compared(device, scene, size=(12, 10), samples=64) -> Compared:
    points, source, _ = sampling(device, scene, DirectLight(), size, samples)
    arrays = batch_arrays(batch := source.draw(range(points.active), range(samples), 0), 3)
    embree = (shadowed_values(batch, 3) > 0).any(axis=0)
    live = (arrays["value"] > 0).any(axis=0)
    _, on_lines, _ = sampling(device, scene, DirectLight(), size, samples, lines=True)
    occluders = on_lines.occluders
    defines = {
        **surface_defines(), **occluders.defines(), **line_defines(), **DirectLight().defines(scene),
    }  # fmt: skip
    files = ("common", "surface", "bsdf", "lights", "shaft", "lines")
    kernel = bare_kernel(device, files, defines, KERNEL, "free_of_lines")
    found = [HostArray(device, live.shape, np.float32) for _ in range(2)]
    kernel(
        live.size // device.vector_width, samples, points.active, points.total, occluders.stride, points.surface,
        HostArray.of(device, DirectLight().data(scene)), occluders.starts, occluders.lists,
        occluders.corners, HostArray.of(device, arrays["u"]), HostArray.of(device, arrays["v"]), *found,
    )  # fmt: skip
    is_free, margin = (array.read() for array in found)
    known = np.array([occluders.list_of(point) is not None for point in range(points.active)])
    asked = live & known[:, None] & (is_free < 2)
    return Compared(
        embree[asked], is_free[asked] == 1, margin[asked], int((is_free[live & known[:, None]] == 2).sum())
    )


@pytest.mark.parametrize("count", [0, 3, 40, 600])
@pytest.mark.parametrize("lights", [LIGHTS, SEVERAL_LIGHTS], ids=["one-light", "two-lights"])
def test_lines_are_free_where_embree_sees_the_light(device, count, lights):
    found = compared(device, soup(count, lights, 3 / (2 + count**0.5)))
    assert found.embree.size > 2000 and (count == 0 or 0 < found.embree.mean() < 1)
    # Where a ray grazes an edge rounding decides.
    assert len(found.disagreements) < 1e-4 * found.embree.size
    assert (found.disagreements < 1e-4).all()
    assert found.refused < 0.02 * found.embree.size
