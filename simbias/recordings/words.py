"""An assessment in words and tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from operator import itemgetter

import numpy as np

from simbias.lab.recording import ESTIMATED
from simbias.recordings.assessment import Assessment
from simbias.recordings.excitation import Excitation
from simbias.recordings.findings import BEYOND_PRIOR, FAR, STEP_DOUBT
from simbias.recordings.horizons import by_state
from simbias.recordings.parts import Part

PARAMETER_NAMES = (
    "parameter",
    "unit",
    "declared",
    "prior 5% .. 95%",
    "identified",
    "5% .. 95%",
    "learned",
    "trust",
)
ERROR_NAMES = ("horizon (s)", "predictions", "over nominal", "90% region holds")
MEAN = "in the geometric mean over states and horizons"
NARROWER = 0.8  # ratio of deviations below which another window length is worth trying
FAR_LARGER = 10.0  # times the explained errors: rare even without a spring or friction in the model
OFTEN = 0.1  # share of states beyond failure criteria; recordings of failures end there
WORTH = 0.1  # share by which an experiment must narrow a parameter for it to be named
REMEDY = "measure what you can in other ways (masses by weighing or with another load), and declare it"
WIDER = "Enlarge their priors (nominal.uncertainty; identification.motors and sensors), and identify again"
ROUNDS = "Raise identification.rounds"
STILL_MOVES = 0.1  # standard deviations by the last round
SHORTER = 'take a smaller nominal.sub_step; in an MJCF, a smaller timestep or integrator="RK4"'
TRUST = (
    "Trust is for motions like those recorded. To test it, hold out a faster or stronger one (--held-out)."
)


def verdict(assessment: Assessment) -> str:
    """How well the model predicts held-out data, in a sentence."""
    ratios = assessment.ratios
    apart = f" ({min(ratios.values()):.2f} to {max(ratios.values()):.2f} in single parts)"
    each = apart if len(ratios) > 1 else ""
    what = "held-out recordings" if assessment.held_out else "parts that it was not fitted to"
    wrong = _mistakes(assessment) + _units(assessment)
    if assessment.better:
        none = "" if assessment.trusted else " No parameter is trusted."
        worse = [f"after {one.seconds:g} s" for one in assessment.predictions if one.ratio() > 1.0]
        states = zip(assessment.task.states, by_state(assessment.predictions), strict=True)
        worse += [f"in {state.name}" for state, ratio in states if ratio > 1.0]
        ahead = f" They are larger {', '.join(worse)}." if worse else ""
        return (
            f"On {what}, the identified model's errors are {assessment.ratio:.2f} times those of "
            f"the nominal one{each}, {MEAN}.{ahead}{none}{_lacking(assessment)}{wrong}"
        )
    return (
        f"The identified model is no better than the nominal one on {what}: its errors are "
        f"{assessment.ratio:.2f} times as large{each}, {MEAN}. Do not use it.{wrong}"
    )


def sources(assessment: Assessment) -> str:
    """The recordings that were fitted and held out, with their durations."""

    def durations(parts: Iterable[Part]) -> str:
        frames = Counter[str]()
        for part in parts:
            for name, pieces in part.pieces.items():
                frames[name] += sum(piece.frames for piece in pieces)
        step = assessment.task.time_step
        return ", ".join(f"{name} ({step * count:.3g} s)" for name, count in frames.items())

    held = f" Held out: {durations([assessment.held_out])}." if assessment.held_out else ""
    return f"Identified from {durations(assessment.parts)}.{held}"


def beginning(assessment: Assessment) -> str:
    """The words before the overrides of a trial with a model that is better than the nominal one."""
    if assessment.mistakes:
        return "Before a trial, correct the recordings and identify again; to start one anyway:"
    if not assessment.trusted:
        return "Before a trial, remove the doubts, as no parameter is trusted; to start one anyway:"
    return "Start a trial with it:"


def _lacking(assessment: Assessment) -> str:
    """A sentence if errors are larger than noise and the model's uncertainty explain; else ""."""
    if (found := assessment.unexplained) is None:
        return ""
    times, seconds = found
    cause = ", or its integration steps are too long" if _stepped(assessment) else ""
    if any(doubt.startswith(ESTIMATED) for doubt in assessment.findings[0].doubts):
        cause += f", or {ESTIMATED} too roughly"
    (worst,) = (each.least_explained() for each in assessment.predictions if each.seconds == seconds)
    return (
        f" Errors after {seconds:g} s are {times:.1f} times what measurement noise and intervals explain, "
        f"above all those of {assessment.task.states[worst].name}: the model lacks something{cause}. Its "
        "values are those that predict best; they may not be the robot's."
    )


def _stepped(assessment: Assessment) -> list[str]:
    """The parameters that shorter integration steps would move."""
    return [each.estimate.name for each in assessment.findings if STEP_DOUBT in each.doubts]


def _mistakes(assessment: Assessment) -> str:
    """A sentence for each likely mistake in signs or columns; else ""."""
    said = ""
    for words, times, recordings in assessment.mistakes:
        where = f" (in {', '.join(recordings)} alone)" if recordings else ""
        also = ", too," if said else ","
        said += f" With {words}{where}{also} the nominal model's errors are {times:.2g} times as large"
        said += ": check the recording's signs, columns and units."
    return said


def _units(assessment: Assessment) -> str:
    """A sentence if errors are far larger than explained and states exceed what the task allows; else ""."""
    times, _ = assessment.unexplained or (0.0, 0.0)
    if times < FAR_LARGER or (share := assessment.failing) < OFTEN:
        return ""
    return f" {share:.0%} of the recorded states are beyond the task's failure criteria: is a unit wrong?"


def parameter_rows(assessment: Assessment) -> Iterator[Sequence[str]]:
    """A row for each parameter; its last cell states whether it may be trusted."""
    for finding in assessment.findings:
        estimate, (low, high) = finding.estimate, finding.prior_interval
        yield (
            estimate.name,
            estimate.unit,
            f"{estimate.declared:.4g}",
            f"{low:.4g} .. {high:.4g}",
            f"{estimate.value:.4g}",
            f"{estimate.low:.4g} .. {estimate.high:.4g}",
            f"{100 * finding.shrinkage:.0f}%",
            "; ".join(finding.doubts) or "yes",
        )


def own_lines(assessment: Assessment) -> Iterator[str]:
    """A line for each recording with specific parameters, such as zeros or a payload."""
    for name, found in assessment.own_findings.items():
        texts = []
        for e, doubts in ((each.estimate, each.doubts) for each in found):
            doubted = f" (doubted: {'; '.join(doubts)})" if doubts else ""
            texts.append(f"{e.name} {e.value:.4g} ({e.low:.4g} .. {e.high:.4g}) {e.unit}{doubted}")
        if texts:
            yield f"{name}: {', '.join(texts)}"


def error_names(assessment: Assessment) -> list[str]:
    """Names of the columns of errors."""
    return [*ERROR_NAMES, *(f"{state.name} ({state.unit})" for state in assessment.task.states)]


def error_rows(assessment: Assessment) -> Iterator[Sequence[str]]:
    """A row for each horizon: ratio, coverage, and the errors of both models for each state."""
    for prediction in assessment.predictions:
        nominal, identified = prediction.rmse()
        coverage = prediction.coverage()
        yield (
            f"{prediction.seconds:g}",
            str(prediction.windows),
            f"{prediction.ratio():.2f}",
            "too few" if np.isnan(coverage) else f"{100 * coverage:.0f}%",
            *(f"{after:.3g} of {before:.3g}" for before, after in zip(nominal, identified, strict=True)),
        )


def about_errors(assessment: Assessment) -> str:
    """How to read the rows of errors."""
    said = (
        "Under states, a of b: root mean square errors of the identified model (a) and the nominal one (b)."
    )
    own = [each.prior.name for each in assessment.findings if each.prior.of_recording]
    if own and (assessment.held_out or len(assessment.recordings) > 1):
        said += f" Each recording has its own {', '.join(own)}; here, the prior's median is used."
    return said


def undetermined_lines(assessment: Assessment) -> Iterator[str]:
    """A line for each direction that the data do not determine."""
    for direction in assessment.undetermined:
        share = direction.deviation
        wider = ": wider than its prior" if share > BEYOND_PRIOR else ""
        yield f"{direction} (keeps {100 * share:.0f}% of the prior's deviation{wider})"


def reach_lines(assessment: Assessment) -> Iterator[str]:
    """A line for each part that extends beyond its model's training data."""
    for name, reaches in assessment.reaches.items():
        texts = [
            f"{each.name} goes from {each.range[0]:.3g} to {each.range[1]:.3g} {each.unit}, but the model "
            f"was fitted to data from {each.learned[0]:.3g} to {each.learned[1]:.3g} "
            f"({100 * each.share:.0f}% of the frames are outside)"
            for each in reaches
        ]
        if texts:
            yield f"In {name}, {'; '.join(texts)}. Do not rely on the 90% regions there."


def advice(assessment: Assessment, excitation: Excitation | str) -> Iterator[str]:
    """Sentences about priors, convergence, integration steps, windows, and the next trajectory."""
    if far := [each.prior.name for each in assessment.findings if FAR in each.doubts]:
        yield f"Far from what is declared, so priors may distort all estimates: {', '.join(far)}. {WIDER}."
    if (moved := assessment.identified.diagnostics.get("moved", 0.0)) > STILL_MOVES:
        yield f"Estimates have not converged: the last round moved them by {moved:.2g} deviations. {ROUNDS}."
    if stepped := _stepped(assessment):
        yield f"Shorter steps of integration would move {', '.join(stepped)}: {SHORTER}."
    if not assessment.steps_checked:
        yield "Whether shorter steps of integration would move parameters could not be checked."
    wrong = assessment.mistakes or assessment.unexplained is not None
    window, share = min(assessment.by_window.items(), key=itemgetter(1))
    if wrong:
        yield "Correct the recordings or the model before you record more."
    elif share < NARROWER:
        narrower = f"With windows of {window:g} s, deviations are {share:.0%} of these on average"
        yield f"{narrower}: try identification.window={window:g}."
    if isinstance(excitation, str):
        yield f"No trajectory is proposed ({excitation})."
    elif not wrong:
        yield from _narrowing(assessment, excitation)


def _narrowing(assessment: Assessment, excitation: Excitation) -> Iterator[str]:
    """Sentences on what the next trajectory should determine, and what not."""
    before = np.sqrt(np.diag(assessment.identified.covariance))
    names = [finding.estimate.name for finding in assessment.findings]
    gained = 1.0 - excitation.deviations / before
    own = np.array([finding.prior.of_recording for finding in assessment.findings], bool)
    gained[own] = 0.0  # not useful for other recordings
    worth = gained > WORTH
    texts = [f"{names[i]} (by about {100 * gained[i]:.0f}%)" for i in np.argsort(-gained) if worth[i]]
    seconds = excitation.rollout.frames * assessment.task.time_step
    if texts:
        yield f"{seconds:g} s of the inputs in excitation.csv should narrow {', '.join(texts)}."
    else:
        least = f"{100 * WORTH:.0f}%"
        yield f"Another {seconds:g} s within the limits should narrow every parameter by less than {least}."
    far = np.array([FAR in finding.doubts for finding in assessment.findings], bool)
    left = [names[i] for i in np.flatnonzero(~own & ~far & ~worth & (excitation.deviations > 0.5))]
    if left:
        yield f"No input should determine {', '.join(left)}: {REMEDY}."
