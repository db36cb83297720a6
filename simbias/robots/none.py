"""No model: f' = 0, so that all dynamics are learned from data."""

from __future__ import annotations

import numpy as np

from simbias.core import Nominal, Task, rates_and_positions
from simbias.core.records import Array


class NoNominal(Nominal):
    """Predicts that nothing changes: f' = 0 in Eq. 2, so that g_D is learned from scratch (Section IV-A).

    Parameters
    ----------
    kinematics
        Whether positions follow from their rates; then only changes of the rates are left to learn.

    Raises
    ------
    ValueError
        If `kinematics` is set, and a position lacks a rate: a state in its unit per second.
    """

    def __init__(self, task: Task, kinematics: bool = False) -> None:
        self._moves = np.zeros((len(task.states), len(task.states)))  # change per frame, linear in x
        if kinematics:
            rates, positions = rates_and_positions(task.states)
            self._moves[rates, positions] = task.time_step

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n) = x (..., n), or with each position moved by its rate."""
        return x + x @ self._moves if self._moves.any() else x.copy()
