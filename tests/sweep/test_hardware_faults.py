"""A sweep whose hardware misbehaves in every way, then is mended."""

import re
from pathlib import Path

import pandas as pd
import pytest
from faulty_hardware import CONF, LEFT, MENDED
from sweeping import FOLDERS, run, state, sweep_folder, write_sweep
from texts import write

from simbias.trial.folder import TrialFolder

pytestmark = pytest.mark.slow

RAISED, RETURNED = ["no UTF-8", "exit", "own words"], ["columns", "NaN"]
DEADLY = ["SIGKILL beside a child"]  # takes six workers
FINE = ["none", *LEFT]
FAULTS = [*RAISED, *RETURNED, *DEADLY, *FINE]  # one of a kind: tests/trial/test_faults.py has all
SWEEP = f"""
task: {{horizon: 100}}
optimizer: {{max_evaluations: 10}}
method: {{max_iterations: 1}}
cost: {{max_cost: 1e-3}}
sweep:
  trials: 1
  axes:
    hardware.fault: {FAULTS}
"""


def test_a_sweep_continues_whatever_its_hardware_does(tmp_path: Path) -> None:
    """A cell for each fault, those that end the process too; mended, the same command runs what is missing.

    Nobody waits for what they leave behind.
    """
    write(write_sweep(tmp_path, "mine", SWEEP), CONF)
    command = ["--config-dir", "conf", "+sweep=mine", "hardware=faulty", *FOLDERS]
    status, out, err = run(*command, folder=tmp_path)
    assert status == 1, out + err
    assert "Traceback" not in err
    for fault in FAULTS:
        (line,) = re.findall(rf"^\[\d+/{len(FAULTS)}\] {re.escape(fault)} #0: (.*)$", out, re.MULTILINE)
        if fault in FINE:
            assert line.startswith("not succeeded after 2 experiments")
        elif fault in DEADLY:
            assert line.startswith("its worker died 3 times"), line
        elif fault != "own words":
            assert line.startswith("HardwareError: Faulty.run: "), (fault, line)
            assert "expected" in line
    raised = [*RAISED, *RETURNED, *DEADLY]
    assert f"{len(raised)} trials raised an error" in out
    assert f"and {len(raised) - 5} more raised an error" in out
    assert out.count("(traceback in ") == len(raised) - len(DEADLY)
    assert state(tmp_path)["verdict"] == "**Ended**, some trials with an error"
    assert "1 raised" in state(tmp_path)["table"]
    told = pd.read_csv(sweep_folder(tmp_path) / "trials.csv", keep_default_na=False)
    told = told.set_index("hardware.fault")
    assert set(told.index[told["outcome"] == "error"]) == set(raised)
    assert told.loc["own words", "raised"] == "HardwareError: the battery is empty"
    # A neighbour that dies may have ended its first attempt; there is one traceback, of its last.
    (trace,) = (tmp_path / "trials" / told.loc["no UTF-8", "hash"]).glob("error_*.txt")
    assert "in _raise" in trace.read_text()
    trials = [TrialFolder(file.parent) for file in (tmp_path / "trials").glob("*/trial.json")]
    assert (len(trials), sum(trial.ended for trial in trials)) == (len(FAULTS), len(FINE))
    assert sum((trial.path / "refused_0000.json").exists() for trial in trials) == len(RETURNED)
    (tmp_path / MENDED).touch()
    status, out, err = run(*command, "engine=sequential", folder=tmp_path)
    assert (status, err) == (0, ""), out + err
    assert f"= {len(FAULTS)}, {len(FINE)} of them finished already" in out
    assert all(trial.ended for trial in trials)
