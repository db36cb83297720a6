"""What is learned from experiments: samples, parameters, a bias, and how well a model predicts."""
