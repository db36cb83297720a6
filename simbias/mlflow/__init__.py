"""Trials and sweeps in an MLflow store."""
