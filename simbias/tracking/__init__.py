"""Stores of what a trial did."""
