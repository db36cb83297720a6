"""The contract of the method that runs a trial."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from simbias.core.records import Iteration, Rollout
from simbias.trial.observer import Observer

if TYPE_CHECKING:
    from simbias.trial.study import Study


class Method(ABC):
    """An algorithm that searches, experiments and learns, built from the steps in `simbias.trial.steps`.

    It does not handle folders. It may be rerun over the steps of an earlier run, which are then replayed
    (`simbias.trial.replay`). Therefore every search and every experiment has its own random generator,
    spawned from the method's.
    """

    max_iterations: int  # N_out
    experiments: int  # on hardware, at most per iteration
    random_experiments: int = 0  # before the first policy
    trajectories: int = 0  # planned for each search

    @cached_property
    def max_experiments(self) -> int:
        """The maximum number of hardware experiments, in a trial that never succeeds."""
        return sum(map(self.passes_of, range(self.max_iterations)))

    def passes_of(self, policy: int) -> int:
        """Experiments that the trial's policy of this number, from 0, has to pass; it runs no more."""
        return self.experiments

    def split(
        self, unfinished: Sequence[Rollout], first: bool
    ) -> tuple[Sequence[Rollout], Sequence[Rollout]]:
        """The experiments of an unfinished iteration, perhaps the first: random ones; those of a policy."""
        drawn = self.random_experiments if first else 0
        return unfinished[:drawn], unfinished[drawn:]

    def check(self, study: Study) -> None:  # noqa: B027 (most methods accept any)
        """Refuse components that the method cannot work with, before anything is run.

        Raises
        ------
        ConfigError
            Naming the key.
        """

    @abstractmethod
    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every iteration as it ends."""
