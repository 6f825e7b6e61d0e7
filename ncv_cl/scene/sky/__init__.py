"""Light from outside of the scene: constant, from an image, or a standard sky; and suns."""
