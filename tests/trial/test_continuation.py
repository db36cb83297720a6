"""A trial with larger limits begins with the steps of one that ended without success."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import OWN_CONF, POINT_MASS
from errors import one_line
from hardware import Doing, counted
from records import assert_equal, step_names, timeless

import simbias
from simbias.__main__ import main
from simbias.config.stored import read_folder
from simbias.core.records import Rollout
from simbias.report.pages import trial_page
from simbias.trial.continuation import continue_trial
from simbias.trial.folder import TrialFolder, withdraw
from simbias.trial.run import read_trial, run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome

TEST = ["policy_test.episodes=2", "policy_test.long_episodes=0"]
ITS = "0005_experiment.npz"  # the first of iteration 1


def failing(*overrides: str) -> Study:
    """A point mass in a wind that no policy withstands, with these limits."""
    study = simbias.load(
        [*POINT_MASS, *TEST, "tracking=none", "optimizer.max_evaluations=20", *overrides], OWN_CONF
    )

    def blown(rollout: Rollout) -> Rollout:
        return replace(rollout, failed_at=rollout.frames, failure="wind")

    return replace(
        study,
        hardware=Doing(study.hardware, blown),
        hardware_of=lambda task: Doing(study.hardware_of(task), blown),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "limits", [["method.max_iterations=2"], ["budget.experiments=3", "method.max_iterations=4"]]
)
def test_it_ends_as_a_trial_with_larger_limits(limits: Sequence[str], tmp_path: Path) -> None:
    """Only further experiments are made; the budget may have ended within a policy."""
    earlier, more = failing(*limits), failing("method.max_iterations=4")
    ended = run_trial(earlier, tmp_path / "earlier")
    before = {file.name: file.read_bytes() for file in TrialFolder(tmp_path / "earlier").files()}
    counting, log = counted(more)
    for _ in range(2):  # the same command resumes it
        continue_trial(counting, tmp_path / more.hash, tmp_path / "earlier", lambda _: ended)
        record = run_trial(counting, tmp_path / more.hash)
    whole = run_trial(more, tmp_path / "whole")
    assert_equal(timeless(record), timeless(whole))
    assert record.summary.seconds > ended.summary.seconds
    assert step_names(tmp_path / more.hash) == step_names(tmp_path / "whole")
    assert log.count("made") == whole.summary.experiments - ended.summary.experiments + 2  # the test's
    assert {file.name: file.read_bytes() for file in TrialFolder(tmp_path / "earlier").files()} == before
    page = trial_page(tmp_path / more.hash, OWN_CONF, ())
    assert f"It continues trial {earlier.hash}, which made {ended.summary.experiments} experiments." in page


@pytest.mark.slow
def test_withdrawn_experiments_stay_out(tmp_path: Path) -> None:
    """So do withdrawn test episodes; the earlier trial is no longer needed once its steps are copied."""
    earlier, more = failing("method.max_iterations=2"), failing("method.max_iterations=3")
    source, folder = tmp_path / "earlier", tmp_path / "more"
    run_trial(earlier, source)
    for name in (ITS, "0013_test_episode.npz"):
        withdraw(source / name, "a loose cable")
        ended = run_trial(earlier, source)
    kept = [file.read_bytes() for file in TrialFolder(source).steps() if "test" not in file.name]
    continue_trial(more, folder, source, lambda _: ended)
    assert [file.read_bytes() for file in TrialFolder(folder).steps()] == kept
    record = run_trial(more, folder)
    shutil.rmtree(source)
    continue_trial(more, folder, source, read_folder)
    assert record.withdrawn == ()
    assert_equal(timeless(read_trial(more, folder)), timeless(record))


@pytest.mark.slow
def test_what_cannot_be_continued_is_named(tmp_path: Path) -> None:
    """Nothing is written."""
    earlier, more = failing("method.max_iterations=1"), failing("method.max_iterations=2")
    folder, source = tmp_path / "more", tmp_path / "earlier"
    ended = run_trial(earlier, source)

    def refuses(words: str, study: Study, outcome: Outcome = Outcome.NOT_SUCCEEDED) -> None:
        other = replace(ended, summary=replace(ended.summary, outcome=outcome))
        with one_line(words):
            continue_trial(study, folder, source, lambda _: other)

    refuses("has succeeded", more, Outcome.SUCCEEDED)
    refuses("has not ended; its own command resumes it", more, Outcome.WAITING)
    refuses("has made 1 iteration and 2 experiments, .* s on hardware; raise method.max_iterations$", earlier)
    spent = failing("method.max_iterations=2", "budget.experiments=2", "budget.seconds=1")
    refuses("; raise budget.experiments and budget.seconds$", spent)
    other = failing("method.max_iterations=2", "seed=1", "method.experiments=3")
    refuses("differs in method.experiments, seed; only budget and", other)
    assert not folder.exists()
    run_trial(more, folder)
    refuses("began without the steps of", more)


def test_the_command_line_continues_a_single_trial_that_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    own = ["--config-dir", str(OWN_CONF), *POINT_MASS]
    for command, said in (
        (["+sweep=smoke", "--continue", "trials/earlier"], "--continue: a sweep continues no trial"),
        ([*own, "tracking=none", "--continue", "trials/earlier"], "--continue: nothing would be kept"),
        (
            [*own, "tracking=folders", "--continue", "trials/earlier"],
            "trials/earlier: is not the folder of a trial",
        ),
    ):
        assert main(command) == 2
        assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
