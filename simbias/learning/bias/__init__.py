"""The dynamics bias g(x, u): Gaussian processes, or none."""
