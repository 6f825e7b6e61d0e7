"""TOML and mesh files, or arrays, to triangles, materials, lights and a camera."""
