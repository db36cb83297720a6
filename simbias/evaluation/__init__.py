"""How a policy's cost is predicted in simulation."""
