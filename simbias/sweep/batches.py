"""Hardware experiments that a figure needs in addition to those of the trials."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from simbias.config import Composition
from simbias.config.build import build
from simbias.core import HardwareError, Waiting
from simbias.core.digest import short_digest
from simbias.core.records import Array


@dataclass(frozen=True, eq=False)
class Batch:
    """Experiments with one policy on one hardware, the i-th from the i-th start; the seed is for noise."""

    composition: Composition  # the study that defines the hardware
    parameters: Array  # theta (p,)
    starts: Array  # (k, n)
    seed: int

    @property
    def hash(self) -> str:
        """Identity: 12 hexadecimal digits of everything that affects the outcomes."""
        parts = [self.composition.group_hash, self.parameters.tolist(), self.starts.tolist(), self.seed]
        return short_digest(json.dumps(parts).encode())


@dataclass(frozen=True)
class Outcomes:
    """The outcomes of the k experiments of a batch."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    costs: tuple[float, ...]  # (k,) Z of Eq. 8
    frames: tuple[int, ...]  # (k,) frames in which the robot was controlled
    failures: tuple[str, ...]  # (k,) names of violated criteria; "" if none was
    successes: tuple[bool, ...]  # (k,) whether it passed, by the study's cost
    error: str = ""  # why there are no outcomes

    def as_json(self) -> str:
        """Text for `from_json`."""
        return json.dumps({name: each for name, each in vars(self).items() if name != "error"})

    @staticmethod
    def from_json(text: str) -> Outcomes:
        """Outcomes from text by `as_json`; a ValueError if it is truncated or of another version."""
        return TypeAdapter(Outcomes).validate_json(text)


def run_batch(batch: Batch) -> Outcomes:
    """Run the experiments of a batch; an error of the hardware is part of the outcomes."""
    study = build(batch.composition)
    generators = np.random.default_rng(batch.seed).spawn(len(batch.starts))
    try:
        rollouts = [
            study.experiment(batch.parameters, rng, start)
            for start, rng in zip(batch.starts, generators, strict=True)
        ]
    except (HardwareError, Waiting) as error:
        return Outcomes((), (), (), (), f"hardware: {error}")
    return Outcomes(
        costs=tuple(float(rollout.cost) for rollout in rollouts),
        frames=tuple(rollout.frames for rollout in rollouts),
        failures=tuple(rollout.failure or "" for rollout in rollouts),
        successes=tuple(map(study.passes, rollouts)),
    )
