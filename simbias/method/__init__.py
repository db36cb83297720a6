"""Algorithms that learn and optimise."""
