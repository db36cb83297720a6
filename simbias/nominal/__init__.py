"""Simulation models f' (Section IV-A)."""
