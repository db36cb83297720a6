"""A check that components of a group have to pass, and how to register one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from simbias.trial.study import Study


@dataclass(frozen=True)
class Check:
    """Something that components of a group have to pass."""

    group: str
    words: str
    run: Callable[[Study], None]

    def __str__(self) -> str:
        return f"{self.group}: {self.words}"


CHECKS: list[Check] = []


def check(group: str, words: str) -> Callable[[Callable[[Study], None]], Callable[[Study], None]]:
    """Register a check."""

    def register(run: Callable[[Study], None]) -> Callable[[Study], None]:
        CHECKS.append(Check(group, words, run))
        return run

    return register
