"""What is to be written into an MLflow run: a few large writes take a fraction of many small ones' time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.engine import workplace

if TYPE_CHECKING:
    from mlflow import MlflowClient

BATCH = 100  # parameters that MLflow takes at once
METRICS = 800  # metrics at once: MLflow takes 1000 of metrics, parameters and tags

Point = tuple[str, float, int, float]  # name, value, step, s since the epoch
File = tuple[str, Callable[[Path], object]]  # name, what writes it


@dataclass
class Writes:
    """Files, parameters, metrics and tags that are written together."""

    files: list[File] = field(default_factory=list)
    parameters: dict[str, str] = field(default_factory=dict)
    metrics: list[list[Point]] = field(default_factory=list)  # those of a list are kept together
    tags: dict[str, str] = field(default_factory=dict)

    def flush(self, client: MlflowClient, run_id: str) -> None:
        """Write all of it: files first, so that who finds metrics finds all."""
        from mlflow.entities import Metric, Param, RunTag

        self._flush_files(client, run_id)
        parameters = [Param(key, value) for key, value in self.parameters.items()]
        for start in range(BATCH, len(parameters), BATCH):
            client.log_batch(run_id, params=parameters[start : start + BATCH])
        metrics = [
            [Metric(name, value, int(1000 * time), step) for name, value, step, time in batch]
            for batch in _batches(self.metrics)
        ]
        for batch in metrics[:-1]:
            client.log_batch(run_id, metrics=batch)
        tags = [RunTag(key, value) for key, value in self.tags.items()]
        client.log_batch(run_id, metrics=metrics[-1], params=parameters[:BATCH], tags=tags)

    def _flush_files(self, client: MlflowClient, run_id: str) -> None:
        """Write the files, all in one copy."""
        if not self.files:
            return
        with workplace.temporary_folder() as folder:
            for name, write in self.files:
                path = Path(folder, name)
                path.parent.mkdir(exist_ok=True)
                write(path)
            client.log_artifacts(run_id, folder)


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
