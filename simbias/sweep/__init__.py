"""Grids of trials: what they are, running them, their tables."""
