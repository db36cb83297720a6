"""Identify public robots from one recording each, and predict recordings that nothing was chosen on.

    python sweeps/studies/rigs.py CHECKOUT [--test] [--rigs NAME ...]

CHECKOUT is a checkout of the repository that `rigs.yaml` names; that file also says which recordings may be
looked at (development) and which are predicted once, at the end (`--test`). Learned is from each development
recording alone. In development, the others are predicted.

Measured are, over the lab's own identified model: errors of all states 0.1 and 0.5 s ahead, from measured
states under measured torques, a geometric mean over states; and how many errors lie in 90% regions at each
horizon (`simbias.recordings.horizons`), whose size comes from predictions of the one recording.

An encoder is switched on at a robot at rest, which friction keeps away from where it would hang. So each
recording has zeros of its own: they are identified with the robot, and of others the prior is known.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml
from scipy.optimize import least_squares

import simbias
from simbias.core import FittedBias, Nominal
from simbias.core.parameters import values_at
from simbias.core.records import Array, Rollout
from simbias.lab.recorded import Recorded
from simbias.learning.identification.identified import Identified
from simbias.recordings.horizons import HORIZONS, errors, inside, ratio, spread
from simbias.recordings.parts import Part, others, parts
from simbias.simulation.open_loop import PredictionModel, Windows, predict
from simbias.trial.study import Study

RIGS = Path(__file__).with_name("rigs.yaml")
COMPARED = (0.1, 0.5)  # s
COLUMNS = {"pos1": "pos_meas1", "pos2": "pos_meas2", "vel1": "vel_meas1", "vel2": "vel_meas2"}
COLUMNS |= {"tau1": "tau_meas1", "tau2": "tau_meas2"}
MOST = 4.0  # prior standard deviations that least squares may go
ZERO = 0.05  # rad, standard deviation of an encoder's zero
MOST_RATIO = 1.0  # of errors with a guarded residual over those without, in any third and horizon
Models = Mapping[str, tuple[Nominal, FittedBias | None]]


def load(rig: Mapping[str, Any], drives: Mapping[str, float] | None = None) -> Study:
    """The nominal model of a rig, or one with the drives' parameters of the lab."""
    links = [
        f"nominal.{link}.{name}={value}" for link in ("first", "second") for name, value in rig[link].items()
    ]
    drives = [f"nominal.drives.{name}={value}" for name, value in (drives or {}).items()]
    chosen = ["preset=double_pendulum", "tracking=none", "identification=posterior", "bias=window_gp"]
    chosen += [f"+identification.sensors.{angle}.zero={ZERO}" for angle in ("pos1", "pos2")]
    return simbias.load([*chosen, *links, *drives])


def read(study: Study, folder: Path, names: Sequence[str]) -> dict[str, Rollout]:
    """Recordings by name."""
    reader = Recorded(study.task, str(folder), columns=COLUMNS).reader
    return {name: max(reader.read(folder / name).pieces, key=lambda piece: piece.frames) for name in names}


def least_squares_fit(study: Study, rollout: Rollout) -> Nominal:
    """Ordinary least squares over windows, each state in units of the nominal model's typical error."""
    posterior: Any = study.identification
    windows: Windows = posterior.windows([rollout])
    parameters, observed = study.nominal.parameters, windows.means
    wrong = predict([PredictionModel(study.nominal)], windows)[0] - observed
    scale = np.median(np.abs(wrong), axis=(0, 1))

    def residuals(z: Array) -> Array:
        model = study.nominal.with_parameters(values_at(parameters, z))
        made = (predict([PredictionModel(model)], windows)[0] - observed) / scale
        return np.nan_to_num(made, nan=1e3, posinf=1e3, neginf=-1e3).ravel()

    z = least_squares(residuals, np.full(len(parameters), 0.01), bounds=(-MOST, MOST), max_nfev=40).x
    return study.nominal.with_parameters(values_at(parameters, z))


class Residual(NamedTuple):
    """A bias, and how well such biases predicted what they were not learned from."""

    bias: FittedBias | None  # None where it may hurt
    ratios: tuple[float, ...]  # errors with over without, of each part and horizon


def guarded(study: Study, identified: Nominal, models: Sequence[Nominal], parts: Sequence[Part]) -> Residual:
    """The bias of an identified model, learned from all parts, if none of them speaks against it.

    Each part is predicted by its own model, which was not fitted to it, and a bias learned from the others.
    The bias is left out where it makes predictions of any part worse, at any horizon.
    """
    found = []
    for i, (model, part) in enumerate(zip(models, parts, strict=True)):
        bias = study.bias.learn(study.no_data, others(parts, i), model)
        for seconds in COMPARED:
            k = study.task.frames(seconds)
            with_bias, without = (errors(model, part.rollouts, k, each) for each in (bias, None))
            if len(without):
                found.append(ratio(with_bias, without))
    if not found or max(found) > MOST_RATIO:
        return Residual(None, tuple(found))
    rollouts = [rollout for part in parts for rollout in part.rollouts]
    return Residual(study.bias.learn(study.no_data, rollouts, identified), tuple(found))


def models(study: Study, lab: Study, rollout: Rollout) -> tuple[Models, dict[str, Any]]:
    """Every way to learn from a recording, by name; and how it went."""
    begin = time.perf_counter()
    identified = study.identification.fit(study.nominal, [rollout])
    seconds = time.perf_counter() - begin
    thirds = parts({"": rollout})
    of_others = [study.identification.fit(study.nominal, others(thirds, i)) for i in range(len(thirds))]
    bias = study.bias.learn(study.no_data, [rollout], identified)
    kept = guarded(study, identified, of_others, thirds)
    ways: Models = {
        "nominal": (study.nominal, None),
        "lab": (lab.nominal, None),
        "least squares": (least_squares_fit(study, rollout), None),
        "residual": (study.nominal, study.bias.learn(study.no_data, [rollout], study.nominal)),
        "identified": (elsewhere(identified), None),
        "identified and residual": (elsewhere(identified), bias),
        "identified and guarded residual": (elsewhere(identified), kept.bias),
    }
    return ways, {"identified": identified, "seconds": seconds, "guard": kept.ratios}


def elsewhere(model: Nominal) -> Nominal:
    """The model of other recordings."""
    return model.elsewhere() if isinstance(model, Identified) else model


def rows(rig: Mapping[str, Any], checkout: Path, test: bool) -> Iterator[dict[str, Any]]:
    """A row for each recording that is learned from, way to learn, and horizon."""
    study, lab = load(rig), load(rig, rig["lab"])
    folder = checkout / rig["folder"]
    development = read(study, folder, rig["development"])
    apart = read(study, folder, rig["test"]) if test else {}
    for name, rollout in development.items():
        left = list(apart.values()) or [each for other, each in development.items() if other != name]
        ways, more = models(study, lab, rollout)
        for seconds in HORIZONS:
            k = study.task.frames(seconds)
            reference = errors(lab.nominal, left, k)
            known, spreads = (each(more["identified"], [rollout], k) for each in (errors, spread))
            for way, (model, bias) in ways.items():
                wrong = errors(model, left, k, bias)
                yield {
                    "learned": name,
                    "way": way,
                    "seconds": seconds,
                    "ratio": ratio(wrong, reference),
                    "coverage": np.mean(inside(wrong, spread(model, left, k), known, spreads))
                    if way == "identified"
                    else np.nan,
                    "fit": more["seconds"] if way == "identified" else np.nan,
                }
        print(name, [round(each, 3) for each in more["guard"]], file=sys.stderr, flush=True)


def summary(table: pd.DataFrame) -> str:
    """Tables as markdown: mean (least to greatest) over recordings that were learned from."""
    ways = list(dict.fromkeys(table["way"]))
    text = "| robot | horizon | " + " | ".join(ways) + " |\n" + "| --- " * (2 + len(ways)) + "|\n"
    for (rig, seconds), own in table[table["seconds"].isin(COMPARED)].groupby(["rig", "seconds"], sort=False):
        cells = [own[own["way"] == way]["ratio"] for way in ways]
        each = [f"{c.mean():.2f} ({c.min():.2f} to {c.max():.2f})" for c in cells]
        text += f"| {rig} | {seconds:g} s | " + " | ".join(each) + " |\n"
    only = table[table["way"] == "identified"]
    text += "\n| robot | " + " | ".join(f"{seconds:g} s" for seconds in HORIZONS) + " | s of a fit |\n"
    text += "| --- " * (2 + len(HORIZONS)) + "|\n"
    for rig, own in only.groupby("rig", sort=False):
        shares = [own[own["seconds"] == seconds]["coverage"] for seconds in HORIZONS]
        each = [f"{100 * s.mean():.0f}% ({100 * s.min():.0f} to {100 * s.max():.0f})" for s in shares]
        text += f"| {rig} | " + " | ".join(each) + f" | {own['fit'].mean():.1f} |\n"
    return text


def main() -> None:
    """Write the table and the summary to the current folder."""
    parser = argparse.ArgumentParser()
    parser.add_argument("checkout", type=Path)
    parser.add_argument("--test", action="store_true", help="predict the test recordings: once, at the end")
    parser.add_argument("--rigs", nargs="+", help="only these")
    arguments = parser.parse_args()
    found = []
    for name, rig in yaml.safe_load(RIGS.read_text()).items():
        if arguments.rigs is None or name in arguments.rigs:
            made = rows(rig, arguments.checkout.resolve(), arguments.test)
            found += [{"rig": name, **row} for row in made]
            pd.DataFrame(found).to_csv("rigs.csv", index=False, float_format="%.4g")
    text = summary(pd.DataFrame(found))
    Path("table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
