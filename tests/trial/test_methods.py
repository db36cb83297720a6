"""What `python -m simbias check` finds wrong with a method, and what holds for all that ship."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from point_mass import InTheWind
from scripted import Guessing

import simbias
from simbias.core import Policy, platform
from simbias.core.errors import ConfigError
from simbias.core.records import Array, Rollout
from simbias.pictures.trial.comparison import in_simulation
from simbias.policy.output_feedback import OutputFeedback
from simbias.search.lqr import lqr_policies
from simbias.testing.conformance import verdicts
from simbias.trial.diagnostics import of_policy
from simbias.trial.methods.algorithm1 import Algorithm1
from simbias.trial.methods.lqr import Lqr
from simbias.trial.methods.model_based import ModelBased
from simbias.trial.run import read_trial, run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome, iteration_summary


class Gusty(InTheWind):
    """Draws from its generator, which an experiment that is replayed does not."""

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        rng.standard_normal()
        return super().run(policy, theta, start, rng)


@pytest.mark.slow
def test_what_is_wrong_is_one_line(point_mass: Study) -> None:
    for wrong, problem in (
        ({}, ""),
        ({"counts_from": 1}, "Guessing.run: expected 2 experiments so far, got 3"),
        ({"max_experiments": 3}, "Guessing.run: expected at most 3 experiments, got 4"),
        (
            {"shares_its_generator": True},
            "Guessing.run: expected each search and each experiment to have a generator of its own, got ",
        ),
        ({"draws_starts_anew": True}, "Guessing.run: expected the same trial from the same seed, got "),
        ({"breaks": True}, "ZeroDivisionError: of nothing"),
        ({"run": lambda *_: iter(())}, "Guessing.run yields no iteration"),
    ):
        method = Guessing()
        vars(method).update(wrong)
        study = replace(point_mass, method=method, hardware=Gusty(point_mass.task))  # type: ignore[arg-type]
        (verdict,) = verdicts(study, ["method"])
        assert problem in verdict.problem
        assert bool(problem) == bool(verdict.problem)
        assert "\n" not in verdict.problem


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_methods_that_ship_pass(hasty: Study) -> None:
    study = replace(hasty, policy=OutputFeedback(hasty.task))
    for method in (Algorithm1(2), ModelBased(2), Lqr()):
        assert [verdict.problem for verdict in verdicts(replace(study, method=method), ["method"])] == [""]


def test_no_method_knows_another() -> None:
    for file in (Path(simbias.__file__).parent / "trial" / "methods").glob("*.py"):
        assert "simbias.trial.methods" not in file.read_text(), file


def test_lqr_of_the_nominal_model_is_one_design(point_mass: Study) -> None:
    """After it there is no other policy to try, whether it succeeds or not."""
    study = replace(point_mass, policy=OutputFeedback(point_mass.task), method=Lqr(input_weight=1000.0))
    (only,) = study.run()
    np.testing.assert_array_equal(only.parameters, lqr_policies(study.model(), [1000.0])[0])
    assert (only.search, only.learning, len(only.experiments)) == (None, None, 2)
    assert only.model.nominal is study.nominal
    with pytest.raises(ConfigError) as caught:
        list(replace(point_mass, method=Lqr()).run())  # whose policy imitates none
    assert caught.value.key == "method"


@pytest.mark.usefixtures("uncompiled")
def test_a_policy_that_is_tried_again_is_told_without_a_search(point_mass: Study) -> None:
    """Where nothing can be identified, each design is the first one; last digits make no other."""
    method = Lqr(input_weight=1000.0, identified=True, max_iterations=2)
    calm = replace(point_mass, policy=OutputFeedback(point_mass.task), method=method)
    record = run_trial(calm)
    assert [each.succeeded for each in record.iterations] == [False, False]
    assert record.summary.diagnostics == ("a refuted policy was tried again",)
    assert record.summary.reason.startswith("Of the last policy, 4 of 4 experiments ")
    made = record.iterations[:1]
    nearly, other = (
        list(of_policy(made[0].parameters * (1.0 + d), made[0].model, None, made)) for d in (1e-9, 1e-3)
    )
    assert ([remark.kind for remark in nearly], other) == ([*record.summary.diagnostics], [])


@pytest.mark.usefixtures("uncompiled")
def test_the_method_in_the_readme_is_lqr_without_options(point_mass: Study) -> None:
    text = (Path(simbias.__file__).parent / "trial" / "README.md").read_text()
    exec(re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)[0], own := dict[str, Any]())
    study = replace(point_mass, policy=OutputFeedback(point_mass.task), method=own["Redesign"](2))
    assert [verdict.problem for verdict in verdicts(study, ["method"])] == [""]
    lqr = replace(study, method=Lqr(100.0, identified=True, max_iterations=2, sticking=False))
    for one, other in zip(study.run(), lqr.run(), strict=True):
        np.testing.assert_array_equal(one.parameters, other.parameters)
        assert (one.hardware_cost, one.succeeded) == (other.hardware_cost, other.succeeded)


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled", "plain_predictions")
def test_lqr_of_the_identified_model_is_designed_again(tmp_path: Path) -> None:
    """Until it balances two poles by a motor that is weaker than its model's; read back, all is as it was."""
    lqr = ["preset=double_cartpole", "method=lqr", "method.identified=true"]
    quick = ["identification.starts=1", "identification.rounds=1", "task.horizon=20"]  # it falls within 16
    study = simbias.load([*lqr, *quick, "tracking=none"])
    first, again = (run_trial(study, tmp_path / study.hash) for _ in range(2))
    assert first.outcome is Outcome.SUCCEEDED
    assert [iteration.succeeded for iteration in first.iterations] == [False, True]
    declared, identified = (iteration_summary(study, each, ()) for each in first.iterations)
    assert "estimates" not in declared
    assert identified["estimates"]
    assert {"identification/windows", "identification/share"} <= identified["metrics"].keys()
    names = [in_simulation(study, first.iterations, each, each.experiments[0]) for each in first.iterations]
    assert [each.name for each in names] == ["simulation: nominal model", "simulation: identified model"]
    for one, other in zip(first.iterations, again.iterations, strict=True):
        np.testing.assert_array_equal(one.parameters, other.parameters)
        np.testing.assert_array_equal(one.experiments[0].states, other.experiments[0].states)


@pytest.mark.slow
def test_a_computed_policy_is_read_back_on_another_platform(tmp_path: Path) -> None:
    """Where its last bits are others; on the trial's own they say that its code has changed."""
    study = simbias.load(["preset=cartpole", "method=lqr", "method.passes=3", "tracking=none"])
    record, experiment = run_trial(study, tmp_path), tmp_path / "0000_experiment.npz"
    assert (record.summary.outcome, record.summary.experiments) == ("succeeded", 3)
    with np.load(experiment) as kept:
        arrays = dict(kept)
    for factor, where, refused in (
        (1 + 1e-9, "here", True),
        (1 + 1e-9, "there", False),
        (1.1, "there", True),
    ):
        np.savez(experiment, **{**arrays, "parameters": factor * arrays["parameters"]})
        attempts = tmp_path / "attempts.jsonl"
        if where == "there":
            attempts.write_text(attempts.read_text().replace(platform.kind(), "another processor"))
        if refused:
            with pytest.raises(ConfigError, match="does not fit the trial"):
                read_trial(study, tmp_path)
        else:
            assert read_trial(study, tmp_path).summary.experiments == record.summary.experiments
