"""Renamed keys and options; their errors give the new name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from simbias.core.errors import ConfigError

# An old key (`group.key`) or option (`group=option`) -> the new one. A key includes all keys below it.
# Sorted.
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
    "tracking.journals": "tracking.trials",
}


def new_name(old: str) -> str | None:
    """The new name of an old one, by its own entry or a parent's; None if there is none."""
    parts = old.split(".")
    for length in range(len(parts), 0, -1):
        head = ".".join(parts[:length])
        if head in RENAMED:
            new = ".".join([RENAMED[head], *parts[length:]])
            return new_name(new) or new  # it may have been renamed twice
    return None


def unknown(names: Iterable[str], key: str, otherwise: str) -> ConfigError:
    """The error for an unknown `key`: the first renamed one of `names`, or `otherwise`."""
    for name in names:
        if (new := new_name(name)) is not None:
            return ConfigError(name, f"is now {new}")
    return ConfigError(key, otherwise)
