"""Learning from experiments: samples, parameters, a bias, and the distribution of prediction errors."""
