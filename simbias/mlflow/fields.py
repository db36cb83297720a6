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

from simbias.config.own_code import changed, digests
from simbias.core.records import Iteration, Learning, Search

if TYPE_CHECKING:
    from pandas import DataFrame

    from simbias.trial.run import TrialRecord
    from simbias.trial.study import Origin

Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the one in C is ten times as fast
PACKAGE = Path(__file__).resolve().parent.parent
KEY_LENGTH = 250  # MLflow's limits
VALUE_LENGTH = 6000

PARENT = "mlflow.parentRunId"  # MLflow's tag that nests runs
MACHINE = "machine"  # the tag that tells on which kind of machine a trial ran
SECONDS = "trial/seconds"  # the metric that tells how long a trial took
TRIAL_METRICS = ("trial/experiments", "trial/iterations", SECONDS)
HELD_OUT = "held_out"  # the tag that tells from which held-out starts the last policy holds: 1 where it does
LATER_METRICS = (  # that trials of earlier versions lack, and those whose last policy was not tried
    *("trial/hardware_seconds", "held_out/held", "held_out/lasted", "held_out/seconds"),
)
CODE = "code"  # the tag that has digests of the user's own modules
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


def parameters(composition: Origin) -> dict[str, str]:
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
    named = dict(zip(TRIAL_METRICS, numbers, strict=True))
    tries = record.held_out
    later = (tries.held, tries.lasted, tries.seconds) if tries else ()
    named |= zip(LATER_METRICS, (record.hardware_seconds, *later), strict=False)
    return {name: value for name, value in named.items() if not isnan(value)}


def holds(record: TrialRecord) -> str:
    """From which held-out starts the last policy holds, as the tag says it; empty if it was not tried."""
    return "".join("1" if held else "0" for held in record.held_out.holds) if record.held_out else ""


def sweep_metrics(trials: DataFrame) -> dict[str, float]:
    """A sweep's trials, as `simbias.mlflow.results` describes them, in numbers."""
    outcomes = list(trials["outcome"])
    counts = {
        name.replace(" ", "_"): outcomes.count(name) for name in ("succeeded", "not succeeded", "error")
    }
    means = {"experiments/mean": trials["experiments"].mean()} if trials["experiments"].notna().any() else {}
    return {**{f"trials/{name}": float(count) for name, count in counts.items()}, **means}


def tags(composition: Origin) -> dict[str, str]:
    """What a trial is and comes from: its identity, git commit, versions, user."""
    own = digests(composition.config)
    return {"hash": composition.hash, **({CODE: json.dumps(own)} if own else {}), **origin()}


def changed_code(tags: Mapping[str, str], composition: Origin) -> str:
    """The modules of the user's that have changed since a run was tagged, in words; "" if none has."""
    if CODE not in tags:  # of an earlier version of simbias, or without own components
        return ""
    try:
        before = json.loads(tags[CODE])
    except ValueError:
        return ""
    return changed(before, digests(composition.config))


def machine_tags(record: TrialRecord) -> dict[str, str]:
    """What a trial ran on; of one that went on elsewhere, all kinds of machines."""
    if not record.machines:
        return {}
    return {MACHINE: " then ".join(record.machines)[:VALUE_LENGTH], "processor": record.processor}


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
