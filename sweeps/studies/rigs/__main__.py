"""Identify public robots from their recordings, and predict recordings that nothing was chosen on.

    python sweeps/studies/rigs CHECKOUTS [--test | --second | --third] [--rigs NAME ...] [--ways NAME ...]

CHECKOUTS is a folder of checkouts of the repositories that `rigs.yaml` names, each in a folder of its name;
those of other commits in `NAME-COMMIT`. That file also says which recordings may be looked at (development)
and which are predicted once, at the end (`--test`; later tests, `--second` and `--third`, have others). In
development, each other recording is predicted by what is learned from one, and each by what is learned from
all others together; at the end, test recordings are by what is learned from one, and from all of development.

Measured are, at each horizon, from measured states under measured inputs: errors of all states over those of
the lab's own identified model, a geometric mean over states; how many errors lie in 90% regions; how many
nats less surprising an error is than under the lab's model (its negative log-likelihood), with regions whose
size comes from the recordings that were learned from; and the seconds of processor time of learning.

An encoder is switched on at a robot at rest, which friction keeps away from where it would hang. So each
recording has zeros of its own: they are identified with the robot, and of others the prior is known. What
is left of errors without them is seen where the first fifth of each predicted recording tells its zeros, to
the identified model and to the lab's, and the rest of it is predicted.

A load is weighed by recordings with it, once those without it have told all else (`loads.csv`). Where others
have published an error in units, ours is told as theirs is (`published.csv`).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import in_units
import loads
import numpy as np
import pandas as pd
from loading import FIRST, LATER, ONE, Rig, cases, declared, load
from threadpoolctl import threadpool_limits
from ways import OF_SEVERAL, WAYS, fit, lab, of_lab, timed

from simbias.core import Nominal
from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified, Known
from simbias.recordings.horizons import HORIZONS, errors, inside, ratio, sizes

COMPARED = (0.1, 0.5)  # s
BEGINNING = 0.2  # share of a recording that tells its zeros


def rows(rig: Rig, ways: Sequence[str], zeros: bool) -> Iterator[dict[str, Any]]:
    """A row for each case, way to learn, and horizon; also of predictions whose beginnings tell `zeros`."""
    for number, name, known, left in cases(rig):
        learned, reference = list(known.values()), lab(rig, list(known.values()))
        for way in [way for way in ways if way in (WAYS if number == ONE else OF_SEVERAL)]:
            found, seconds = timed(WAYS[way], rig, learned)
            case = {"number": number, "learned": name, "way": way, "cpu": seconds, "zeros": _zeros(found.own)}
            for horizon in HORIZONS:
                k = rig.study.task.frames(horizon)
                wrong, labs_wrong = (each.errors(left, k) for each in (found, reference))
                if not len(wrong):
                    continue
                covariances, labs = (each.covariances(learned, left, k) for each in (found, reference))
                nats = np.mean(surprises(labs_wrong, labs)) - np.mean(surprises(wrong, covariances))
                held = float(np.mean(inside(wrong, covariances)))
                own = {"ratio": ratio(wrong, labs_wrong), "coverage": held, "nats": float(nats)}
                yield case | {"seconds": horizon} | own | {"residual": found.bias is not None}
            if way == "identified" and isinstance(found.model, Identified) and rig.has_zeros and zeros:
                yield from rows_with_zeros(rig, case, found.model.known, left)
        print(number, name, file=sys.stderr, flush=True)


def surprises(wrong: Array, covariances: Array) -> Array:
    """Negative log-densities (w,) in nats of errors (w, n) that are normal with covariances (w, n, n)."""
    volumes = 0.5 * np.linalg.slogdet(2 * np.pi * covariances)[1]
    return 0.5 * sizes(wrong, covariances) + volumes


def rows_with_zeros(
    rig: Rig, case: dict[str, Any], known: Known, left: Sequence[Rollout]
) -> Iterator[dict[str, Any]]:
    """Errors over the lab's of what follows the beginnings of recordings, which have told their zeros."""
    begun = [cut(rollout) for rollout in left]
    for way, before in (("lab and zeros", of_lab(rig)), ("identified and zeros", known)):
        models = [fit(rig, [beginning], before) for beginning, _ in begun]
        for horizon in HORIZONS:
            k = rig.study.task.frames(horizon)
            pairs = [(model, rest) for model, (_, rest) in zip(models, begun, strict=True)]
            wrong = np.concatenate([errors(model, [rest], k) for model, rest in pairs])
            plain = np.concatenate([errors(rig.lab, [rest], k) for _, rest in pairs])
            if len(wrong):
                yield case | {"way": way, "seconds": horizon, "ratio": ratio(wrong, plain)}


def cut(rollout: Rollout) -> tuple[Rollout, Rollout]:
    """The beginning of a recording, and the rest."""
    k = round(BEGINNING * rollout.frames)
    return Rollout(rollout.states[: k + 1], rollout.inputs[:k]), Rollout(
        rollout.states[k:], rollout.inputs[k:]
    )


def _zeros(models: Sequence[Nominal]) -> str:
    """The zeros of recordings, in the sensors' units."""
    identified = [model for model in models if isinstance(model, Identified)]
    own = [[e.value for e in model.estimates if e.name.endswith(".zero")] for model in identified]
    return "; ".join(" ".join(f"{zero:.4f}" for zero in each) for each in own)


def summary(table: pd.DataFrame) -> str:
    """Tables as markdown: mean (least to greatest) over what was learned from."""
    text = ""
    for number, own in table.groupby("number", sort=False):
        compared = own[own["seconds"].isin(COMPARED)]
        rated = compared[compared["nats"].notna()]
        text += f"Learned from {number}: errors over the lab's.\n\n{_by_way(compared, 'ratio', '{:.2f}')}\n"
        text += f"Learned from {number}: nats less surprising than by the lab's model.\n\n"
        text += f"{_by_way(rated, 'nats', '{:.1f}')}\n"
        costs = own[own["way"].isin(WAYS)].groupby(["way"], sort=False)["cpu"].mean()
        text += (
            "Seconds of processor time: " + ", ".join(f"{way} {s:.1f}" for way, s in costs.items()) + ".\n\n"
        )
        text += f"Learned from {number}: errors of the identified model that its 90% regions hold.\n\n"
        text += "| robot | " + " | ".join(f"{each:g} s" for each in HORIZONS) + " |\n"
        text += "| --- " * (1 + len(HORIZONS)) + "|\n"
        for rig, of_rig in own[own["way"] == "identified"].groupby("rig", sort=False):
            shares = [100 * of_rig[of_rig["seconds"] == each]["coverage"].to_numpy() for each in HORIZONS]
            text += f"| {rig} | " + " | ".join(_range(each, "{:.0f}") for each in shares) + " |\n"
        text += "\n"
    return text


def _by_way(table: pd.DataFrame, column: str, form: str) -> str:
    """A table of a column: rigs and horizons down, ways across."""
    ways = list(dict.fromkeys(table["way"]))
    text = "| robot | horizon | " + " | ".join(ways) + " |\n" + "| --- " * (2 + len(ways)) + "|\n"
    for (rig, horizon), own in table.groupby(["rig", "seconds"], sort=False):
        cells = [_range(own[own["way"] == way][column].to_numpy(), form) for way in ways]
        text += f"| {rig} | {horizon:g} s | " + " | ".join(cells) + " |\n"
    return text


def _range(values: Array, form: str) -> str:
    """Mean (least to greatest)."""
    if not len(values):
        return ""
    return f"{form.format(values.mean())} ({form.format(values.min())} to {form.format(values.max())})"


@threadpool_limits.wrap(limits=1, user_api="blas")  # as `identify`
def main() -> None:
    """Write the table and the summary to the current folder."""
    parser = argparse.ArgumentParser(prog="rigs")
    parser.add_argument("checkouts", type=Path)
    tests = parser.add_mutually_exclusive_group()
    for part in (FIRST, *LATER):
        tests.add_argument(
            f"--{part}", dest="part", action="store_const", const=part, help="predict these, once"
        )
    parser.add_argument("--rigs", nargs="+", choices=declared(), default=list(declared()), help="only these")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS), help="only these")
    arguments = parser.parse_args()
    found, weighed, told = (list[dict[str, Any]]() for _ in range(3))
    for name in arguments.rigs:
        declaration = declared()[name]
        rig = load(declaration, arguments.checkouts.resolve(), arguments.part)
        if arguments.part and not rig.test:
            continue
        if "load" in declaration:
            unloaded = load(declared()[declaration["load"]["unloaded"]], arguments.checkouts.resolve())
            weighed += loads.rows(rig, declaration["load"]["name"], unloaded)
            pd.DataFrame(weighed).to_csv("loads.csv", index=False, float_format="%.4g")
        if "published" in declaration:
            told += [{"rig": name, **row} for row in in_units.rows(rig, declaration["published"])]
            pd.DataFrame(told).to_csv("published.csv", index=False, float_format="%.4g")
        found += [{"rig": name, **row} for row in rows(rig, arguments.ways, arguments.part not in LATER)]
        pd.DataFrame(found).to_csv("rigs.csv", index=False, float_format="%.4g")
    text = summary(pd.DataFrame(found)) if found else ""
    Path("table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
