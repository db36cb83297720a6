"""`python -m simbias preview`: a prediction of a trial's first experiment."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from simbias.config import ConfigError, compose
from simbias.config.build import build
from simbias.core import Policy, Waiting
from simbias.core.records import Array, Rollout
from simbias.lab.safety import Bounds, exceeded
from simbias.pictures.elements.style import save
from simbias.pictures.preview import predicted
from simbias.pictures.preview import preview as picture
from simbias.terminal.lines import say, standard_output
from simbias.terminal.notices import preparing
from simbias.testing.rehearsal import rehearse
from simbias.trial.prediction import DRAWS, Prediction, predict
from simbias.trial.study import Study

FILE = "preview.png"
# How simulated experiments end.
SUCCEEDED, FAILED = "succeed", "fail"
ABORTED, MISSED, DEAR = "are aborted by hardware.safety", "miss the goal", "cost more than Z_max"


def preview(overrides: Sequence[str], config_dir: str | None, allow: Sequence[str] = ()) -> None:
    """Search the first policy, simulate its experiment, describe it, and draw it into a file.

    Errors as for `simbias.load` and `rehearse`; also ConfigError if the picture cannot be written.
    """
    console = standard_output()
    with preparing():
        study = build(compose(overrides, config_dir, allow))
        rehearse(study)
    if Path(FILE).is_dir():
        raise ConfigError(FILE, "cannot be written (it is a folder)")
    say(console, "Searching for the trial's first policy; no experiment is run ...")
    prediction = first_prediction(study)
    bounds = study.conditions.safety.bounds(study.task)
    for line in describe(study, prediction, bounds):
        say(console, line)
    try:
        save(picture(study, prediction, bounds), FILE)
    except OSError as error:
        raise ConfigError(FILE, f"cannot be written ({error.strerror})") from error
    say(console, f"Look at it:  {FILE}")


def first_prediction(study: Study) -> Prediction:
    """Simulate the first experiment of a trial on the model used to search its policy."""
    asked: list[tuple[Policy, Array, Array, int]] = []

    def refuse(*experiment: Any) -> bool:
        asked.append(experiment)
        return False

    conditions = replace(study.conditions, confirm=True, ask=refuse)
    with suppress(Waiting):
        next(replace(study, conditions=conditions).run())
    policy, theta, start, _ = asked[0]
    return predict(replace(study, policy=policy), theta, start, nominal=study.first_model().nominal)


def describe(study: Study, prediction: Prediction, bounds: Bounds) -> Iterator[str]:
    """A prediction as a table: the range of each quantity, as expected and in the band."""
    task, expected = study.task, prediction.expected
    yield f"{'':>16}  {'start':>9}  {'predicted':>21}  {'band':>21}  {'limit':>9}"
    for quantity, own, low, high, limits in predicted(task, prediction, bounds):
        yield (
            f"{quantity.name:>16}  {_first(own):>9}  {_range(own, own):>21}  {_range(low, high):>21}"
            f"  {_limit(*limits):>9}  {quantity.unit}"
        )
    for quantity, change, limit in zip(
        task.inputs, prediction.largest_change(task.time_step), bounds.input_rates, strict=True
    ):
        limited = f" (limit {limit:.4g})" if np.isfinite(limit) else ""
        yield f"{quantity.name} changes by at most {change:.4g} {quantity.unit} per second{limited}."
    if not prediction.is_known:
        yield "There is no model, so the first experiment's states cannot be predicted."
        return
    if exceeded(expected, task, bounds):
        parts = (expected.part(max(frame - 1, 0), frame + 1) for frame in range(expected.frames))
        beyond_in = enumerate(exceeded(part, task, bounds) for part in parts)
        frame, beyond = next(each for each in beyond_in if each[1])
        yield f"Predicted: hardware.safety aborts it after {frame * task.time_step:.2f} s: {beyond}."
    else:
        end = f", then fails: {task.words(expected.failure)}" if expected.failure else ""
        cost = f"cost {expected.cost:.4g} (Z_max {study.cost.max_cost:g})"
        success = "a success" if study.passes(expected) else "no success"
        yield f"Predicted: {expected.frames * task.time_step:.2f} s{end}, {cost}: {success}."
    ends = [_end(study, draw, bounds) for draw in prediction.draws]
    failures = [draw.failure for draw, end in zip(prediction.draws, ends, strict=True) if end == FAILED]
    counts = Counter(task.words(failure or "failed") for failure in failures)
    failed = ", ".join(f"{words} ({count})" for words, count in counts.most_common())
    missed = "".join(f", {ends.count(end)} {end}" for end in (ABORTED, MISSED, DEAR) if end in ends)
    fail = f"{len(failures)} fail{failed and f': {failed}'}"
    yield f"Of {DRAWS} draws of {prediction.drawn}, {ends.count(SUCCEEDED)} succeed{missed}, {fail}."


def _end(study: Study, draw: Rollout, bounds: Bounds) -> str:
    """How a simulated experiment ends."""
    if exceeded(draw, study.task, bounds):  # checked before failure, as it ends the experiment
        return ABORTED
    if draw.failed_at is not None:
        return FAILED
    if study.passes(draw):
        return SUCCEEDED
    return DEAR if study.task.succeeds(draw.states) is None else MISSED


def _limit(lower: float, upper: float) -> str:
    """The limit of a magnitude or, if not symmetric, on each side; "" if there is none."""
    if lower == -upper:
        return f"{upper:.4g}" if np.isfinite(upper) else ""
    return f"{lower:.4g} to {upper:.4g}"


def _first(values: np.ndarray) -> str:
    """The first value of a quantity; "" if it has none."""
    return f"{values[0]:.4g}" if len(values) else ""


def _range(low: np.ndarray, high: np.ndarray) -> str:
    """The range of values, in words."""
    return f"{np.nanmin(low):.4g} .. {np.nanmax(high):.4g}" if len(low) else ""
