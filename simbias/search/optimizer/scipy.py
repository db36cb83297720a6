"""SciPy's global algorithms."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.optimize import Bounds, direct

from simbias.core import Optimizer
from simbias.core.evaluations import Evaluations
from simbias.core.ranges import Seconds, Share, Steps
from simbias.search.optimizer.lookahead import look_ahead


class ScipyDirect(Optimizer):
    """DIRECT (Section V) by SciPy; it is deterministic and ignores the random generator.

    Parameters
    ----------
    locally_biased
        Whether to run DIRECT_L instead.
    max_evaluations
        N_in; the search never makes more. SciPy takes memory for all of them at once.
    relative_tolerance
        epsilon: the search ends when the best cost Z improves by less than epsilon |Z|. SciPy has no such
        test; its own, on the size of the best rectangle, are off.
    max_steps, max_seconds
        Of simulation and of wall time, after which the search ends too.
    """

    def __init__(
        self,
        locally_biased: bool,
        max_evaluations: Annotated[int, Field(gt=0, le=10**6)],
        relative_tolerance: Share,
        max_steps: Steps | None = None,
        max_seconds: Seconds | None = None,
    ) -> None:
        self.max_evaluations = max_evaluations
        self._locally_biased = locally_biased
        self.relative_tolerance = relative_tolerance
        self.max_steps, self.max_seconds = max_steps, max_seconds

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Search, looking ahead."""
        return look_ahead(self._search, evaluations)

    def _search(self, evaluations: Evaluations) -> str:
        """One search; always the same."""
        result = direct(
            evaluations.evaluate,
            Bounds(evaluations.lower, evaluations.upper),
            maxfun=evaluations.remaining,
            maxiter=evaluations.remaining,  # every step evaluates
            locally_biased=self._locally_biased,
            vol_tol=0.0,
            len_tol=0.0,
        )
        return f"SciPy: {result.message}"
