"""The page of a trial and of a sweep: one file, of what the folders hold, and nothing in it runs."""

import json
import re
from contextlib import chdir
from html import escape
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from in_numpy import simulate_in_numpy
from sweeping import FOLDERS, write_sweep

import simbias
from simbias.__main__ import main
from simbias.core import markdown
from simbias.core.errors import ConfigError
from simbias.mlflow.notes import note
from simbias.pictures.trial.gallery import FIGURES
from simbias.report.pages import sweep_page, trial_page, write_report
from simbias.sweep.folder import CHANGED, SweepFolder
from simbias.trial.disk import write_json
from simbias.trial.folder import TrialFolder
from simbias.trial.run import run_trial
from simbias.trial.summary import Outcome, TrialSummary

pytestmark = pytest.mark.usefixtures("uncompiled")

EVIL = "<script>alert(1)</script>"
SWEEP = f"""
sweep:
  trials: 1
  axes:
    evil:
      keys: method.max_iterations
      values: [1, 2]
      labels: ["{EVIL}", b]
  report: {{measures: [experiments, succeeded, holds]}}
"""
LOADED = re.compile(r"""(src|href)=["'](?!data:image/png;base64,)|<script|<link|<iframe|url\(""")


def self_contained(html: str) -> bool:
    """Nothing is loaded from elsewhere, and nothing runs."""
    return html.startswith("<!DOCTYPE html>") and not LOADED.search(html)


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    short = ["task.horizon=50", "policy_test.episodes=3", "policy_test.long_episodes=0"]
    study = simbias.load(["preset=cartpole", "method=lqr", *short])
    folder = tmp_path_factory.mktemp("trials") / study.hash
    with pytest.MonkeyPatch.context() as patch:
        simulate_in_numpy(patch)  # for a module
        run_trial(study, folder)
    return folder


@pytest.mark.slow
def test_the_page_of_a_trial_tells_what_its_folder_does(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    some = {name: FIGURES[name] for name in ("costs", "phases")}
    monkeypatch.setattr("simbias.report.pages.FIGURES", some)
    (file,) = write_report(trial)
    html, summary = file.read_text(), json.loads((trial / "outcome.json").read_text())
    assert file == trial / "report.html"
    assert self_contained(html)
    said = [trial.name, f"its last policy {summary['claim']}", summary["test_words"]]
    said += ["max_iterations: 10", "numpy"]
    assert [words for words in said if words not in html] == []
    assert html.count("data:image/png;base64,") == 2


def test_the_page_and_the_note_have_what_was_identified(
    trial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("simbias.report.pages.FIGURES", {})
    folder = Path(copytree(trial, tmp_path / trial.name))
    step = next(folder.glob("*_iteration.json"))
    estimate = {"name": "<i>", "unit": "s", "declared": 0.0, "value": 0.02, "low": 0.01, "high": 0.03}
    step.write_text(json.dumps(json.loads(step.read_text()) | {"estimates": [estimate]}))
    row = [estimate["name"], "0", "0.02", "0.01", "0.03", "s"]
    html = trial_page(folder, None, ())
    assert "".join(f"<td>{escape(cell)}</td>" for cell in row) in html
    read = TrialFolder(folder)
    text = note(read.description(), read.iterations(), read.summary(), running=False)
    assert f"| {' | '.join(map(markdown.text, row))} |" in text
    assert text.endswith("`pictures/` if drawn.")  # of most trials of a sweep, none are


def test_what_files_say_is_text_and_never_markup(
    trial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a trial that somebody else made; one that is unfinished has a page, another folder none."""
    monkeypatch.setattr("simbias.report.pages.FIGURES", {})
    copy = tmp_path / trial.name
    copy.mkdir()
    with pytest.raises(ConfigError, match="is not the folder of a trial or sweep"):
        write_report(copy)
    for name in ("trial.json", "attempts.jsonl"):
        (copy / name).write_bytes((trial / name).read_bytes())
    with monkeypatch.context() as patch:
        patch.setattr("os.access", lambda path, mode: path != copy)
        patch.setattr("simbias.report.pages.trial_page", None)  # nothing is drawn before
        with pytest.raises(ConfigError, match=r"report\.html: cannot be written"):
            write_report(copy)
    assert "Interrupted after 0 hardware experiments" in write_report(copy)[0].read_text()
    for file in trial.iterdir():
        if file.is_file():
            (copy / file.name).write_bytes(file.read_bytes().replace(b'"numpy"', b'"<script>numpy"'))
    summary = json.loads((trial / "outcome.json").read_text())
    (copy / "outcome.json").write_text(json.dumps({**summary, "test_words": EVIL, "claim": EVIL}))
    description = json.loads((copy / "trial.json").read_text())
    write_json(copy / "trial.json", description | {"code": {EVIL: "another"}})
    html = write_report(copy)[0].read_text()
    assert self_contained(html)
    assert f"Code or files have changed since the trial began ({escape(EVIL)})" in html
    assert "&lt;script&gt;alert(1)" in html


@pytest.mark.slow
@pytest.mark.usefixtures("plain_predictions")
def test_the_page_of_a_sweep(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its tables, figures and counts; labels are the user's."""
    conf = write_sweep(tmp_path, "mine", SWEEP)
    quick = ["task.horizon=50", "optimizer.max_evaluations=5", "policy_test.episodes=2"]
    overrides = ["preset=cartpole", "policy_test.long_episodes=0", *quick, *FOLDERS]
    with chdir(tmp_path):
        command = ["--config-dir", str(conf), "+sweep=mine", "engine=sequential", *overrides]
        assert main(command) == 0
        assert main(["report", "trials"]) == 0
    out = capsys.readouterr().out
    (file,) = tmp_path.glob("trials/sweeps/*/report.html")
    assert f"Look at it:  {file.relative_to(tmp_path)}" in out
    html = file.read_text()
    assert self_contained(html)
    said = ["2 of 2 trials have ended; of these, ", "&lt;script&gt;alert(1)&lt;/script&gt;"]
    assert "Drawn from" not in html
    said += ["data:image/png;base64,", "preset=cartpole", "<th>succeeded</th>", "/1 ["]
    assert [words for words in said if words not in html] == []
    rows = re.findall("<tr>(<td>.*)</tr>", html)[:2]
    columns = np.array([re.findall("<td>(.*?)</td>", row) for row in rows])
    assert (columns != "").any(axis=0).all()  # none is empty
    state = json.loads((file.parent / "state.json").read_text())
    assert state["drawn"] == dict.fromkeys(state["captions"], 2)
    write_json(file.parent / "state.json", state | {"drawn": dict.fromkeys(state["captions"], 1)})
    page = sweep_page(SweepFolder(file.parent))
    assert "Drawn from 1 trial; it is drawn again once all have ended." in page
    assert escape(CHANGED) not in page
    outcome = next(tmp_path.glob("trials/*/outcome.json"))
    ended = json.loads(outcome.read_text())
    write_json(outcome, ended | {"experiments": 7, "max_experiments": 7})  # resumed after a withdrawal
    assert escape(CHANGED) in sweep_page(SweepFolder(file.parent))


def test_claims_that_a_test_contradicts_are_counted(tmp_path: Path) -> None:
    """A claim is of the time that an experiment takes, not of success."""
    tests = {"a": "00" * 8, "b": "11" * 8, "c": ""}
    for name, holding in tests.items():
        (tmp_path / name).mkdir()
        claim = {"claim": "holds", "claimed_share": 0.8, "test_episodes": "0" * len(holding)}
        claim["holding_episodes"] = holding
        write_json(tmp_path / name / "outcome.json", TrialSummary(Outcome.SUCCEEDED, **claim).as_json())
    folder = SweepFolder(tmp_path / "sweeps" / "mine")
    folder.begin({"name": "mine", "trials": dict.fromkeys(tests), "config": {}})
    html = sweep_page(folder)
    assert "the test of the last policy contradicts 1 of 2 (9% to 91%)" in html
    write_json(tmp_path / "c" / "outcome.json", TrialSummary(Outcome.ERROR).as_json())
    assert "of these, 2 succeeded. 1 trial raised an error and is left out." in sweep_page(folder)
    assert escape(CHANGED) not in sweep_page(folder)
    folder.write_state({"outcomes": {"succeeded": 3}, "digest": ""})  # before one was withdrawn
    assert "of these, 3 succeeded" in (html := sweep_page(folder))
    assert escape(CHANGED) in html
