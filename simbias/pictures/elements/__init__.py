"""Style, layout and drawings of tasks, which all pictures share."""
