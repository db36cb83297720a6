"""What policies could do on a hardware if experiments cost nothing.

`python sweeps/studies/searched_on_hardware.py FILE [--seeds 5] [--evaluations 500] [override ...]` searches a
policy on sampled models and goes on from it with CMA-ES on the hardware itself, where a policy costs the mean
from eight starts; for each seed it tells in how many of 20 other starts either balances. The hardware has
separate feet if nothing is overridden.

`--sweep NAME` goes on from the last policy of a trial of each of the sweep's cells instead, `--cells LABEL
...` of those whose labels begin so. Regulators need `--deviation 0.002`: their gains depend on each other.
With `--screening 2`, a policy that falls from the first two starts is judged by these:

    python sweeps/studies/searched_on_hardware.py on_hardware.csv --sweep gaps --cells "slope 0.05" \
        --seeds 1 --evaluations 2000 --deviation 0.002 --screening 2
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from cells import cells, chosen
from joblib import Parallel, delayed
from premise import STARTS, balanced_starts

from simbias.config import compose
from simbias.config.build import build
from simbias.core.records import Array
from simbias.trial.study import Study

SEPARATE = ["hardware.feet=separate"]
SIMULATED = ["evaluation=domain_randomization", "optimizer=hybrid", "bias=none"]


def study_of(overrides: Sequence[str], sweep: str | None, cell: str) -> Study:
    """The study of these overrides, or of a sweep's cell."""
    overrides = ["tracking=none", *overrides]
    if sweep is None:
        return build(compose(overrides))
    return build(cells([f"+sweep={sweep}", *overrides])[cell].composition)


def simulated(
    study: Study, scenario_rng: np.random.Generator, search_rng: np.random.Generator
) -> tuple[Array, float]:
    """A policy that is optimal on sampled models, and its cost there."""
    objective = study.evaluation.objective(study.model(), study.cost, scenario_rng)
    optimum = study.optimizer.minimize(objective, *study.policy.bounds, search_rng, study.cost.max_cost)
    return optimum.parameters, optimum.cost


def learned(study: Study) -> tuple[Array, float]:
    """The last policy of a trial, and its predicted cost."""
    *_, last = study.run()
    return last.parameters, last.search.predicted_cost


def searched(seed: int, cell: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Both searches of a seed, and what their policies are worth."""
    sweep, overrides = arguments.sweep, arguments.overrides
    limits = [f"optimizer.max_evaluations={arguments.evaluations}"]
    limits += [f"optimizer.initial_deviation={arguments.deviation}"]
    scenario_rng, search_rng, start_rng, rng = np.random.default_rng(seed).spawn(4)
    if sweep:
        theta, cost_there = learned(study_of([*overrides, f"seed={seed}"], sweep, cell))
    else:
        overrides = overrides or SEPARATE
        theta, cost_there = simulated(
            study_of([*SIMULATED, *overrides], None, cell), scenario_rng, search_rng
        )
    real = study_of([*overrides, "optimizer=cma", *limits], sweep, cell)
    starts = [real.task.draw_start(start_rng) for _ in range(arguments.starts)]

    def cost(theta: Array) -> float:
        """The mean over the starts, each with its own noise."""
        costs: list[float] = []
        for i, x in enumerate(starts):
            rollout = real.hardware.run(real.policy, theta, x, np.random.default_rng(i))
            costs.append(real.cost.of(rollout))
            if len(costs) == arguments.screening and min(costs) > real.cost.max_cost:
                break
        return float(np.mean(costs))

    found = real.optimizer.minimize(cost, *real.policy.bounds, rng, real.cost.max_cost, [theta])
    return {
        **({"cell": cell} if cell else {}),
        "seed": seed,
        "simulated_cost": cost_there,
        "simulated_balances": balanced_starts(real, theta),
        "hardware_cost": found.cost,
        "hardware_balances": balanced_starts(real, found.parameters),
        "starts": STARTS,
    }


def main(arguments: argparse.Namespace) -> None:
    """Search for every cell and seed, print the table and write it."""
    labels = [""]
    if arguments.sweep:
        labels = chosen([f"+sweep={arguments.sweep}", *arguments.overrides], arguments.cells)
    rows = Parallel(n_jobs=2)(
        delayed(searched)(seed, cell, arguments) for cell in labels for seed in range(arguments.seeds)
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
    parser.add_argument("--deviation", type=float, default=0.05, help="of CMA-ES, over the box's width")
    parser.add_argument("--starts", type=int, default=8, help="of which a policy costs the mean")
    parser.add_argument("--screening", type=int, default=None, help="so many, if it falls from all of them")
    parser.add_argument("--sweep", help="whose cells to search for")
    parser.add_argument(
        "--cells", nargs="*", default=[""], help="only those whose labels begin with one of these"
    )
    main(parser.parse_intermixed_args())
