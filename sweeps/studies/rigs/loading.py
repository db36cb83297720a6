"""Rigs and their recordings, as `rigs.yaml` declares them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml
from scipy.io import loadmat

import simbias
from simbias.core import Nominal
from simbias.core.records import Rollout
from simbias.lab.recorded import Recorded
from simbias.learning.identification.posterior import Posterior
from simbias.trial.study import Study

HERE = Path(__file__).parent
ZERO = 0.05  # rad, standard deviation of an encoder's zero
LONGER = [0.5]  # s, of predictions that are compared beside those of 0.1 s
FIRST, LATER = "test", ("second", "third")  # tests, by their names in `rigs.yaml`
ONE, SEVERAL = "one", "several"  # recordings that are learned from


class Rig(NamedTuple):
    """A robot with its nominal model, and recordings by name."""

    study: Study
    lab_values: dict[str, float]  # of parameters, as the lab identified them; others are nominal
    development: dict[str, Rollout]
    test: dict[str, Rollout]  # or those of a later test; empty unless they are asked for

    @property
    def lab(self) -> Nominal:
        """The model that the lab identified."""
        values = {parameter.name: parameter.value for parameter in self.prior.parameters} | self.lab_values
        return self.prior.with_parameters(np.array(list(values.values())))

    @property
    def has_zeros(self) -> bool:
        """Whether each recording has zeros of its own."""
        return any(parameter.of_recording for parameter in self.prior.parameters)

    @property
    def prior(self) -> Nominal:
        """The nominal model with all uncertain parameters, those of motors and sensors too."""
        assert isinstance(self.study.identification, Posterior)
        return self.study.identification.prior(self.study.nominal)


def declared() -> dict[str, dict[str, Any]]:
    """Rigs by name, each with what is declared of its robot."""
    read = yaml.safe_load((HERE / "rigs.yaml").read_text())
    return {name: read["robots"][rig["robot"]] | rig for name, rig in read["rigs"].items()}


def load(rig: Mapping[str, Any], checkouts: Path, part: str | None = None) -> Rig:
    """A rig whose repository is checked out in a folder of its name; with the recordings of a test."""
    nominal = [f"{key}={_text(value)}" for key, value in rig.items() if key.startswith("nominal.")]
    zeros = [f"+identification.sensors.{angle}.zero={ZERO}" for angle in rig["zeros"]]
    load = (
        [f"+nominal.uncertainty={{{rig['load']['name']}: {rig['load']['deviation']}}}"]
        if "load" in rig
        else []
    )
    options = ["tracking=none", f"identification.longer_windows={LONGER}"]
    study = simbias.load([*options, *rig["composition"], *nominal, *zeros, *load], HERE / "robots")
    before = rig["learned_later"] if part in LATER and "learned_later" in rig else rig["development"]
    after = rig.get(part, []) if part else []
    return Rig(study, rig["lab"], *(_read(study, rig, checkouts, places) for places in (before, after)))


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


def _read(
    study: Study, rig: Mapping[str, Any], checkouts: Path, places: Sequence[str | Mapping[str, Any]]
) -> dict[str, Rollout]:
    """The longest piece of each recording, or what lies between two of its times."""
    found, repository = {}, Path(rig["repository"]).name
    for place in places:
        own: Mapping[str, Any] = {"file": place} if isinstance(place, str) else place
        checkout = f"{repository}-{own['commit']}" if "commit" in own else repository
        file = checkouts / checkout / own.get("folder", rig["folder"]) / own["file"]
        begin = study.task.frames(own.get("from", _begins(rig, file)))
        reader = Recorded(study.task, str(file.parent), columns=own.get("columns", rig["columns"])).reader
        with tempfile.TemporaryDirectory() as scratch:
            file = _of_matlab(file, Path(scratch)) if file.suffix == ".mat" else file
            whole = max(reader.read(file).pieces, key=lambda piece: piece.frames)
        end = study.task.frames(own["until"]) if "until" in own else whole.frames
        states = whole.states[begin : end + 1]
        found[str(place)] = Rollout(states, whole.inputs[begin:end], measured=states, sensed=True)
    return found


def _of_matlab(file: Path, scratch: Path) -> Path:
    """A recording of EMPS as CSV: time in s, position in m, and the drive's force with added pulses in N."""
    held = loadmat(file)
    force = held["gtau"] * held["vir"] + held.get("pulses_N", 0.0)
    table = pd.DataFrame(np.hstack([held["t"], held["qm"], force]), columns=["t", "qm", "force"])
    table.to_csv(scratch / "recording.csv", index=False)
    return scratch / "recording.csv"


def _begins(rig: Mapping[str, Any], file: Path) -> float:
    """The time in s at which a recording begins to be of a robot that moves as its model does."""
    if "begins" not in rig:
        return 0.0
    table = pd.read_csv(file)
    times = table[rig["columns"]["time"]].to_numpy()
    return float(times[np.argmax(table[rig["begins"]].to_numpy() == 1)] - times[0])


def _text(value: Any) -> str:
    """A value as an override's text."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_text(each)}" for key, each in value.items()) + "}"
    return str(value)
