"""A stream's costs are those of whole rollouts, whatever is asked for in between."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import get_num_threads, set_num_threads

import simbias
from simbias.core.records import Array, Transitions
from simbias.learning.bias.none import ZeroBias
from simbias.search.evaluation.nominal_start import CostOfOneRollout
from simbias.simulation.closed_loop import simulator
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.simulation.stream import NEEDED, Stream
from simbias.trial.study import Study

COUNT = 60
REMEMBERS = ["policy=dynamic_output_feedback", "policy.delay_seconds=0.005", "policy.constant=1.0"]
LAGS = ["nominal.uncertainty.lag=0.02", "nominal.uncertainty.delay=0.01"]


@pytest.fixture(
    scope="module", params=[[], ["bias=sparse_gp"], [*REMEMBERS, *LAGS]], ids=["none", "gp", "memory"]
)
def streamed(request: pytest.FixtureRequest) -> tuple[Study, CompiledSimulator, Array, Array]:
    """A study, its simulator, policies (k, p) that last for 1 to 300 frames, and their costs (k,)."""
    study = simbias.load(["tracking=none", "task.horizon=300", "nominal.foot_mass=1.0", *request.param])
    rng = np.random.default_rng(0)
    bias = ZeroBias(6)
    if "bias=sparse_gp" in request.param:
        inputs = rng.normal(size=(40, 7))
        bias = study.bias.fit(Transitions(inputs, 1e-4 * np.tanh(inputs @ rng.normal(size=(7, 6)))))
    model = study.model(bias)
    compiled = simulator(model)
    assert isinstance(compiled, CompiledSimulator)
    thetas = rng.uniform(*study.policy.bounds, (COUNT, study.policy.n_parameters))
    costs, frames = compiled.costs(study.cost, thetas, np.tile(study.task.start_mean, (COUNT, 1)))
    assert len(np.unique(frames)) > 10
    return study, compiled, thetas, costs


@pytest.mark.parametrize("threads", [1, 2])
@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_costs_are_those_of_whole_rollouts(
    streamed: tuple[Study, CompiledSimulator, Array, Array], threads: int, seed: int
) -> None:
    """Whichever policies are asked for in each call, and given up in the next."""
    study, compiled, thetas, costs = streamed
    rng, before = np.random.default_rng(seed), get_num_threads()
    set_num_threads(min(threads, before))
    try:
        stream, unknown = Stream(compiled, study.cost, study.task.start_mean), set(range(COUNT))
        while unknown:
            asked = rng.permutation(sorted(unknown))[: rng.integers(1, 33)]
            streamed_costs, frames = stream.costs(thetas[asked])
            known = frames >= 0
            assert known.sum() >= min(NEEDED, len(asked) // threads, 1)
            np.testing.assert_array_equal(streamed_costs[known], costs[asked[known]])
            unknown -= set(asked[known].tolist())
    finally:
        set_num_threads(before)


def test_rollouts_under_way_go_on(streamed: tuple[Study, CompiledSimulator, Array, Array]) -> None:
    """The last of those asked for again and again is known after so many steps as its rollout has."""
    study, compiled, thetas, _ = streamed
    stream, asked = Stream(compiled, study.cost, study.task.start_mean), list(range(COUNT))
    calls = 0
    while asked:
        known = stream.costs(thetas[asked])[1] >= 0
        asked = [number for number, ended in zip(asked, known, strict=True) if not ended]
        calls += 1
    assert calls <= COUNT // NEEDED + 1


def test_steps_are_counted_of_what_has_ended(streamed: tuple[Study, CompiledSimulator, Array, Array]) -> None:
    study, compiled, thetas, costs = streamed
    start = study.task.start_mean
    objective = CostOfOneRollout(compiled, study.cost, start)
    assert objective.speculate is not None
    streamed_costs, known = objective.speculate(thetas)
    frames = compiled.costs(study.cost, thetas, np.tile(start, (COUNT, 1)))[1]
    assert known.any()
    np.testing.assert_array_equal(streamed_costs[known], costs[known])
    assert objective.steps == frames[known].sum()


def test_plain_rollouts_end_together(streamed: tuple[Study, CompiledSimulator, Array, Array]) -> None:
    """Where NumPy simulates them, nothing is guessed in vain."""
    study = streamed[0]
    plain = PlainSimulator([study.model()], [None])
    assert CostOfOneRollout(plain, study.cost, study.task.start_mean).speculate is None
