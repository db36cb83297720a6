"""Grids of trials: defining them, running them, and their tables."""
