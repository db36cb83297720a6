"""SIGKILLs at random instants, of trials, sweeps and exports: is anything lost, made twice or left behind?

`python sweeps/studies/soak.py FOLDER [--kills 30] [--seed 0]` writes FOLDER/soak.csv, a row for each
campaign. The same command is started and its whole process group killed, again and again, until it is left
alone. Then the trials' folders are compared with those of an uninterrupted run, the runs in MLflow likewise,
and the experiments that the hardware has begun with those that were kept.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlparse

import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))  # the tests' own helpers
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from logged_hardware import LOG
from mlflow.entities import Run
from sweeping import client_of, finish, run, start, trial_by_trial

SHORT = [
    *("task.horizon=300", "optimizer.max_evaluations=30", "method.max_iterations=4", "cost.max_cost=1e-3"),
    *("hardware=logged", "hardware.seconds=0.3", "tracking.pictures=true"),
]
OWN = ["--config-dir", "conf"]
SWEEP = "sweep: {trials: 3, axes: {bias: [gp, none]}}"
COMMANDS = {"trial": [*OWN, *SHORT], "sweep": [*OWN, "+sweep=mine", *SHORT], "export": ["export"]}
MOST = 4  # kills of a campaign, on average


@dataclass(frozen=True)
class Uninterrupted:
    """A run that is left alone."""

    folder: Path  # before it, but for exports without a store
    trials: object
    runs: object
    begun: Counter[str]
    seconds: float


def begun(folder: Path) -> Counter[str]:
    """How often an experiment from each start was begun."""
    log = folder / LOG
    return Counter(log.read_text().splitlines() if log.exists() else [])


def ended(folder: Path) -> bool:
    """Whether all trials that began have ended, though the process has not."""
    trials = list(folder.glob("trials/*/trial.json"))
    return bool(trials) and all((file.parent / "outcome.json").exists() for file in trials)


def prepared(folder: Path) -> Path:
    """A folder with the configs of the campaign."""
    for name, text in (
        ("components", "allow: [logged_hardware]\n"),
        ("hardware/logged", "_target_: logged_hardware.Logged\nseconds: 0.2\n"),
        ("sweeps/mine", SWEEP),
    ):
        path = folder / "conf" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def exported(folder: Path) -> dict[str, object]:
    """Runs of the store by their hashes: status, metrics of each iteration but times, names of files."""
    client = client_of(folder)
    experiment = client.get_experiment_by_name("simbias")
    assert experiment is not None
    found = client.search_runs([experiment.experiment_id])
    assert len({run.data.tags["hash"] for run in found}) == len(found)
    return {run.data.tags["hash"]: _run(folder, run) for run in found}


def _run(folder: Path, run: Run) -> dict[str, object]:
    """A run, comparable."""
    client, files = client_of(folder), Path(unquote(urlparse(run.info.artifact_uri).path))
    names = [name for name in run.data.metrics if not name.startswith(("seconds/", "trial/seconds"))]
    histories = {name: client.get_metric_history(run.info.run_id, name) for name in names}
    inside = [str(file.relative_to(files)) for file in files.rglob("*") if file.is_file()]
    return {
        "status": run.info.status,
        "outcome": run.data.tags.get("outcome"),
        "metrics": {name: [(each.step, each.value) for each in own] for name, own in histories.items()},
        "files": sorted(inside),
    }


def difference(there: object, expected: object, where: str = "") -> str:
    """The first place where what a store holds is not as expected; "" if it is."""
    if isinstance(there, dict) and isinstance(expected, dict):
        for key in [*expected, *there]:
            if key not in there or key not in expected:
                return f"{where}/{key} is {'missing' if key in expected else 'strange'}"
            if found := difference(there[key], expected[key], f"{where}/{key}"):
                return found
        return ""
    return "" if there == expected else f"{where}: {str(there)[:200]}, expected {str(expected)[:200]}"


def uninterrupted(kind: str, folder: Path) -> Uninterrupted:
    """A run that is left alone, once all is compiled; exports are of the trials of such a sweep."""
    first, before, after = (folder / kind / name for name in ("first", "before", "after"))
    swept = COMMANDS["sweep" if kind == "export" else kind]
    run(*swept, folder=prepared(first), timeout=300)
    prepared(before)
    if kind == "export":
        shutil.copytree(first / "trials", before / "trials")
    shutil.copytree(before, after)
    began = time.monotonic()
    status, out, err = run(*COMMANDS[kind], folder=after, timeout=300)
    seconds = time.monotonic() - began
    assert status == (1 if kind == "trial" else 0), out + err
    return Uninterrupted(before, trial_by_trial(after), exported(after), begun(after), seconds)


def campaign(kind: str, kills: int, rng: random.Random, expected: Uninterrupted) -> dict[str, object]:
    """Kill the command so often, or until it ends sooner, then leave it alone; what came of it."""
    command = COMMANDS[kind]
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryDirectory() as temporary:
        folder = Path(shutil.copytree(expected.folder, Path(name, "here")))
        struck = at_the_end = 0
        while struck < kills:
            process = start(*command, folder=folder, temporary=Path(temporary))
            try:
                process.wait(rng.uniform(0.0, 1.1 * expected.seconds))
                break
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                struck, at_the_end = struck + 1, at_the_end + ended(folder)
            finally:
                finish(process)
        left_by_kills = len(list(Path(temporary).iterdir()))
        status, _, err = run(*command, folder=folder, timeout=300, temporary=Path(temporary))
        made = begun(folder)
        differs = difference(trial_by_trial(folder), expected.trials)
        return {
            "kind": kind,
            "kills": struck,
            "at_the_end": at_the_end,  # when all trials had ended: drawing, exporting, tidying up
            "status": status,
            "differs": differs or difference(exported(folder), expected.runs, "mlflow"),
            "experiments": sum(expected.begun.values()),
            "begun_again": sum((made - expected.begun).values()),  # under way when killed
            "missing": sum((expected.begun - made).values()),
            "strange": len(set(made) - set(expected.begun)),
            "parts_left": len(list(folder.rglob("*.part"))),  # of files that were being written
            "temporary_by_kills": left_by_kills,
            "temporary_left": len(list(Path(temporary).iterdir())),
            "said": json.dumps(err[-200:]),
        }


def good(row: dict[str, object]) -> bool:
    """Whether a campaign ended as if nothing had been killed."""
    return not (row["differs"] or row["missing"] or row["strange"] or row["parts_left"])


def main() -> None:
    """Run the campaigns; print and write what came of them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=30, help="of each kind (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parsed = parser.parse_args()
    rng = random.Random(parsed.seed)
    parsed.folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as name:
        expected = {kind: uninterrupted(kind, Path(name)) for kind in COMMANDS}
        left = dict.fromkeys(COMMANDS, parsed.kills)
        while any(left.values()):
            kind = max(left, key=lambda each: left[each])
            kills = min(left[kind], rng.randint(1, 2 * MOST - 1))
            rows.append(campaign(kind, kills, rng, expected[kind]))
            left[kind] -= int(str(rows[-1]["kills"]))
            table = pd.DataFrame(rows)
            table.to_csv(parsed.folder / "soak.csv", index=False)
            print(rows[-1], flush=True)
    print(table.drop(columns=["kind", "said", "differs"]).sum().to_string())
    sys.exit(0 if all(map(good, rows)) else 1)


if __name__ == "__main__":
    main()
