"""A sweep whose hardware misbehaves in every way, then is mended."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from faulty_hardware import LEFT, MENDED
from sweeping import FOLDERS, run, write_sweep

from simbias.trial.folder import TrialFolder

pytestmark = pytest.mark.slow

DEADLY = ["SIGKILL beside a child"]  # each takes six workers; tests of engines have others
SWEEP = """
task: {{horizon: 100}}
optimizer: {{max_evaluations: 20}}
method: {{max_iterations: 1}}
cost: {{max_cost: 1e-3}}
sweep:
  trials: 1
  axes:
    hardware.fault: [{faults}]
"""


def test_a_sweep_continues_whatever_its_hardware_does(tmp_path: Path) -> None:
    """A cell for each fault, those that end the process too; mended, the same command runs what is missing.

    Nobody waits for what they leave behind.
    """
    raised = ["speechless", "no UTF-8", "exit", "cancelled", "own words"]
    returned = ["list", "columns", "ended early", "NaN"]
    fine = ["float32", "none", *LEFT]
    faults = [*raised, *returned, *DEADLY, "hangs", *fine]
    conf = write_sweep(tmp_path, "mine", SWEEP.format(faults=", ".join(f'"{fault}"' for fault in faults)))
    (conf / "hardware").mkdir()
    (conf / "hardware" / "faulty.yaml").write_text("_target_: faulty_hardware.Faulty\nfault: none\n")
    (conf / "components.yaml").write_text("allow: [faulty_hardware]\n")
    command = ["--config-dir", "conf", "+sweep=mine", "hardware=faulty", "experiment_timeout=2", *FOLDERS]
    status, out, err = run(*command, folder=tmp_path)
    assert status == 1, out + err
    assert "Traceback" not in err
    for fault in faults:
        (line,) = re.findall(rf"^\[\d+/{len(faults)}\] {re.escape(fault)} #0: (.*)$", out, re.MULTILINE)
        if fault in fine:
            assert line.startswith("not succeeded after 2 experiments")
        elif fault in DEADLY:
            assert line.startswith("its worker died 3 times"), line
        elif fault != "own words":
            assert line.startswith("HardwareError: Faulty.run: "), (fault, line)
            assert "expected" in line
    assert out.count("(traceback in ") == len([*raised, *returned, "hangs"])
    trials = [TrialFolder(file.parent) for file in (tmp_path / "trials").glob("*/trial.json")]
    assert (len(trials), sum(trial.ended for trial in trials)) == (len(faults), len(fine))
    assert sum((trial.path / "refused_0000.json").exists() for trial in trials) == len(returned)
    (tmp_path / MENDED).touch()
    status, out, err = run(*command, "engine=sequential", folder=tmp_path)
    assert (status, err) == (0, ""), out + err
    assert all(trial.ended for trial in trials)
