"""How the cost of a policy is predicted in simulation."""
