"""Learners of the dynamics bias g_D (Section IV)."""
