"""Whether a residual on top of an identified model helps where nothing was learned, or may be left out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from simbias.core import FittedBias, Nominal
from simbias.recordings.horizons import errors, ratio
from simbias.recordings.parts import Part, others
from simbias.trial.study import Study

HORIZONS = (0.1, 0.5)  # s
WORST = 1.0  # the largest ratio of errors in any part and horizon, with the residual over without


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
        for seconds in HORIZONS:
            k = study.task.frames(seconds)
            with_bias, without = (errors(model, part.rollouts, k, each) for each in (bias, None))
            if len(without):
                found.append(ratio(with_bias, without))
    if not found or max(found) > WORST:
        return Residual(None, tuple(found))
    rollouts = [rollout for part in parts for rollout in part.rollouts]
    return Residual(study.bias.learn(study.no_data, rollouts, identified), tuple(found))
