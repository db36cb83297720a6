"""Keys, options and classes that had another name or place before: their errors say where each is now."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from simbias.core.errors import ConfigError

# An old key (`group.key`), option (`group=option`), module or class -> the new one. A key or module stands
# for all that is below it. Sorted.
RENAMED: Mapping[str, str] = {
    "bias=held_out": "bias=window_gp",
    "evaluation=lasting": "evaluation=domain_randomization_30s",
    "evaluation=robust_models": "evaluation=domain_randomization",
    "evaluation=robust_posterior": "evaluation.sample_bias",
    "hardware.orders": "hardware.requests",
    "held_out.lasting": "policy_test.long_episodes",
    "held_out.seconds": "policy_test.long_seconds",
    "held_out.starts": "policy_test.episodes",
    "method.by_evidence": "method.model_selection",
    "method.design": "method.lqr_candidates",
    "method.retry_spread": "method.posterior_scale",
    "method.satisfactory_cost": "method.target_cost",
    "method=adaptive": "method=model_selection",
    "method=frugal": "method=model_based",
    "optimizer=bipop_cma": "optimizer=hybrid",
    "optimizer=scipy_direct": "optimizer=nlopt_direct",
    "simbias.bias": "simbias.learning.bias",
    "simbias.evaluation": "simbias.search.evaluation",
    "simbias.hardware.box2d": "simbias.robots.bongoboard.box2d",
    "simbias.hardware.gymnasium": "simbias.robots.gymnasium",
    "simbias.hardware.manual": "simbias.lab.requests.manual",
    "simbias.hardware.mujoco": "simbias.robots.mujoco.hardware",
    "simbias.hardware.mujoco_bongoboard": "simbias.robots.bongoboard.mujoco",
    "simbias.hardware.process": "simbias.lab.requests.process",
    "simbias.hardware.pymunk": "simbias.robots.bongoboard.pymunk",
    "simbias.hardware.recorded": "simbias.lab.recorded",
    "simbias.identification": "simbias.learning.identification",
    "simbias.interfaces": "simbias.core",
    "simbias.learning.bias.held_out.HeldOut": "simbias.learning.bias.window_gp.WindowGP",
    "simbias.method": "simbias.trial.methods",
    "simbias.nominal.bongoboard": "simbias.robots.bongoboard.model",
    "simbias.nominal.cartpole": "simbias.robots.cartpole",
    "simbias.nominal.double_pendulum": "simbias.robots.double_pendulum",
    "simbias.nominal.mujoco": "simbias.robots.mujoco.model",
    "simbias.nominal.none": "simbias.robots.none",
    "simbias.optimizer": "simbias.search.optimizer",
    "simbias.pictures.sweep": "simbias.sweep.figures",
    "simbias.records": "simbias.core.records",
    "simbias.samples": "simbias.learning.samples",
    "simbias.task.bongoboard": "simbias.robots.bongoboard.task",
    "simbias.task.declared": "simbias.robots.declared.task",
    "simbias.tracking.mlflow": "simbias.mlflow.tracking",
    "simbias.tracking.none": "simbias.sweep.tracking",
    "tracking.journals": "tracking.trials",
}

ATTRIBUTES = {"memory_size": "state_size"}  # of components, likewise


def check_attributes(component: object, key: str) -> None:
    """Raise a ConfigError of `key` if a component has an attribute under its old name."""
    for old, new in ATTRIBUTES.items():
        if hasattr(component, old):
            raise ConfigError(key, f"{type(component).__name__}.{old} is now {new}")


def new_name(old: str) -> str | None:
    """The new name of an old one, by its own entry or that of a name above it; None if it has none."""
    parts = old.split(".")
    for length in range(len(parts), 0, -1):
        head = ".".join(parts[:length])
        if head in RENAMED:
            new = ".".join([RENAMED[head], *parts[length:]])
            return new_name(new) or new  # it may have been renamed twice
    return None


def unknown(names: Iterable[str], key: str, otherwise: str) -> ConfigError:
    """The error of an unknown `key`: the first of the `names` that was renamed, `otherwise` if none was."""
    for name in names:
        if (new := new_name(name)) is not None:
            return ConfigError(name, f"is now {new}")
    return ConfigError(key, otherwise)
