"""Predictions of a policy's cost in simulation."""
