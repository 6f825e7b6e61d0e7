"""What a render leaves: pixels and layers, statistics, image files, checkpoints."""
