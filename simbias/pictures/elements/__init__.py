"""What pictures have in common: style, panels, and how a task draws itself."""
