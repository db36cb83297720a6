"""Experiments on hardware: checked, and limited in time and by safety limits."""
