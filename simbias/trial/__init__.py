"""A trial: the study that it runs, the steps of methods, and what is kept of it."""
