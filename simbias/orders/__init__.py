"""Orders: experiments for a person or a program to make, and the trajectories that come back."""
