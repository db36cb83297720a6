"""Robots from MJCF and URDF files, in MuJoCo."""
