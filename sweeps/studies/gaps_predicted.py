"""What is learned from experiments on a gap: how well does it predict other experiments?

`python sweeps/studies/gaps_predicted.py FILE [--seeds 3] [--cells LABEL ...]` runs, on each cell of
`+sweep=gaps`, policies that imitate LQR of the nominal model and of draws of it. From three
experiments it learns parameters, a residual of the nominal model, and both; of three others, with other
policies and starts, it predicts windows of 0.1 s. An error is that of the last state, over the root mean
square change of each state in a window; `error` is its root mean square, over that of the nominal model.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from cells import cells, chosen
from joblib import Parallel, delayed

from simbias.config.build import build
from simbias.core import FittedBias, Nominal
from simbias.core.records import Rollout
from simbias.search.lqr import lqr_candidates
from simbias.simulation.open_loop import PredictionModel, Windows, predict
from simbias.trial.study import Study

DURATION = 0.1  # s
LEARNED = 3  # experiments, and as many that are predicted
MODELS = 3  # whose LQR is imitated: the most probable one, and draws
WAYS = ("nominal", "residual", "identified", "both")


def experiments(study: Study, seed: int) -> list[Rollout]:
    """Experiments with different policies from different starts, those that last for a window."""
    rng = np.random.default_rng(seed)
    policies = list(lqr_candidates(study.model(), MODELS))
    made: list[Rollout] = []
    for index in rng.permutation(len(policies)):
        rollout = study.hardware.run(study.policy, policies[index], study.task.draw_start(rng), rng)
        if rollout.frames * study.task.time_step >= 2 * DURATION:
            made.append(rollout)
    return made[: 2 * LEARNED]


def models(study: Study, learned: list[Rollout]) -> Iterator[tuple[Nominal, FittedBias | None]]:
    """What is learned in each way."""
    identified = study.identification.fit(study.nominal, learned)
    yield study.nominal, None
    yield study.nominal, study.bias.learn(study.no_data, learned, study.nominal)
    yield identified, None
    yield identified, study.bias.learn(study.no_data, learned, identified)


def predicted(label: str, seed: int, overrides: list[str]) -> list[dict[str, Any]]:
    """A row for each way to learn."""
    study = build(cells(["+sweep=gaps", "tracking=none", *overrides])[label].composition)
    made = experiments(study, seed)
    learned, others = made[: len(made) // 2], made[len(made) // 2 :]
    if not learned:
        return []
    some = Windows.of(others, round(DURATION / study.task.time_step), 1)
    change = np.sqrt(np.mean((some.means[:, -1] - some.states[some.starts]) ** 2, axis=0))
    rows = []
    for way, (nominal, bias) in zip(WAYS, models(study, learned), strict=True):
        errors = (predict([PredictionModel(nominal)], some, bias)[0, :, -1] - some.means[:, -1]) / change
        row = {"gap": label, "seed": seed, "learned": len(learned), "windows": len(errors), "way": way}
        rows.append(row | {"rms": float(np.sqrt(np.mean(errors**2)))})
    return [row | {"error": row["rms"] / rows[0]["rms"]} for row in rows]


def summary(table: pd.DataFrame) -> str:
    """A row for each gap: the mean errors, over the nominal model's, as markdown."""
    means = table.pivot_table(index="gap", columns="way", values="error", sort=False)[list(WAYS[1:])]
    lines = ["| gap | residual | identified | both |", "| :-- | --: | --: | --: |"]
    lines += [f"| {gap} | {' | '.join(f'{value:.2f}' for value in row)} |" for gap, row in means.iterrows()]
    return "\n".join(lines)


def main(arguments: argparse.Namespace) -> None:
    """Learn and predict, print the table and write the rows."""
    labels = chosen(["+sweep=gaps", *arguments.overrides], arguments.cells)
    made = Parallel(n_jobs=2)(
        delayed(predicted)(label, seed, arguments.overrides)
        for seed in range(arguments.seeds)
        for label in labels
    )
    table = pd.DataFrame([row for rows in made for row in rows])
    table.to_csv(arguments.file, index=False, float_format="%.4g", lineterminator="\n")
    print(summary(table))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("overrides", nargs="*", metavar="override")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument(
        "--cells", nargs="*", default=[""], help="only those whose labels begin with one of these"
    )
    main(parser.parse_intermixed_args())
