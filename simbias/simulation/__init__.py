"""The closed loop in simulation: plain and compiled."""
