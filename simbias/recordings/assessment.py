"""Identify a model from recordings and judge it on held-out data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from threadpoolctl import threadpool_limits

from simbias.core import Nominal, Task
from simbias.core.errors import ConfigError
from simbias.core.records import Array, Rollout
from simbias.learning.identification.directions import Direction, undetermined
from simbias.learning.identification.identified import Identified, Known
from simbias.recordings.copies import Digest, digests
from simbias.recordings.findings import Finding, findings
from simbias.recordings.fitting import Fitting
from simbias.recordings.horizons import HorizonErrors, overall, predictions
from simbias.recordings.mistakes import Mistake, mistakes
from simbias.recordings.parts import Part, others, parts
from simbias.recordings.reach import Reach, beyond
from simbias.trial.study import Study

UNEXPLAINED = 2.0  # times the errors explained by noise and uncertainty: beyond, the model is incomplete


@dataclass(frozen=True, eq=False, repr=False)
class Assessment:
    """A model identified from recordings, and what is known of it."""

    study: Study  #: `prepared`; components that recordings do not need, such as its cost, may be None
    recordings: Sequence[str]  #: those not held out
    identified: Identified  #: from all these recordings
    parts: Sequence[Part]  #: parts of them, each predicted by a model of the others
    held_out: Part | None  #: recordings that were only predicted
    models: Sequence[Identified]  #: for each of `judged`, a model that was not fitted to it
    findings: Sequence[Finding]  #: one for each parameter
    own_findings: Mapping[str, Sequence[Finding]]  #: of parameters specific to each recording, by its name
    predictions: Sequence[HorizonErrors]  #: of `judged`, by horizon and state
    mistakes: Sequence[Mistake]  #: of signs and columns
    by_window: Mapping[float, float]  #: window in s -> deviations relative to those of `identified`
    steps_checked: bool  #: whether the effect of shorter integration steps on parameters is known
    learned: Sequence[Digest]  #: of all recordings that `identified` has learned, also earlier

    def __repr__(self) -> str:
        """The assessment in a line, e.g. in a notebook."""
        trusted = f"{sum(each.trusted for each in self.findings)} of {len(self.findings)} parameters trusted"
        return f"<assessment: {self.ratio:.2f} of the nominal model's error, {trusted}>"

    @property
    def task(self) -> Task:
        """The task of the robot."""
        return self.study.task

    @property
    def nominal(self) -> Nominal:
        """The nominal model as declared."""
        return self.study.nominal

    @property
    def judged(self) -> list[Part]:
        """The predicted parts, which are the held-out recordings or, without any, each part."""
        return [self.held_out] if self.held_out else list(self.parts)

    @property
    def ratio(self) -> float:
        """Prediction error on held-out data, relative to the nominal model's."""
        return overall(self.predictions)

    @cached_property
    def ratios(self) -> dict[str, float]:
        """Prediction error relative to the nominal model's, by the name of each part."""
        return {part.name: overall(self.predictions, i) for i, part in enumerate(self.judged)}

    @cached_property
    def reaches(self) -> dict[str, list[Reach]]:
        """How far each part, by name, extends beyond its model's training data."""
        everything = [rollout for part in self.parts for rollout in part.rollouts]
        return {
            part.name: beyond(
                self.task,
                part.rollouts,
                everything if self.held_out else others(self.parts, i).rollouts,
            )
            for i, part in enumerate(self.judged)
        }

    @property
    def better(self) -> bool:
        """Whether the model predicts held-out data better than the nominal one, to two digits."""
        return round(self.ratio, 2) < 1.0

    @property
    def trusted(self) -> bool:
        """Whether any parameter is trusted."""
        return any(finding.trusted for finding in self.findings)

    @property
    def sound(self) -> bool:
        """Whether a trial may begin with the model: it is better, partly trusted, and has right signs."""
        return self.better and self.trusted and not self.mistakes

    @property
    def failing(self) -> float:
        """The share of recorded states that violate the task's failure criteria."""
        states = [rollout.states for part in self.parts for rollout in part.rollouts]
        return float(np.mean(self.task.violated(np.concatenate(states)) >= 0))

    @property
    def unexplained(self) -> tuple[float, float] | None:
        """The largest ratio of errors to those explained by noise and model uncertainty, with its horizon.

        Parameters specific to a recording have the values fitted to it, as no other recording tells them.
        None if all errors are explained; otherwise the model is incomplete.
        """
        each = ((one.unexplained(), one.seconds) for one in self.predictions)
        return max((found for found in each if found[0] > UNEXPLAINED), default=None)  # nan is ignored

    def doubted(self, doubt: str = "") -> Assessment:
        """A copy in which doubts about the model or its recordings apply to each parameter."""
        lacks = "the model lacks something" if self.unexplained is not None else ""
        doubts = doubt, lacks if self.better else "the model is no better than the nominal one"
        more = tuple(filter(None, doubts))

        def also(found: Sequence[Finding]) -> list[Finding]:
            return [replace(each, lasting=(*each.lasting, *more)) for each in found]

        own = {name: also(each) for name, each in self.own_findings.items()}
        return replace(self, findings=also(self.findings), own_findings=own)

    @property
    def undetermined(self) -> list[Direction]:
        """Combinations of parameters that the data do not determine."""
        return undetermined(self.identified)


@threadpool_limits.wrap(limits=1, user_api="blas")  # for small matrices, threads cost more than they save
def assess(
    study: Study,
    recordings: Mapping[str, Sequence[Rollout]],
    held_out: Mapping[str, Sequence[Rollout]] | None = None,
    progress: Callable[[str], None] = lambda words: None,
    doubt: str = "",
) -> Assessment:
    """Identify the nominal model of a study, which is `prepared`, from recordings, and judge it.

    Recordings are given by name, each as its pieces. Without held-out ones, each recording (or each third of
    a single one) is predicted by a model of all others. A doubt about the recordings applies to each
    parameter; doubts of an earlier posterior, with which the study begins, stay.

    Raises
    ------
    ConfigError
        If there are no recordings, or they are too short.
    """
    if not recordings:
        raise ConfigError("identify", "needs recordings neither held out nor learned: files or folders")
    task, nominal, fitting = study.task, study.nominal, Fitting(study, progress)
    everything, all_parts = Part("all recordings", recordings), parts(recordings)
    kept = Part("held-out recordings", held_out) if held_out else None
    judged = [kept] if kept else all_parts
    fitting.check_length([*all_parts, *filter(None, [kept])])

    identified = fitting.of(everything, everything.name)
    shorter = fitting.moved_by_shorter_steps(identified, everything)
    alone = [fitting.of(part, f"{part.name} alone") for part in all_parts]
    by_window = fitting.by_window(everything)
    of_one = not kept and len(recordings) == 1
    if kept:
        models, learned = [identified.elsewhere()], fitting.unseen(alone, all_parts)
    else:
        models, learned = fitting.of_others(alone, all_parts, of_one), []
    own = [] if of_one else [*fitting.with_own(models, judged)]
    found = findings(
        identified,
        alone,
        [*by_window.values()],
        0.0 if shorter is None else shorter.max(axis=0),
        fitting.apart(everything),
    )
    assessment = Assessment(
        study,
        list(recordings),
        identified,
        all_parts,
        kept,
        models,
        _with_earlier(found, fitting.known),
        own_findings(list(recordings), identified, [*by_window.values()], shorter),
        predictions(task, nominal, models, [part.rollouts for part in judged], learned, own),
        mistakes(task, [nominal, identified], _named_apart(recordings, held_out or {})),
        {w: each.mean_deviation / identified.mean_deviation for w, each in by_window.items()},
        shorter is not None,
        _learned(fitting.known, recordings, task.time_step),
    )
    return assessment.doubted(doubt)


def _named_apart(
    recordings: Mapping[str, Sequence[Rollout]], held_out: Mapping[str, Sequence[Rollout]]
) -> dict[str, Sequence[Rollout]]:
    """All recordings; a held-out one that has another's name is told by it."""
    return {**recordings, **{n + ", held out" * (n in recordings): each for n, each in held_out.items()}}


def _with_earlier(found: Sequence[Finding], known: Known | None) -> Sequence[Finding]:
    """Findings with the doubts of an earlier posterior, if it has any."""
    if not known or not known.doubts:
        return found
    return [replace(each, earlier=tuple(d)) for each, d in zip(found, known.doubts, strict=True)]


def _learned(
    known: Known | None, recordings: Mapping[str, Sequence[Rollout]], time_step: float
) -> list[Digest]:
    """Digests of what an earlier posterior has learned, and of these recordings."""
    before = map(Digest.of, (known and known.learned) or ())
    return [*before, *(each for pieces in recordings.values() for each in digests(pieces, time_step))]


def own_findings(
    recordings: Sequence[str],
    identified: Identified,
    by_window: Sequence[Identified],
    shorter: Array | None,
) -> dict[str, list[Finding]]:
    """Findings about parameters specific to a recording, such as zeros or a payload, by recording."""
    found = {}
    for i, name in enumerate(recordings):
        shifts = 0.0 if shorter is None else shorter[i % len(shorter)]
        fits = [each.of_recording(i) for each in (identified, *by_window)]
        of_all = findings(fits[0], [], fits[1:], shifts)
        found[name] = [each for each in of_all if each.prior.of_recording]
    return found
