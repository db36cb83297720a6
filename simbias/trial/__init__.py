"""A trial: its study, the steps of methods, and its records on disk."""
