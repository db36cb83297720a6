"""Shapes for drawings of robots."""
