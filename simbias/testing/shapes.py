"""Shapes of arrays, checked at every call of a component: for tests, as it takes time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import wraps
from typing import Any, TypeVar

import numpy as np

from simbias.core import FittedBias, Nominal
from simbias.testing.expectations import expect
from simbias.trial.study import Study

Shape = tuple[str, ...]  # axes after the leading ones, by their names in the contracts; a ray of them

_Component = TypeVar("_Component")


def watch(study: Study) -> Study:
    """The study, whose task, policy, nominal model and bias raise where a shape is not the contract's.

    Sizes are n states, m inputs, q outputs, c criteria, p policy parameters, s numbers in the policy state
    and h in the model state.
    Arrays may have leading axes, as the contracts say; those of a result are those of what it is made from.

    Raises
    ------
    ConformanceError
        When a component is called with, or returns, an array of another shape; names method and array.
    """
    task, policy = study.task, study.policy
    sizes = {
        "n": len(task.states),
        "m": len(task.inputs),
        "q": len(task.outputs),
        "c": len(task.criteria),
        "p": policy.n_parameters,
        "s": policy.state_size,
        "h": study.nominal.state_size,
    }

    def fitted(bias: FittedBias) -> FittedBias:
        correction = _shaped(bias, "correction", {"x": "n", "u": "m"}, {"correction": "n"}, sizes)
        return _with(bias, correction=correction, draw=_then(bias.draw, fitted))

    def nominal(model: Nominal) -> Nominal:
        step = _shaped(model, "step", {"x": "n", "u": "m"}, {"x_next": "n"}, sizes)
        takes, gives = {"x": "n", "u": "m", "model_state": "h"}, {"x_next": "n", "model_state": "h"}
        more = {"advance": _shaped(model, "advance", takes, gives, sizes)} if model.state_size else {}
        return _with(model, step=step, draw=_then(model.draw, nominal), **more)

    return replace(
        study,
        task=_with(
            task,
            measure=_shaped(task, "measure", {"x": "n"}, {"measures": "c"}, sizes),
            output=_shaped(task, "output", {"x": "n"}, {"z": "q"}, sizes),
        ),
        policy=_with(
            policy,
            act=_shaped(
                policy,
                "act",
                {"theta": "p", "x": "n", "t": "", "policy_state": "s"},
                {"u": "m", "policy_state": "s"},
                sizes,
            ),
        ),
        nominal=nominal(study.nominal),
        bias=_with(study.bias, fit=_then(study.bias.fit, fitted)),
    )


def _with(component: _Component, **methods: Callable) -> _Component:
    """A copy of a component with other methods."""
    changed = copy(component)
    vars(changed).update(methods)
    return changed


def _then(method: Callable, change: Callable) -> Callable:
    """A method whose result is changed."""

    @wraps(method)
    def call(*arguments: Any) -> Any:
        return change(method(*arguments))

    return call


def _shaped(
    component: Any, method: str, takes: Mapping[str, str], gives: Mapping[str, str], sizes: Mapping[str, int]
) -> Callable:
    """A method whose arrays (..., axis) are checked; "" stands for a number."""
    function = getattr(component, method)
    name = f"{type(component).__name__}.{method}"

    @wraps(function)
    def call(*arguments: Any) -> Any:
        leading = _leading(name, takes, arguments, sizes)
        result = function(*arguments)
        results = result if len(gives) > 1 else (result,)
        made = _leading(name, gives, results, sizes)
        expect(made == leading, name, f"leading axes {leading} of its arguments", made)
        return result

    return call


def _leading(
    name: str, axes: Mapping[str, str], arrays: Sequence[Any], sizes: Mapping[str, int]
) -> tuple[int, ...]:
    """The leading axes that arrays have in common."""
    expect(len(arrays) == len(axes), name, f"{len(axes)} arrays: {', '.join(axes)}", len(arrays))
    leading: list[tuple[int, ...]] = []
    for (array, axis), value in zip(axes.items(), arrays, strict=True):
        shape = np.shape(value)
        if not axis:
            expect(shape == (), name, f"{array} to be a number", f"an array of shape {shape}")
            continue
        size = sizes[axis]
        expect(
            shape[-1:] == (size,), name, f"{array} (..., {axis}) with {axis} = {size}", f"the shape {shape}"
        )
        leading.append(shape[:-1])
    try:
        return np.broadcast_shapes(*leading)
    except ValueError:
        shapes = ", ".join(map(str, leading))
        expect(False, name, "leading axes that go together", shapes)
        raise
