"""The stages in order: scene to image, points and functions of the user to integrals."""
