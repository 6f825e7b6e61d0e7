"""Which triangles can stand between a point and the lights: shadow rays without a ray tracer."""
