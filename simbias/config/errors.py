"""What is wrong with an override, a key or a value, in one line."""

from __future__ import annotations


class ConfigError(ValueError):
    """A bad override, key or value."""

    def __init__(self, key: str, problem: str) -> None:
        super().__init__(f"{key}: {problem}" if key else problem)
        self.key, self.problem = key, problem

    def __reduce__(self) -> tuple[type[ConfigError], tuple[str, str]]:
        """So that it comes back from a worker as what it is."""
        return ConfigError, (self.key, self.problem)
