"""Training: the network, its control coefficients, the density of its residual."""
