"""Feedback laws."""
