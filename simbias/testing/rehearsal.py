"""What is done before a trial: components of the user's own are tried, and all is compiled."""

from __future__ import annotations

from simbias.blame import is_own, told
from simbias.config.errors import ConfigError
from simbias.study import Study
from simbias.testing.conformance import verdicts

GROUPS = ("task", "nominal", "policy")  # whose checks take milliseconds


def rehearse(study: Study) -> None:
    """Hold own components to their contracts, and compile the simulation.

    Raises
    ------
    ConfigError
        If one breaks its contract or raises: one line with component, method, expected and got.
    """
    own = [group for group in GROUPS if is_own(getattr(study, group))]
    for verdict in verdicts(study, own):
        if verdict.problem:
            raise ConfigError("", verdict.problem) from verdict.error
    try:
        study.warm_up()
    except (Exception, SystemExit) as error:
        raise ConfigError("", told(error)) from error
