"""Costs of a rollout."""
