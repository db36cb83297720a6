"""A trial, read back from the store."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml
from threadpoolctl import threadpool_limits

from simbias.config import Composition, ConfigError
from simbias.config.allowed import beside, prefixes
from simbias.config.build import build
from simbias.core.records import Iteration, Learning, Optimum, Rollout, Search
from simbias.engine.workplace import temporary_folder
from simbias.mlflow.store import cause, find_run
from simbias.trial.files import (
    data_name,
    experiment_name,
    load_rollout,
    load_transitions,
    policy_name,
)
from simbias.trial.model_selection import learn, likeliest
from simbias.trial.run import RecordedTrial
from simbias.trial.study import Study

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

NO_TRACKING = {"_target_": "simbias.mlflow.none.NoTracking"}
FOLDERS = ("policies", "experiments", "data")
RESET = "model/reset"  # of iterations that learned
PER_ITERATION = (
    RESET,
    "experiments/total",
    "bias/",
    "evidence/",
    "identification/",
    "seconds/",
)  # metrics that are in no file


def load_trial(
    run_id: str,
    uri: str = "sqlite:///mlflow.db",
    config_dir: Path | str | None = None,
    allow: Sequence[str] = (),
) -> RecordedTrial:
    """The study of a run and its full records; the run may be one of a sweep's, or still go on.

    A store may be somebody else's: components of one's own have to be importable, and beside `config_dir` or
    in a module that `allow` names. What follows from the files is computed again: D_i from the
    experiments, and each fitted bias from the data of the iteration before.

    Raises
    ------
    ConfigError
        If the store cannot be used, has no such run, or the run is no trial, or its files are not complete.
    """
    client, run = find_run(uri, run_id)
    if "sweep" in run.data.tags:
        raise ConfigError(run_id, "is a sweep; each of its trials is a run of its own")
    if "hash" not in run.data.tags:
        raise ConfigError(run_id, "is no run of simbias")
    with temporary_folder() as folder:
        try:
            _download(client, run_id, Path(folder))
            study = build(_composition(Path(folder, "config.yaml"), run, config_dir, allow))
            with threadpool_limits(1, user_api="blas"):  # as when the trial ran
                iterations = tuple(_iterations(study, Path(folder), _metrics(client, run)))
        except ConfigError:
            raise
        except Exception as error:
            raise ConfigError(run_id, f"its files cannot be read ({cause(error)})") from error
    return RecordedTrial(run_id, study, iterations)


def _download(client: MlflowClient, run_id: str, folder: Path) -> None:
    """Copy a run's files."""
    for file in client.list_artifacts(run_id):
        if file.path in (*FOLDERS, "config.yaml"):
            client.download_artifacts(run_id, file.path, str(folder))


def _composition(path: Path, run: Run, config_dir: Path | str | None, allow: Sequence[str]) -> Composition:
    """What the trial was composed of, but for the store."""
    folders = [] if config_dir is None else [Path(config_dir)]
    config = {**yaml.safe_load(path.read_text()), "tracking": NO_TRACKING}
    values = {key for key, value in config.items() if not isinstance(value, Mapping)}
    choices = {name: text for name, text in run.data.params.items() if "." not in name and name not in values}
    allowed = (*prefixes(folders, allow), *beside(config, folders))
    return Composition(config, {**choices, "tracking": "none"}, allowed)


def _metrics(client: MlflowClient, run: Run) -> dict[int, dict[str, float]]:
    """The metrics of each iteration that are not in its files."""
    metrics: dict[int, dict[str, float]] = defaultdict(dict)
    for name in sorted(run.data.metrics):
        if name.startswith(PER_ITERATION):
            for metric in client.get_metric_history(run.info.run_id, name):
                metrics[metric.step][name] = metric.value
    return metrics


def _iterations(
    study: Study, folder: Path, metrics: Mapping[int, Mapping[str, float]]
) -> Iterator[Iteration]:
    """The records, as the method yielded them."""
    total, made = 0, list[Rollout]()
    taught: list[tuple[Rollout, ...]] = []
    model = study.model()
    for index in sorted(metrics):
        before, total = total, int(metrics[index]["experiments/total"])
        names = [experiment_name(index, experiment) for experiment in range(total - before)]
        experiments = tuple(_rollout(study, folder / name) for name in names)
        policy = json.loads((folder / policy_name(index)).read_text())
        search, learning = None, None
        if "search" in policy:
            optimum = Optimum(np.array(policy["parameters"]), **policy["search"])
            diagnostics = _of_group("bias", metrics[index])
            search = Search(
                *(optimum, policy["predicted_cost"], model.bias, diagnostics),
                *(model.nominal, model.nominal.estimates, _of_group("identification", metrics[index])),
            )
        made += experiments
        if RESET in metrics[index]:
            data, evidence = (
                load_transitions(folder / data_name(index)),
                _of_group("evidence", metrics[index]),
            )
            taught = [] if metrics[index][RESET] else taught
            if not policy["succeeded"]:
                taught.append(experiments)
                model = learn(study, likeliest(evidence), made, taught, data).model
            selection = study.samples.select(experiments, model.nominal)
            learning = Learning(selection, data, bool(metrics[index][RESET]), evidence)
        yield Iteration(
            index=index,
            parameters=np.array(policy["parameters"]),
            experiments=experiments,
            hardware_cost=policy["hardware_cost"],
            succeeded=policy["succeeded"],
            total_experiments=total,
            search=search,
            learning=learning,
            seconds=_of_group("seconds", metrics[index]),
        )


def _rollout(study: Study, path: Path) -> Rollout:
    """A hardware experiment; stores of version 0.1.0 have its failure in words."""
    rollout = load_rollout(path)
    names = {criterion.words: criterion.name for criterion in study.task.criteria}
    return replace(rollout, failure=names.get(rollout.failure or "", rollout.failure))


def _of_group(group: str, metrics: Mapping[str, float]) -> dict[str, float]:
    """The metrics of a group, without its name."""
    prefix = f"{group}/"
    return {name.removeprefix(prefix): value for name, value in metrics.items() if name.startswith(prefix)}
