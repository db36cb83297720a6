"""From rollouts to training data (Section IV-C)."""
