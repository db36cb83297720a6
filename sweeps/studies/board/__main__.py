"""Predict published runs of controllers on a real double pendulum from recordings of the robot.

    python sweeps/studies/board CHECKOUTS [--check]

CHECKOUTS is a folder of checkouts of two repositories of github.com/dfki-ric-underactuated-lab, each in a
folder of its name: double_pendulum (commit 1e8544e) and real_ai_gym_leaderboard (81ea5bc). `board.yaml` says
which runs are predicted, what is learned from, and what counts. It writes `draws.csv`, a row for each way,
run and draw, `board.csv`, a row for each way and run, and `table.md`.

With `--check`, it only prints how far commands are from those recorded, in the first run of each set.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from learned import angle_noise, draws, numbers, recordings, robot
from rollouts import Loop, Published, predict, published
from tables import of_runs, summary
from threadpoolctl import threadpool_limits

from simbias.core.records import Array

HERE = Path(__file__).parent
LEARNED = {"one": 1, "two": 2, "five": 5}  # recordings


def rows(board: dict[str, Any], checkouts: Path, sets: dict[str, Published]) -> Iterator[dict[str, Any]]:
    """A row for each way, run and draw, and for each run as recorded."""
    rig, known = robot(board, checkouts), recordings(board, checkouts)
    count, seconds = board["draws"], board["seconds"]
    for name, own in sets.items():
        for run, recorded in zip(own.names, own.recorded, strict=True):
            yield {"way": "recorded", "set": name, "run": run} | _row(recorded.outcomes(seconds), 0)
    for way in ("nominal", "lab", *LEARNED):
        rng = np.random.default_rng(board["seed"])
        learned = known[: LEARNED.get(way, len(known))]
        if way in LEARNED:
            parameters = draws(rig, learned, board["zero"], count, rng)
        else:
            parameters = np.tile(numbers(rig.lab if way == "lab" else rig.prior)[:, None], count)
        noise = angle_noise(learned)
        loops = [Loop(own, count, noise, seconds, board["furthest"], rng) for own in sets.values()]
        kernel, memory = rig.prior.kernel, rig.prior.state_size
        assert kernel is not None
        made = predict(kernel, memory, parameters, loops, seconds)
        for (name, own), runs in zip(sets.items(), made, strict=True):
            outcomes = runs.outcomes(seconds)
            for lane in range(len(own.names) * count):
                run, draw = divmod(lane, count)
                yield {"way": way, "set": name, "run": own.names[run], "draw": draw} | _row(outcomes, lane)


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
    found = list[dict[str, Any]]()
    for way, own in groupby(rows(board, checkouts, sets), key=itemgetter("way")):
        found += own
        pd.DataFrame(found).to_csv("draws.csv", index=False, float_format="%.4g")
        print(way, file=sys.stderr, flush=True)
    runs = of_runs(pd.DataFrame(found))
    runs.to_csv("board.csv", index=False, float_format="%.4g")
    text = summary(runs)
    Path("table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
