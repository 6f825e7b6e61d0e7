"""Training: the network, its control coefficients, and the density of its residual."""
