"""From recordings of a robot to a model, and to what of it may be trusted."""
