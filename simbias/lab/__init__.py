"""Experiments on hardware: checked, limited in time and by safety limits."""
