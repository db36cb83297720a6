"""The expensive systems."""
