"""Components in NumPy are traced, written for Numba and run in the lanes of vector registers."""
