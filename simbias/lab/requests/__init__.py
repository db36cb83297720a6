"""Experiments that a person or a program makes, requested in files."""
