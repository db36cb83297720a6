"""Shapes that drawings of robots consist of."""
