"""A trial that continues an ended one with more experiments to spend.

Limits on experiments are part of a trial's identity, so the continued trial is another one. Up to the end of
the earlier trial its steps are the same: they are copied, and replayed.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from math import inf
from operator import lt
from pathlib import Path
from typing import Any

from simbias.core.errors import ConfigError
from simbias.core.messages import counted
from simbias.trial.disk import PART, write_json
from simbias.trial.folder import ATTEMPTS, EPISODE, TRIAL, TrialFolder
from simbias.trial.origin import description
from simbias.trial.run import TrialRecord
from simbias.trial.study import Study
from simbias.trial.summary import Outcome

OPTION = "--continue"
CONTINUES = "continues"  # key in trial.json
LIMITS = "budget", "method.max_iterations"  # in which the trials may differ


def continue_trial(study: Study, folder: Path, earlier: TrialRecord, source: Path) -> None:
    """Begin a study's trial in its folder with the steps of an ended trial in the folder `source`.

    Withdrawn experiments and attempts are copied as well; the test of the last policy is not. A folder that
    was begun in this way stays as it is.

    Raises
    ------
    ConfigError
        If the earlier trial has not ended or has succeeded, if the trials differ in more than their limits,
        or if the folder already has a trial that began otherwise.
    """
    origin = {"hash": earlier.study.hash, "experiments": earlier.summary.experiments}
    _check(study, earlier, source)
    if (folder / TRIAL).exists():
        if TrialFolder(folder).description().get(CONTINUES) == origin:
            return
        problem = f"is a trial that has already begun, without the steps of {source}; run it without {OPTION}"
        raise ConfigError(str(folder), problem)
    part = folder.with_name(f".{folder.name}{PART}")
    shutil.rmtree(part, ignore_errors=True)  # left by a killed process
    part.mkdir(parents=True)
    files = [step for step in TrialFolder(source).all_steps() if not step.name.endswith(EPISODE)]
    for file in (source / ATTEMPTS, *files):
        shutil.copy2(file, part)
    code = TrialFolder(source).description().get("code", {})  # as it was when the steps were made
    write_json(part / TRIAL, {**description(study), "code": code, CONTINUES: origin})
    part.rename(folder)


def _check(study: Study, earlier: TrialRecord, source: Path) -> None:
    """Raise a ConfigError unless the study's trial begins as the earlier one did."""
    outcome = earlier.outcome
    if outcome is not Outcome.NOT_SUCCEEDED:
        own = "has not ended; its own command resumes it"
        problem = "has succeeded" if outcome is Outcome.SUCCEEDED else own
        raise ConfigError(OPTION, f"trial {source} {problem}")
    now, then = (_apart_from_limits(each) for each in (study, earlier.study))
    if other := sorted(key for key in {*now, *then} if now.get(key) != then.get(key)):
        problem = f"trial {source} differs in {', '.join(other)}; only {' and '.join(LIMITS)} may differ"
        raise ConfigError(OPTION, problem)
    limits, before = _limits(study), _limits(earlier.study)
    if limits == before or any(map(lt, limits, before)):
        raise ConfigError(OPTION, f"trial {source} needs larger limits here: raise {' or '.join(LIMITS)}")


def _limits(study: Study) -> tuple[float, float, float]:
    """The limits in iterations, experiments, and seconds on hardware."""
    budget = study.budget
    return study.method.max_iterations, budget.experiments or inf, budget.seconds or inf


def _apart_from_limits(study: Study) -> dict[str, Any]:
    """A trial's identity without its limits, by key."""
    fields = dict[str, Any]()
    for group, value in study.composition.identity_fields.items():
        parts = value if isinstance(value, Mapping) else {"": value}
        fields |= {f"{group}.{name}".rstrip("."): part for name, part in parts.items()}
    return {key: each for key, each in fields.items() if not key.startswith(LIMITS)}


def continued(trial: Mapping[str, Any]) -> str:
    """Which trial a trial continues, by its description, in a sentence; "" if none."""
    if CONTINUES not in trial:
        return ""
    origin = trial[CONTINUES]
    return f"It continues trial {origin['hash']}, which made {counted(origin['experiments'], 'experiment')}."
