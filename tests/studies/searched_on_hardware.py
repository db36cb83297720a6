"""What policies could do on a hardware if experiments cost nothing.

`python tests/studies/searched_on_hardware.py FILE [--seeds 5] [--evaluations 500] [override ...]` searches a
policy on sampled models and goes on from it with CMA-ES on the hardware itself, where a policy costs the mean
from eight starts; for each seed it tells in how many of 20 other starts either balances. The hardware has
separate feet if nothing is overridden.

Where the policy of sampled models may be far from any good one, `--everywhere` searches all of the box
instead, by `optimizer=hybrid`, and `--screening 2` judges a policy that falls from the first two starts by
these. `--sweep NAME` does all that for each cell of a sweep, `--cell LABEL` for those whose label begins so:

    python tests/studies/searched_on_hardware.py gaps.csv --sweep gaps --seeds 1 --evaluations 2000 \
        --everywhere --screening 2
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from premise import STARTS, balanced_starts

from simbias.config import compose
from simbias.config.build import build
from simbias.records import Array
from simbias.study import Study
from simbias.sweep.grid import expand

SEARCHED_STARTS = 8
DEVIATION = 0.05  # of the search on hardware at first, in units of the box's width
SEPARATE = ["hardware.feet=separate"]
SIMULATED = ["evaluation=robust_models", "optimizer=hybrid"]
NEARBY = ["optimizer=cma", f"optimizer.initial_deviation={DEVIATION}"]
EVERYWHERE = ["optimizer=hybrid"]


def study_of(overrides: Sequence[str], sweep: str | None, cell: str) -> Study:
    """The study of these overrides, or of a sweep's cell."""
    chosen = ["tracking=none", "bias=none", *overrides]
    if sweep is None:
        return build(compose(chosen))
    cells = {" ".join(each.labels): each for each in expand([f"+sweep={sweep}", *chosen]).cells}
    return build(cells[cell].composition)


def searched(seed: int, cell: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Both searches of a seed, and what their policies are worth."""
    overrides = arguments.overrides or ([] if arguments.sweep else SEPARATE)
    study = study_of([*overrides, *SIMULATED], arguments.sweep, cell)
    on_hardware = EVERYWHERE if arguments.everywhere else NEARBY
    limit = f"optimizer.max_evaluations={arguments.evaluations}"
    real = study_of([*overrides, *on_hardware, limit], arguments.sweep, cell)
    scenario_rng, search_rng, start_rng, rng = np.random.default_rng(seed).spawn(4)
    box = study.policy.bounds
    objective = study.evaluation.objective(study.model(), study.cost, scenario_rng)
    simulated = study.optimizer.minimize(objective, *box, search_rng, study.cost.max_cost)
    starts = [real.task.draw_start(start_rng) for _ in range(SEARCHED_STARTS)]

    def cost(theta: Array) -> float:
        """The mean over the starts, each with its own noise."""
        costs: list[float] = []
        for i, x in enumerate(starts):
            rollout = real.hardware.run(real.policy, theta, x, np.random.default_rng(i))
            costs.append(real.cost.of(rollout))
            if len(costs) == arguments.screening and min(costs) > real.cost.max_cost:
                break
        return float(np.mean(costs))

    found = real.optimizer.minimize(cost, *box, rng, real.cost.max_cost, [simulated.parameters])
    return {
        **({"cell": cell} if cell else {}),
        "seed": seed,
        "simulated_cost": simulated.cost,
        "simulated_balances": balanced_starts(real, simulated.parameters),
        "hardware_cost": found.cost,
        "hardware_balances": balanced_starts(real, found.parameters),
        "starts": STARTS,
    }


def main(arguments: argparse.Namespace) -> None:
    """Search for every cell and seed, print the table and write it."""
    cells = [""]
    if arguments.sweep:
        labels = [" ".join(cell.labels) for cell in expand([f"+sweep={arguments.sweep}"]).cells]
        cells = [label for label in labels if label.startswith(arguments.cell)]
    rows = Parallel(n_jobs=2)(
        delayed(searched)(seed, cell, arguments) for cell in cells for seed in range(arguments.seeds)
    )
    table = pd.DataFrame(rows)
    table.to_csv(arguments.file, index=False, float_format="%.4g", lineterminator="\n")
    print(table.to_string(index=False))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("overrides", nargs="*", metavar="override")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--evaluations", type=int, default=500, help="of policies on the hardware")
    parser.add_argument(
        "--everywhere", action="store_true", help="not only near the policy of sampled models"
    )
    parser.add_argument(
        "--screening", type=int, default=SEARCHED_STARTS, help="starts, if it falls from all of them"
    )
    parser.add_argument("--sweep", help="whose cells to search for")
    parser.add_argument("--cell", default="", help="only cells whose labels begin with this")
    main(parser.parse_intermixed_args())
