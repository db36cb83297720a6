"""How many of `identify`'s 90% intervals hold the truth, trusted and not.

`python sweeps/studies/identify_coverage.py FOLDER [--seeds 10] [--jobs 2]`

A seed draws a robot from the prior of a preset's nominal model, and noise. Two recordings of this robot under
inputs designed as by `excite` are simulated, sampled, written as CSV files and given to `identify`, in frames
as long as the sampling interval. In some cases velocities are estimated from positions, or recorded late, a
spring acts that the model lacks, or inputs jump every 0.1 s, where predictions begin. `coverage.csv` gets a
row for each robot as it ends: killed and started again, only what is missing runs. A table is printed.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from joblib import Parallel, delayed

import simbias
from simbias.core import Nominal, markdown
from simbias.core.parameters import values_at
from simbias.core.records import Array
from simbias.learning.identification.identified import Identified
from simbias.recordings.assessment import UNEXPLAINED
from simbias.recordings.excitation import Designer
from simbias.recordings.study import prepared
from simbias.trial.study import Study

RECORDINGS, SECONDS = 2, 5.0  # of each robot; s of each
TRAJECTORIES = 20  # of which `excite` chooses one
STEP = 0.01  # s, frames in which robots are simulated
PENDULUM = Path(__file__).with_name("pendulum_rk4.xml")
NOISE = {"position": 5e-4, "angle": 5e-4, "velocity": 0.02}  # standard deviations, in m, rad, m/s or rad/s
RATES = (100, 50, 20)  # Hz
CASE = ["robot", "hz", "velocities", "spring", "inputs"]
JUMPS, LARGEST = 0.1, 0.4  # s between jumps of inputs; largest input, of its limit
COUNTED = ["intervals that hold the truth", "trusted ones that do"]
COUNTED += ["errors over what is explained: median (range)", "models said to lack something"]


class Robot(NamedTuple):
    """A preset with limits, and a spring at the joint of its last input."""

    overrides: list[str]
    spring: float  # N/m, N m/rad


ROBOTS = {
    "cart-pole": Robot(["preset=cartpole_swingup", "hardware.safety.states={d_angle: 15}"], 5.0),
    "pendulum": Robot(
        ["preset=pendulum_swingup", f"nominal.file={PENDULUM}", "hardware.safety.inputs={torque: 2}"], 0.2
    ),
    "two-link arm": Robot(["preset=double_pendulum", "hardware.safety.states={vel1: 10, vel2: 12}"], 0.5),
}


class Case(NamedTuple):
    """What is recorded of which robot."""

    robot: str
    hz: int
    velocities: str = "recorded"  # or estimated, or late
    spring: str = "no"
    inputs: str = "designed"  # or jump


LATE = {"2 ms late": 0.002, "5 ms late": 0.005}  # s
CASES = [
    case
    for robot in ROBOTS
    for case in [
        *(Case(robot, hz, velocities) for velocities in ("recorded", "estimated") for hz in RATES),
        *(Case(robot, 100, late) for late in LATE),
        *(Case(robot, hz, spring="yes") for hz in (100, 20)),
        Case(robot, 100, inputs="jump"),
    ]
]


def options(robot: str, frame: float) -> list[str]:
    """Overrides for a robot in frames of so many seconds."""
    common = ["identification=posterior", "tracking=none", f"task.time_step={frame}"]
    common.append(f"task.horizon={round(SECONDS / frame)}")
    return [*ROBOTS[robot].overrides, *common]


def excitation(robot: str, hz: int, inputs: str) -> list[Array]:
    """The inputs (T, m) of each recording."""
    study, rngs = prepared(simbias.load(options(robot, 1 / hz))), np.random.default_rng(0).spawn(RECORDINGS)
    if inputs == "jump":
        limit, held = LARGEST * study.task.input_limit, round(JUMPS * hz)
        size = (round(SECONDS / JUMPS), len(limit))
        return [np.repeat(limit * rng.uniform(-1, 1, size), held, axis=0) for rng in rngs]
    noise = np.array([NOISE[state.kind] for state in study.task.states])
    designer = Designer(study, study.nominal, noise)
    return [designer.design(SECONDS, TRAJECTORIES, rng).rollout.inputs for rng in rngs]


def motion(study: Study, robot: Nominal, inputs: Array, spring: float) -> Array:
    """The robot's states (k + 1, n) under inputs (k, m), until it would fail."""
    states, model_state = [study.task.start_mean], np.zeros(robot.state_size)
    for u in inputs:
        pull = np.zeros(len(u))
        pull[-1] = spring * (states[-1] - states[0])[len(u) - 1]
        x, model_state = robot.advance(states[-1], u - pull, model_state)
        states.append(x)
    made = np.array(states)
    failed = np.flatnonzero(study.task.violated(made) >= 0)
    return made[: failed[0]] if len(failed) else made


def recording(
    study: Study, robot: Nominal, inputs: Array, case: Case, rng: np.random.Generator
) -> pd.DataFrame:
    """A table as a lab would write it: one row a sample, with the input that acts from then on."""
    task, hold = study.task, round(1 / (case.hz * STEP))
    spring = ROBOTS[case.robot].spring if case.spring == "yes" else 0.0
    true = motion(study, robot, np.repeat(inputs, hold, axis=0), spring)
    passed = STEP * np.arange(len(true))
    t = passed[::hold][: len(inputs)]
    columns = {"time": t}
    for i, state in enumerate(task.states):
        velocity = state.kind == "velocity"
        late = LATE.get(case.velocities, 0.0) if velocity else 0.0
        noise = NOISE[state.kind] * rng.standard_normal(len(t))
        if not (velocity and case.velocities == "estimated"):
            columns[state.name] = np.interp(t - late, passed, true[:, i]) + noise
    return pd.DataFrame(columns | {u.name: inputs[: len(t), i] for i, u in enumerate(task.inputs)})


def measure(case: Case, seed: int, excited: list[Array]) -> dict[str, Any]:
    """One robot, as a row of coverage.csv."""
    rng = np.random.default_rng(seed)
    study = prepared(simbias.load(options(case.robot, STEP)))
    prior = Identified.of_prior(study.nominal)
    z = prior.draw_coordinates(rng)
    robot, truth = prior.at(z), values_at(prior.parameters, z)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(action="ignore"):
        for i, inputs in enumerate(excited):
            made = recording(study, robot, inputs, case, rng)
            made.to_csv(Path(folder) / f"{i}.csv", index=False)
        found = simbias.identify([folder], options(case.robot, 1 / case.hz))
    held = [
        finding.estimate.low <= true <= finding.estimate.high
        for finding, true in zip(found.findings, truth, strict=True)
    ]
    trusted = [finding.trusted for finding in found.findings]
    return {
        **case._asdict(),
        "seed": seed,
        "intervals": len(held),
        "hold": int(sum(held)),
        "trusted": sum(trusted),
        "trusted_hold": int(np.sum(np.logical_and(held, trusted))),
        "over_explained": round(float(np.nanmax([each.unexplained() for each in found.predictions])), 3),
    }


def table(rows: pd.DataFrame, by: list[str] = CASE) -> str:
    """The robots of each case in a row, in markdown; without `robot` in `by`, all robots together."""
    lines = []
    for case, own in rows.groupby(by, sort=False):
        sums, ratios = own.sum(numeric_only=True), own["over_explained"]
        lines.append(
            [
                *map(str, case),
                f"{sums['hold']:.0f} of {sums['intervals']:.0f}",
                f"{sums['trusted_hold']:.0f} of {sums['trusted']:.0f}",
                f"{ratios.median():.1f} ({ratios.min():.1f} to {ratios.max():.1f})",
                f"{(ratios > UNEXPLAINED).sum()} of {len(own)}",
            ]
        )
    return markdown.table([*by, *COUNTED], lines)


def main(arguments: argparse.Namespace) -> None:
    """Measure what is missing, keep each row as it ends, and print the table."""
    path = arguments.folder / "coverage.csv"
    kept = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=[*CASE, "seed"])
    done = set(kept[[*CASE, "seed"]].itertuples(index=False, name=None))
    missing = [(case, s) for s in range(arguments.seeds) for case in CASES if (*case, s) not in done]
    places = list(dict.fromkeys((case.robot, case.hz, case.inputs) for case, _ in missing))
    designed = Parallel(n_jobs=arguments.jobs)(delayed(excitation)(*place) for place in places)
    inputs = dict(zip(places, designed, strict=True))
    made = Parallel(n_jobs=arguments.jobs, return_as="generator_unordered")(
        delayed(measure)(case, seed, inputs[case.robot, case.hz, case.inputs]) for case, seed in missing
    )
    for row in made:
        pd.DataFrame([row]).to_csv(path, mode="a", header=not path.exists(), index=False)
        print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    order = {case: index for index, case in enumerate(CASES)}
    rows = pd.read_csv(path)
    rows["case"] = [order[Case(*each)] for each in rows[CASE].itertuples(index=False, name=None)]
    rows = rows.sort_values(["case", "seed"]).drop(columns="case")
    rows.to_csv(path, index=False)
    print(table(rows), table(rows, CASE[1:]), sep="\n", end="")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=10, help="robots of each case")
    parser.add_argument("--jobs", type=int, default=2)
    main(parser.parse_args())
