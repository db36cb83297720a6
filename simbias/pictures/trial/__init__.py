"""The pictures of a trial."""
