"""What `identify` says of robots whose parameters are known, and what it leaves behind."""

import re
from collections.abc import Iterable
from copy import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pandas as pd
import pytest
import yaml
from errors import one_line
from mechanisms import cart_pole, mjcf
from pendulum import NOISE, QUICK, experiment, pendulum, truth
from rich.console import Console

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError
from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified, Known
from simbias.learning.identification.posterior import Posterior
from simbias.learning.identification.rig import Rig, Sensor
from simbias.recordings import plots
from simbias.recordings.assessment import Assessment, assess, own_findings
from simbias.recordings.copies import copied, digests
from simbias.recordings.excitation import Excitation
from simbias.recordings.files import (
    check_replaces_nothing,
    draws,
    head,
    models,
    of_recordings,
    option_lines,
    parameters,
    write,
)
from simbias.recordings.findings import FAR, STEP_DOUBT, findings
from simbias.recordings.horizons import (
    CHANGE,
    HorizonErrors,
    ModelErrors,
    inside,
    predictions,
    regions,
    sizes,
)
from simbias.recordings.mistakes import Mistake, changes, mistakes
from simbias.recordings.parts import parts
from simbias.recordings.reach import beyond
from simbias.recordings.reading import SAME, UNKNOWN, columns, read, read_apart
from simbias.recordings.report import report
from simbias.recordings.study import prepared
from simbias.recordings.words import (
    about_errors,
    advice,
    beginning,
    error_names,
    own_lines,
    parameter_rows,
    undetermined_lines,
    verdict,
)
from simbias.robots.mujoco.model import Mujoco
from simbias.robots.mujoco.parameters import values_of
from simbias.robots.none import NoNominal
from simbias.terminal.identify import Request
from simbias.testing.rehearsal import rehearse
from simbias.trial.study import Study

Robot = tuple[dict[str, float], dict[str, Rollout]]  # its parameters, and recordings of it
QUICKER = ["identification.starts=2", "identification.rounds=1", "identification.evaluations=4"]


@pytest.fixture(scope="module")
def study() -> Study:
    return prepared(pendulum(*QUICK))


@pytest.fixture(scope="module")
def robot(study: Study) -> Robot:
    """A robot's parameters, and two recordings of it."""
    rng = np.random.default_rng(4)
    model, values = truth(study.nominal, rng)
    names = [parameter.name for parameter in study.nominal.parameters]
    return dict(zip(names, values.tolist(), strict=True)), {
        name: experiment(model, rng) for name in ("one", "<script>two")
    }


@pytest.fixture(scope="module")
def assessment(study: Study, robot: Robot) -> Assessment:
    return assess(study, {name: (rollout,) for name, rollout in robot[1].items()})


@pytest.mark.slow
def test_what_is_trusted_is_true(assessment: Assessment, robot: Robot) -> None:
    """Each trusted value lies within three deviations of the truth, and some are trusted."""
    trusted = [finding for finding in assessment.findings if finding.trusted]
    assert {"friction_1", "friction_2"} <= {finding.prior.name for finding in trusted}
    for finding in trusted:
        estimate, true = finding.estimate, robot[0][finding.prior.name]
        assert abs(estimate.value - true) < 3 * max(estimate.high - estimate.low, 1e-9) / 3.29
        assert finding.shrinkage > 0.5


def test_mass_and_centre_of_the_first_link_are_one_parameter(assessment: Assessment) -> None:
    """Its equations hold only their product, so along the quotient the posterior is the prior."""
    direction = assessment.undetermined[0]
    assert direction.deviation == pytest.approx(1.0, abs=1e-6)
    doubted = {f.prior.name: f.doubts for f in assessment.findings}
    assert doubted["mass_1"]
    assert doubted["centre_1"]
    by_name = {name: abs(weight) for name, weight in direction.weights.items()}
    if set(by_name) == {"mass_1", "centre_1"}:
        assert by_name["mass_1"] == pytest.approx(by_name["centre_1"], rel=1e-3)


def with_errors(one: HorizonErrors, wrong: Iterable[Array]) -> HorizonErrors:
    """With other errors of the identified models, by part."""
    pairs = zip(one.identified, wrong, strict=True)
    return replace(one, identified=tuple(each._replace(errors=errors) for each, errors in pairs))


def enlarged(one: HorizonErrors, times: float) -> HorizonErrors:
    """With larger errors of the identified models."""
    return with_errors(one, [times * each.errors for each in one.identified])


def swapped(one: HorizonErrors) -> HorizonErrors:
    """With the errors of the nominal model and of the identified ones in place of each other."""
    return replace(with_errors(one, one.nominal), nominal=tuple(each.errors for each in one.identified))


def test_errors_that_noise_and_uncertainty_do_not_explain_are_told(assessment: Assessment) -> None:
    """Not where the model is the robot's; errors three times as large are three times what is explained."""
    rng, noise = np.random.default_rng(0), np.array([0.1, 2.0])
    spread = np.tile(np.diag([0.01, 9.0]), (400, 1, 1))
    wrong = rng.standard_normal((400, 2)) * np.sqrt(np.array([0.01, 9.0]) + noise**2)
    for times in (1.0, 3.0):
        own = ModelErrors(times * wrong, spread, noise, wrong)
        assert HorizonErrors(0.5, (wrong,), (own,)).unexplained() == pytest.approx(times, rel=0.1)
    of_second = own._replace(errors=wrong * [1.0, 3.0])
    assert HorizonErrors(0.5, (wrong,), (of_second,)).least_explained() == 1
    still = own._replace(errors=wrong * [1.0, 0.0], spreads=spread * [1.0, 0.0], noise=noise * [1.0, 0.0])
    assert HorizonErrors(0.5, (wrong,), (still,)).least_explained() == 0  # the other never moves
    few = own._replace(errors=wrong[:9], spreads=spread[:9])
    assert np.isnan(HorizonErrors(0.5, (wrong,), (few,)).unexplained())
    assert "explain" not in verdict(assessment)
    larger = [enlarged(one, 3.0) for one in assessment.predictions]
    lacking = replace(assessment, predictions=larger).doubted()
    still = replace(assessment.study, task=pendulum("task.failure.speed.above=0.1").task)
    said = r" Errors after \S+ s are [34]\.\d times what measurement noise and intervals explain, above "
    assert re.search(said, verdict(lacking))
    told = [[row[-1] for row in parameter_rows(each)] for each in (assessment, lacking)]
    stepped = [replace(each, lasting=(STEP_DOUBT,)) for each in lacking.findings]
    cause = "the model lacks something, or its integration steps are too long. Its values"
    assert [cause in verdict(each) for each in (lacking, replace(lacking, findings=stepped))] == [False, True]
    rough = [
        replace(each, lasting=("velocities are estimated in frames of 0.05 s",)) for each in lacking.findings
    ]
    rough_words = "the model lacks something, or velocities are estimated too roughly. Its values"
    assert rough_words in verdict(replace(lacking, findings=rough))
    assert "yes" in told[0]
    doubt = "the model lacks something"
    assert told[1] == [doubt if cell == "yes" else f"{cell}; {doubt}" for cell in told[0]]
    assert " No parameter is trusted." in verdict(lacking)
    assert not parameters(lacking)["trusted"].any()
    assert "is a unit wrong?" not in verdict(replace(lacking, study=still))
    far = [enlarged(one, 9.0) for one in larger]
    for fitted, asks in ((lacking.study, False), (still, True)):
        assert ("is a unit wrong?" in verdict(replace(lacking, study=fitted, predictions=far))) == asks
    no_better = replace(assessment, predictions=[*map(swapped, larger)]).doubted()
    doubts = [each.doubts[-1] for each in no_better.findings]
    assert set(doubts) == {"the model is no better than the nominal one"}
    worse = []
    for one in assessment.predictions:
        pairs = zip(one.identified, one.nominal, strict=True)
        worse.append(
            with_errors(one, [np.hstack([own.errors[:, :-1], 1.1 * of[:, -1:]]) for own, of in pairs])
        )
    assert f" They are larger in {assessment.task.states[-1].name}." in verdict(
        replace(assessment, predictions=worse)
    )


def test_signs_and_columns_that_are_mistaken_are_named(
    assessment: Assessment, study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With those of the model nothing is said, nor if the identified one disagrees."""
    assert not assessment.mistakes
    task, both = study.task, [study.nominal, assessment.identified]
    first, *others = (part.rollouts for part in assessment.parts)
    names = [each.name for each in (*task.states, *task.inputs)]
    for change in changes(task):
        inverse = change._replace(factors=1 / change.factors)
        wrong = {str(i): inverse.of(each) for i, each in enumerate((first, *others))}
        ((words, times, recordings),) = mistakes(task, both[:1], wrong)
        assert words == change.words
        assert not recordings
    assert [each.words for each in changes(task)] == [
        *(f"the sign of {name} reversed" for name in names[4:]),
        *(f"the sign of {' and '.join(names[i:4:2])} reversed" for i in (0, 1)),
        f"the sign of {names[4]} and {names[5]} reversed",
        f"{names[4]} and {names[5]} swapped",
        f"{names[0]} and {names[1]}, {names[2]} and {names[3]} swapped",
        *(f"{' and '.join(names[i:4:2])} taken as deg" for i in (0, 1)),
        f"{' and '.join(names[i] for i in (0, 2, 1, 3))} taken as deg",
    ]
    torque, *_, joint = changes(task)[:4]
    brief = [replace(each, states=each.states[:4], inputs=each.inputs[:3]) for each in first]
    both_wrong = {str(i): torque.of(joint.of(each)) for i, each in enumerate((first, *others, brief))}
    told = mistakes(task, both[:1], both_wrong)
    assert [(each.words, each.recordings) for each in told] == [(joint.words, []), (torque.words, [])]
    some = {"right": first, "brief": brief, "a": torque.of(first), "b": torque.of(others[0])}
    assert [each.recordings for each in mistakes(task, both[:1], some)] == [["a", "b"]]
    degrees = changes(task)[-1]
    in_degrees = degrees._replace(factors=1 / degrees.factors)
    for change, name in ((torque, torque.words), (in_degrees, degrees.words)):  # in a minority, too
        minority = {"a": change.of(first), "b": others[0], "c": first}
        assert [each[::2] for each in mistakes(task, both, minority)] == [(name, ["a"])]
    assert mistakes(task, both, {"a": [each.part(0, 9) for each in in_degrees.of(first)]}) == []  # too short
    mistaken = replace(assessment, mistakes=[Mistake(words, times, ["b.csv"])])
    assert [assessment.sound, mistaken.sound] == [True, False]
    assert beginning(mistaken).startswith("Before a trial, correct the recordings")
    assert verdict(mistaken).endswith(
        f" With {words} (in b.csv alone), the nominal model's errors are {times:.2g} times as large: "
        "check the recording's signs, columns and units."
    )
    signs = [each for each in changes(task) if not each.unit]
    monkeypatch.setattr("simbias.recordings.mistakes.changes", lambda task: [*signs])
    monkeypatch.setattr(
        "simbias.recordings.mistakes.over_changes",
        lambda task, model, rollouts: 1.0 if rollouts[0] is first[0] else ratios[model],
    )
    ratios, rollouts = dict(zip(both, (0.6, 60.0), strict=True)), {"a": first}
    assert not mistakes(task, both, rollouts)
    assert len(mistakes(task, both[:1], rollouts)) == 1
    ratios[both[1]] = 0.8
    assert [each.times for each in mistakes(task, both, rollouts)] == [0.6]  # the nominal model's


def test_velocities_that_are_estimated_in_long_frames_and_rare_samples_are_doubted(
    assessment: Assessment, folder: Path
) -> None:
    t, names = np.arange(0.0, 3.0, 0.02), ["pos1", "pos2", "tau1", "tau2"]
    pd.DataFrame({"time": t} | {name: np.sin(t) for name in names}).to_csv("positions.csv", index=False)
    options = ["preset=double_pendulum", "identification=posterior", "tracking=none"]
    long, short = (simbias.load([*options, f"task.time_step={frame}"]) for frame in (0.02, 0.01))
    doubt = read(long, ["positions.csv"]).doubt
    assert doubt == "velocities are estimated in frames of 0.02 s"
    assert read(short, ["positions.csv"]).doubt == "states are measured every 0.02 s, in frames of 0.01 s"
    for before, after in zip(assessment.findings, assessment.doubted(doubt).findings, strict=True):
        assert after.doubts == (*before.doubts, doubt)
        assert not after.trusted


def test_what_takes_up_a_parameter_that_changes_is_doubted_with_it(assessment: Assessment) -> None:
    """Where recordings disagree on friction, the joint's damping is doubted, too, and nothing else."""
    fitted, names = assessment.identified, [each.prior.name for each in assessment.findings]
    i, j = names.index("friction_2"), names.index("damping_2")
    spread = np.diag(np.full(len(names), 0.1))
    spread[j, i] = -0.1  # so that they are correlated by -0.7
    moved = np.where(np.arange(len(names)) == i, 0.6, 0.0)
    sure, other = (Identified(fitted.model, mode, spread, {}) for mode in (fitted.mode, fitted.mode + moved))
    doubts = {each.prior.name: each.doubts for each in findings(sure, [sure, other], [])}
    assert doubts.pop("friction_2")[-1] == "recordings disagree"
    assert doubts.pop("damping_2")[-1] == "recordings disagree on friction_2"
    assert not any("disagree" in doubt for each in doubts.values() for doubt in each)
    (doubted,) = [
        each for each in findings(sure, [], [], apart=[sure, other]) if each.prior.name == "friction_2"
    ]
    assert doubted.lasting == ("the earlier posterior disagrees",)


def test_states_that_no_model_predicts_are_refused_in_a_line(study: Study) -> None:
    rng = np.random.default_rng(0)
    rollouts = {name: [experiment(study.nominal, rng, 400)] for name in "ab"}
    huge = {n: [replace(one, states=1e160 * one.states) for one in each] for n, each in rollouts.items()}
    with one_line("identify: all recordings: predictions have no finite errors: is a unit"):
        assess(study, huge)


def test_what_is_advised_may_help(assessment: Assessment) -> None:
    """Of what each recording has of its own no input tells beforehand, nor anything that is weighed."""
    told = next(advice(assessment, "none"))  # after a single round
    assert re.fullmatch(r"Estimates have not converged: .* deviations\. Raise identification\.rounds\.", told)
    identified = copy(assessment.identified)
    identified.diagnostics = {**identified.diagnostics, "moved": 0.05}
    assessment = replace(assessment, identified=identified)
    first, *others = assessment.findings
    useless = Excitation(
        Rollout(np.zeros((3, 4)), np.zeros((2, 2))), np.full(1 + len(others), 0.9), 0.0, np.zeros(4)
    )
    off = replace(first, passing=(FAR,))
    told, *_, rest = advice(replace(assessment, findings=[off, *others]), useless)
    assert told.startswith(
        f"Far from what is declared, so priors may distort all estimates: {first.prior.name}. Enlarge"
    )
    assert first.prior.name not in rest
    own = replace(first, prior=first.prior._replace(of_recording=True))
    told = [" ".join(advice(replace(assessment, findings=[each, *others]), useless)) for each in (first, own)]
    assert [each.count(f"No input should determine {first.prior.name}, ") for each in told] == [1, 0]
    assert told[1].count(f"No input should determine {others[0].prior.name}, ") == 1
    narrowed = 0.8 * np.sqrt(assessment.identified.covariance[0, 0])
    assert narrowed > 0.5
    useful = replace(useless, deviations=np.array([narrowed, *useless.deviations[1:]]))
    (best, rest) = advice(assessment, useful)
    assert best.endswith(f" should narrow {first.prior.name} (by about 20%).")
    assert first.prior.name not in rest
    assert rest.endswith(
        ": measure what you can in other ways (masses by weighing or with another load), and declare it."
    )
    lacking = [enlarged(one, 9.0) for one in assessment.predictions]
    for wrong in ({"predictions": lacking}, {"mistakes": [Mistake("x", 0.5, [])]}):
        incomplete = replace(assessment, by_window={0.2: 0.1}, **wrong)  # type: ignore[arg-type]
        assert [*advice(incomplete, useful)] == [
            "Correct the recordings or the model before you record more."
        ]
    stepped = replace(first, lasting=(STEP_DOUBT,))
    said = next(advice(replace(assessment, findings=[stepped, *others]), "none"))
    assert said.startswith(f"Shorter steps of integration would move {first.prior.name}: take a smaller ")
    said = next(advice(replace(assessment, steps_checked=False), "none"))
    assert said == "Whether shorter steps of integration would move parameters could not be checked."
    said = [
        next(advice(replace(assessment, by_window={0.05: 1.6, 0.2: share}), "none")) for share in (0.7, 0.9)
    ]
    assert said[0].endswith("s are 70% of these on average: try identification.window=0.2.")
    assert said[1] == "No trajectory is proposed (none)."
    with_own = replace(assessment, findings=[own, *others])
    told = [about_errors(each) for each in (assessment, with_own, replace(with_own, recordings=["one"]))]
    assert [f"Each recording has its own {first.prior.name}" in each for each in told] == [0, 1, 0]


@pytest.mark.slow
def test_what_is_specific_to_a_recording_may_be_far_from_its_prior(robot: Robot) -> None:
    """Two recordings whose zeros are six prior deviations away: the model lacks nothing."""
    study = prepared(pendulum(*QUICK, "+identification.sensors={pos2: {zero: 0.01}}"))
    recordings = {}
    for (name, rollout), zero in zip(robot[1].items(), (0.06, -0.06), strict=True):
        states = rollout.states + np.array([0.0, zero, 0.0, 0.0])
        recordings[name] = (replace(rollout, states=states, measured=states),)
    found = assess(study, recordings)
    assert found.unexplained is None
    assert found.trusted
    medians = [replace(one, own=()).unexplained() for one in found.predictions]
    assert max(medians) > 2.0
    held = assess(study, {"one": recordings["one"]}, {"two": recordings["<script>two"]})
    assert held.unexplained is None


@pytest.mark.slow
def test_a_model_that_is_no_better_says_so(study: Study) -> None:
    """Learned from a robot; what is held out is the nominal model's, which nothing can improve."""
    rng = np.random.default_rng(3)
    model, _ = truth(study.nominal, rng)
    found = assess(study, {"a": (experiment(model, rng),)}, {"b": (experiment(study.nominal, rng),)})
    assert not found.better
    assert "no better than the nominal one on held-out recordings" in verdict(found)
    assert not any(finding.trusted for finding in found.findings)


def test_a_single_recording_is_cut_into_thirds() -> None:
    states = np.arange(20.0)[:, None]
    made = parts({"one": (Rollout(states, states[:-1]),)})
    assert [part.name for part in made] == ["one, part 1", "one, part 2", "one, part 3"]
    cut = [part.rollouts[0] for part in made]
    np.testing.assert_array_equal(np.concatenate([piece.inputs for piece in cut]), states[:-1])
    assert all(len(piece.states) == piece.frames + 1 for piece in cut)
    assert [len(piece.with_history()[1]) for piece in cut] == [6, 12, 19]
    assert len(parts({str(i): cut[:1] for i in range(12)})) == 5
    assert [part.recordings for part in parts({"one": cut, "two": cut[:1]})] == [["one"] * 3, ["two"]]
    again = [part.rollouts for part in parts({"one": cut[:2] + cut[:1]})]
    assert [sum(rollout.frames for rollout in each) for each in again] == [6, 6, 6]


def errors_with(wrong: Array, spreads: Array, changes: Array | None = None) -> ModelErrors:
    """Errors of predictions of measurements without noise, by default without a change."""
    n = wrong.shape[1]
    return ModelErrors(wrong, spreads, np.zeros(n), np.zeros_like(wrong) if changes is None else changes)


def test_regions_hold_what_they_promise() -> None:
    """Normal errors, the same in all parts: 90%, for any covariance. Wider ones elsewhere: less, unless their
    predictions spread as much.
    """
    rng = np.random.default_rng(0)
    factor = np.array([[1.0, 0.9], [0.0, 1e-4]])
    e = [rng.standard_normal((4000, 2)) @ factor for _ in range(3)]
    none, spreads = np.zeros((4000, 2, 2)), np.tile(factor.T @ factor, (4000, 1, 1))

    def coverage(wrong: list[np.ndarray], spread: list[np.ndarray]) -> float:
        return HorizonErrors(0.1, tuple(wrong), tuple(map(errors_with, wrong, spread))).coverage()

    assert coverage(e, [none] * 3) == pytest.approx(0.9, abs=0.02)
    wide = [e[0], e[1], 5 * e[2]]
    assert coverage(wide, [none] * 3) < 0.75
    assert coverage(wide, [spreads, spreads, 25 * spreads]) == pytest.approx(0.9, abs=0.03)
    assert np.isnan(coverage([each[:3] for each in e], [none[:3]] * 3))


def test_what_known_errors_do_not_hold_widens_regions_as_it_is() -> None:
    """Errors of other recordings scatter more, by zeros of their own, of which the deviation is known."""
    rng, zeros = np.random.default_rng(0), np.diag([4.0, 0.01])
    known, none = rng.standard_normal((4000, 2)), np.zeros((4000, 2, 2))
    wrong = rng.standard_normal((4000, 2)) + rng.standard_normal((4000, 2)) * np.sqrt(np.diag(zeros))
    assert np.mean(inside(wrong, regions(none, known, none))) < 0.7
    covariances = regions(none, known, none) + zeros
    assert np.mean(inside(wrong, covariances)) == pytest.approx(0.9, abs=0.02)
    np.testing.assert_allclose(covariances[0], np.eye(2) + zeros, rtol=0.05, atol=0.05)
    exact = np.einsum("wi,ij,wj->w", wrong, np.linalg.inv(covariances[0]), wrong)
    np.testing.assert_allclose(sizes(wrong, covariances), exact, rtol=1e-9)


def test_other_recordings_may_err_by_a_share_of_what_happens() -> None:
    """Where more happens than in what is known, regions are as much wider as errors are larger."""
    rng, none = np.random.default_rng(0), np.zeros((4000, 2, 2))
    known, moved = errors_with(rng.standard_normal((4000, 2)), none), 30.0 * rng.standard_normal((4000, 2))
    wrong = rng.standard_normal((4000, 2)) + CHANGE * moved * rng.standard_normal((4000, 2))
    for change, least, most in ((None, 0.0, 0.6), (moved, 0.88, 0.92)):
        own = errors_with(wrong, none, change)
        assert least < HorizonErrors(0.1, (wrong,), (own,), (known,)).coverage() < most


@pytest.mark.parametrize(
    ("time_step", "seconds"), [(0.04, [0.04, 0.08, 0.2, 0.48, 1.0]), (0.25, [0.25, 0.5, 1.0])]
)
@pytest.mark.usefixtures("plain_predictions")
def test_horizons_are_what_is_predicted(time_step: float, seconds: list[float]) -> None:
    """States grow by 1/s, so that a model in which they stand errs by the horizon."""
    task, t = cart_pole(time_step=time_step), time_step * np.arange(150)
    rollout = Rollout(np.tile(t[:, None], 4), np.zeros((149, 1)))
    made = predictions(task, NoNominal(task), [NoNominal(task)], [[rollout]])
    assert [each.seconds for each in made] == seconds
    np.testing.assert_allclose([each.rmse()[0][0] for each in made], seconds, rtol=1e-5)


class Growing(NoNominal):
    """States grow by 2/s."""

    def step(self, x: Array, u: Array) -> Array:
        return x + 2.0 * 0.04


@pytest.mark.usefixtures("plain_predictions")
def test_of_other_recordings_the_predicted_change_counts() -> None:
    """Not the measured one, which is half of it."""
    task = cart_pole(time_step=0.04)
    rollout = Rollout(np.tile(0.04 * np.arange(60.0)[:, None], 4), np.zeros((59, 1)))
    model = Growing(task)
    for each in predictions(task, model, [model], [[rollout]], learned=[(model, [rollout])]):
        np.testing.assert_allclose(each.identified[0].changes, 2.0 * each.seconds)


def test_few_errors_give_regions_that_hold_another_one() -> None:
    """Of twenty, half of which are independent, the region reaches to the largest."""
    rng, none = np.random.default_rng(0), np.zeros((20, 2, 2))
    held = []
    for _ in range(100):
        known = np.repeat(rng.standard_normal((10, 2)), 2, axis=0)
        held.append(np.mean(inside(rng.standard_normal((20, 2)), regions(none, known, none))))
    assert np.mean(held) == pytest.approx(0.88, abs=0.05)


def test_too_short_recordings_are_one_line(study: Study) -> None:
    short = Rollout(np.zeros((60, 4)), np.zeros((59, 2)))
    with pytest.raises(ConfigError, match=r"^short, part 1: is shorter than a window of 0\.2 s$"):
        assess(study, {"short": (short,)})
    with pytest.raises(ConfigError, match="identification=posterior does"):
        prepared(pendulum())


@pytest.mark.slow
def test_a_trial_begins_with_what_was_identified(
    assessment: Assessment, study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The written option: the same posterior, to which experiments add."""
    monkeypatch.setattr("simbias.recordings.files.report", lambda *_: "")  # drawn below
    for stale in ("excitation.csv", "identified.xml", "draw_9.xml"):
        (tmp_path / stale).touch()
    option = tmp_path / "conf" / "identification" / "identified.yaml"
    check_replaces_nothing(study, tmp_path, option)
    write(assessment, "none", study.config["identification"], tmp_path, option)
    check_replaces_nothing(study, tmp_path, option)  # of a run before
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"report.html", "parameters.csv", "errors.csv", "draws.csv", "conf"}
    options = ["preset=double_pendulum", "tracking=none", "bias=none", "identification=identified"]
    attached = simbias.load(options, tmp_path / "conf")
    with pytest.raises(
        ConfigError, match=r"^--into: would replace identification=identified: choose another"
    ):
        check_replaces_nothing(attached, tmp_path, option)
    first = attached.first_model().nominal
    assert isinstance(first, Identified)
    assert first.estimates == assessment.identified.estimates
    heavier = [*options, "nominal.drives.damping_1=0.002"]
    with pytest.raises(ConfigError, match=r"^identification\.known: belongs to a nominal model with other"):
        simbias.load(heavier, tmp_path / "conf")
    wider = simbias.load([*options, "nominal.uncertainty.damping=0.03"], tmp_path / "conf")
    declared = (
        r"^identification\.known: is for damping_1 declared as 0 N m s/rad \(half_normal of spread 0\.02\);"
    )
    with pytest.raises(ConfigError, match=declared):
        rehearse(wider)
    np.testing.assert_array_equal(first.covariance, assessment.identified.covariance)
    robot, _ = truth(study.nominal, np.random.default_rng(4))
    more = attached.identification.fit(attached.nominal, [experiment(robot, np.random.default_rng(9))])
    assert isinstance(more, Identified)
    volumes = [np.linalg.slogdet(each.covariance)[1] for each in (more, first)]
    assert volumes[0] < volumes[1]
    assert len(pd.read_csv(tmp_path / "draws.csv")) == 100
    assert pd.read_csv(tmp_path / "parameters.csv").set_index("name").loc["friction_1", "trusted"]
    with pytest.raises(
        ValueError, match=r"identification\.known: is for mass; the nominal model's parameters"
    ):
        type(study.identification)(study.task, known=Known(["mass"], [0.0], [[1.0]])).fit(  # type: ignore[call-arg]
            study.nominal, []
        )


def test_doubts_about_recordings_stay_with_the_option(study: Study, assessment: Assessment) -> None:
    """Those of the posterior's width do not."""
    option, first = study.config["identification"], assessment.findings[0]
    rest = [replace(each, lasting=()) for each in assessment.findings[1:]]
    doubted = [replace(first, passing=("partly determined",), lasting=("a",), earlier=("b", "a")), *rest]
    assert doubted[0].doubts == ("partly determined", "a", "doubted earlier: b")
    written = yaml.safe_load("\n".join(option_lines(replace(assessment, findings=doubted), option)))
    known = Known(**written["known"])
    assert known.doubts == [["b", "a"], *([] for _ in rest)]


def test_columns_may_have_units_in_braces() -> None:
    text = "{pos1: q1 [deg], tau1: I [mN m], time: t, pos2: /js.position[elbow], vel1: 'v [1/s]'}"
    assert columns(text) == {
        "pos1": "q1 [deg]",
        "tau1": "I [mN m]",
        "time": "t",
        "pos2": "/js.position[elbow]",
        "vel1": "v [1/s]",
    }
    assert columns("{q: 'Motor 1: angle [deg]'}") == {"q": "Motor 1: angle [deg]"}
    assert columns("q: position[0] [deg]") == {"q": "position[0] [deg]"}
    assert columns("{q: position[0] [deg], u: effort[0]}") == {"q": "position[0] [deg]", "u": "effort[0]"}


def test_copies_do_not_count_again(study: Study, folder: Path) -> None:
    """Rounded, cut or with another clock; nor what an option has learned. Repeated motions are no copies."""
    study = replace(study, hardware=None)  # type: ignore[arg-type]
    one = experiment(study.nominal, np.random.default_rng(8), 1600)
    write_csv(one, folder / "one.csv")
    write_csv(one.part(0, 800), folder / "half.csv")
    rows = pd.read_csv("one.csv").iloc[1:].round(5)
    rows.assign(time=rows["time"] + 3.0).to_csv("late.csv", index=False)
    noise = NOISE * np.random.default_rng(0).standard_normal((2, *one.states.shape))
    write_csv(replace(one, states=one.states + noise[0]), folder / "repeated.csv")
    for i in (0, 1):
        write_csv(replace(one, states=noise[i]), folder / f"rest{i}.csv")
    apart = ["one.csv", "repeated.csv", "rest0.csv", "rest1.csv"]
    found = read(study, [*apart, "half.csv", "late.csv"])
    assert list(found.rollouts) == apart
    assert found.notes == ("half.csv, late.csv: the same as earlier data, so not counted again",)
    again = pd.concat([rows, rows.assign(time=rows["time"] + rows["time"].max() + 1.0)])
    again.to_csv("twice.csv", index=False)
    twice = read(study, ["twice.csv"])
    assert [note for note in twice.notes if "counted" in note] == [
        f"twice.csv: {twice.rollouts['twice.csv'][0].frames * study.task.time_step:.3g} s are {SAME}"
    ]
    (rest,) = read_apart(study, ["one.csv"], ["half.csv"])[0].pieces.rollouts
    assert rest.frames == one.frames - 800
    np.testing.assert_allclose(rest.with_history()[1][-rest.frames - 1], one.inputs[798])
    write_csv(one.part(0, 1400), folder / "longer.csv")
    wide = replace(study, identification=study.identification.with_window(1.5))  # type: ignore[attr-defined]
    found = read(wide, ["half.csv", "longer.csv"], windows=1.0)
    assert list(found.rollouts) == ["half.csv"]
    assert found.notes[-1] == "longer.csv: 1 piece shorter than 1.5 s left out"
    learned = digests([one], study.task.time_step)
    known = replace(Identified.of_prior(study.nominal).known, learned=[*map(str, learned)])
    again = replace(study, identification=study.identification.with_known(known))  # type: ignore[attr-defined]
    told = "late.csv: learned by the earlier posterior, so not counted again"
    found, _ = read_apart(again, ["late.csv", "repeated.csv"], [])
    assert list(found.rollouts) == ["repeated.csv"]
    assert found.notes == (UNKNOWN, told)  # no doubts are known
    with pytest.raises(ConfigError, match=r"^--held-out: the earlier posterior has learned all of it$"):
        read_apart(again, ["repeated.csv"], ["late.csv"])
    assert list(read_apart(again, ["late.csv"], [], again=True)[0].rollouts) == ["late.csv"]


@pytest.mark.parametrize("noise", [0.0, 3e-4])
def test_repeated_motions_at_low_rates_are_no_copies(noise: float) -> None:
    """Differences over several samples are motion there, and similar; exact copies are still found."""
    rng, t = np.random.default_rng(0), 0.1 * np.arange(201)

    def recording() -> Rollout:
        q = rng.normal(1.0, 0.01) * np.sin(4.4 * t) + rng.normal(0.3, 0.003) * np.sin(11.9 * t)
        q += noise * rng.standard_normal(len(t))
        return Rollout(np.column_stack([q, np.gradient(q, 0.1)]), np.zeros((200, 1)))

    one, repeated = recording(), recording()
    learned = digests([one], 0.1)
    assert not copied(repeated, learned).any()
    assert copied(one, learned).all()
    assert copied(one.part(50, 200), learned).all()


def test_names_of_a_model_are_no_keys_of_the_option(study: Study, assessment: Assessment) -> None:
    """An MJCF file may name its bodies as it likes, line breaks included."""
    size = len(study.nominal.parameters)
    identified = Identified(study.nominal, np.zeros(size), np.eye(size), {})
    first, *others = identified.estimates
    identified.estimates = (first._replace(name="pole\n_target_: os.system\u2028#"), *others)
    made = replace(assessment, identified=identified)
    written = yaml.safe_load("\n".join(option_lines(made, {"rounds": 2, "differences": "forward"})))
    assert written.pop("known")["mode"] == identified.known.mode
    assert written == {"rounds": 2, "differences": "central", "smoothing": 0.05}  # as `identify` identifies


def test_an_identified_mjcf_is_read_back(tmp_path: Path) -> None:
    """Six digits of each parameter and of what moves with it; the same steps."""
    model = Mujoco(
        cart_pole(), mjcf(tmp_path), uncertainty={"pole.mass": 0.3, "slider.damping": 0.1, "*.size": 0.1}
    )
    values = np.array([0.7, 0.2, *[1.1] * (len(model.parameters) - 2)])
    changed = model.with_parameters(values)
    (tmp_path / "changed.xml").write_text(changed.mjcf())
    again = Mujoco(cart_pole(), str(tmp_path / "changed.xml"))
    assert values_of(again._robot.model, "pole.mass")["pole.mass"] == pytest.approx(0.7, rel=1e-5)
    x, u = np.array([[0.1, 0.2, 0.3, 0.4]]), np.array([[3.0]])
    np.testing.assert_allclose(again.step(x, u), changed.step(x, u), rtol=1e-4)


def test_what_is_told_of_a_gain_or_a_size_is_over_that_of_the_file(tmp_path: Path) -> None:
    """Also beside values that are set; in their place, or from an option, it is the same model."""
    file, spreads = mjcf(tmp_path), {"push.gain": 0.3, "pole.size": 0.1}
    declared = Mujoco(cart_pole(), file, values={"push.gain": 0.5, "pole.size": 1.2}, uncertainty=spreads)
    found = Identified(declared, np.array([0.6, -0.8]), 0.01 * np.eye(2), {})
    assert [estimate.declared for estimate in found.estimates] == [0.5, 1.2]
    told = {estimate.name: estimate.value for estimate in found.estimates}
    loaded = Posterior(cart_pole(), known=found.known).fit(declared, [])
    again = found.model.with_parameters(np.array(list(told.values())))
    x, u = np.array([[0.1, 0.2, 0.3, 0.4]]), np.array([[3.0]])
    for model in Mujoco(cart_pole(), file, values=told), loaded, again:
        np.testing.assert_allclose(model.step(x, u), found.step(x, u), rtol=1e-9)
    with pytest.raises(ValueError, match=r"^uncertainty: push\.gain is set to zero$"):
        Mujoco(cart_pole(), file, values={"push.gain": 0.0}, uncertainty=spreads)


def test_the_file_that_the_model_is_read_from_is_not_replaced(study: Study, tmp_path: Path) -> None:
    """The posterior is of that model: of the identified one, it would apply twice. Nor is an option's own."""
    file = Path(mjcf(tmp_path)).rename(tmp_path / "identified.xml")
    study, option = (
        replace(study, nominal=Mujoco(cart_pole(), str(file))),
        tmp_path / "identification" / "a.yaml",
    )
    check_replaces_nothing(study, tmp_path / "elsewhere", option)
    with pytest.raises(ConfigError, match=r"^--into: would replace .*identified\.xml"):
        check_replaces_nothing(study, tmp_path, option)
    for shipped in "delay", "posterior":
        with pytest.raises(ConfigError, match=f"^--into: would replace identification={shipped}"):
            check_replaces_nothing(study, tmp_path / "elsewhere", option.with_stem(shipped))
    with pytest.raises(ConfigError, match=r"^--into: .*identified\.xml cannot be written \(File exists\)"):
        check_replaces_nothing(study, file, option)
    monday, tuesday = (tmp_path / day / "out" for day in ("monday", "tuesday"))
    option.write_text(head(monday, option) + "\nwindow: 0.1")
    check_replaces_nothing(study, monday, option)
    with pytest.raises(ConfigError, match=r"^--into: would replace identification=a: choose another folder"):
        check_replaces_nothing(study, tuesday, option)


def test_what_each_recording_has_of_its_own_is_in_a_table(assessment: Assessment, tmp_path: Path) -> None:
    """With their doubts; the MJCF says that it has the prior's."""
    robot = Mujoco(cart_pole(), mjcf(tmp_path), uncertainty={"tip.mass": 0.1, "pole.mass": 0.1})
    rig = Rig(cart_pole(), robot, {}, {}, each=["tip.mass"])
    first, second = (Identified(rig, np.full(2, z), 0.1 * np.eye(2), {}) for z in (-1.0, 1.0))
    identified = first.elsewhere()
    identified.recordings = (first, second)
    own = own_findings(["bare", "loaded"], identified, [], np.array([[0.0, 0.0], [2.0, 2.0]]))
    made = replace(assessment, own_findings=own).doubted("lagging")
    table = of_recordings(made)
    assert table["doubts"].tolist() == ["lagging", f"{STEP_DOUBT}; lagging"]
    assert all(line.endswith("lagging)") for line in own_lines(made))
    assert table[["recording", "name"]].to_numpy().tolist() == [["bare", "tip.mass"], ["loaded", "tip.mass"]]
    assert table["value"].tolist() == [each.estimates[0].value for each in (first, second)]
    said = "<!-- tip.mass at the prior's median: each recording has its own, in recordings.csv. -->"
    assert dict(models(identified))["identified"].startswith(said)


@pytest.mark.slow
def test_files_of_draws_are_of_the_table_of_draws(tmp_path: Path) -> None:
    """Of a gain and of a size, which multiply; also behind sensors, of which the files say that they lack."""
    task, uncertainty = cart_pole(), {"push.gain": 0.3, "tip.mass": 0.1, "pole.size": 0.2}
    model = Mujoco(task, mjcf(tmp_path), uncertainty=uncertainty)
    rig = Rig(task, model, {}, {"angle": Sensor(offset=0.1)})
    for prior, lines in (model, 0), (rig, 1):
        p = len(prior.parameters)
        identified = Identified(prior, np.linspace(-0.7, 0.8, p), 0.5 * np.eye(p), {})
        files, table = dict(models(identified)), draws(identified)
        told = [[estimate.value for estimate in identified.estimates], *table.to_numpy()[:10]]
        assert list(files) == ["identified", *(f"draw_{i}" for i in range(10))]
        for text, values in zip(files.values(), told, strict=True):
            robot = mujoco.MjModel.from_xml_string(text)
            by_name = dict(zip(table, values, strict=True))
            assert robot.actuator("push").gear[0] == pytest.approx(20 * by_name["push.gain"], rel=1e-5)
            assert robot.body("tip").pos[2] == pytest.approx(0.8 * by_name["pole.size"], rel=1e-5)
            assert text.count("Without motors and sensors") == lines


@pytest.mark.slow
def test_the_page_is_one_file_and_runs_nothing(assessment: Assessment) -> None:
    """It says that what was not fitted to is predicted better, and how."""
    assert assessment.better
    assert assessment.ratio < 0.5
    assert list(assessment.ratios) == ["one", "<script>two"]
    low, high = sorted(assessment.ratios.values())
    said = f"times those of the nominal one ({low:.2f} to {high:.2f} in single parts), in the geo"
    assert said in verdict(assessment)
    doubted = [replace(each, passing=("partly determined",)) for each in assessment.findings]
    assert verdict(replace(assessment, findings=doubted)) == f"{verdict(assessment)} No parameter is trusted."
    first, *rest = assessment.predictions
    worse = replace(assessment, predictions=[swapped(first), *rest])
    assert f" They are larger after {first.seconds:g} s." in verdict(worse)
    text = report(assessment, "none", ["one: vel2 is estimated from pos2"])
    assert "Identified from one (2 s), &lt;script&gt;two (2 s)." in text
    assert "one: vel2 is estimated from pos2" in text
    assert "<script" not in text
    assert "<title>double_pendulum, identified from recordings</title>" in text
    assert "&lt;script&gt;two" in text
    assert not re.search(r"(?:src|href)=\"(?!data:)", text)
    assert text.count("<img ") == 4
    assert text.count("the geometric mean over states and horizons") == 1
    assert "at most the first 5 s are shown" in text
    assert "Trust is for motions like those recorded." in text
    assert "@media print" in text


def test_what_is_measured_is_seen_below_a_prediction_that_is_right(assessment: Assessment) -> None:
    """And states are called as in the tables."""
    figure = plots.forecasts(assessment, 0)
    for axes in figure.axes:
        measured, *predicted = axes.lines
        assert measured.get_linewidth() > 2 * max(line.get_linewidth() for line in predicted)
    assert [axes.get_ylabel() for axes in figure.axes] == error_names(assessment)[-4:]


@pytest.mark.slow
def test_errors_of_many_states_are_drawn_in_rows() -> None:
    wrong, none = np.ones((2, 12)), np.zeros((2, 12, 12))
    made = [HorizonErrors(0.1, (wrong,), (errors_with(share * wrong, none),)) for share in (1.0, 0.3)]
    twelve = SimpleNamespace(states=3 * cart_pole().states)
    figure, of_one_decade = (plots.errors(SimpleNamespace(task=twelve, predictions=[each])) for each in made)  # type: ignore[arg-type]
    assert [len(figure.axes), figure.axes[0].get_gridspec().ncols] == [12, 4]  # type: ignore[union-attr]
    axes = of_one_decade.axes[0]
    low, high = axes.get_ylim()
    assert sum(low <= tick <= high for tick in axes.get_yticks()) >= 2


def test_what_is_far_wider_than_the_prior_hides_nothing(assessment: Assessment) -> None:
    """An interval that leaves the axes has an arrow there."""
    first, *_ = assessment.findings
    wide = replace(first, by_part=(first.estimate._replace(high=1e6), first.estimate))
    axes, *_ = plots.parameters(replace(assessment, findings=[wide])).axes
    assert axes.get_xlim()[1] < 4 * wide.prior_interval[1]
    assert [line.get_marker() for line in axes.lines].count(">") == 1
    fitted = assessment.identified
    scattered = fitted.with_spread(1.7 * np.eye(len(fitted.parameters)))
    (doubts,) = {each.doubts for each in findings(scattered, [], []) if "at its bound" not in each.doubts}
    assert doubts == ("not determined by the data", "wider than its prior")
    wide = replace(assessment, identified=scattered)
    assert "(keeps 170% of the prior's deviation: wider than its prior)" in next(undetermined_lines(wide))


def test_a_posterior_far_from_its_prior_is_shown_whole(assessment: Assessment) -> None:
    """With the marks of parts that agree."""
    first, *_ = assessment.findings
    low, high = first.prior_interval
    value, width = high + 5 * (high - low), high - low
    far = first.estimate._replace(low=value - width, value=value, high=value + width)
    moved = replace(first, estimate=far, by_part=(far._replace(value=value + 2 * width),))
    axes, *_ = plots.parameters(replace(assessment, findings=[moved])).axes
    assert axes.get_xlim()[0] < low
    assert axes.get_xlim()[1] > value + 2 * width
    assert [line.get_marker() for line in axes.lines] == ["None", "None", "o", "None", "s"]


def test_draws_are_within_the_priors(assessment: Assessment) -> None:
    made = draws(assessment.identified)
    assert (made > 0).all(axis=None)
    for estimate in assessment.identified.estimates:
        inside = made[estimate.name].between(estimate.low, estimate.high).mean()
        assert inside == pytest.approx(0.9, abs=0.1)


def write_csv(rollout: Rollout, file: Path) -> None:
    """A recording with the task's own names."""
    names = ["time", "pos1", "pos2", "vel1", "vel2", "tau1", "tau2"]
    time = 0.002 * np.arange(rollout.frames)
    rows = np.column_stack([time, rollout.states[:-1], rollout.inputs])
    pd.DataFrame(rows, columns=names).to_csv(file, index=False)


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_the_command_tells_and_writes(
    study: Study,
    robot: Robot,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """And a trial is started from recordings: its first search is made on the identified model."""
    monkeypatch.setattr("simbias.terminal.identify.TRAJECTORIES", 4)
    monkeypatch.setattr("simbias.recordings.files.report", lambda *_: "")  # likewise
    write_csv(robot[1]["one"], folder / "one.csv")
    short = ["task.horizon=60", "optimizer.max_evaluations=5", "method.max_iterations=1", "bias=none"]
    recorded = [f"hardware.folder={folder}", "tracking=folders", "tracking.pictures=false"]
    arguments = ["identify", "one.csv", "preset=double_pendulum", *QUICKER, *short, *recorded]
    assert main([*arguments, "--attach"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^friction_1 +N m .* yes$", out, re.MULTILINE)
    assert "Not determined: " in out
    assert "On parts that it was not fitted to, the identified model's errors are 0." in out
    assert "one.csv 2 s at 500 Hz\nfitting all recordings\n" in out
    assert "\nStart a trial with it:  --config-dir identified/conf identification=identified  (" in out
    assert "\nThe model has learned one.csv, which counts again in the trial.\n" in out
    written = {path.name for path in (folder / "identified").rglob("*") if path.is_file()}
    assert written == {
        *("report.html", "parameters.csv", "errors.csv", "draws.csv", "excitation.csv", "identified.yaml")
    }
    (of_trial,) = (folder / "trials").iterdir()
    trial = simbias.load_trial(of_trial, config_dir=folder / "identified" / "conf")
    assert trial.iterations[0].model.nominal.estimates
    with monkeypatch.context() as patched:
        patched.setattr(Assessment, "trusted", False)
        assert main([*arguments, "method.max_iterations=2", "--attach"]) == 1
    out = capsys.readouterr().out
    assert re.search(r"^Before a trial, remove the doubts, .*: +--config-dir ", out, re.MULTILINE)
    assert "\nNo trial is started.\n" in out
    assert list((folder / "trials").iterdir()) == [of_trial]
    write_csv(experiment(study.nominal, np.random.default_rng(0)), folder / "two.csv")
    files, overrides = arguments[:2], arguments[2:]
    assert main([*files, "--attach", "--held-out", "two.csv", *overrides]) == 1
    out = capsys.readouterr().out
    assert "Do not use it." in out
    assert "Start no trial with it  (identified/conf/identification/identified.yaml)\n" in out
    assert "No trial is started.\n" in out
    assert "Next: No trajectory is proposed (it would rely on the identified model" in out
    for wrong, said in (
        (["identify", "three.csv", *arguments[2:]], "three.csv: no such recording (.csv, .csv.gz, .mcap, "),
        (
            [*arguments, "--columns", "{angle: q}"],
            "columns: names quantities that the task lacks: angle; it",
        ),
        ([*arguments, "--columns", "[angle]"], "--columns: must be a mapping of names"),
        ([*arguments, "hardware.folder=lab", "--attach"], "hardware.folder: has no recording to start a"),
    ):
        assert main(wrong) == 2
        assert capsys.readouterr().err.startswith(f"simbias: {said}")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* never changes")
def test_nothing_is_fitted_to_what_is_held_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nor to a copy of it, however it is named; without another recording, there is nothing to fit to."""
    (folder / "lab").mkdir()
    rng = np.random.default_rng(0)
    for name in ("one", "two"):
        states = 0.01 * rng.standard_normal((202, 4)) * [0, 1, 0, 1]
        write_csv(Rollout(states, np.zeros((201, 2))), folder / "lab" / f"{name}.csv")
    (folder / "again.csv").symlink_to(folder / "lab" / "two.csv")
    options = ["preset=double_pendulum", "identification=posterior", "tracking=none"]
    found, kept = read_apart(simbias.load(options), ["lab", "lab/../lab/one.csv"], [folder / "again.csv"])
    assert list(found.rollouts) == list(found.times) == ["one.csv"]
    assert "two.csv: held out, so not fitted" in found.notes
    assert list(kept.rollouts) == ["again.csv"]
    still = next(note for note in read(simbias.load(options), ["lab"]).notes if "pos1 never changes" in note)
    assert still.startswith("one.csv, two.csv: ")  # once for both
    (folder / "copy.csv").write_bytes((folder / "lab" / "one.csv").read_bytes())
    found = read(simbias.load(options), ["lab", "copy.csv"])
    assert list(found.rollouts) == ["one.csv", "two.csv"]
    assert "copy.csv: the same as earlier data, so not counted again" in found.notes
    found, _ = read_apart(simbias.load(options), ["lab"], ["copy.csv"])
    assert list(found.rollouts) == ["two.csv"]
    assert "one.csv: held out, so not fitted" in found.notes
    refused = pytest.raises(ConfigError, match=r"^identify: needs recordings neither held out nor learned: ")
    with refused, pytest.warns(UserWarning, match=r"^one\.csv, two\.csv: held out, so not fitted"):
        simbias.identify(["lab"], options, held_out=["lab"])
    assert main(["identify", "--recover", "lab", *options, "--held-out", "lab"]) == 2
    assert capsys.readouterr().err == "simbias: --held-out: holds out every recording\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "option", "motors"),
    [
        (["preset=acrobot_swingup", "identification.starts=3"], "acrobot_swingup", ["torque.delay"]),
        (["preset=[double_pendulum,paper]", "identification.starts=3"], "posterior", []),
        (["preset=acrobot_swingup", "identification=posterior_forward"], "posterior_forward", []),
    ],
)
def test_what_a_preset_identifies_is_identified(
    words: list[str], option: str, motors: list[str], tmp_path: Path
) -> None:
    """And written, so that a trial begins with it; the plain posterior is of presets that identify none."""
    request = Request([], [], words, None, tmp_path, None, [])
    study, *_ = request.opened(Console())
    posterior = study.identification
    assert isinstance(posterior, Posterior)
    assert study.choices["identification"] == option
    assert bool(study.config["identification"]["motors"]) == bool(motors)
    names = [each.name for each in posterior.prior(study.nominal).parameters]
    assert [name for name in names if name.startswith("torque.")] == motors
    assert posterior._differences == "central"
    assert request.again[-1] == "identification=identified"


def test_an_option_beside_those_of_ones_own_is_named_as_the_folder() -> None:
    """Hydra chooses none that is a number or constant, or has other letters."""
    intos = ("a/day 2", ".", "2026-11-26", "1e5", "Null", "größe")
    options = [
        Request([], [], [], None, Path(into), config_dir, [])
        .option.relative_to(config_dir or into)
        .as_posix()
        for into, config_dir in (("a/day 2", None), *((into, "b") for into in intos))
    ]
    names = ("day_2", "identified", "identified_2026_11_26", "identified_1e5", "identified_Null", "gr__e")
    assert options == [
        f"{each}.yaml" for each in ("conf/identification/identified", *(f"identification/{n}" for n in names))
    ]


@pytest.mark.slow
def test_short_pieces_are_left_out_and_short_files_refused(study: Study, folder: Path) -> None:
    """A gap behind 0.02 s and one behind 0.3 s leave two pieces that hold a window of 0.2 s."""
    write_csv(Rollout(np.zeros((401, 4)), np.zeros((400, 2))), folder / "cut.csv")
    rows = pd.read_csv("cut.csv").drop(index=[*range(11, 21), *range(171, 191)])
    rows.to_csv("cut.csv", index=False)
    study = replace(study, hardware=None)  # type: ignore[arg-type]
    found = read(study, ["cut.csv"], windows=2.0)
    assert [piece.frames for piece in found.rollouts["cut.csv"]] == [149, 208]
    assert all(piece.continues for piece in found.rollouts["cut.csv"])  # after the one that is left out
    assert found.extent == "cut.csv 0.714 s at 500 Hz"
    assert "cut.csv: 1 piece shorter than 0.2 s left out" in found.notes
    rows[:100].to_csv("cut.csv", index=False)
    with pytest.raises(ConfigError, match=r"^cut\.csv: is shorter than a window of 0\.2 s$"):
        read(study, ["cut.csv"], windows=2.0)
    rows[:110].to_csv("held.csv", index=False)
    request = Request(["cut.csv"], ["held.csv"], ["preset=double_pendulum"], None, folder, None, [])
    _, *opened = request.opened(Console())  # as excite, which needs 0.1 s
    continue_ = [[piece.continues for piece in each.pieces.rollouts] for each in opened]
    assert continue_ == [[True], [False, True]]  # the first one of a file begins without a torque


def test_files_hold_windows_of_whole_chunks(folder: Path) -> None:
    """Of 0.032 s in place of 0.03 s, and of 33 frames for twice as much."""
    options = ["preset=double_pendulum", "identification=posterior", "identification.window=0.03"]
    study = simbias.load([*options, "tracking=none"])
    for rows in 33, 34:
        write_csv(Rollout(np.zeros((rows + 1, 4)), np.zeros((rows, 2))), folder / f"{rows}.csv")
    (piece,) = read(study, ["34.csv"], windows=2.0).pieces.rollouts
    assert piece.frames == 33
    coarse = simbias.load([*options, "task.time_step=0.02", "tracking=none"])
    assert read(coarse, ["34.csv"]).extent == "34.csv 0.06 s at 500 Hz"  # though it has 0.066 s
    with pytest.raises(ConfigError, match=r"^33\.csv: is shorter than a window of 0\.066 s$"):
        read(study, ["33.csv"], windows=2.0)


def test_nothing_is_asked_of_a_tasks_targets(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They are no states of the robot, and no recording has them."""
    options = ["preset=reacher", "identification=posterior", "tracking=none"]
    task = simbias.load(options).task.without_targets
    # Do not fit the task, nor play a part; the samples' limits are of another one.
    options += ["cost=quadratic", "policy=output_feedback", "samples=bongoboard"]
    names = ["time", *(each.name for each in (*task.states, *task.inputs))]
    pd.DataFrame(task.time_step * np.tile(np.arange(5.0)[:, None], len(names)), columns=names).to_csv("a.csv")
    with pytest.raises(ConfigError, match=r"^a\.csv: is shorter than a window of "):
        simbias.identify(["a.csv"], options)
    assert main(["identify", "a.csv", *options]) == 2
    assert capsys.readouterr().err.startswith("simbias: a.csv: is shorter than a window of ")


@pytest.fixture(scope="module")
def rollouts() -> list[Rollout]:
    study = pendulum()
    model, _ = truth(study.nominal, np.random.default_rng(4))
    return [experiment(model, np.random.default_rng(seed)) for seed in (1, 2)]


def test_other_positions_do_and_motion_of_a_kind_does_not(rollouts: list[Rollout]) -> None:
    task, turned = pendulum().task, rollouts[0].states + np.array([20.0, 0.0, 0.0, 0.0])
    assert beyond(task, rollouts[:1], rollouts[1:]) == beyond(task, rollouts, rollouts) == []
    (found,) = beyond(task, [replace(rollouts[0], states=turned)], rollouts)
    assert (found.name, found.share) == (task.states[0].name, 1.0)
    wraps = pendulum("task.states.pos1={unit: rad, kind: angle, wraps: true}").task
    whole = rollouts[0].states + np.array([6 * np.pi, 0.0, 0.0, 0.0])
    assert beyond(wraps, [replace(rollouts[0], states=whole)], rollouts) == []


def test_stronger_inputs_do(rollouts: list[Rollout]) -> None:
    """Inputs three times as large, in half of the frames or in a few."""
    task, first = pendulum().task, rollouts[0]
    stronger = np.where(np.arange(first.frames)[:, None] % 2 == 0, 3.0, 1.0) * first.inputs
    found = beyond(task, [replace(first, inputs=stronger)], [first])
    assert {each.name for each in found} == {each.name for each in task.inputs}
    for each in found:
        assert each.range == pytest.approx(np.multiply(3.0, each.learned), rel=0.1)
        assert 0.15 < each.share < 0.5
    few = np.where(np.arange(first.frames)[:, None] < 0.1 * first.frames, 3.0, 1.0) * first.inputs
    assert beyond(task, [replace(first, inputs=few)], [first]) == []
