"""Methods: the paper's Algorithm 1, and others of the same steps. They do not depend on each other."""
