"""Training data of the bias, selected from experiments."""
