"""SIGKILLs at random instants, of single trials and of sweeps: is anything lost, made twice or left behind?

`python sweeps/studies/soak.py FOLDER [--kills 30] [--seed 0]` writes FOLDER/soak.csv, a row for each
campaign. The same command is started and its whole process group killed, again and again, until it is left
alone. What the store holds then is compared with that of an undisturbed run, and the experiments that the
hardware has begun with those that were kept.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import closing
from pathlib import Path

import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))  # the tests' own helpers

from logged_hardware import LOG
from mlflow import MlflowClient
from sweeping import everything, finish, run, start, trial_by_trial

SHORT = [
    *("task.horizon=300", "optimizer.max_evaluations=30", "method.max_iterations=4", "cost.max_cost=1e-3"),
    *("hardware=logged", "hardware.seconds=0.1", "tracking.pictures=true"),
]
SWEEP = "sweep: {trials: 3, axes: {bias: [gp, none]}}"
COMMANDS = {"trial": SHORT, "sweep": ["+sweep=mine", *SHORT]}
MOST = 4  # kills of a campaign, on average


def begun(folder: Path) -> Counter[str]:
    """How often an experiment from each start was begun."""
    log = folder / LOG
    return Counter(log.read_text().splitlines() if log.exists() else [])


def ended(folder: Path) -> bool:
    """Whether all that the store holds has come to its end, though the process has not."""
    store = folder / "mlflow.db"
    if not store.exists():
        return False
    with closing(sqlite3.connect(store)) as database:
        states = {state for (state,) in database.execute("SELECT status FROM runs")}
    return states == {"FINISHED"}


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


def kept(kind: str, folder: Path) -> object:
    """What the store holds in the end."""
    if kind == "sweep":
        return trial_by_trial(folder)
    client = MlflowClient(tracking_uri=f"sqlite:///{folder}/mlflow.db")
    experiment = client.get_experiment_by_name("simbias")
    assert experiment is not None
    (only,) = client.search_runs([experiment.experiment_id])
    return everything(client, only)


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


def undisturbed(kind: str) -> tuple[object, Counter[str], float]:
    """The store, the experiments and the seconds of a run that is left alone, once all is compiled."""
    with tempfile.TemporaryDirectory() as name:
        run("--config-dir", "conf", *COMMANDS[kind], folder=prepared(Path(name)), timeout=300)
    with tempfile.TemporaryDirectory() as name:
        folder = prepared(Path(name))
        began = time.monotonic()
        status, out, err = run("--config-dir", "conf", *COMMANDS[kind], folder=folder, timeout=300)
        assert status == (1 if kind == "trial" else 0), out + err
        return kept(kind, folder), begun(folder), time.monotonic() - began


def campaign(
    kind: str, kills: int, rng: random.Random, expected: tuple[object, Counter[str], float]
) -> dict[str, object]:
    """Kill the command so often, or until it ends sooner, then leave it alone; what came of it."""
    store, experiments, seconds = expected
    command = ["--config-dir", "conf", *COMMANDS[kind]]
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryDirectory() as temporary:
        folder = prepared(Path(name))
        pids, struck, at_the_end = [], 0, 0
        while struck < kills:
            process = start(*command, folder=folder, temporary=Path(temporary))
            pids.append(process.pid)
            try:
                process.wait(rng.uniform(0.0, 1.1 * seconds))
                break
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                struck, at_the_end = struck + 1, at_the_end + ended(folder)
            finally:
                finish(process)
        left_by_kills = len(list(Path(temporary).iterdir()))
        status, _, err = run(*command, folder=folder, timeout=300, temporary=Path(temporary))
        made = begun(folder)
        return {
            "kind": kind,
            "kills": struck,
            "at_the_end": at_the_end,  # when all was kept: pictures were drawn, files tidied up
            "status": status,
            "differs": difference(kept(kind, folder), store),
            "experiments": sum(experiments.values()),
            "begun_again": sum((made - experiments).values()),  # under way when killed: at most one a worker
            "missing": sum((experiments - made).values()),
            "strange": len(set(made) - set(experiments)),
            "journals_left": (folder / "journals").exists(),
            "temporary_by_kills": left_by_kills,
            "temporary_left": len(list(Path(temporary).iterdir())),
            "said": json.dumps(err[-200:]),
        }


def main() -> None:
    """Run the campaigns; print and write what came of them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=30, help="of each kind (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parsed = parser.parse_args()
    rng = random.Random(parsed.seed)
    parsed.folder.mkdir(parents=True, exist_ok=True)
    expected, left = {kind: undisturbed(kind) for kind in COMMANDS}, dict.fromkeys(COMMANDS, parsed.kills)
    rows: list[dict[str, object]] = []
    while any(left.values()):
        kind = max(left, key=lambda each: left[each])
        kills = min(left[kind], rng.randint(1, 2 * MOST - 1))
        rows.append(campaign(kind, kills, rng, expected[kind]))
        left[kind] -= int(str(rows[-1]["kills"]))
        table = pd.DataFrame(rows)
        table.to_csv(parsed.folder / "soak.csv", index=False)
        print(rows[-1], flush=True)
    print(table.drop(columns=["kind", "said", "differs"]).sum().to_string())
    good = (
        (table["differs"] == "") & (table["missing"] == 0) & (table["strange"] == 0) & ~table["journals_left"]
    )
    sys.exit(0 if good.all() else 1)


if __name__ == "__main__":
    main()
