"""What MLflow's tables show of a trial: parameters, tags and metrics."""

from __future__ import annotations

import getpass
import json
import platform
import re
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from simbias.records import Iteration, Learning, Search

if TYPE_CHECKING:
    from pandas import DataFrame

    from simbias.config import Composition
    from simbias.trial import TrialRecord

Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the one in C is ten times as fast
PACKAGE = Path(__file__).resolve().parent.parent
KEY_LENGTH = 250  # MLflow's limits
VALUE_LENGTH = 6000

PARENT = "mlflow.parentRunId"  # MLflow's tag that nests runs
SECONDS = "trial/seconds"  # the metric that tells how long a trial took
TRIAL_METRICS = ("trial/experiments", "trial/iterations", SECONDS)
AXIS = "axis."  # prefix of the tags that say where on the sweep's axes a trial lies


def redact(uri: str) -> str:
    """A URI without its user and password."""
    return re.sub(r"//[^/@]*@", "//", uri)


def shown_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """A resolved config without a password of the store."""
    tracking = {k: redact(v) if isinstance(v, str) else v for k, v in config["tracking"].items()}
    return {**config, "tracking": tracking}


def config_yaml(config: Mapping[str, Any]) -> str:
    """A resolved config as text."""
    return yaml.dump(shown_config(config), Dumper=Dumper, sort_keys=False, allow_unicode=True)


def parameters(composition: Composition) -> dict[str, str]:
    """The chosen options (`bias`) and the resolved config (`bias.d`); what is not text as JSON."""
    flat = {**composition.choices, **dict(_flat(shown_config(composition.config)))}
    return {_name(key): _value(value) for key, value in flat.items()}


def _flat(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and their values."""
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _name(key: str) -> str:
    """A key with only what MLflow allows in names."""
    return re.sub(r"[^\w\-. /]", "_", key)[:KEY_LENGTH]


def _value(value: Any) -> str:
    """Text as it is, anything else as JSON; config.yaml has what is cut off."""
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= VALUE_LENGTH else text[: VALUE_LENGTH - 3] + "..."


def metrics(iteration: Iteration) -> dict[str, float]:
    """An iteration in numbers, `group/name`; costs as in Eq. 8, seconds of wall time."""
    experiments = iteration.experiments
    numbers = {
        "cost/hardware_max": iteration.hardware_cost,
        **{f"cost/hardware_{i}": rollout.cost for i, rollout in enumerate(experiments)},
        "experiments/total": iteration.total_experiments,
        "experiments/iterations": iteration.index + 1,
        "experiments/failed": sum(rollout.failed_at is not None for rollout in experiments),
        "experiments/frames_min": min((rollout.frames for rollout in experiments), default=0),
        "experiments/succeeded": iteration.succeeded,
        **(_search_metrics(iteration.search) if iteration.search else {}),
        **(_learning_metrics(iteration.learning) if iteration.learning else {}),
        **{f"seconds/{phase}": seconds for phase, seconds in iteration.seconds.items()},
    }
    return {_name(key): float(value) for key, value in numbers.items()}


def _search_metrics(search: Search) -> dict[str, float]:
    """A search in numbers."""
    return {
        "cost/predicted": search.predicted_cost,
        "search/evaluations": search.optimum.evaluations,
        **{f"bias/{name}": value for name, value in search.diagnostics.items()},
        **{f"identification/{name}": value for name, value in search.identification.items()},
    }


def _learning_metrics(learning: Learning) -> dict[str, float]:
    """What was learned, in numbers."""
    selection = learning.selection
    return {
        "model/reset": learning.reset,
        "data/samples": len(learning.data),
        "data/new": len(selection.transitions),
        "data/frames": selection.frames,
        "data/sampled": selection.sampled,
        **{f"data/rejected_{criterion}": count for criterion, count in selection.rejected.items()},
        **{f"evidence/{name}": value for name, value in learning.evidence.items()},
    }


def trial_metrics(record: TrialRecord) -> dict[str, float]:
    """A trial in numbers: what a sweep's table takes from it."""
    numbers = (record.experiments_until_success, record.iterations_until_success, record.seconds)
    named = zip(TRIAL_METRICS, numbers, strict=True)
    return {name: value for name, value in named if not isnan(value)}


def sweep_metrics(trials: DataFrame) -> dict[str, float]:
    """A sweep's trials, as `simbias.tracking.results` describes them, in numbers."""
    outcomes = list(trials["outcome"])
    counts = {
        name.replace(" ", "_"): outcomes.count(name) for name in ("succeeded", "not succeeded", "error")
    }
    means = {"experiments/mean": trials["experiments"].mean()} if trials["experiments"].notna().any() else {}
    return {**{f"trials/{name}": float(count) for name, count in counts.items()}, **means}


def tags(composition: Composition) -> dict[str, str]:
    """What a trial is and comes from: its identity, git commit, versions, user."""
    return {"hash": composition.hash, **origin()}


def origin() -> dict[str, str]:
    """Where a run comes from: git commit, versions, user."""
    tags = {"mlflow.source.name": "simbias", "mlflow.source.type": "LOCAL"}
    with suppress(OSError, KeyError):  # a user without a name, as in some containers
        tags["mlflow.user"] = getpass.getuser()
    versions = ", ".join(f"{package} {number}" for package, number in _versions().items())
    return {**tags, **_commit(), "versions": versions}


@cache
def _commit() -> dict[str, str]:
    """Commit of the checkout that the package runs from; nothing if it runs from none."""
    if not (PACKAGE.parent / ".git").exists():
        return {}
    try:
        commit = _git("rev-parse", "--verify", "HEAD")
        changed = bool(_git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return {}
    return {"git.changed": str(changed).lower(), "mlflow.source.git.commit": commit}


def _git(*arguments: str) -> str:
    """What git answers about the checkout."""
    command = ["git", "-C", str(PACKAGE.parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()


@cache
def _versions() -> dict[str, str]:
    """Versions of Python, simbias and what it requires."""
    versions = {"python": platform.python_version()}
    with suppress(PackageNotFoundError):
        required = [line for line in requires("simbias") or [] if "extra ==" not in line]
        for package in ("simbias", *(re.split(r"[^\w\-.]", line)[0] for line in required)):
            versions[package] = version(package)
    return versions
