"""Summaries of trials and iterations: plain numbers and texts, as stored in files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import cache
from itertools import chain
from math import isfinite, nan
from typing import Any

from pydantic import TypeAdapter, ValidationError

from simbias.core.messages import counted
from simbias.core.records import Iteration, Learning
from simbias.trial import diagnostics
from simbias.trial.study import Study

COLUMNS = (  # columns of a table of iterations
    *("iteration", "predicted cost", "hardware cost", "experiments", "samples", "seconds", "what happened"),
)
NUMBERS = (  # numbers in every file
    *("experiments", "iterations", "max_experiments", "max_iterations"),
    *("ended", "seconds", "hardware_seconds"),
)
PARAMETERS = ("parameter", "declared", "identified", "5%", "95%", "unit")  # columns of a table of parameters
IDENTIFIED = "The quantiles assume a complete model: effects that it lacks may shift parameters further."


class Outcome(StrEnum):
    """How a trial ended, or why it stopped; `verdict` is the beginning of a sentence about it."""

    SUCCEEDED = "succeeded"
    NOT_SUCCEEDED = "not succeeded"
    WAITING = "waiting"  # for the result of an experiment; the same command resumes
    INTERRUPTED = "interrupted"  # the same command resumes
    RUNNING = "running"  # a trial that is read while a process runs it; never stored
    ERROR = "error"  # the same command resumes, once the cause is mended

    @property
    def verdict(self) -> str:
        """The outcome as the beginning of a sentence about the trial."""
        words = {Outcome.NOT_SUCCEEDED: "Did not succeed", Outcome.ERROR: "Stopped by an error"}
        return words.get(self, self.value.capitalize())

    @property
    def final(self) -> bool:
        """Whether the trial has ended, and would end the same way if repeated."""
        return self in (Outcome.SUCCEEDED, Outcome.NOT_SUCCEEDED)


@dataclass(frozen=True)
class TrialSummary:
    """A trial in numbers, up to its end or to where it stopped; missing numbers are nan."""

    outcome: Outcome
    reason: str = ""  #: for an error, its type and message; else a sentence
    traceback_file: str = ""
    experiments: int = 0  #: on hardware, so far
    iterations: int = 0  #: finished so far
    max_experiments: int = 0  #: that method and budget allow; once its seconds are spent, those made
    max_iterations: int = 0
    ended: float = nan  #: or stopped, s since the epoch; nan if it is running, or was killed
    seconds: float = 0.0  #: wall time of all processes that ran it; of a killed one, that of its iterations
    hardware_seconds: float = 0.0  #: duration of the experiments
    test_episodes: str = ""  #: of the last policy: 1 for each that counts as a success, 0 for each other
    lasting_episodes: str = ""  #: of the last policy: 1 for each that lasts to its own end
    holding_episodes: str = ""  #: of the last policy: 1 for each that lasts as long as an experiment
    success_rate: float = nan  #: share of test episodes
    long_success_rate: float = nan  #: share of the long test episodes
    long_seconds: float = nan  #: mean duration of the long test episodes
    uptime: float = nan  #: mean over the test episodes, without long ones if there are others
    policy: str = ""  #: a digest of the last policy's parameters
    test_words: str = ""  #: the test in one sentence
    claim: str = ""  #: by its experiments, about the last policy: holds 90% of starts (80% to 96%)
    claimed_share: float = nan  #: lower bound on the share of starts
    platforms: tuple[str, ...] = ()  #: two if it was resumed elsewhere
    processor: str = ""  #: model of the last platform's processor
    diagnostics: tuple[str, ...] = ()  #: oddities of the trial

    @property
    def stopped_by(self) -> str:
        """The reason why it has not ended; "" if it has."""
        return "" if self.outcome.final else self.reason

    @property
    def effort(self) -> str:
        """Experiments made, with iterations and time in brackets."""
        made = counted(self.experiments, "hardware experiment")
        return f"{made} ({counted(self.iterations, 'iteration')}, {self.seconds:.0f} s)"

    @property
    def findings(self) -> list[str]:
        """The claim of its last policy and the result of its test: a sentence each."""
        claim = f"By its own experiments, its last policy {self.claim}."
        return [claim] * bool(self.claim) + [self.test_words] * bool(self.test_words)

    @property
    def experiments_until_success(self) -> float:
        """Experiments until success; without success `max_experiments`; nan if the trial has not ended."""
        return self._until_success(self.experiments, self.max_experiments)

    @property
    def iterations_until_success(self) -> float:
        """Iterations until success; without success the method's maximum; nan if the trial has not ended."""
        return self._until_success(self.iterations, self.max_iterations)

    def _until_success(self, count: int, most: int) -> float:
        """A count until success, censored at `most` without success."""
        if not self.outcome.final:
            return nan
        return float(count if self.outcome is Outcome.SUCCEEDED else max(count, most))

    def metrics(self) -> dict[str, float]:
        """The numbers by name, `group/name`, without missing ones."""
        numbers = {
            "trial/experiments": self.experiments_until_success,
            "trial/experiments_made": float(self.experiments) if self.outcome.final else nan,
            "trial/iterations": self.iterations_until_success,
            "trial/seconds": self.seconds,
            "trial/hardware_seconds": self.hardware_seconds,
            "test/success_rate": self.success_rate,
            "test/long_success_rate": self.long_success_rate,
            "test/long_seconds": self.long_seconds,
            "test/uptime": self.uptime,
        }
        return {name: value for name, value in numbers.items() if isfinite(value)}

    def as_json(self) -> dict[str, Any]:
        """A mapping of JSON's types, which `from_json` reads back."""
        values = {k: None if v != v else v for k, v in asdict(self).items()}  # JSON has no NaN
        return {**values, "platforms": list(self.platforms), "diagnostics": list(self.diagnostics)}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> TrialSummary:
        """The summary, as `as_json` wrote it; a ValueError names a number that is missing, or a bad value."""
        if lacking := [name for name in NUMBERS if name not in values]:
            raise ValueError(f"lacks {', '.join(lacking)}")
        known = {name: nan if value is None else value for name, value in values.items()}
        try:
            return _adapter().validate_python(known)
        except ValidationError as error:
            first = error.errors()[0]
            raise ValueError(f"{first['loc'][0]}: {first['msg']}") from None


@cache
def _adapter() -> TypeAdapter[TrialSummary]:
    """The validator of summaries; constructing it takes longer than reading hundreds of them."""
    return TypeAdapter(TrialSummary)


def iteration_summary(study: Study, iteration: Iteration, earlier: Sequence[Iteration]) -> dict[str, Any]:
    """An iteration after earlier ones, in JSON's types: policy, costs, learning, events."""
    search, gains = iteration.search, getattr(study.policy, "gains", None)
    summary: dict[str, Any] = {
        "iteration": iteration.index,
        "parameters": iteration.parameters.tolist(),
        **({"gains": gains(iteration.parameters).tolist()} if callable(gains) else {}),
        "hardware_cost": iteration.hardware_cost,
        "succeeded": iteration.succeeded,
        "total_experiments": iteration.total_experiments,
        "samples": len(iteration.learning.data) if iteration.learning else 0,
        "events": list(_events(study, iteration, earlier)),
        "seconds": dict(iteration.seconds),
        "metrics": metrics(iteration),
    }
    uptimes = [study.task.uptime(rollout.states) for rollout in iteration.experiments]
    if isfinite(worst := min(uptimes, default=nan)):
        summary["metrics"]["experiments/uptime_min"] = worst
    if search is not None:
        summary |= {"predicted_cost": search.predicted_cost, "stopped_by": search.optimum.stopped_by}
    if iteration.model is not None and (estimates := iteration.model.nominal.estimates):
        summary["estimates"] = [estimate._asdict() for estimate in estimates]
    return summary


def _events(study: Study, iteration: Iteration, earlier: Sequence[Iteration]) -> Iterator[str]:
    """The events of an iteration in words: why experiments do not succeed, and everything odd."""
    yield from diagnostics.of_experiments(iteration.experiments, study)
    said = {remark.kind for remark in diagnostics.of_trial(earlier, study)}
    said |= {"model cleared" for each in earlier if each.learning and each.learning.reset}
    resets = diagnostics.of_reset(iteration, study.cost.max_cost)
    for remark in chain(resets, diagnostics.of_iteration(iteration, earlier, study)):  # once in full
        yield remark.kind if remark.kind in said else remark.words


def cells(iteration: Mapping[str, Any]) -> list[str]:
    """An iteration's summary as texts, below the names of `COLUMNS`."""
    predicted = iteration.get("predicted_cost")
    return [
        str(iteration["iteration"]),
        "" if predicted is None else f"{predicted:.4g}",
        f"{iteration['hardware_cost']:.4g}",
        str(iteration["total_experiments"]),
        str(iteration["samples"]),
        f"{sum(iteration['seconds'].values()):.1f}",
        "; ".join(["succeeded"] * iteration["succeeded"] + list(iteration["events"])),
    ]


def parameters(iterations: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Identified parameters of the last policy's model, as texts, below the names of `PARAMETERS`."""
    identified = iterations[-1].get("estimates", []) if iterations else []
    keys = "declared", "value", "low", "high"
    return [[each["name"], *(f"{each[key]:.4g}" for key in keys), each["unit"]] for each in identified]


def metrics(iteration: Iteration) -> dict[str, float]:
    """An iteration in numbers, `group/name`; costs as in Eq. 8, seconds of wall time."""
    experiments = iteration.experiments
    numbers = {
        "cost/hardware_max": iteration.hardware_cost,
        **{f"cost/hardware_{i}": rollout.cost for i, rollout in enumerate(experiments)},
        "experiments/total": iteration.total_experiments,
        "experiments/iterations": iteration.index + 1,
        "experiments/failed": sum(rollout.failed_at is not None for rollout in experiments),
        "experiments/frames_min": min((rollout.frames for rollout in experiments), default=0),
        "experiments/succeeded": iteration.succeeded,
    }
    if (search := iteration.search) is not None:
        numbers |= {"cost/predicted": search.predicted_cost, "search/evaluations": search.optimum.evaluations}
    if (model := iteration.model) is not None:
        numbers |= {f"bias/{name}": value for name, value in model.bias.diagnostics.items()}
        numbers |= {f"identification/{name}": value for name, value in model.nominal.diagnostics.items()}
    if iteration.learning is not None:
        numbers |= _learning_metrics(iteration.learning)
    numbers |= {f"seconds/{phase}": seconds for phase, seconds in iteration.seconds.items()}
    return {name: float(value) for name, value in numbers.items()}


def _learning_metrics(learning: Learning) -> dict[str, float]:
    """The training data in numbers, and the likelihood of each model variant."""
    selection = learning.selection
    return {
        "model/reset": learning.reset,
        "data/samples": len(learning.data),
        "data/new": len(selection.transitions),
        "data/frames": selection.frames,
        "data/sampled": selection.sampled,
        **{f"data/rejected_{criterion}": count for criterion, count in selection.rejected.items()},
        **{f"model_selection/{name}": value for name, value in learning.log_likelihoods.items()},
    }
