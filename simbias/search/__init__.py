"""Policy search in simulation."""
