"""The rehearsal before a trial: custom components are checked, and everything is compiled."""

from __future__ import annotations

from threadpoolctl import threadpool_limits

from simbias.core.error_origin import is_own, with_origin
from simbias.core.errors import ConfigError
from simbias.testing.conformance import CHECKS, verdicts
from simbias.testing.studies import warm_up
from simbias.trial.study import Study

LEAST_SECONDS = 0.01  # of an experiment: in less time nothing can fail, and every policy would succeed
GROUPS = ("task", "nominal", "policy")  # groups whose checks take at most a second


def rehearse(study: Study) -> None:
    """Check the contracts of custom components, and compile the simulation.

    A ConfigError gives component, method, expected and got if one breaks its contract or raises. It is also
    raised if a method cannot work with a component, or an experiment is too short to be meaningful.
    """
    study.check()
    task = study.task
    if (seconds := task.horizon * task.time_step) < LEAST_SECONDS:
        problem = f"{task.horizon} frames of {task.time_step:g} s are {seconds:g} s, too short for a failure"
        raise ConfigError("task.horizon", f"{problem}; at least {LEAST_SECONDS:g} s are needed")
    checks = [check for check in CHECKS if check.rehearsed or check.group in GROUPS]
    own = [check.group for check in checks if is_own(getattr(study, check.group))]
    for verdict in verdicts(study, own, checks):
        if verdict.problem:
            raise ConfigError("", verdict.problem) from verdict.error
    try:
        with threadpool_limits(1, user_api="blas"):  # as in a trial
            warm_up(study)
    except (ConfigError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise ConfigError("", with_origin(error)) from error
