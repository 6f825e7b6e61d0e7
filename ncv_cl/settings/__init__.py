"""What a render is asked for, and the presets it may name."""
