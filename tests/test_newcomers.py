"""What newcomers with a robot of their own fell over: each is said at once, in a line."""

import re
import warnings
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import cast

import numpy as np
import point_mass as robot
import pytest
from conftest import OWN_CONF, POINT_MASS
from errors import one_line
from interpreted import interpreted
from rich.console import Console
from texts import write

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError
from simbias.core import NOT_A_NUMBER, Bias, Cost, FittedBias, HardwareError, Nominal, error_origin
from simbias.core.commands import BAD_INPUT
from simbias.core.ranges import frames_in
from simbias.core.records import Array, Indices, Rollout, Selection, Transitions
from simbias.learning.bias.none import NoBias
from simbias.learning.samples.thresholds import Thresholds, WindowLengths
from simbias.terminal.trial import TrialConsole, cost_text
from simbias.testing.rehearsal import rehearse
from simbias.trial import diagnostics as remarks
from simbias.trial.methods.algorithm1 import Algorithm1
from simbias.trial.run import run_trial
from simbias.trial.study import Study

PENDULUM = ["preset=double_pendulum", "tracking=none"]


class NaNVelocity(robot.WithoutWind):
    def step(self, x: Array, u: Array) -> Array:
        x_next = super().step(x, u)
        x_next[..., 1] = np.nan
        return x_next


class Raises(robot.WithoutWind):
    def step(self, x: Array, u: Array) -> Array:
        return self._helped(x)

    def _helped(self, x: Array) -> Array:
        raise KeyError("mass")


class Decides(robot.WithoutWind):
    def step(self, x: Array, u: Array) -> Array:
        return super().step(x, u) if (np.abs(x) < 1e6).all() else x


class OneColumn(robot.WithoutWind):
    def step(self, x: Array, u: Array) -> Array:
        return super().step(x, u)[..., :1]


class Unbounded(robot.Spring):
    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        return 1e3 * x[..., :1], policy_state


class Single(robot.Spring):
    """In single precision, which rounds its limits."""

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        u, policy_state = super().act(theta, x, t, policy_state)
        return u * (1 + 1e-7), policy_state


class ImitatesByOne(robot.Spring):
    def imitating(self, states: Array, inputs: Array) -> Array:
        return np.zeros(1)


class Always(Cost):
    max_cost = 1.0

    def __init__(self, value: float) -> None:
        self._value = value

    def of(self, rollout: Rollout) -> float:
        return self._value


class OfTheFirst(Cost):
    max_cost, horizon, time_step, reductions = 1.0, 100, 0.02, ("sum",)

    def of_totals(self, totals: Array, lost: Indices) -> Array:
        return totals[0] + lost


@pytest.fixture(scope="module")
def compilable() -> Study:
    """A quick one."""
    return simbias.load([*POINT_MASS, "tracking=none", "optimizer.max_evaluations=40"], OWN_CONF)


@pytest.fixture
def point_mass(compilable: Study, uncompiled: None) -> Study:
    """The same, in NumPy."""
    return compilable


def shown(study: Study) -> str:
    """What a terminal of 60 columns shows of a trial."""
    file = StringIO()
    with TrialConsole(study, Console(file=file, width=60, highlight=False, soft_wrap=True)) as console:
        run_trial(study, observer=console)
    return file.getvalue()


@pytest.mark.slow
def test_what_an_own_component_breaks_is_one_line_before_the_trial(compilable: Study) -> None:
    study = replace(compilable, bias=NoBias())
    with interpreted(), warnings.catch_warnings():
        warnings.simplefilter("error", simbias.core.StudyWarning)  # ordinary NumPy can be compiled
        rehearse(study)
    for group, component, line in (
        ("cost", lambda _: OfTheFirst(), "OfTheFirst.of_totals: expected for several points what it gives"),
        ("nominal", NaNVelocity, "NaNVelocity.step: expected finite numbers near the start, got [["),
        ("nominal", Raises, "Raises.step: expected a result, got KeyError: 'mass' (test_newcomers.py:"),
        ("nominal", OneColumn, "OneColumn.step: expected a state, got (1,)"),
        ("policy", Unbounded, "Unbounded.act: expected inputs within [-5.] and [5.], got "),
        ("policy", ImitatesByOne, "ImitatesByOne.imitating: expected parameters (3,), got (1,)"),
    ):
        with pytest.raises(ConfigError) as caught:
            rehearse(replace(study, **{group: component(study.task)}))  # type: ignore[arg-type]
        assert str(caught.value).startswith(line)
        assert str(caught.value).isprintable()
    said = r"slower.*: Decides.step \(test_newcomers.py:\d+: it branches on a value.*kernels.py"
    with pytest.warns(simbias.core.StudyWarning, match=said):
        rehearse(replace(study, nominal=Decides(study.task)))  # type: ignore[arg-type]


def test_what_python_replaced_is_not_kept(point_mass: Study, tmp_path: Path) -> None:
    """A line says so; nor is a seed a generator."""
    with pytest.warns(simbias.core.StudyWarning, match="keeps only the config: components replaced in Pytho"):
        simbias.run_trial(replace(point_mass, seed=4), tmp_path / "other")
    ask = replace(point_mass, conditions=replace(point_mass.conditions, ask=lambda *_: True))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*keeps only the config")
        simbias.run_trial(ask, tmp_path / "asked")
    with pytest.raises(ValueError, match=r"^rng: expected numpy\.random\.default_rng\(seed\), got int$"):
        point_mass.experiment(np.zeros(3), 0)  # type: ignore[arg-type]


def test_an_own_policy_cannot_move_a_robot_beyond_its_limits(point_mass: Study) -> None:
    """From Python, a trial is refused as on the command line, and so is a single input; rounding is not."""
    study = replace(point_mass, policy=Unbounded(point_mass.task))
    with pytest.raises(ConfigError, match=r"^Unbounded.act: expected inputs within \[-5"):
        simbias.run_trial(study)
    with pytest.raises(HardwareError, match=r"^Unbounded.act: expected inputs within \[-5"):
        study.experiment(np.ones(3), np.random.default_rng(0))
    single = replace(study, policy=Single(point_mass.task))
    assert single.experiment(np.array([100.0, 0.0, 0.0]), np.random.default_rng(0)).frames > 0


def test_what_is_no_list_is_said_to_be_none(tmp_path: Path) -> None:
    for call, line in (
        (
            lambda: simbias.load("seed=3"),
            "overrides: expected a list of texts such as 'seed=3', got 'seed=3'",
        ),
        (lambda: simbias.load({"seed": 3}), "overrides: expected a list of texts such as 'seed=3', got {"),  # type: ignore[arg-type]
        (
            lambda: simbias.identify("a.csv", PENDULUM),
            "recordings: expected a list of files and folders, got",
        ),
        (
            lambda: simbias.identify([tmp_path], PENDULUM, held_out="a.csv"),
            "held_out: expected a list of files and folders, got 'a.csv'",
        ),
    ):
        with one_line(line):
            call()


def test_an_error_within_a_library_is_told_by_the_method_and_line_that_called_it() -> None:
    class Inverts(Bias):
        def fit(self, transitions: Transitions) -> FittedBias:
            return np.linalg.inv(np.zeros((2, 2)))  # type: ignore[return-value]

    no_data = Transitions.empty(2, 1)
    with pytest.raises(np.linalg.LinAlgError) as caught:
        Inverts().learn(no_data, [], cast(Nominal, None))  # which calls `fit`
    said = r"Inverts\.fit: expected a result, got LinAlgError: Singular matrix \(test_newcomers\.py:\d+\)"
    assert re.fullmatch(said, error_origin.with_origin(caught.value))


@pytest.mark.slow
def test_the_traceback_of_an_own_component_is_in_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    code = "from simbias.core import Nominal\nclass Mine(Nominal):\n"
    code += "    def __init__(self, task): self._x = task.mas\n    def step(self, x, u): return x\n"
    config = "_target_: mine_that_raises.Mine\n"
    write(tmp_path, {"conf/nominal/mine.yaml": config, "mine_that_raises.py": code})
    command = ["--config-dir", str(tmp_path / "conf"), "nominal=mine", "tracking=none"]
    assert main(command) == BAD_INPUT
    line = capsys.readouterr().err
    assert line.startswith("simbias: nominal: 'Bongoboard' object has no attribute 'mas' (traceback in ")
    (trace,) = tmp_path.glob("simbias-error-*.txt")
    assert "self._x = task.mas" in trace.read_text()


def test_a_state_that_is_no_number_has_failed_whatever_the_criteria_measure(point_mass: Study) -> None:
    """The criterion measures the position; the velocity is nan."""
    study = replace(point_mass, nominal=NaNVelocity(point_mass.task))  # type: ignore[arg-type]
    rollout = study.simulate(np.zeros(3))
    assert (rollout.failed_at, rollout.failure) == (1, NOT_A_NUMBER)
    assert study.task.words(NOT_A_NUMBER) == "not a number"
    np.testing.assert_array_equal(
        study.task.violated(np.array([[0.0, 0.0], [0.0, np.inf], [2.0, np.nan]])), [-1, 1, 0]
    )


def test_a_cost_that_is_no_number_names_its_class(point_mass: Study) -> None:
    for value, got in ((np.nan, "nan"), (np.array([2.0]), "[2.]")):
        record = run_trial(replace(point_mass, cost=Always(value)))
        assert record.summary.reason == f"ValueError: Always.of: expected a finite number, got {got}"


@pytest.mark.slow
def test_a_policy_that_is_tried_again_is_told_and_counted(point_mass: Study) -> None:
    text = shown(replace(point_mass, bias=NoBias(), method=Algorithm1(max_iterations=2)))
    assert "this is again the policy of iteration 0" in text
    assert text.index("again") > text.index("\n  0 ")

    def kinds(study: Study) -> set[str]:
        made = run_trial(replace(study, method=Algorithm1(max_iterations=2))).iterations
        return {remark.kind for remark in remarks.of_trial(made, study)}

    assert kinds(point_mass) == set()  # which learns
    assert kinds(replace(point_mass, bias=NoBias())) == {"a refuted policy was tried again"}
    flat, none = "all simulated policies cost the same", "experiments without a sample to learn from"
    samples = Thresholds(point_mass.task, residual=1e-6)
    assert {flat, none} <= kinds(replace(point_mass, cost=Always(2.0), samples=samples))


@pytest.mark.slow
def test_an_iteration_without_samples_says_why(point_mass: Study) -> None:
    spans: tuple[tuple[int | str, str], ...] = (
        (101, "the longest experiment has 100 frames, fewer than the 101 of one sample (2.02 s"),
        ("3 s", "the longest experiment has 100 frames, fewer than the 150 of one sample (3 s"),
        (1, "all 6 were rejected: residual 6"),
    )
    for window, why in spans:
        samples = Thresholds(point_mass.task, window=WindowLengths(true_state=window), residual=1e-6)
        text = shown(replace(point_mass, samples=samples, method=Algorithm1(max_iterations=2)))
        assert f"no samples to learn from: {why}" in text
    (remark,) = remarks.of_selection(Selection(Transitions.empty(2, 1), 70, 0, {}))
    assert remark.words == "no samples to learn from: none of 70 frames was sampled"


@pytest.mark.slow
def test_a_model_is_cleared_with_the_reason_once(point_mass: Study) -> None:
    text = shown(replace(point_mass, cost=Always(2.0), method=Algorithm1(max_iterations=3)))
    reason = "no policy costs less than Z_max = 1 in the corrected simulation (best of 40: 2)"
    assert (text.count(f"model cleared: {reason}"), text.count("model cleared")) == (1, 4)
    same = "all 40 simulated policies cost the same (2), so this one is arbitrary"
    assert text.count(same) == 1
    assert text.index(f"\n  0  {same}") < text.index("\n  0      2.000")  # before hardware is spent


def test_a_span_in_seconds_is_whole_frames(point_mass: Study) -> None:
    spans: dict[int | str, int] = {35: 35, "40 ms": 2, "0.2s": 10, "1 ms": 1, "0.05 s": 2, "70ms": 4}
    assert {span: frames_in(span, 0.02) for span in spans} == spans
    for wrong in ("'-1 ms'", "0", "abc"):
        with pytest.raises(ConfigError, match=r"^samples\.stride: must be "):
            simbias.load([f"samples.stride={wrong}", "tracking=none"])
    rollouts = [point_mass.experiment(np.array([4.0, 4.0, -2.0]), np.random.default_rng(1))]
    frames = Thresholds(point_mass.task, stride=2, window=WindowLengths(true_state=4), residual=None)
    seconds = Thresholds(
        point_mass.task, stride="40 ms", window=WindowLengths(true_state="80 ms"), residual=None
    )
    one, other = (each.select(rollouts, point_mass.nominal).transitions for each in (frames, seconds))
    np.testing.assert_array_equal(one.inputs, other.inputs)
    assert len(one) == 49


def test_the_screen_says_what_is_under_way(point_mass: Study) -> None:
    """A search, as long as it plans, too."""
    iteration, file = next(point_mass.run()), StringIO()
    console = Console(file=file, width=100, force_terminal=True, highlight=False)
    with TrialConsole(point_mass, console) as observer:
        assert "policy search" in file.getvalue()
        observer.searching(20, 3.0)
        observer.experimenting(np.zeros(3), np.zeros(2))
        observer._progress.refresh()
        last = file.getvalue().rpartition("policy search")[2]
        assert "hardware experiment 1 under way" in last
        assert "best 3" not in last
        observer.experimented(iteration.experiments[0])
        observer.iterated(iteration)
        row = cost_text(iteration.search.predicted_cost)
        assert "policy search" in (after := file.getvalue().rpartition(row)[2])
        assert "hardware experiment" not in after
        assert "failed" not in after
        cheap = replace(iteration.experiments[0], cost=0.1, failed_at=20, failure="distance")
        observer.iterated(replace(iteration, experiments=(cheap,)))
        short = replace(cheap, cost=0.1, failed_at=None, failure=None)
        with pytest.MonkeyPatch.context() as patch:  # as if the task decided
            patch.setattr(type(point_mass.task), "succeeds", lambda *_: False)
            observer.iterated(replace(iteration, experiments=(short,)))
        assert ", missed)" in file.getvalue()
        assert [cost_text(each) for each in (5.952, 0.1, 0.09996, 0.0009878)] == [
            "5.952",
            "0.100",
            "0.100",
            "0.000988",
        ]
        assert (
            f"{cost_text(0.1)} ({cheap.frames * point_mass.task.time_step:.2f} s, failed)" in file.getvalue()
        )


def test_config_yaml_in_an_own_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("seed: 3\n")
    with pytest.raises(ConfigError, match=r"config\.yaml: is not read; .* preset/NAME\.yaml"):
        simbias.load([], tmp_path)


def test_help_lists_what_is_in_an_own_folder(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    write(tmp_path, {"sweeps/mine.yaml": ""})
    for arguments in (["--help", "--config-dir", str(OWN_CONF)], ["--help", f"--config-dir={tmp_path}"]):
        with pytest.raises(SystemExit):
            main(arguments)
    first, second = capsys.readouterr().out.split("usage:")[1:]
    assert "  nominal        bongoboard | acrobot" in first
    assert "| point_mass" in first
    assert "| mine |" in second
