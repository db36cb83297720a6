"""Models from recordings of a robot, and which of their parameters can be trusted."""
