"""An attack on all that comes from outside, of so many minutes: is anything but refused in one line, or run?

`python sweeps/studies/attack FOLDER [--minutes 12] [--seed 0]` writes FOLDER/attack_<seed>.csv, how many
cases of each surface ended how, FOLDER/finds_<seed>.csv, a row for each that ended as none should, and
FOLDER/ran_<seed>.csv, the values and forms that ran, for a person to judge. A case is drawn by the seed, but
how many there is time for depends on the machine.

A trial that runs for long, as it was told to, is interrupted after some seconds, and has to end then.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # whose threads no fork has
STUDIES = Path(__file__).resolve().parents[1]
TESTS = STUDIES.parents[1] / "tests"
sys.path[:0] = [str(STUDIES), str(TESTS), str(TESTS / "support")]

import pandas as pd

from attack.surfaces import SURFACES, template
from attack.values import form_case, value_case
from attack.verdict import Result, Verdict, attempt

SHARES = {  # of the time
    "values": 0.24,
    "forms": 0.08,
    "stores": 0.07,
    "files": 0.04,
    "hardware, trial": 0.05,
    "hardware, sweep": 0.04,
    "kills": 0.05,
    "strangers": 0.03,
    "controllers": 0.12,
    "experiments": 0.06,
    "disks": 0.09,
    "together": 0.05,
    "archives": 0.04,
    "words": 0.04,
    "code": 0.08,
    "recordings": 0.08,
}

JUDGED = ["values", "forms", "code", "recordings"]  # surfaces of which a person reads what ran


def cases(surface: str, rng: random.Random, work: Path) -> Iterator[Result]:
    """Results of cases of a surface, without end."""
    while True:
        if surface == "values":
            case, command, key = value_case(rng)
            yield attempt(surface, case, command, key=key)
        elif surface == "forms":
            yield attempt(surface, *form_case(rng))
        else:
            yield from SURFACES[surface](rng, work)


def attack(minutes: float, seed: int, only: list[str]) -> Iterator[Result]:
    """Results of all surfaces in turns, by their shares of the time."""
    spent = dict.fromkeys(only or SHARES, 0.0)
    with tempfile.TemporaryDirectory(prefix="attack-template-") as name:
        work = template(Path(name))
        sources = {surface: cases(surface, random.Random(f"{seed} {surface}"), work) for surface in spent}
        end = time.monotonic() + 60 * minutes
        while time.monotonic() < end:
            surface = min(spent, key=lambda each: spent[each] / SHARES[each])
            began = time.monotonic()
            yield next(sources[surface])
            spent[surface] += time.monotonic() - began


def main() -> None:
    """Attack, print finds as they come, and write what came of it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--minutes", type=float, default=12.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", action="append", default=[], choices=list(SHARES))
    parsed = parser.parse_args()
    parsed.folder.mkdir(parents=True, exist_ok=True)
    results: list[Result] = []
    for result in attack(parsed.minutes, parsed.seed, parsed.only):
        results.append(result)
        if result.verdict.find:
            print(result, flush=True)
    table = pd.DataFrame([asdict(result) for result in results])
    counts = table.groupby(["surface", "verdict"]).agg(cases=("case", "size"), seconds=("seconds", "sum"))
    counts.round(1).to_csv(parsed.folder / f"attack_{parsed.seed}.csv")
    finds = table[[result.verdict.find for result in results]]
    finds.to_csv(parsed.folder / f"finds_{parsed.seed}.csv", index=False)
    ran = table[table["surface"].isin(JUDGED) & (table["verdict"] == Verdict.RAN)]
    ran[["surface", "case", "status"]].to_csv(parsed.folder / f"ran_{parsed.seed}.csv", index=False)
    print(counts["cases"].unstack(fill_value=0).to_string())
    print(f"{len(results)} cases, {len(finds)} finds")
    sys.stdout.flush()
    os._exit(1 if len(finds) else 0)  # threads that strangers left may wait for ever


if __name__ == "__main__":
    main()
