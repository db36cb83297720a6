"""Experiments run by a person or a program, on request."""
