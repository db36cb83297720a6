"""A person with a robot: orders in a folder, trajectories as CSV files that are put beside them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from simbias.core import Hardware, HardwareError, Policy, Task, Waiting
from simbias.core.messages import words
from simbias.core.records import Array, Rollout
from simbias.lab.requests.folder import README, TRAJECTORY, write_order
from simbias.lab.requests.order import Order
from simbias.lab.requests.trajectory import read


class Manual(Hardware):
    """Writes an order for each experiment, and waits for its `trajectory.csv`, for days if need be.

    Parameters
    ----------
    orders
        The folder of the orders, one folder for each.
    """

    sets_start = False  # people come near to it

    def __init__(self, task: Task, orders: str = "orders") -> None:
        self._task = task
        self._orders = Path(orders)

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """The trajectory of an order, if it is there.

        Raises
        ------
        HardwareError
            If something is wrong with it, in one line with file, row and column, or the order cannot be
            written.
        Waiting
            If it is not there yet.
        """
        order = Order(self._task, policy, theta, start, int(rng.integers(2**62)))
        try:
            folder = write_order(order, self._orders)
        except OSError as error:
            raise HardwareError(f"{self._orders}: the order cannot be written ({words(error)})") from error
        file = folder / TRAJECTORY
        if not file.exists():
            raise Waiting(f"make the experiment of {folder / README}, and put its {TRAJECTORY} there")
        return read(file, self._task)
