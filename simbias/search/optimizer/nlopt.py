"""NLopt's global algorithms."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import nlopt
import numpy as np

from simbias.core import Optimizer
from simbias.core.errors import ConfigError
from simbias.core.evaluations import EVALUATION_LIMIT, Evaluations
from simbias.core.records import Array
from simbias.search.optimizer.lookahead import look_ahead

Algorithm = Literal["GN_DIRECT", "GN_DIRECT_L", "GN_DIRECT_L_RAND", "GN_ORIG_DIRECT", "GN_CRS2_LM"]


@dataclass(kw_only=True, eq=False)
class Nlopt(Optimizer):
    """A global, derivative-free search by NLopt; GN_DIRECT is the DIRECT of Section V.

    DIRECT without RAND is deterministic: it evaluates the same points for any random generator. NLopt's
    own ftol_rel is not used: GN_ORIG_DIRECT ignores it.

    Parameters
    ----------
    algorithm
        NLopt's name for the algorithm (https://nlopt.readthedocs.io/en/latest/NLopt_Algorithms).
    """

    algorithm: Algorithm

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Search by NLopt's algorithm; return why it ended, in words."""
        return search_nlopt(self.algorithm, evaluations, rng)


def search_nlopt(algorithm: Algorithm, evaluations: Evaluations, rng: np.random.Generator) -> str:
    """Search by one of NLopt's algorithms, looking ahead; return why it ended, in words.

    ConfigError if the algorithm cannot handle this many parameters.
    """
    seed, start, most = int(rng.integers(1, 2**31)), evaluations.start, evaluations.remaining

    def search(evaluate: Callable[[Array], float]) -> str:
        strategy = nlopt.opt(getattr(nlopt, algorithm), len(start))
        strategy.set_lower_bounds(evaluations.lower)
        strategy.set_upper_bounds(evaluations.upper)
        strategy.set_maxeval(most)
        nlopt.srand(seed)
        return _minimized(strategy, evaluate, start)

    try:
        return look_ahead(search, evaluations)
    except nlopt.runtime_error as error:  # of GN_ORIG_DIRECT with more than 500, depending on `most`
        raise ConfigError("optimizer", f"{algorithm} fails with {len(start)} parameters") from error


def _minimized(strategy: nlopt.opt, evaluate: Callable[[Array], float], start: Array) -> str:
    """Run NLopt from a point (p,); return why it ended, in words. Exceptions of `evaluate` propagate."""
    raised: list[BaseException] = []
    stoppable = weakref.proxy(strategy)  # NLopt holds references that Python's garbage collector cannot see

    # NLopt loses some exceptions, so none may reach it. It is stopped in the call after the error:
    # stopped in its first evaluation, GN_ORIG_DIRECT crashes. Some algorithms keep calling for a while.
    def guarded(point: Array, _gradient: Array) -> float:
        if raised:
            stoppable.force_stop()
            return 0.0
        try:
            return evaluate(point)
        except BaseException as error:
            raised.append(error)
            return 0.0

    strategy.set_min_objective(guarded)
    stopped_by = ""
    try:
        strategy.optimize(start)
        result = strategy.last_optimize_result()
        stopped_by = EVALUATION_LIMIT if result == nlopt.MAXEVAL_REACHED else f"NLopt's result {result}"
    except nlopt.ForcedStop:
        stopped_by = "the objective"
    except nlopt.RoundoffLimited:
        stopped_by = "round-off errors"
    if raised:
        raise raised.pop()  # otherwise, NLopt's references would keep the whole traceback alive
    return stopped_by
