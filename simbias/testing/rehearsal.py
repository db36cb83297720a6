"""Before a trial: components of the user's own are tried, and all is compiled."""

from __future__ import annotations

from threadpoolctl import threadpool_limits

from simbias.core.error_origin import is_own, told
from simbias.core.errors import ConfigError
from simbias.testing.conformance import verdicts
from simbias.trial.study import Study
from simbias.trial.warm_up import warm_up

LEAST_SECONDS = 0.01  # of an experiment: in less nothing can fail, and every policy would succeed
GROUPS = ("task", "nominal", "policy")  # whose checks take a second at most


def rehearse(study: Study) -> None:
    """Hold own components to their contracts, and compile the simulation.

    A ConfigError has component, method, expected and got of one that breaks its contract or raises. Others
    are of a method that cannot work with a component, and of an experiment too short to tell anything.
    """
    study.method.check(study)
    task = study.task
    if (seconds := task.horizon * task.time_step) < LEAST_SECONDS:
        problem = (
            f"{task.horizon} frames of {task.time_step:g} s are {seconds:g} s, in which nothing can fail"
        )
        raise ConfigError("task.horizon", f"{problem}; at least {LEAST_SECONDS:g} s are needed")
    own = [group for group in GROUPS if is_own(getattr(study, group))]
    for verdict in verdicts(study, own):
        if verdict.problem:
            raise ConfigError("", verdict.problem) from verdict.error
    try:
        with threadpool_limits(1, user_api="blas"):  # as in a trial
            warm_up(study)
    except (ConfigError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise ConfigError("", told(error)) from error
