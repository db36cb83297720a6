"""How the cost of learning grows: `python sweeps/benchmarks/scaling.py FOLDER` measures and draws it.

With the number N of samples, of the exact and the sparse GP; with the horizon T; with the number of
evaluations of a policy search; with the number of jobs of a sweep. The samples are those of hardware
experiments; a figure is the median of some rounds, in turn. On one thread, but for the jobs.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numba
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

import simbias
from simbias.__main__ import main as command_line
from simbias.core import FittedBias
from simbias.core.records import Array, Transitions
from simbias.pictures import save
from simbias.pictures.elements.style import HARDWARE, SIMULATION, plain
from simbias.simulation.compiler import LANES
from simbias.trial.study import Study

SAMPLES = [50, 100, 200, 400, 571, 1000, 2000, 4000]
HORIZONS = [1250, 2500, 5000, 10000]
EVALUATIONS = [500, 1000, 2000, 4000]
JOBS = [1, 2, 4]
STEPS_OF_A_SEARCH = 3.8e6  # 1000 evaluations of the default search
NEVER = 1e-12  # a relative tolerance that ends no search before its last evaluation
ROUNDS = 3
LEARNERS = {"gp": HARDWARE, "sparse_gp": SIMULATION}


def load(*overrides: str) -> Study:
    """A study that no store keeps."""
    return simbias.load(["tracking=none", *overrides])


def stable_policy() -> Array:
    """A policy that balances the nominal model, and often the hardware: the last of the default trial."""
    return list(load("bias=sparse_gp").run())[-1].parameters


def recorded(theta: Array, count: int) -> Transitions:
    """So many samples of hardware experiments: with a policy that balances, and with such as fall."""
    study = load()
    rng = np.random.default_rng(0)
    data = study.no_data
    while len(data) < count:
        rollout = study.experiment(theta + rng.normal(scale=0.1, size=theta.shape), rng)
        data = data | study.samples.select([rollout], study.nominal).transitions
    order = rng.permutation(len(data))[:count]
    return Transitions(data.inputs[order], data.residuals[order])


def seconds(function: Callable[[], object]) -> float:
    """Wall time of a call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def over_samples(theta: Array) -> Iterator[dict[str, object]]:
    """Seconds to fit, and microseconds of a closed-loop step of rollouts that run in lockstep."""
    data = recorded(theta, max(SAMPLES))
    thetas, rounds = np.tile(theta, (LANES, 1)), range(ROUNDS)
    for n in SAMPLES:
        study = load(f"task.horizon={np.clip(1_000_000 // n, 200, 5000)}")
        starts = np.tile(study.task.start_mean, (LANES, 1))
        some = Transitions(data.inputs[:n], data.residuals[:n])
        learners = {name: load(f"bias={name}").bias for name in LEARNERS}
        fitted: dict[str, FittedBias] = {}
        fits: dict[str, list[float]] = {name: [] for name in LEARNERS}
        steps: dict[str, list[float]] = {name: [] for name in LEARNERS}
        for _ in rounds:
            for name, learner in learners.items():
                start = time.perf_counter()
                fitted[name] = learner.fit(some)
                fits[name].append(time.perf_counter() - start)
                simulator = study.simulator(fitted[name])
                start = time.perf_counter()
                frames = sum(rollout.frames for rollout in simulator.rollouts(thetas, starts))
                steps[name].append((time.perf_counter() - start) / frames)
        for name in LEARNERS:
            yield {
                "varied": "samples",
                "value": n,
                "bias": name,
                "inducing_points": fitted[name].diagnostics.get("inducing_points", n),
                "fit_seconds": np.median(fits[name]),
                "step_microseconds": 1e6 * np.median(steps[name]),
                "seconds": STEPS_OF_A_SEARCH * np.median(steps[name]),
            }


def over(varied: str, key: str, values: Sequence[int]) -> Iterator[dict[str, object]]:
    """Seconds of a policy search on the nominal model."""
    for value in values:
        study = load(f"{key}={value}", f"optimizer.relative_tolerance={NEVER}")
        evaluations = 0

        def search(study: Study = study) -> None:
            nonlocal evaluations
            rng = np.random.default_rng(0)
            objective = study.evaluation.objective(study.model(), study.cost, rng)
            optimum = study.optimizer.minimize(objective, *study.policy.bounds, rng, study.cost.max_cost)
            evaluations = optimum.evaluations

        times = [seconds(search) for _ in range(ROUNDS)]
        yield {"varied": varied, "value": value, "seconds": np.median(times), "evaluations": evaluations}


def over_jobs() -> Iterator[dict[str, object]]:
    """Seconds of a sweep of 32 short trials, workers' start included."""
    sweep = ["+sweep=smoke", "sweep.trials=16", "task.horizon=2000", "optimizer.max_evaluations=1000"]
    for jobs in JOBS:
        with tempfile.TemporaryDirectory() as folder:
            store = f"tracking.uri=sqlite:///{folder}/mlflow.db"
            yield {
                "varied": "jobs",
                "value": jobs,
                "seconds": seconds(
                    lambda store=store, jobs=jobs: command_line([*sweep, store, f"engine.n_jobs={jobs}"])
                ),
            }


def draw(rows: pd.DataFrame) -> Figure:
    """Four panels; only the samples' is logarithmic."""
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    panels = figure.subplots(2, 2)
    samples = rows[rows["varied"] == "samples"]
    for name, color in LEARNERS.items():
        chosen = samples[samples["bias"] == name]
        panels[0, 0].loglog(
            chosen["value"], chosen["step_microseconds"], "o-", color=color, label=f"bias={name}"
        )
    panels[0, 0].set(xlabel="samples N", ylabel="closed-loop step (µs)")
    panels[0, 0].set_xticks(SAMPLES, [str(n) for n in SAMPLES], rotation=45)
    panels[0, 0].minorticks_off()
    panels[0, 0].legend(frameon=False)
    for axes, varied, words in (
        (panels[0, 1], "horizon", "horizon T (frames)"),
        (panels[1, 0], "evaluations", "evaluations of a search"),
        (panels[1, 1], "jobs", "jobs"),
    ):
        chosen = rows[rows["varied"] == varied]
        axes.plot(chosen["value"], chosen["seconds"], "o-", color=SIMULATION, clip_on=False)
        axes.set(xlabel=words, xlim=(0, None), xticks=[0, *chosen["value"]], ylim=(0, None))
        axes.set_ylabel("policy search (s)" if varied != "jobs" else "sweep of 32 short trials (s)")
    for axes in panels.flat:
        axes.grid(alpha=0.3)
        plain(axes)
    return figure


def main(folder: Path) -> None:
    """Measure everything; print and keep it."""
    numba.set_num_threads(1)
    with threadpool_limits(1):
        rows = [
            *over_samples(stable_policy()),
            *over("horizon", "task.horizon", HORIZONS),
            *over("evaluations", "optimizer.max_evaluations", EVALUATIONS),
        ]
    rows += over_jobs()
    frame = pd.DataFrame(rows)
    frame.to_csv(folder / "scaling.csv", index=False, float_format="%.4g")
    save(draw(frame), folder / "scaling.png")
    print(frame.to_string(index=False, float_format="%.4g", na_rep=""))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    main(parser.parse_args().folder)
