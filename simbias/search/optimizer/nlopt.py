"""NLopt's global algorithms."""

from __future__ import annotations

import weakref
from typing import Literal, get_args

import nlopt
import numpy as np

from simbias.core import Optimizer
from simbias.core.evaluations import EVALUATION_LIMIT, Evaluations
from simbias.core.ranges import EvaluationCount, Seconds, Share, Steps
from simbias.core.records import Array
from simbias.search.optimizer.lookahead import look_ahead

Algorithm = Literal[
    "GN_DIRECT",
    "GN_DIRECT_L",
    "GN_DIRECT_L_RAND",
    "GN_DIRECT_NOSCAL",
    "GN_DIRECT_L_NOSCAL",
    "GN_DIRECT_L_RAND_NOSCAL",
    "GN_ORIG_DIRECT",
    "GN_ORIG_DIRECT_L",
    "GN_CRS2_LM",
    "GN_ISRES",
    "GN_ESCH",
    "GN_MLSL",
    "GN_MLSL_LDS",
    "GN_AGS",
]  # global, derivative-free, in a box


class Nlopt(Optimizer):
    """A global, derivative-free search by NLopt; GN_DIRECT is the DIRECT of Section V.

    DIRECT without RAND is deterministic: it evaluates the same points whatever the random generator.

    Parameters
    ----------
    algorithm
        NLopt's name of it (https://nlopt.readthedocs.io/en/latest/NLopt_Algorithms). NLopt 2.11 runs all
        three _NOSCAL as GN_DIRECT_L_NOSCAL.
    max_evaluations
        N_in; the search never makes more.
    relative_tolerance
        epsilon: the search ends when the best cost Z improves by less than epsilon |Z|. NLopt's own ftol_rel
        is not used: GN_ORIG_DIRECT*, GN_ESCH and GN_AGS ignore it, GN_MLSL* do but for their local searches.
    max_steps, max_seconds
        Of simulation and of wall time, after which the search ends too.

    Raises
    ------
    ValueError
        If the algorithm is not one of `Algorithm`.
    """

    def __init__(
        self,
        algorithm: Algorithm,
        max_evaluations: EvaluationCount,
        relative_tolerance: Share,
        max_steps: Steps | None = None,
        max_seconds: Seconds | None = None,
    ) -> None:
        if algorithm not in get_args(Algorithm):
            raise ValueError(f"algorithm {algorithm!r} is none of {', '.join(get_args(Algorithm))}")
        self.max_evaluations = max_evaluations
        self._algorithm = algorithm
        self.relative_tolerance = relative_tolerance
        self.max_steps, self.max_seconds = max_steps, max_seconds

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Search, looking ahead."""
        seed = int(rng.integers(1, 2**31))
        return look_ahead(lambda rehearsed: self._search(rehearsed, seed), evaluations)

    def _search(self, evaluations: Evaluations, seed: int) -> str:
        """One search, the same for the same seed."""
        search = nlopt.opt(getattr(nlopt, self._algorithm), len(evaluations.lower))
        search.set_lower_bounds(evaluations.lower)
        search.set_upper_bounds(evaluations.upper)
        search.set_maxeval(evaluations.remaining)
        nlopt.srand(seed)
        raised: list[BaseException] = []
        stoppable = weakref.proxy(search)  # it keeps what it calls, unseen by Python's garbage collector

        # NLopt loses some exceptions, so none may reach it. It is stopped in the call after the error:
        # stopped in its first evaluation, GN_ORIG_DIRECT crashes. Some algorithms go on calling a while.
        def guarded(point: Array, _gradient: Array) -> float:
            if raised:
                stoppable.force_stop()
                return 0.0
            try:
                return evaluations.evaluate(point)
            except BaseException as error:
                raised.append(error)
                return 0.0

        search.set_min_objective(guarded)
        stopped_by = self._optimize(search, evaluations.start)
        if raised:
            raise raised.pop()  # with it, what NLopt keeps would keep all that the traceback knows
        return stopped_by

    def _optimize(self, search: nlopt.opt, start: Array) -> str:
        """Run NLopt; why it ended, in words."""
        try:
            search.optimize(start)
        except nlopt.ForcedStop:
            return "the objective"
        except nlopt.RoundoffLimited:
            return "round-off errors"
        except nlopt.invalid_argument as error:
            raise ValueError(f"NLopt's {self._algorithm} cannot take {len(start)} parameters") from error
        result = search.last_optimize_result()
        return EVALUATION_LIMIT if result == nlopt.MAXEVAL_REACHED else f"NLopt's result {result}"
