"""How often a policy search on the noise-aware nominal model converges, for every optimizer.

`python sweeps/studies/optimizers.py FOLDER [--seeds 50] [--jobs 2] [--steps 40000000] [--only NAME ...]`

Every search may simulate the same number of steps, and as many policies as it likes; its first 1000 policies
(N_in, Table I) are also judged alone. A seed draws the starts and the noise of the evaluation, the same for
all optimizers, and what the optimizer draws. `searches.csv` gets a row for each search as it ends: killed
and started again, only what is missing runs. `table.md` sums up.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pandas as pd
from joblib import Parallel, delayed

import simbias
from simbias.core import Objective
from simbias.core.proportions import wilson
from simbias.core.records import Array
from simbias.search.optimizer.nlopt import Algorithm
from simbias.sweep.tables import BLANK

GOOD = 10.0  # a cost Z below which a search has found a good policy
NEAR = 1.1  # times the seed's best known cost: the search has converged
STEPS = 1000 * 8 * 5000  # N_in policies in K rollouts of T frames: more than they need, as many fail early
EVALUATIONS = 1000  # N_in, Table I
MOST = 100_000  # evaluations; no search comes near, as even a hopeless policy costs several hundred steps
STUDY = [
    "tracking=none",
    "bias=none",
    "evaluation=robust",
    "hardware.noise.torque_variance=0.1",  # the ninth row of Table II
    "hardware.noise.angle_variance=1.6e-5",
    "hardware.noise.velocity_variance=1.6e-2",
]
DIRECTS = [name for name in get_args(Algorithm) if "DIRECT" in name]
OPTIMIZERS: Mapping[str, list[str]] = {
    **{name: ["optimizer=nlopt_direct", f"optimizer.algorithm={name}"] for name in DIRECTS},
    **{name: [f"optimizer={name}"] for name in ("nlopt_crs", "cma", "hybrid")},
    "cma, population 8": ["optimizer=cma", "optimizer.population=8"],
    "hybrid, population 16": ["optimizer=hybrid", "optimizer.population=16"],
}


@dataclass(eq=False)
class Watched:
    """An objective, policy by policy; it keeps how the best cost came down."""

    objective: Objective
    evaluations: int = 0
    best: float = np.inf
    improvements: list[tuple[int, int, float]] = field(default_factory=list)  # evaluations, steps, best cost

    @property
    def steps(self) -> int:
        """Simulated so far."""
        return self.objective.steps

    def __call__(self, theta: Array) -> float:
        cost = self.objective(theta)
        self.evaluations += 1
        if cost < self.best:
            self.best = cost
            self.improvements.append((self.evaluations, self.steps, cost))
        return cost

    def reached(self, cost: float) -> tuple[int | None, int | None]:
        """After how many evaluations and steps the best cost was below this one."""
        return next(((n, steps) for n, steps, best in self.improvements if best < cost), (None, None))

    def best_of_first(self, evaluations: int) -> float:
        """The best cost of so many evaluations."""
        return min(best for n, _, best in self.improvements if n <= evaluations)


def search(name: str, overrides: list[str], seed: int, budget: int) -> dict[str, Any]:
    """One search, as a row of searches.csv."""
    limits = [f"optimizer.max_evaluations={MOST}", f"optimizer.max_steps={budget}"]
    study = simbias.load([*STUDY, *overrides, *limits])
    scenario_rng, rng = np.random.default_rng(seed).spawn(2)
    watched = Watched(study.evaluation.objective(study.model(), study.cost, scenario_rng))
    began = time.perf_counter()
    optimum = study.optimizer.minimize(watched, *study.policy.bounds, rng, target_cost=study.cost.max_cost)
    balanced, good = watched.reached(study.cost.max_cost), watched.reached(GOOD)
    return {
        "optimizer": name,
        "seed": seed,
        "budget": budget,
        "best_cost": watched.best,
        "best_cost_of_1000": watched.best_of_first(EVALUATIONS),
        "evaluations": watched.evaluations,
        "steps": watched.steps,
        "evaluations_until_balanced": balanced[0],
        "steps_until_balanced": balanced[1],
        "evaluations_until_good": good[0],
        "steps_until_good": good[1],
        "stopped_by": optimum.stopped_by,
        "seconds": round(time.perf_counter() - began, 1),
    }


def rate(succeeded: pd.Series) -> str:
    """How many of how many, and Wilson's 95% interval of the share."""
    count, of = int(succeeded.sum()), len(succeeded)
    interval = wilson(count, of)
    return f"{count} of {of} ({100 * interval.low:.0f} to {100 * interval.high:.0f} %)"


def table(searches: pd.DataFrame) -> str:
    """The searches of each optimizer in a row, in markdown; last, the best search of each seed.

    Not every seed has a good policy: some of its starts may cost more than that whatever the policy.
    """
    best = searches.groupby("seed")["best_cost"].min()
    near = searches["best_cost"] <= NEAR * searches["seed"].map(best)
    near &= searches["steps_until_balanced"].notna()
    head = [
        f"optimizer, {searches['budget'].max() / 1e6:g}M steps",
        f"below {GOOD:g}",
        "of these, median steps until there",
        f"within {NEAR - 1:.0%} of the seed's best",
        "quartiles of the best cost",
        f"below {GOOD:g} in {EVALUATIONS} evaluations",
        "median cost then",
    ]
    lines = [f"| {' | '.join(head)} |", f"| :-- |{' --: |' * (len(head) - 1)}"]
    for name, own in searches.groupby("optimizer", sort=False):
        good = own["steps_until_good"].dropna()
        steps = f"{good.median() / 1e6:.1f}M" if len(good) else BLANK
        lines.append(
            f"| {name} | {rate(own['best_cost'] < GOOD)} | {steps} | {rate(near[own.index])} "
            f"| {quartiles(own['best_cost'])} | {rate(own['best_cost_of_1000'] < GOOD)} "
            f"| {own['best_cost_of_1000'].median():.3g} |"
        )
    lines.append(f"| the best of all | {rate(best < GOOD)} | | | {quartiles(best)} | | |")
    return "\n".join(lines) + "\n"


def quartiles(costs: pd.Series) -> str:
    """The three of them."""
    return " / ".join(f"{cost:.3g}" for cost in np.percentile(costs, [25, 50, 75]))


def main(arguments: argparse.Namespace) -> None:
    """Run the searches that are missing, keep each as it ends, and write the table."""
    path = arguments.folder / "searches.csv"
    kept = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=["optimizer", "seed", "budget"])
    if not kept["budget"].isin([arguments.steps]).all():
        sys.exit(f"{path} has searches with another budget than {arguments.steps} steps")
    done = set(zip(kept["optimizer"], kept["seed"], strict=True))
    missing = [(n, s) for s in range(arguments.seeds) for n in arguments.only if (n, s) not in done]
    rows = Parallel(n_jobs=arguments.jobs, return_as="generator_unordered")(
        delayed(search)(name, OPTIMIZERS[name], seed, arguments.steps) for name, seed in missing
    )
    for row in rows:
        new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, row.keys(), lineterminator="\n")
            if new:
                writer.writeheader()
            writer.writerow(row)
        print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    names = dict.fromkeys([*OPTIMIZERS, *kept["optimizer"]])
    order = {name: index for index, name in enumerate(names)}
    searches = pd.read_csv(path).sort_values(["optimizer", "seed"], key=lambda c: c.map(order).fillna(c))
    searches.to_csv(path, index=False, lineterminator="\n")
    (arguments.folder / "table.md").write_text(table(searches))
    print(table(searches), end="")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--steps", type=int, default=STEPS, help="of simulation, for each search")
    parser.add_argument("--only", nargs="+", choices=OPTIMIZERS, default=list(OPTIMIZERS), metavar="NAME")
    main(parser.parse_args())
