"""One trial: a study is run, and every record kept before the next begins."""

from __future__ import annotations

from collections.abc import Callable

from threadpoolctl import threadpool_limits

from simbias.interfaces import Observer, TrackedTrial
from simbias.records import Array, Iteration, Rollout
from simbias.study import Study


class KeepingObserver:
    """Keeps every hardware experiment before anyone else hears of it."""

    def __init__(self, tracked: TrackedTrial, observer: Observer) -> None:
        self._tracked = tracked
        self._observer = observer

    def searching(self, evaluations: int, best_cost: float) -> None:
        """Pass a search's progress on."""
        self._observer.searching(evaluations, best_cost)

    def experimented(self, iteration: int, experiment: int, theta: Array, rollout: Rollout) -> None:
        """Keep an experiment, then pass it on."""
        self._tracked.experimented(iteration, experiment, theta, rollout)
        self._observer.experimented(iteration, experiment, theta, rollout)


def run_trial(
    study: Study, tracked: TrackedTrial, observer: Observer, on_iteration: Callable[[Iteration], None]
) -> Iteration:
    """Run a study to its end; return its last iteration. An error ends the record before it is raised.

    Pictures come last, when everything else is safe.
    """
    iterations = []
    try:
        with threadpool_limits(1, user_api="blas"):  # more would change the last bits of a factorisation
            for iteration in study.run(KeepingObserver(tracked, observer)):
                tracked.log(iteration)
                iterations.append(iteration)
                on_iteration(iteration)
    except BaseException as error:
        tracked.close(error)
        raise
    tracked.close()
    if study.tracking.pictures:
        from simbias.pictures.trial.gallery import pictures  # lazily: not everyone wants any

        tracked.illustrate(pictures(study, iterations))
    return iterations[-1]
