"""Minimisers over a box."""
