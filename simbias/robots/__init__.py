"""Robots and physics engines, each with its task, nominal model, hardware and drawing in one place."""
