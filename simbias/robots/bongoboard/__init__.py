"""A legged robot on a bongoboard (Section VI)."""
