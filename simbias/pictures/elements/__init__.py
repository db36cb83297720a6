"""Style, layout and drawings of tasks, shared by all pictures."""
