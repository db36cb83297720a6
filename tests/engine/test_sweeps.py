"""Whole sweeps on clusters whose workers share no disk."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from processes import wait_for
from sweeping import FOLDERS, NO_FIGURES, QUICK, trial_by_trial, write_sweep

import simbias
from simbias.config import ConfigError
from simbias.core import files
from simbias.sweep import worker
from simbias.trial.folder import TrialFolder

pytestmark = pytest.mark.slow

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")


def on_another_disk(here: str, there: str) -> None:
    """Have a worker see this folder's paths in another one, and work in neither."""
    for module in (worker, files):
        module.Path = lambda name: Path(str(name).replace(here, there))  # type: ignore[attr-defined]
    os.chdir("/")


def test_workers_that_share_no_disk_get_and_send_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a trial that was stopped, and of one that was not begun."""
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    monkeypatch.chdir(here)
    sweep = ["+sweep=smoke", "sweep.trials=1", NO_FIGURES, *QUICK, *FOLDERS, "cost.max_cost=1e-3"]
    simbias.run_sweep([*sweep, "engine=sequential"])
    expected = trial_by_trial(here)
    stopped, not_begun = (here / "trials" / identity for identity in expected)
    for file in (stopped / "outcome.json", *TrialFolder(stopped).steps()[3:]):
        file.unlink()
    shutil.rmtree(not_begun)
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster:
        cluster.get_client().run(on_another_disk, str(here), str(there))
        simbias.run_sweep([*sweep, "engine=dask", f"engine.address={cluster.scheduler_address}"])
    assert trial_by_trial(here) == trial_by_trial(there) == expected
    assert len(TrialFolder(there / "trials" / stopped.name).attempts()) == 2  # the first of them from here


HEAVIER = """
from pathlib import Path
from my_gaps import FACTOR
from simbias.core.files import ConfigFile
from simbias.robots.bongoboard.pymunk import PymunkBongoboard

class Heavier(PymunkBongoboard):
    def __init__(self, task, file: ConfigFile) -> None:
        super().__init__(task, inertia_error=FACTOR * float(Path(file).read_text()))
"""


@contextmanager
def cluster(folder: Path) -> Iterator[str]:
    """The address of a scheduler of its own process that talks TLS, and a worker, each in another folder."""
    security = distributed.Security.temporary()
    (folder / "ca.pem").write_text(security.tls_ca_file)
    (folder / "cert.pem").write_text(f"{security.tls_client_key}\n{security.tls_client_cert}")
    tls = [f"--tls-ca-file={folder}/ca.pem", f"--tls-cert={folder}/cert.pem", f"--tls-key={folder}/cert.pem"]
    file = folder / "scheduler.json"
    commands = (["scheduler", "--protocol=tls", "--port=0", "--no-dashboard"], ["worker", "--nthreads=1"])
    with ExitStack() as stack:
        for command in commands:
            place = folder / command[0]
            place.mkdir()
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *command, *tls, f"--scheduler-file={file}"],
                cwd=place,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)
            wait_for(file.exists)
        yield json.loads(file.read_text())["address"]


def test_own_components_and_their_files_reach_workers_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TLS; modules beside the folder of configs, one that another imports, and a relative file in it."""
    here, there = tmp_path / "here", tmp_path / "there"
    conf = write_sweep(here, "mine", "sweep: {trials: 1, axes: {}, figures: {}}")
    (conf / "hardware").mkdir()
    (conf / "hardware" / "heavier.yaml").write_text("_target_: heavier.Heavier\nfile: gap.txt\n")
    (conf / "gap.txt").write_text("0.1")
    (here / "heavier.py").write_text(HEAVIER)
    (here / "my_gaps.py").write_text("FACTOR = 2")
    monkeypatch.syspath_prepend(here)
    monkeypatch.chdir(tmp_path)
    sweep = ["+sweep=mine", "hardware=heavier", *QUICK, *FOLDERS]
    simbias.run_sweep([*sweep, "engine=sequential"], conf)
    expected = trial_by_trial(tmp_path)
    shutil.rmtree("trials")
    with cluster(tmp_path) as address:
        clustered = [*sweep, "engine=dask", f"engine.address={address}"]
        with pytest.raises(ConfigError, match=r"engine\.address: tls://.*: no scheduler answers"):
            simbias.run_sweep(clustered, conf)
        keys = {"ca-file": "ca.pem", "client.cert": "cert.pem"}
        with dask.config.set({f"distributed.comm.tls.{key}": f"{tmp_path}/{f}" for key, f in keys.items()}):
            with distributed.Client(address) as client:
                client.run(on_another_disk, str(here), str(there))
            simbias.run_sweep(clustered, conf)
    assert trial_by_trial(tmp_path) == expected
