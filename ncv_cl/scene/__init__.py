"""Scenes: TOML and mesh files to triangles, materials, lights and a camera."""
