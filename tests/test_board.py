"""The study of published runs: weights, controllers, the loop and its scores, on files made here."""

import json
import os
import pickle
import re
import sys
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from conftest import ROOT
from texts import write

import simbias
from simbias.core.errors import ConfigError

STUDIES = ROOT / "sweeps" / "studies"
BOARD = yaml.safe_load((STUDIES / "board" / "board.yaml").read_text())


@pytest.fixture(autouse=True)
def modules(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("rigs", "board"):
        monkeypatch.syspath_prepend(STUDIES / name)
        for file in (STUDIES / name).glob("[!_]*.py"):
            monkeypatch.delitem(sys.modules, file.stem, raising=False)


def test_weights_are_read_without_running_what_a_file_says(tmp_path: Path) -> None:
    import weights

    rng = np.random.default_rng(0)
    shapes = {"log_lengthscales": (6,), "centers": (9, 6), "w": (1, 9)}
    saved = [{name: rng.normal(size=shape) for name, shape in shapes.items()} for _ in range(2)]
    (tmp_path / "policy.np").write_bytes(pickle.dumps(saved))
    for own, (scales, centres, w) in zip(
        saved, weights.of_basis_functions(tmp_path / "policy.np"), strict=True
    ):
        np.testing.assert_array_equal(scales, np.exp(own["log_lengthscales"]))
        np.testing.assert_array_equal(centres * scales, own["centers"] / scales * scales)
        np.testing.assert_array_equal(w, own["w"][0])

    tensors = {"mu.weight": np.float32([[1, 2], [3, 4], [5, 6]]), "mu.bias": np.float32([7, 8, 9])}
    with zipfile.ZipFile(tmp_path / "policy.pth", "w") as archive:
        named = {name: ("storage", str(i)) for i, name in enumerate(tensors)}
        archive.writestr("archive/data.pkl", pickle.dumps(named, protocol=2))
        for i, values in enumerate(tensors.values()):
            archive.writestr(f"archive/data/{i}", values.tobytes())
    with zipfile.ZipFile(tmp_path / "model.zip", "w") as archive:
        archive.write(tmp_path / "policy.pth", "policy.pth")
    ((W, b),) = weights.of_network(tmp_path / "model.zip", ["mu"])
    np.testing.assert_array_equal(W, tensors["mu.weight"].T)
    np.testing.assert_array_equal(b, tensors["mu.bias"])


def test_tvlqr_of_rest_at_the_top_is_lqr(tmp_path: Path) -> None:
    from controllers import GOAL, Lqr, Tvlqr

    Q, R, limits, times = np.eye(4), np.eye(2), np.array([5.0, 0.0]), 0.0005 * np.arange(4000)
    rest = dict.fromkeys(("pos2", "vel1", "vel2", "tau1", "tau2"), 0.0) | {"pos1": np.pi}
    pd.DataFrame({"time": times} | rest).to_csv(tmp_path / "rest.csv")
    tvlqr = Tvlqr(tmp_path / "rest.csv", 0.0005 * Q, 0.0005 * R, np.eye(4), limits)
    x = GOAL + 0.01 * np.random.default_rng(0).normal(size=(5, 4))
    expected = Lqr(Q, R, limits, 1e6).command(x, 0.0)
    assert np.abs(expected).max() > 0.01
    np.testing.assert_allclose(tvlqr.command(x, 0.1), expected, rtol=0.03)
    np.testing.assert_array_equal(Lqr(Q, R, limits, 0.0).command(x, 0.0), 0.0)


@pytest.mark.slow
def test_the_loop_commands_after_what_was_measured_a_period_ago() -> None:
    """Models in lanes are those of one lane; pushes come on top of commands within limits."""
    from learned import numbers, robot
    from rollouts import Loop, Published, Runs, predict

    class Constant:
        def command(self, x: np.ndarray, t: float) -> np.ndarray:
            return np.tile([9.0, -0.1], (len(x), 1)) + 0.0 * x[:, :2]

    rig = robot(BOARD, ROOT)
    start = Runs(np.array([0.0, 0.002]), np.full((2, 1, 4), 0.1), np.zeros((2, 1, 2)), np.array([2]))
    pushes = np.zeros((50, 2))
    pushes[25:, 1] = 0.3
    limits = {"most": [2.0, 0.5], "fastest": 1e3, "rate": 500.0}

    own = Published(limits, lambda *_: Constant(), ["a", "b"], [start, start], [pushes, 0.0 * pushes], 500.0)
    loop = Loop(own, 2, np.zeros(2), 0.1, 1e3, np.random.default_rng(0))
    models = [rig.lab, rig.prior]
    parameters = np.stack([numbers(model) for model in models], axis=1)
    (runs,) = predict(rig.prior.kernel, rig.prior.state_size, parameters, [loop], 0.1)
    assert runs.states.shape == (50, 4, 4)
    for lane in range(4):
        x, states = np.array([0.1, 0.1, 0.0, 0.0]), []
        for k in range(50):
            states.append(x)
            push = pushes[k] if lane < 2 else 0.0
            x = models[lane % 2].step(x, np.array([2.0, -0.1]) + push)
        np.testing.assert_allclose(runs.states[1:, lane], states[:-1], atol=1e-5)
    np.testing.assert_allclose(runs.commands, np.tile([2.0, -0.1], (50, 4, 1)), atol=1e-6)


def test_outcomes_are_the_boards() -> None:
    """The second lane falls again, the third one's loop stops early."""
    from rollouts import Runs

    times = 0.01 * np.arange(1000)
    states = np.zeros((1000, 3, 4))
    states[400:, :, 0] = np.pi
    states[900:, 1, 0] = 0.0
    runs = Runs(times, states, np.zeros((1000, 3, 2)), np.array([1000, 1000, 700]))
    outcomes = runs.outcomes(10.0)
    np.testing.assert_array_equal(outcomes["success"], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(outcomes["up"], [6.0, 5.0, 3.0])
    swung_up_at_4 = 1.0 - np.tanh(np.pi * 4.0 / 20.0) / 5
    np.testing.assert_allclose(outcomes["score"], [swung_up_at_4, 0.0, 0.0])


def test_tables_tell_what_predictions_are_worth() -> None:
    """Of sets of which none to three of four runs succeed: right, and the opposite."""
    from tables import of_runs, summary

    rows = []
    for index, name in enumerate(("acrobot a", "acrobot b", "pendubot a", "pendubot b")):
        for run in range(4):
            success = float(run < index)
            for way, draws, made in (
                ("recorded", 1, success),
                ("right", 9, success),
                ("wrong", 9, 1 - success),
            ):
                own = {"way": way, "set": name, "run": run, "success": made, "up": 5.0 * made, "score": made}
                rows += [own] * draws
    lines = [line.split(" | ") for line in summary(of_runs(pd.DataFrame(rows))).splitlines()]
    right, wrong = (next(line for line in lines if line[0] == f"| {way}") for way in ("right", "wrong"))
    assert float(right[1]) == pytest.approx(0.05**2, abs=1e-3)
    assert float(wrong[1]) == pytest.approx(0.95**2, abs=1e-3)
    assert (right[4:6], wrong[4:6]) == (["0.00", "100%"], ["5.00", "0%"])
    assert right[6].startswith("1.00 (")
    assert wrong[6].startswith("-1.00 (")


@pytest.mark.slow
def test_a_scored_policy_is_the_one_in_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its controller gives the torques that the score is of; the plant is the one whose LQR is taken."""
    import controllers
    import score
    from plant import PLANT, derivatives

    monkeypatch.setattr(score, "SECONDS", 0.1)
    study = simbias.load(["preset=pendubot_swingup", "task.time_step=0.004", "task.horizon=2000"])
    lower, upper = study.policy.bounds
    theta = np.random.default_rng(0).uniform(0.3 * lower, 0.3 * upper)
    scored = score.simulate(
        score.Asked(study.policy, study.task, theta), [score.Scenario("none")], 0, np.random.default_rng(0)
    )
    theirs = ModuleType("double_pendulum.controller.abstract_controller")
    theirs.AbstractController = type("AbstractController", (), {"init": lambda self: self.init_()})
    monkeypatch.setitem(sys.modules, "double_pendulum", ModuleType("double_pendulum"))
    monkeypatch.setitem(sys.modules, "double_pendulum.controller", ModuleType("double_pendulum.controller"))
    monkeypatch.setitem(sys.modules, theirs.__name__, theirs)
    names: dict[str, Any] = {}
    exec(score.controller_file(study.policy, study.task, theta, 0, "ours"), names)
    made = [
        names["controller"].get_control_output_(x[0], t)
        for x, t in zip(scored.states[:-1], scored.times, strict=False)
    ]
    assert np.abs(made).max() > 0.1
    np.testing.assert_allclose(made, scored.commands[:-1, 0], atol=1e-9)

    x, u = np.random.default_rng(1).normal(size=(5, 4)), np.random.default_rng(2).normal(size=(5, 2))
    accelerations = derivatives(x.T, u.T, PLANT)[2:]
    np.testing.assert_allclose(np.column_stack(accelerations), controllers._accelerations(x, u), rtol=1e-10)


@pytest.mark.slow
def test_a_search_for_the_time_up_begins_after_resets(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """At a network that gives the same torques with more units."""
    import plant
    import score
    import uptime

    for module in (plant, score):
        monkeypatch.setattr(module, "MINUTE", 3.0)
    monkeypatch.setattr(plant, "RESETS", 2)
    monkeypatch.setattr(uptime, "SEEDS", range(2))
    board = ["preset=acrobot_board", "tracking=none"]
    study, larger = (simbias.load([*board, f"policy.units={units}"]) for units in (3, 5))
    theta = np.random.default_rng(0).uniform(-0.1, 0.1, study.policy.n_parameters)
    grown, x = uptime.grown(theta, larger), np.random.default_rng(1).normal(size=(9, 4))
    small, large = (
        policy.act(parameters, x, 0.0, np.zeros((9, policy.state_size)))[0]
        for policy, parameters in ((study.policy, theta), (larger.policy, grown))
    )
    np.testing.assert_allclose(small, large, atol=1e-12)

    file = tmp_path / "policy.json"
    file.write_text(json.dumps({"parameters": grown.tolist()}))
    content = uptime.preset("acrobot", uptime.law_of(study, theta), file)
    write(tmp_path, {"preset/up.yaml": f"# @package _global_\n{yaml.safe_dump(content, sort_keys=False)}"})
    begun = simbias.load(["preset=up", "policy.units=5", "tracking=none"], tmp_path)
    begun.method.check(begun)
    starts = np.array(content["task"]["starts"])
    assert len(starts) == 4  # after two resets of each of two seeds
    drawn = np.array([begun.task.draw_start(np.random.default_rng(seed)) for seed in range(20)])
    assert np.abs(drawn[:, None] - starts).max(axis=2).min(axis=1).max() < 3.0  # rad/s, six deviations


def test_robustness_counts_kinds_of_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """At rest at the top nothing needs a torque; the plant of the first level is their first one."""
    import score

    monkeypatch.setattr(score, "SECONDS", 0.01)
    each = score.scenarios(0, np.random.default_rng(0))
    assert len(each) == 722
    assert {one.plant[0] for one in each if one.kind == "model" and one.level == 0} >= {
        ("c_1", -0.2),
        ("m_2", 0.75 * score.PLANT["m_2"]),
    }
    assert max(abs(size) for one in each for _, _, size in one.pushes) <= 5.0
    rates = score.robustness(lambda x, t: np.zeros(len(x)), 0, 0)
    assert set(rates.values()) == {0.0}
    late = score.Scenario("delay", delay=0.004)
    runs = score.simulate(lambda x, t: 1.0 + x[:, 0], [late], 0, np.random.default_rng(0))
    assert runs.states[-2, 0, 0] > 0.0
    np.testing.assert_array_equal(runs.commands[2:-1, 0, 0], 1.0 + runs.states[:-3, 0, 0])


@pytest.mark.slow
def test_uptime_counts_what_the_policy_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reset holds a robot where it is: nobody is asked, and nothing is up."""
    import score
    from plant import PLANT, derivatives, gravity

    asked: list[Any] = []
    x = [*np.random.default_rng(0).uniform(-3.0, 3.0, (2, 5)), 0.0, 0.0]
    np.testing.assert_allclose(derivatives(x, gravity(x, PLANT), PLANT)[2:], 0.0, atol=1e-9)

    def nothing(x: Any, t: float, own: Any = True) -> Any:
        asked.append(own)
        return np.zeros(len(x))

    monkeypatch.setattr(score, "MINUTE", 2.0)
    monkeypatch.setattr(score, "resets", lambda seed: (np.full((15, 2), seed), np.array([1.0, np.inf])))
    shares = score.uptime(nothing, 0, [0, 0])
    assert shares.tolist() == [0.0, 0.0]  # held where it hangs
    held = [k for k, own in enumerate(asked) if not own.all()]
    assert held == list(range(500, 500 + len(held)))
    assert len(held) == 101  # as their scripts: until their clock exceeds 0.2 s


def test_the_fastest_plans_that_are_published_begin_where_resets_end() -> None:
    import fastest
    from plant import RESET, STEP, resets

    published = pd.read_csv(ROOT / "sweeps" / "results" / "board" / "fastest_pendubot.csv")
    for one in published[1:].sample(5, random_state=0).itertuples():
        x, up = fastest.after_reset(resets(one.seed)[0][one.reset - 1])
        np.testing.assert_allclose([one.angle_1, one.angle_2, one.d_angle_1, one.d_angle_2], x, atol=1e-4)
        assert one.down == pytest.approx(RESET + STEP - up + one.seconds, abs=2e-4)


THEIRS = ["preset=pendubot_trajectory", "hardware=their_simulator", "tracking=none"]


@pytest.mark.slow
def test_a_checkout_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    conf, checkout = STUDIES / "board" / "conf", f"hardware.checkout={tmp_path}"
    with pytest.raises(ConfigError, match=rf"checkout: {tmp_path} has no src/python/double_pendulum"):
        simbias.load([*THEIRS, checkout], conf)
    with pytest.raises(ConfigError, match=r"task\.time_step: expected a multiple of 0\.001 s, got 0\.0055 s"):
        simbias.load([*THEIRS, checkout, "task.time_step=0.0055"], conf)


@pytest.mark.slow
@pytest.mark.skipif("DOUBLE_PENDULUM" not in os.environ, reason="DOUBLE_PENDULUM names no checkout of theirs")
def test_their_simulator_and_our_model_agree() -> None:
    """With the lab's parameters; friction is steep at rest, and their steps are shorter."""
    import their_simulator

    study = simbias.load(["preset=pendubot_trajectory", "tracking=none", "nominal.sub_step=0.0005"])
    theirs, joint = their_simulator._simulator(Path(os.environ["DOUBLE_PENDULUM"]), "first", 0.0)
    x = np.array([np.pi, 0.1, 0.0, 0.0])
    running = their_simulator._Running(study.task, theirs, joint, 5, x)
    plant = theirs.plant
    names = ("mass_1", "mass_2", "centre_1", "centre_2", "inertia_1", "inertia_2", "damping_1", "damping_2")
    names += ("friction_1", "friction_2", "rotor_inertia")
    assert tuple(each.name for each in study.nominal.parameters) == names
    values = [*plant.m, *plant.com, *plant.I, *plant.b, *plant.coulomb_fric, plant.Ir]
    ours = study.nominal.with_parameters(np.array(values))
    for k in range(100):
        u = np.array([3.0 * np.sin(0.1 * k)])
        running.step(u)
        x = ours.step(x, u)
    np.testing.assert_allclose(running.state(), x, atol=2e-3)


def test_published_scores_are_those_of_the_published_policies() -> None:
    """The table is from the CSV; one run of the pendubot's first policy gives its performance again."""
    import score
    import searches

    folder = ROOT / "sweeps" / "results" / "board"
    rows, text = pd.read_csv(folder / "searches.csv"), (folder / "HOW.md").read_text()
    assert rows.groupby("robot")["seed"].apply(list).to_dict() == {
        robot: [*range(1, 16)] for robot in score.DRIVEN
    }
    rows["fresh"] = rows["seed"] > 10  # a batch that tested the rule of choice
    for (robot, fresh), own in rows.groupby(["robot", "fresh"]):
        robustness = own["robustness"]
        told = f"{robustness.mean():.3f} ({robustness.min():.3f} to {robustness.max():.3f})"
        chosen = own.loc[own["development"].idxmax()]
        seed = f": seed {chosen['seed']}, holds {chosen['development']:.0%}" if fresh else " |"
        assert f"{told} | **{chosen['robustness']:.3f}**{seed}" in text, (robot, fresh)
    study = searches.study_of("pendubot")
    law = score.Asked(study.policy, study.task, searches.parameters(rows.iloc[0]))
    assert score.performance(law, score.DRIVEN.index("pendubot")) == pytest.approx(
        rows["performance"][0], abs=1e-3
    )


def test_published_scores_of_what_was_learned_are_in_the_table() -> None:
    """Its numbers are from the CSV."""
    folder = ROOT / "sweeps" / "results" / "board"
    text = (folder / "HOW.md").read_text()
    rows = pd.read_csv(folder / "learned.csv").query("kind == 'trajectory'")
    counts = rows.groupby(["robot", "policy"]).size().to_dict()
    assert counts == {("acrobot", "first"): 10, ("acrobot", "last"): 10, ("pendubot", "last"): 10}
    cells = [("acrobot", "last"), ("acrobot", "first"), ("pendubot", "last")]  # the table's columns
    means = rows.groupby(["robot", "policy"])[["robustness", "robustness_with_gap"]].mean().loc[cells]
    for name, head in zip(means, ("**robustness**", "robustness with the gap"), strict=True):
        (line,) = (each for each in text.splitlines() if each.startswith(f"| {head} | ") and " (" in each)
        told = [float(mean) for mean in re.findall(r"(\S+) \(", line)]
        assert told == pytest.approx(list(means[name]), abs=6e-4)


def test_a_scenario_with_the_gap_keeps_what_it_says_itself() -> None:
    from plant import FRICTION
    from score import Scenario
    from score_learned import gap_of

    noise = {"velocity_variance": 0.01}
    hardware = {"compensated": 0.9, "response": 0.3, "delay": 1, "noise": noise}
    changed = gap_of(hardware, 0.004, 1)
    one = changed(Scenario("delay", delay=0.02, plant=(("c_2", -0.2),)))
    assert (one.delay, one.velocity_noise) == (0.02, pytest.approx(0.1))
    assert one.response == pytest.approx(0.51)
    assert dict(one.plant) == FRICTION | {"c_1": pytest.approx(0.016), "c_2": -0.2}
    assert changed(Scenario("none")).delay == 0.004
