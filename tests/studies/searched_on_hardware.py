"""What policies could do on a hardware if experiments cost nothing.

`python tests/studies/searched_on_hardware.py FILE [--seeds 5] [--evaluations 500] [override ...]` searches a
policy on sampled models and goes on from it with CMA-ES on the hardware itself, where a policy costs the mean
from eight starts; for each seed it tells in how many of 20 other starts either balances. The hardware has
separate feet if nothing is overridden.
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

import simbias
from simbias.records import Array

SEARCHED_STARTS = 8
DEVIATION = 0.05  # of the search on hardware at first, in units of the box's width
SEPARATE = ["hardware.feet=separate"]
SIMULATED = ["evaluation=robust_models", "optimizer=hybrid"]
ON_HARDWARE = ["optimizer=cma", f"optimizer.initial_deviation={DEVIATION}"]


def searched(seed: int, evaluations: int, overrides: Sequence[str]) -> dict[str, Any]:
    """Both searches of a seed, and what their policies are worth."""
    common = ["tracking=none", "bias=none", *overrides]
    study = simbias.load([*common, *SIMULATED])
    real = simbias.load([*common, *ON_HARDWARE, f"optimizer.max_evaluations={evaluations}"])
    scenario_rng, search_rng, start_rng, rng = np.random.default_rng(seed).spawn(4)
    box = study.policy.bounds
    objective = study.evaluation.objective(study.model(), study.cost, scenario_rng)
    simulated = study.optimizer.minimize(objective, *box, search_rng, study.cost.max_cost)
    starts = [real.task.draw_start(start_rng) for _ in range(SEARCHED_STARTS)]

    def cost(theta: Array) -> float:
        """The mean over the starts, each with its own noise."""
        rollouts = [
            real.hardware.run(real.policy, theta, x, np.random.default_rng(i)) for i, x in enumerate(starts)
        ]
        return float(np.mean([real.cost.of(rollout) for rollout in rollouts]))

    found = real.optimizer.minimize(cost, *box, rng, real.cost.max_cost, [simulated.parameters])
    return {
        "seed": seed,
        "simulated_cost": simulated.cost,
        "simulated_balances": balanced_starts(real, simulated.parameters),
        "hardware_cost": found.cost,
        "hardware_balances": balanced_starts(real, found.parameters),
        "starts": STARTS,
    }


def main(arguments: argparse.Namespace) -> None:
    """Search for every seed, print the table and write it."""
    overrides = arguments.overrides or SEPARATE
    rows = Parallel(n_jobs=2)(
        delayed(searched)(seed, arguments.evaluations, overrides) for seed in range(arguments.seeds)
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
    main(parser.parse_intermixed_args())
