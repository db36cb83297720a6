"""Methods: the paper's Algorithm 1, and others of the same steps. None knows another."""
