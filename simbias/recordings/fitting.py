"""Models of a robot, identified from all recordings, from parts of them, and in other windows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import final

import numpy as np

from simbias.core.errors import ConfigError
from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified
from simbias.learning.identification.posterior import Posterior
from simbias.learning.identification.refinement import moved_by_shorter_steps
from simbias.recordings.parts import Part, others
from simbias.trial.study import Study

OTHER_WINDOWS = (0.5, 2.0)  # durations of predictions, relative to the chosen one
LONGEST = max(OTHER_WINDOWS)  # duration that each part must have, in windows


@final
class Fitting:
    """Fits the nominal model of a study, which is `prepared`, to parts of recordings.

    `progress` is told in words what is fitted.
    """

    def __init__(self, study: Study, progress: Callable[[str], object]) -> None:
        assert isinstance(study.identification, Posterior)
        self._study, self._posterior, self._progress = study, study.identification, progress
        self.known = self._posterior.known  # the earlier posterior

    def check_length(self, all_parts: Sequence[Part]) -> None:
        """Raise ConfigError if a part is too short for predictions."""
        longest = self._posterior.with_window(LONGEST * self._posterior.window)
        for part in all_parts:
            if not longest.windows(part.rollouts):
                raise ConfigError(part.name, f"is shorter than a window of {longest.window:g} s")

    def of(self, part: Part, words: str, window: float = 1.0, begin: Posterior | None = None) -> Identified:
        """The model of a part, in windows of so many times their duration.

        It begins with the prior of another posterior, if there is one.

        Raises
        ------
        ConfigError
            If predictions are not finite.
        """
        self._progress(words)
        fitting = (begin or self._posterior).with_window(window * self._posterior.window)
        try:
            return fitting.identified(self._study.nominal, part.rollouts, part.recordings)
        except np.linalg.LinAlgError as error:
            problem = f"{part.name}: predictions have no finite errors: is a unit or a column wrong?"
            raise ConfigError("identify", problem) from error

    def by_window(self, everything: Part) -> dict[float, Identified]:
        """The models in shorter and longer windows, by their duration in s."""
        s = self._posterior.window
        return {f * s: self.of(everything, f"with windows of {f * s:g} s", f) for f in OTHER_WINDOWS}

    def moved_by_shorter_steps(self, identified: Identified, everything: Part) -> Array | None:
        """How far (r, p) shorter integration steps would move modes, in deviations; None if unknown."""
        self._progress("in shorter steps")
        study = self._study
        models = study.task, study.nominal, study.nominal_of
        recordings = everything.rollouts, everything.recordings
        return moved_by_shorter_steps(*models, self._posterior, identified, *recordings)

    def apart(self, everything: Part) -> list[Identified]:
        """The earlier posterior, and the model that the recordings give without it; none without one."""
        if not self.known:
            return []
        prior = self._posterior.with_known(None)
        without_it = self.of(everything, "without the earlier posterior", begin=prior)
        return [self._posterior.identified(self._study.nominal, []), without_it]

    def of_others(
        self, alone: Sequence[Identified], all_parts: Sequence[Part], of_one: bool
    ) -> list[Identified]:
        """For each part, the model of all others; `alone` are the models of each part.

        Parts of one recording share its specific parameters. Those of another recording are as in the prior.
        """
        if len(all_parts) == 2:
            models = alone[::-1]
        else:
            rest = [others(all_parts, i) for i in range(len(all_parts))]
            models = [self.of(each, each.name) for each in rest]
        return [model.of_recording(0) if of_one else model.elsewhere() for model in models]

    @staticmethod
    def unseen(
        alone: Sequence[Identified], all_parts: Sequence[Part]
    ) -> list[tuple[Identified, list[Rollout]]]:
        """The model of each part, with the experiments of all others."""
        return [(model.elsewhere(), others(all_parts, i).rollouts) for i, model in enumerate(alone)]

    def with_own(
        self, models: Sequence[Identified], all_parts: Sequence[Part]
    ) -> Iterator[tuple[Identified, Sequence[Rollout]]]:
        """Each part's model, its specific parameters fitted to each of its recordings; others unchanged.

        None without specific parameters.
        """
        own = np.diag([float(parameter.of_recording) for parameter in models[0].parameters])
        for model, part in zip(models, all_parts, strict=True) if own.any() else ():
            self._progress(f"what is specific to {part.name}")
            fitting = self._posterior.with_known(replace(model.known, spread=own.tolist()))
            for name, pieces in part.pieces.items():
                fitted = fitting.identified(self._study.nominal, pieces, [name] * len(pieces))
                yield fitted.with_spread(np.hstack([model.spread - own, fitted.spread])), pieces
