"""A whole sweep on a cluster whose workers share neither disk nor modules."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from sweeping import FOLDERS, QUICK, trial_by_trial, write_sweep
from texts import write

import simbias
from simbias.config import ConfigError
from simbias.trial.folder import TrialFolder

pytestmark = pytest.mark.slow

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")


def on_another_disk(here: Path, there: Path) -> Callable[[], None]:
    """Has a worker see a folder's paths in another one, and work in neither."""

    def change(here: str = str(here), there: str = str(there)) -> None:  # sent as it is, not by its name
        import os
        from pathlib import Path

        from simbias.core import files
        from simbias.sweep import worker

        class There(type(Path())):  # type: ignore[misc]
            def __new__(cls, *parts: object) -> Path:  # type: ignore[misc]
                return Path(*(str(part).replace(here, there) for part in parts))

        worker.Path = files.Path = There  # type: ignore[assignment,misc]
        os.chdir("/")

    return change


HEAVIER = """
from pathlib import Path
from my_gaps import FACTOR
from simbias.core.files import ConfigFile
from simbias.robots.bongoboard.pymunk import PymunkBongoboard

class Heavier(PymunkBongoboard):
    def __init__(self, task, file: ConfigFile, other: ConfigFile) -> None:
        super().__init__(task, inertia_error=FACTOR * float(Path(file).read_text() + Path(other).read_text()))
        self.source_files = [file, other]
"""


@contextmanager
def cluster(folder: Path) -> Iterator[str]:
    """The address of a scheduler that talks TLS, with a worker that a shell in another folder started."""
    security = distributed.Security.temporary()
    (folder / "ca.pem").write_text(security.tls_ca_file)
    (folder / "cert.pem").write_text(f"{security.tls_client_key}\n{security.tls_client_cert}")
    tls = [f"--tls-ca-file={folder}/ca.pem", f"--tls-cert={folder}/cert.pem", f"--tls-key={folder}/cert.pem"]
    local = {"n_workers": 0, "security": security, "protocol": "tls", "dashboard_address": ":0"}
    with distributed.LocalCluster(**local) as scheduler:
        address = scheduler.scheduler_address
        command = [sys.executable, "-m", "dask", "worker", address, "--nthreads=1", "--no-nanny", *tls]
        process = subprocess.Popen(command, cwd=folder, stderr=subprocess.DEVNULL)
        try:
            yield address
        finally:
            process.terminate()
            process.wait()


def test_own_components_and_their_files_reach_workers_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TLS; modules beside the folder of configs, one that another imports, and files in and beside it.

    Folders of trials travel, of one that was stopped and of one that was not begun, of cells of one seed.
    """
    here, there = tmp_path / "here", tmp_path / "there"
    grid = "axes: {hardware.other: [one.txt, two.txt]}, common_seeds: [hardware.other]"
    conf = write_sweep(here, "mine", f"sweep: {{trials: 1, {grid}, figures: {{}}}}")
    heavier = "_target_: heavier.Heavier\nfile: gap.txt\nother: one.txt\n"
    write(conf, {"hardware/heavier.yaml": heavier, "gap.txt": "0.1"})
    write(here, {"heavier.py": HEAVIER, "my_gaps.py": "FACTOR = 2", "one.txt": "1", "two.txt": "2"})
    monkeypatch.syspath_prepend(here)
    monkeypatch.chdir(here)
    sweep = ["+sweep=mine", "hardware=heavier", *QUICK, *FOLDERS, "cost.max_cost=1e-3"]
    simbias.run_sweep([*sweep, "engine=sequential"], conf)
    expected = trial_by_trial(here)
    stopped, not_begun = (here / "trials" / identity for identity in expected)
    for file in (stopped / "outcome.json", *TrialFolder(stopped).steps()[3:]):
        file.unlink()
    shutil.rmtree(not_begun)
    with cluster(tmp_path) as address:
        clustered = [*sweep, "engine=dask", f"engine.address={address}"]
        with monkeypatch.context() as patch:
            patch.setattr("simbias.engine.dask.CONNECT_SECONDS", 0.3)
            with pytest.raises(ConfigError, match=r"engine\.address: tls://.*: no scheduler answers"):
                simbias.run_sweep(clustered, conf)
        keys = {"ca-file": "ca.pem", "client.cert": "cert.pem"}
        with dask.config.set({f"distributed.comm.tls.{key}": f"{tmp_path}/{f}" for key, f in keys.items()}):
            with distributed.Client(address) as client:
                client.wait_for_workers(1)
                assert client.run(on_another_disk(here, there))
            simbias.run_sweep(clustered, conf)
    assert trial_by_trial(here) == expected
    assert len(TrialFolder(stopped).attempts()) == 2  # the second of them there
    assert not (there / "trials").exists()
