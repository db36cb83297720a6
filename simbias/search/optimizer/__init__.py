"""Minimisers over the policy parameters."""
