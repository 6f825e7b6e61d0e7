"""Values at points of the user: sensors, view factors between surfaces, maps of meshes."""
