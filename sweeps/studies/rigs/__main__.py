"""Identify public robots from their recordings, and predict recordings that nothing was chosen on.

    python sweeps/studies/rigs CHECKOUTS [--test] [--rigs NAME ...] [--ways NAME ...]

CHECKOUTS is a folder of checkouts of the repositories that `rigs.yaml` names, each in a folder of its name.
That file also says which recordings may be looked at (development) and which are predicted once, at the end
(`--test`). In development, each other recording is predicted by what is learned from one, and each by what is
learned from all others together; at the end, test recordings are by what is learned from one, and from all
development recordings.

Measured are, at each horizon, from measured states under measured inputs: errors of all states over those of
the lab's own identified model, a geometric mean over states; how many errors lie in 90% regions; how many
nats less surprising an error is than under the lab's model (medians over predictions), with regions whose
size comes from the recordings that were learned from; and the seconds of processor time of learning.

An encoder is switched on at a robot at rest, which friction keeps away from where it would hang. So each
recording has zeros of its own: they are identified with the robot, and of others the prior is known.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from loading import Rig, declared, load
from ways import WAYS, lab, timed

from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified
from simbias.recordings.horizons import HORIZONS, inside, ratio, surprises

COMPARED = (0.1, 0.5)  # s
ONE, SEVERAL = "one", "several"  # recordings that are learned from


def cases(rig: Rig) -> Iterator[tuple[str, str, dict[str, Rollout], list[Rollout]]]:
    """One or several, a name, the recordings that are learned from, and those that are predicted."""
    development, test = rig.development, list(rig.test.values())
    for name, rollout in development.items():
        rest = {other: each for other, each in development.items() if other != name}
        if test or rest:
            yield ONE, name, {name: rollout}, test or list(rest.values())
        if len(rest) > 1 and not test:
            yield SEVERAL, f"all but {name}", rest, [rollout]
    if test and len(development) > 1:
        yield SEVERAL, "all", development, test


def rows(rig: Rig, ways: Sequence[str]) -> Iterator[dict[str, Any]]:
    """A row for each case, way to learn, and horizon."""
    for number, name, known, left in cases(rig):
        learned, reference = list(known.values()), lab(rig, list(known.values()))
        for way in ways:
            found, seconds = timed(WAYS[way], rig, learned)
            zeros = [_zeros(model) for model in found.own] if isinstance(found.own[0], Identified) else ""
            for horizon in HORIZONS:
                k = rig.study.task.frames(horizon)
                wrong, of_lab = (each.errors(left, k) for each in (found, reference))
                covariances, labs = (each.covariances(learned, left, k) for each in (found, reference))
                if not len(wrong):
                    continue
                yield {
                    "number": number,
                    "learned": name,
                    "way": way,
                    "seconds": horizon,
                    "ratio": ratio(wrong, of_lab),
                    "coverage": float(np.mean(inside(wrong, covariances))),
                    "nats": float(
                        np.median(surprises(of_lab, labs)) - np.median(surprises(wrong, covariances))
                    ),
                    "cpu": seconds,
                    "residual": found.bias is not None,
                    "zeros": zeros,
                }
        print(number, name, file=sys.stderr, flush=True)


def _zeros(model: Identified) -> str:
    """The zeros of a recording, in the sensors' units."""
    return " ".join(f"{each.value:.4f}" for each in model.estimates if each.name.endswith(".zero"))


def summary(table: pd.DataFrame) -> str:
    """Tables as markdown: mean (least to greatest) over what was learned from."""
    text = ""
    for number, of_number in table.groupby("number", sort=False):
        ways = list(dict.fromkeys(of_number["way"]))
        text += f"Learned from {number}: errors over the lab's.\n\n"
        text += "| robot | horizon | " + " | ".join(ways) + " |\n" + "| --- " * (2 + len(ways)) + "|\n"
        compared = of_number[of_number["seconds"].isin(COMPARED)]
        for (rig, horizon), own in compared.groupby(["rig", "seconds"], sort=False):
            cells = [_range(own[own["way"] == way]["ratio"].to_numpy(), "{:.2f}") for way in ways]
            text += f"| {rig} | {horizon:g} s | " + " | ".join(cells) + " |\n"
        text += f"\nLearned from {number}: nats less surprising than by the lab's model, and seconds.\n\n"
        text += "| robot | | " + " | ".join(ways) + " |\n" + "| --- " * (2 + len(ways)) + "|\n"
        for rig, own in compared.groupby("rig", sort=False):
            for horizon in COMPARED:
                at = own[own["seconds"] == horizon]
                cells = [_range(at[at["way"] == way]["nats"].to_numpy(), "{:.1f}") for way in ways]
                text += f"| {rig} | {horizon:g} s | " + " | ".join(cells) + " |\n"
            cells = [f"{own[own['way'] == way]['cpu'].mean():.1f}" for way in ways]
            text += f"| {rig} | seconds | " + " | ".join(cells) + " |\n"
        text += f"\nLearned from {number}: errors of the identified model that its 90% regions hold.\n\n"
        text += "| robot | " + " | ".join(f"{each:g} s" for each in HORIZONS) + " |\n"
        text += "| --- " * (1 + len(HORIZONS)) + "|\n"
        for rig, own in of_number[of_number["way"] == "identified"].groupby("rig", sort=False):
            shares = [100 * own[own["seconds"] == each]["coverage"].to_numpy() for each in HORIZONS]
            text += f"| {rig} | " + " | ".join(_range(each, "{:.0f}") for each in shares) + " |\n"
        text += "\n"
    return text


def _range(values: Array, form: str) -> str:
    """Mean (least to greatest)."""
    if not len(values):
        return ""
    return f"{form.format(values.mean())} ({form.format(values.min())} to {form.format(values.max())})"


def main() -> None:
    """Write the table and the summary to the current folder."""
    parser = argparse.ArgumentParser(prog="rigs")
    parser.add_argument("checkouts", type=Path)
    parser.add_argument("--test", action="store_true", help="predict the test recordings: once, at the end")
    parser.add_argument("--rigs", nargs="+", choices=declared(), default=list(declared()), help="only these")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS), help="only these")
    arguments = parser.parse_args()
    found: list[dict[str, Any]] = []
    for name in arguments.rigs:
        rig = load(declared()[name], arguments.checkouts.resolve(), arguments.test)
        found += [{"rig": name, **row} for row in rows(rig, arguments.ways)]
        pd.DataFrame(found).to_csv("rigs.csv", index=False, float_format="%.4g")
    text = summary(pd.DataFrame(found))
    Path("table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
