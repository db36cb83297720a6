"""A trial that continues an ended one with more experiments to spend.

Limits on experiments are part of a trial's identity, so the continued trial is another one. Up to the end of
the earlier trial its steps are the same: those that count are copied, and replayed.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from simbias.core.errors import ConfigError
from simbias.core.messages import counted
from simbias.trial.disk import PART, append_line, write_json
from simbias.trial.folder import ATTEMPTS, CONTINUES, EPISODE, TRIAL, Origin, TrialFolder, kind_of, step_name
from simbias.trial.origin import description
from simbias.trial.run import TrialRecord
from simbias.trial.study import Study
from simbias.trial.summary import Outcome, TrialSummary

OPTION = "--continue"
LIMITS = "budget", "method.max_iterations"  # in which the trials may differ
OWN = "hash", "title", "seed", "choices", "config"  # keys of trial.json; the others are about its first steps


def continue_trial(study: Study, folder: Path, source: Path, read: Callable[[Path], TrialRecord]) -> None:
    """Begin a study's trial in its folder with the steps of an ended trial in the folder `source`.

    Withdrawn experiments and the test of the last policy are not copied. A trial that was begun in this way
    stays as it is, whatever has become of the source; `read` is called to read the source if it was not.

    ConfigError if the earlier trial cannot be read, has not ended or has succeeded; if the trials differ in
    more than their limits; if no experiment is left to spend; or if the folder's trial began otherwise.
    """
    if (folder / TRIAL).exists():
        if TrialFolder(folder).continues is None:
            _check(study, read(source), source)  # whose error, such as for a typo, comes first
            began = f"is a trial that began without the steps of {source}"
            raise ConfigError(str(folder), f"{began}. Move it away, or leave out {OPTION}")
        return
    earlier, old = read(source), TrialFolder(source)
    _check(study, earlier, source)
    summary = earlier.summary
    origin = Origin(earlier.study.hash, summary.experiments, summary.seconds, old.platforms())
    steps = [step for step in old.steps() if kind_of(step) != EPISODE]
    part = folder.with_name(f".{folder.name}{PART}")
    shutil.rmtree(part, ignore_errors=True)  # left by a killed process
    part.mkdir(parents=True)
    for number, step in enumerate(steps):
        shutil.copy2(step, part / step_name(number, kind_of(step)))
    append_line(part / ATTEMPTS, {CONTINUES: origin._asdict()})
    now = description(study)
    write_json(part / TRIAL, {**old.description(), **{key: now[key] for key in OWN}})
    part.rename(folder)


def _check(study: Study, earlier: TrialRecord, source: Path) -> None:
    """Raise a ConfigError unless the study's trial begins as the earlier one did, and makes more of it."""
    if earlier.outcome is not Outcome.NOT_SUCCEEDED:
        own = "has not ended; its own command resumes it"
        problem = "has succeeded" if earlier.outcome is Outcome.SUCCEEDED else own
        raise ConfigError(OPTION, f"trial {source} {problem}")
    now, then = (_apart_from_limits(each) for each in (study, earlier.study))
    if other := sorted(key for key in {*now, *then} if now.get(key) != then.get(key)):
        problem = f"trial {source} differs in {', '.join(other)}; only {' and '.join(LIMITS)} may differ"
        raise ConfigError(OPTION, problem)
    if spent := [*_spent(study, earlier.summary)]:
        iterations, experiments = earlier.summary.iterations, earlier.summary.experiments
        made = f"{counted(iterations, 'iteration')} and {counted(experiments, 'experiment')}"
        seconds = f"{earlier.summary.hardware_seconds:g} s on hardware"
        raise ConfigError(OPTION, f"trial {source} has made {made}, {seconds}; raise {' and '.join(spent)}")


def _spent(study: Study, summary: TrialSummary) -> Iterator[str]:
    """The keys of limits that allow no more than an earlier trial has made."""
    if summary.iterations >= study.method.max_iterations:
        yield "method.max_iterations"
    yield from (
        f"budget.{limit}" for limit in study.budget.spent(summary.experiments, summary.hardware_seconds)
    )


def _apart_from_limits(study: Study) -> dict[str, Any]:
    """A trial's identity without its limits, by key."""
    fields = dict[str, Any]()
    for group, value in study.composition.identity_fields.items():
        parts = value if isinstance(value, Mapping) else {"": value}
        fields |= {f"{group}.{name}".rstrip("."): part for name, part in parts.items()}
    return {key: each for key, each in fields.items() if not key.startswith(LIMITS)}


def continued(folder: TrialFolder) -> list[str]:
    """Which trial a folder's trial continues, in a sentence; empty if none."""
    if (origin := folder.continues) is None:
        return []
    return [f"It continues trial {origin.hash}, which made {counted(origin.experiments, 'experiment')}."]
