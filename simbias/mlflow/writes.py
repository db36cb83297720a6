"""Writing into an MLflow run: a few large writes take a fraction of many small ones' time."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.engine import workplace

if TYPE_CHECKING:
    from mlflow import MlflowClient

BATCH = 100  # parameters that MLflow takes at once
METRICS = 800  # metrics at once: MLflow takes 1000 of metrics, parameters and tags

Point = tuple[str, float, int, float]  # name, value, step, s since the epoch
Files = Mapping[str, Path | bytes]  # by their names among the artifacts: what is copied, or written


def size(content: Path | bytes) -> int:
    """The number of bytes that a file will have."""
    return len(content) if isinstance(content, bytes) else content.stat().st_size


def flush(
    client: MlflowClient,
    run_id: str,
    files: Files,
    parameters: Mapping[str, str],
    metrics: Sequence[Sequence[Point]],
    tags: Mapping[str, str],
) -> None:
    """Write all of it: files first, so that who finds metrics finds all; those of a list stay together."""
    from mlflow.entities import Metric, Param, RunTag

    if files:
        with workplace.temporary_folder() as folder:
            for name, content in files.items():
                path = Path(folder, name)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content) if isinstance(content, bytes) else shutil.copyfile(content, path)
            client.log_artifacts(run_id, folder)
    params = [Param(key, value) for key, value in parameters.items()]
    for start in range(BATCH, len(params), BATCH):
        client.log_batch(run_id, params=params[start : start + BATCH])
    *before, last = [
        [Metric(name, value, int(1000 * time), step) for name, value, step, time in batch]
        for batch in _batches(metrics)
    ]
    for batch in before:
        client.log_batch(run_id, metrics=batch)
    own_tags = [RunTag(key, value) for key, value in tags.items()]
    client.log_batch(run_id, metrics=last, params=params[:BATCH], tags=own_tags)


def _batches(lists: Sequence[Sequence[Point]]) -> list[list[Point]]:
    """Lists of metrics, put together as far as MLflow takes them at once; those of a list stay together."""
    batches: list[list[Point]] = [[]]
    for metrics in lists:
        for start in range(0, len(metrics), METRICS):
            part = metrics[start : start + METRICS]
            if len(batches[-1]) + len(part) > METRICS:
                batches.append([])
            batches[-1] += part
    return batches
