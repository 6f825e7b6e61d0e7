"""Points of the unit square, and shading points where camera rays hit."""
