"""Robots and physics engines: task, nominal model, hardware and drawing of each in one place."""
