"""The contract of the method that runs a trial."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from simbias.core.records import Iteration
from simbias.trial.observer import Observer

if TYPE_CHECKING:
    from simbias.trial.study import Study


class Method(ABC):
    """An algorithm that searches, experiments and learns, in the steps of `simbias.trial.steps`.

    It knows nothing of folders. It may be run again over the steps of an earlier run, which are then replayed
    (`simbias.trial.replay`). So every search and every experiment has a generator of its own, spawned from
    the method's.
    """

    max_iterations: int  # N_out
    experiments: int  # on hardware, of an iteration at most

    @cached_property
    def max_experiments(self) -> int:
        """Hardware experiments of a trial that never succeeds, at most."""
        return sum(map(self.passes_of, range(self.max_iterations)))

    def passes_of(self, policy: int) -> int:
        """Experiments that the trial's policy of this number, from 0, has to pass, and so makes at most."""
        return self.experiments

    def check(self, study: Study) -> None:  # noqa: B027 (most work with any)
        """Refuse components that the method cannot work with, before anything is made.

        Raises
        ------
        ConfigError
            Naming the key.
        """

    @abstractmethod
    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every iteration as it ends."""
