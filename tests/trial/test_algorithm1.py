"""Algorithm 1, line by line, on a robot whose components count and can be told what to do."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from point_mass import Distance, PointMass
from scripted import FRAMES, Listener, ScriptedHardware, ScriptedPrediction
from scripted import scripted as run_scripted

from simbias.core import FittedBias
from simbias.core.records import Iteration
from simbias.search.optimizer.nlopt import Nlopt
from simbias.trial.methods.algorithm1 import Algorithm1
from simbias.trial.study import Study

pytestmark = pytest.mark.usefixtures("uncompiled")


def scripted(study: Study, predicted: list[float], hardware: list[float], **options: Any) -> list[Iteration]:
    """Run with the costs that searches predict and experiments have, two an iteration; Z_max is 0.1875."""
    return run_scripted(study, Algorithm1(**options), predicted, hardware)


def test_success_ends_the_loop(point_mass: Study) -> None:
    """Lines 10-12, and Z_r is the maximum over the experiments (line 9)."""
    iterations = scripted(point_mass, [0.1] * 3, [0.9, 0.1, 0.15, 0.18, 0.0, 0.0])
    assert [i.succeeded for i in iterations] == [False, True]
    assert [i.hardware_cost for i in iterations] == pytest.approx([0.9, 0.18])
    assert [i.total_experiments for i in iterations] == [2, 4]


def test_failure_ends_after_n_out(point_mass: Study) -> None:
    """Line 3."""
    method = Algorithm1(max_iterations=2, experiments=3)
    assert (method.max_iterations, method.max_experiments) == (2, 6)
    iterations = scripted(point_mass, [0.1] * 2, [0.9] * 6, max_iterations=2, experiments=3)
    assert [i.index for i in iterations] == [0, 1]
    assert not iterations[-1].succeeded
    assert iterations[-1].total_experiments == 6


def test_data_accumulates(point_mass: Study) -> None:
    """Line 13: D is the union of all D_i; line 14: the next search is on g_D."""
    first, second, last = scripted(point_mass, [0.1] * 3, [0.9, 0.8, 0.7, 0.6, 0.0, 0.0])
    learned = [i.learning.data.inputs for i in (first, second, last)]
    assert [len(inputs) for inputs in learned] == [10, 20, 20]  # success learns no more (line 11)
    np.testing.assert_array_equal(learned[1][:10], learned[0])
    np.testing.assert_array_equal(learned[1][10:], second.learning.selection.transitions.inputs)
    assert not predicts_something(first.model.bias)
    assert predicts_something(second.model.bias)


def test_a_bad_search_clears_the_model(point_mass: Study) -> None:
    """Lines 6-8, then line 9 all the same; D is then what line 13 adds."""
    iterations = scripted(point_mass, [0.1, 0.19, 0.1], [0.9] * 4 + [0.0] * 2)
    assert [i.learning.reset for i in iterations] == [False, True, False]
    assert [len(i.learning.data) for i in iterations] == [10, 10, 10]
    assert [len(i.experiments) for i in iterations] == [2, 2, 2]
    at_limit = point_mass.cost.max_cost  # line 6 asks for more than Z_max, line 10 for less
    first, _ = scripted(point_mass, [at_limit, 0.1], [at_limit, 0.0, 0.0, 0.0])
    assert (first.learning.reset, first.succeeded) == (False, False)


def test_a_fall_in_the_last_frame_is_no_success(point_mass: Study) -> None:
    """Even where it costs nothing, as in Eq. 8, where c (T - t_fail) = 0."""

    class Falling(ScriptedHardware):
        def run(self, policy, theta, start, rng):
            rollout = super().run(policy, theta, start, rng)
            return replace(rollout, failed_at=rollout.frames, failure="distance")

    class Lenient(Distance):
        def of(self, rollout):
            return super().of(replace(rollout, failed_at=None))

    for hardware, succeeds in ((ScriptedHardware, True), (Falling, False)):
        study = replace(
            point_mass,
            task=PointMass(horizon=FRAMES),
            evaluation=ScriptedPrediction([0.1]),
            hardware=hardware([0.0, 0.0]),
            cost=Lenient(),
            method=Algorithm1(1),
        )
        (only,) = study.run()
        assert (only.hardware_cost, only.succeeded) == (0.0, succeeds)
        assert len(only.learning.data) == (0 if succeeds else 10)


@pytest.mark.slow
def test_another_optimizer_meets_the_same_starts_and_another_seed_others(hasty: Study) -> None:
    crs = Nlopt(algorithm="GN_CRS2_LM", max_evaluations=20, relative_tolerance=1e-6)
    changed = (replace(hasty, **each) for each in ({}, {"optimizer": crs}, {"seed": 1}))
    start, same, other = (next(study.run()).experiments[0].states[0] for study in changed)
    np.testing.assert_array_equal(same, start)
    assert other != pytest.approx(start)


def test_the_observer_hears_every_experiment_before_the_record(hasty: Study) -> None:
    listener = Listener()
    first = next(hasty.run(listener))
    names = [name for name, _ in listener.heard]
    assert names == [*["searching"] * (len(names) - 4), *2 * ["experimenting", "experimented"]]
    begun = [what for name, what in listener.heard if name == "experimenting"]
    ended = [what for name, what in listener.heard if name == "experimented"]
    assert ended == list(first.experiments)
    for (theta, start), rollout in zip(begun, ended, strict=True):
        np.testing.assert_array_equal(theta, rollout.parameters)
        np.testing.assert_array_equal(start, rollout.states[0])
    searches = [what for name, what in listener.heard if name == "searching"]
    assert searches == sorted(searches)
    assert searches[-1] >= first.search.optimum.evaluations


def predicts_something(bias: FittedBias) -> bool:
    mean, _ = bias.predict(np.array([[0.9, 0.9, 0.0]]))
    return bool(mean.any())
