"""Predict published runs of controllers on a real double pendulum from recordings of the robot.

    python sweeps/studies/board CHECKOUTS [--check]

CHECKOUTS is a folder of checkouts of github.com/dfki-ric-underactuated-lab/double_pendulum (commit 1e8544e) and
.../real_ai_gym_leaderboard (81ea5bc), each in a folder of its name. `board.yaml` says which runs are predicted,
what is learned from, and what counts. It writes `board.csv`, a row for each way and run, and `table.md`.

With `--check`, only the differences of commands are printed, from those recorded of the first run of each set.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from rollouts import COMMANDS, STATES, Loop, Published, predict, published
from tables import summary
from threadpoolctl import threadpool_limits

from simbias.core import Nominal
from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified
from simbias.recordings.noise import noise_of

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent / "rigs"))
from loading import Rig, declared, load  # noqa: E402 (of the study beside this one)

LEARNED = {"one": 1, "two": 2, "five": 5}  # recordings


def robot(board: dict[str, Any], checkouts: Path) -> Rig:
    """The robot, with uncertain motors."""
    motors = [
        f"+identification.motors.tau{joint}.{key}={value}"
        for joint in (1, 2)
        for key, value in board["motors"].items()
    ]
    rig = declared()["design_C.1"]
    return load(
        rig | {"development": [], "composition": [*rig["composition"], *motors]}, checkouts, test=False
    )


def recordings(board: dict[str, Any], checkouts: Path) -> list[Rollout]:
    """What is learned from: states under commands. A row's state was measured when the last command was given."""
    found = []
    for file in board["recordings"]["files"]:
        table = pd.read_csv(checkouts / board["recordings"]["folder"] / file)
        states, commands = table[STATES].to_numpy()[1:], table[COMMANDS].to_numpy()[:-2]
        found.append(Rollout(states, commands, measured=states, sensed=True))
    return found


def draws(rig: Rig, known: Sequence[Rollout], zero: float, count: int, rng: np.random.Generator) -> Array:
    """Parameters (p, count) of kernels of models drawn from the posterior, with zeros like those identified."""
    fitted = rig.study.identification.fit(rig.study.nominal, known)
    assert isinstance(fitted, Identified)
    each = [fitted.of_recording(index).estimates for index in range(len(known))]
    zeros = np.array([[e.value for e in own if e.name.endswith(".zero")] for own in each])
    model, own = fitted.elsewhere(), [parameter.of_recording for parameter in fitted.parameters]
    z = model.mode[:, None] + model.spread @ rng.standard_normal((model.spread.shape[1], count))
    z[own] *= np.sqrt(np.mean(zeros**2, axis=0))[:, None] / zero
    print(
        {e.name: (round(e.low, 4), round(e.value, 4), round(e.high, 4)) for e in model.estimates},
        zeros.round(3),
    )
    return np.stack([_numbers(model.at(coordinates)) for coordinates in z.T], axis=1)


def _numbers(model: Nominal) -> Array:
    """The parameters (p,) of a model's kernel."""
    assert model.kernel is not None
    return np.asarray(model.kernel.parameters)


def rows(board: dict[str, Any], checkouts: Path, sets: dict[str, Published]) -> Iterator[dict[str, Any]]:
    """A row for each way, run and draw, and for each run as recorded."""
    rig, known, count, seconds = (
        robot(board, checkouts),
        recordings(board, checkouts),
        board["draws"],
        board["seconds"],
    )
    for name, own in sets.items():
        for run, recorded in zip(own.names, own.recorded, strict=True):
            yield {"way": "recorded", "set": name, "run": run} | _row(recorded.outcomes(seconds), 0)
    for way in ("nominal", "lab", *LEARNED):
        rng = np.random.default_rng(board["seed"])
        learned = known[: LEARNED.get(way, len(known))]
        if way in LEARNED:
            parameters = draws(rig, learned, board["zero"], count, rng)
        else:
            parameters = np.tile(_numbers(rig.lab if way == "lab" else rig.prior)[:, None], count)
        noise = noise_of(learned)
        loops = [Loop(own, count, noise, seconds, board["furthest"], rng) for own in sets.values()]
        kernel, memory = rig.prior.kernel, rig.prior.state_size
        assert kernel is not None
        for (name, own), made in zip(
            sets.items(), predict(kernel, memory, parameters, loops, seconds), strict=True
        ):
            outcomes = made.outcomes(seconds)
            for lane in range(len(own.names) * count):
                run, draw = divmod(lane, count)
                yield {"way": way, "set": name, "run": own.names[run], "draw": draw} | _row(outcomes, lane)
        print(way, file=sys.stderr, flush=True)


def _row(outcomes: dict[str, Array], lane: int) -> dict[str, float]:
    return {name: float(values[lane]) for name, values in outcomes.items()}


def check(sets: dict[str, Published]) -> None:
    """Print how far commands are from those recorded, in N m, in the first run of each set."""
    for name, own in sets.items():
        run, controller = own.recorded[0], own.controller(1, np.random.default_rng(0))
        most = np.array(own.declared["most"])
        made = [controller.command(x, t) for x, t in zip(run.states, run.times, strict=True)]
        wrong = np.abs(np.clip(np.array(made), -most, most) - run.commands)
        print(f"{name}: median {np.median(wrong):.1e}, at most {wrong.max():.1e} N m")


@threadpool_limits.wrap(limits=1, user_api="blas")
def main() -> None:
    """Write the tables to the current folder."""
    parser = argparse.ArgumentParser(prog="board")
    parser.add_argument("checkouts", type=Path)
    parser.add_argument(
        "--check", action="store_true", help="only compare controllers with recorded commands"
    )
    arguments = parser.parse_args()
    board = yaml.safe_load((HERE / "board.yaml").read_text())
    checkouts = arguments.checkouts.resolve()
    sets = {name: published(each, checkouts) for name, each in board["sets"].items()}
    if arguments.check:
        return check(sets)
    table = pd.DataFrame(rows(board, checkouts, sets))
    table.to_csv("board.csv", index=False, float_format="%.4g")
    text = summary(table)
    Path("table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
