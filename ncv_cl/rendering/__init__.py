"""The stages in order: scene to image, and functions of the user to integrals."""
