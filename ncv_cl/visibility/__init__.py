"""Occluder lists of shading points: shadow rays without a ray tracer."""
