"""What is learned on one engine: does it hold on the others?

`python sweeps/studies/engines.py FILE [--seeds 5] [override ...]` runs a trial for each seed on the
bongoboard in each engine, and tries its last policy from 20 starts that are the same everywhere, on every
engine.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from joblib import Parallel, delayed
from premise import STARTS, balanced_starts

import simbias

ENGINES = ("pymunk", "box2d", "mujoco_bongoboard")


def tried(engine: str, seed: int, overrides: Sequence[str]) -> dict[str, Any]:
    """A trial on an engine, and from how many starts its last policy balances on each."""
    chosen = ["tracking=none", *overrides, f"seed={seed}"]
    *_, last = simbias.load([*chosen, f"hardware={engine}"]).run()
    return {
        "learned on": engine,
        "seed": seed,
        "succeeded": last.succeeded,
        "experiments": last.total_experiments,
        **{
            other: balanced_starts(simbias.load([*chosen, f"hardware={other}"]), last.parameters)
            for other in ENGINES
        },
    }


def table(trials: pd.DataFrame) -> str:
    """Markdown: a row for each engine that was learned on."""
    lines = [
        f"| learned on | trials | succeeded | experiments | {' | '.join(ENGINES)} |",
        "| :-- | --: | --: | --: |" + " --: |" * len(ENGINES),
    ]
    for engine, own in trials.groupby("learned on", sort=False):
        held = [f"{own[other].sum() / (STARTS * len(own)):.0%}" for other in ENGINES]
        lines.append(
            f"| {engine} | {len(own)} | {own['succeeded'].sum()} | {own['experiments'].mean():.1f} | "
            f"{' | '.join(held)} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("overrides", nargs="*", metavar="override")
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_intermixed_args()
    trials = pd.DataFrame(
        Parallel(n_jobs=2)(
            delayed(tried)(engine, seed, arguments.overrides)
            for engine in ENGINES
            for seed in range(arguments.seeds)
        )
    )
    trials.to_csv(arguments.file, index=False, lineterminator="\n")
    print(table(trials))
