"""An experiment that a person withdraws: kept, marked, and as if it had not been."""

import multiprocessing
import os
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from errors import one_line
from hardware import counted
from records import assert_equal, timeless

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError
from simbias.core import Hardware, Policy
from simbias.core.records import Array, Rollout
from simbias.lab.requests.manual import Manual
from simbias.trial import folder as folders
from simbias.trial.disk import LOCK, locked
from simbias.trial.folder import ATTEMPTS, OUTCOME, TRIAL, TrialFolder, withdraw
from simbias.trial.run import TrialRecord, read_trial, run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome

LOOSE = "0005_experiment.npz"  # the first of iteration 1


class Loose(Hardware):
    """A wind that no policy withstands, and a cable that is loose in the third experiment."""

    sets_start = False

    def __init__(self, hardware: Hardware) -> None:
        self._hardware = hardware
        self.loose = True
        self.drawn: list[float] = []  # from each experiment's generator

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        self.drawn.append(rng.random())
        rollout = self._hardware.run(policy, theta, start, rng)
        states = -rollout.states if self.loose and len(self.drawn) == 3 else rollout.states
        return replace(rollout, states=states, failed_at=rollout.frames, failure="wind")


Ended = tuple[Study, Loose, Path]


@pytest.fixture
def ended(tmp_path: Path) -> Ended:
    """A study whose hardware had a loose cable, and the folder of its trial."""
    short = ["tracking=none", "optimizer.max_evaluations=20", "method.max_iterations=3"]
    study = simbias.load([*POINT_MASS, *short], OWN_CONF)
    hardware, folder = Loose(study.hardware), tmp_path / "trial"
    study = replace(study, hardware=hardware)
    assert run_trial(study, folder).outcome is Outcome.NOT_SUCCEEDED
    hardware.loose = False
    return study, hardware, folder


def of_iterations(record: TrialRecord) -> TrialRecord:
    """A record without what tells of withdrawals and attempts."""
    return replace(timeless(record), withdrawn=())


@pytest.mark.slow
def test_the_trial_goes_on_as_if_it_had_not_been(ended: Ended) -> None:
    """What does not depend on it is not made again, and nothing is deleted."""
    study, hardware, folder = ended
    before = {file.name: file.read_bytes() for file in [folder / OUTCOME, *TrialFolder(folder).steps()]}
    withdrawal = withdraw(folder / LOOSE, "a loose cable")
    assert not TrialFolder(folder).ended
    assert len(read_trial(study, folder).iterations) == 1
    record = run_trial(study, folder)
    assert_equal(of_iterations(record), timeless(run_trial(study)))
    assert record.withdrawn == (withdrawal,)
    assert str(withdrawal) == f"{LOOSE} was withdrawn: a loose cable"
    assert withdrawal.superseded == tuple(sorted(before)[6:-1])
    assert all((folder / name).read_bytes() == content for name, content in before.items())
    kinds = [file.name[5:] for file in TrialFolder(folder).steps()]
    assert kinds == [name[5:] for name in sorted(before)[:-1]]
    made = hardware.drawn[6:9]  # that one anew, with noise of its own, and those of a later policy
    assert len(hardware.drawn) == 6 + 3 + 6  # the last of which were made without a folder
    assert made[0] not in hardware.drawn[:6]
    assert made[1:] == hardware.drawn[4:6]
    for again in (run_trial(study, folder), read_trial(study, folder)):
        assert_equal(again, record)


@pytest.mark.slow
def test_it_may_be_withdrawn_again_and_again(ended: Ended) -> None:
    """Also an earlier one; each has noise of its own, and one that was superseded alone counts again."""
    study, hardware, folder = ended
    withdraw(folder / LOOSE)
    run_trial(study, folder)
    anew = TrialFolder(folder).steps()[5]
    withdraw(anew)
    run_trial(study, folder)
    assert len({hardware.drawn[2], hardware.drawn[6], hardware.drawn[9]}) == 3
    count = len(hardware.drawn)
    withdraw(TrialFolder(folder).steps()[2])
    record = run_trial(study, folder)
    assert len(hardware.drawn) == count + 1  # the others follow, as it gave the same
    assert_equal(of_iterations(record), timeless(run_trial(study)))
    assert [file.name for file in sorted(folder.glob("outcome*"))] == [
        OUTCOME,
        *(f"outcome_{n}.json" for n in (1, 2, 3)),
    ]


@pytest.mark.slow
def test_stopped_anywhere_it_is_resumed_as_uninterrupted(ended: Ended, tmp_path: Path) -> None:
    study, _, folder = ended
    withdraw(folder / LOOSE)
    begun = len(TrialFolder(folder).all_steps())
    whole = run_trial(study, folder)
    made = TrialFolder(folder).all_steps()[begun:]
    for lost in range(len(made) + 1):
        cut = tmp_path / str(lost)
        shutil.copytree(folder, cut)
        (cut / "outcome_1.json").unlink()
        for file in made[len(made) - lost :]:
            (cut / file.name).unlink()
        same, log = counted(study)
        assert_equal(timeless(run_trial(same, cut)), timeless(whole))
        lost_experiments = [file.name for file in made[len(made) - lost :] if file.suffix == ".npz"]
        assert log.count("made") == len(set(lost_experiments) - {"0013_experiment.npz"})  # kept superseded


@pytest.mark.slow
def test_killed_while_it_is_withdrawn_it_is_or_it_is_not(
    ended: Ended, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, hardware, folder = ended

    def killed(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with monkeypatch.context() as patch:
        patch.setattr(folders, "append_line", killed)
        process = multiprocessing.get_context("fork").Process(target=withdraw, args=(folder / LOOSE,))
        process.start()
        process.join(20)
        assert process.exitcode == -signal.SIGKILL
    assert run_trial(study, folder).withdrawn == ()
    withdraw(folder / LOOSE)
    content = (folder / ATTEMPTS).read_bytes()
    for end in (1, 20, 100):  # a line that a kill cut off
        (folder / ATTEMPTS).write_bytes(content[:-end])
        assert TrialFolder(folder).ended == (end > 1)
    assert len(hardware.drawn) == 6
    withdraw(folder / LOOSE)
    assert len(run_trial(study, folder).withdrawn) == 1


@pytest.mark.slow
def test_a_withdrawal_that_is_damaged_or_gone_is_named(ended: Ended) -> None:
    """Once the trial has gone on, also one that looks as if a kill had cut it off."""
    study, _, folder = ended
    withdraw(folder / LOOSE)
    run_trial(study, folder)
    file, right = folder / ATTEMPTS, (folder / ATTEMPTS).read_bytes()
    damages = {
        right.replace(b'{"withdrawn"', b'["withdrawn"'): "line 2 is damaged",
        right.replace(b"withdrawn", b"withdrbwn"): r"has a line with unknown keys \['withdrbwn'\]",
        right.replace(b"[", b"\xff"): "line 2 is damaged",
        re.sub(rb"\], .*", b"", right): r"lists 0 withdrawals, but outcome_1\.json exists",
        b"": r"lists 0 withdrawals, but outcome_1\.json exists",
    }
    for damaged, words in damages.items():
        file.write_bytes(damaged)
        for read in (read_trial, run_trial):
            with one_line(rf"attempts\.jsonl: {words}"):
                read(study, folder)
        assert file.read_bytes() == damaged
    (folder / "outcome_1.json").unlink()
    for read in (read_trial, run_trial):  # by the steps after it alone
        with one_line(r"0012_experiment\.npz: does not fit the trial"):
            read(study, folder)


def test_what_is_no_experiment_that_counts_is_one_line(
    ended: Ended, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("simbias.trial.folder.LOCK_SECONDS", 0.1)
    _, _, folder = ended
    withdraw(folder / LOOSE)
    for name in ("0000_search.json", LOOSE, "0006_experiment.npz", "0099_experiment.npz", OUTCOME):
        with pytest.raises(
            ConfigError, match="is not an experiment that counts; those are: 0001_exp"
        ) as caught:
            withdraw(folder / name)
        assert caught.value.key == str(folder / name)
    with pytest.raises(ConfigError, match="is not in a trial's folder"):
        withdraw(tmp_path / LOOSE)
    assert not (tmp_path / LOCK).exists()
    trial, right = folder / TRIAL, (folder / TRIAL).read_bytes()
    trial.write_text("{")
    with pytest.raises(ConfigError, match=r"trial\.json: cannot be read"):
        withdraw(folder / "0001_experiment.npz")
    trial.write_bytes(right)
    held = locked(folder / LOCK, 0, ConfigError("", ""))
    with held, pytest.raises(ConfigError, match="another process is running this trial"):
        withdraw(folder / "0001_experiment.npz")


def test_the_command_line_withdraws(ended: Ended, capsys: pytest.CaptureFixture[str]) -> None:
    _, _, folder = ended
    assert main(["withdraw", str(folder / LOOSE), "--reason", "a loose cable"]) == 0
    assert f"{LOOSE} was withdrawn: a loose cable; 6 later steps" in capsys.readouterr().out
    assert main(["withdraw", str(folder / LOOSE)]) == 2
    assert f"{LOOSE}: is not an experiment that counts" in capsys.readouterr().err


@pytest.mark.slow
def test_a_lab_is_asked_anew(ended: Ended, tmp_path: Path) -> None:
    """By another request: the answer to the first one stays where it is."""
    study, _, folder = ended
    asking = replace(study, hardware=Manual(study.task, str(tmp_path / "requests")))
    withdraw(folder / "0002_experiment.npz")
    assert run_trial(asking, folder).outcome is Outcome.WAITING
    withdraw(folder / "0001_experiment.npz")
    assert run_trial(asking, folder).outcome is Outcome.WAITING
    assert run_trial(asking, folder).outcome is Outcome.WAITING
    assert len(list((tmp_path / "requests").iterdir())) == 2


@pytest.mark.slow
def test_an_episode_of_the_test_takes_the_place_of_no_experiment(tmp_path: Path) -> None:
    """LQR's experiments and the test's episodes are spawned alike."""
    lqr = ["preset=cartpole", "method=lqr", "task.horizon=50", "tracking=none", "seed=4"]
    test = ["policy_test.episodes=2", "policy_test.long_episodes=1", "policy_test.long_seconds=2"]
    study = simbias.load([*lqr, *test])
    first = run_trial(study, tmp_path)
    withdraw(tmp_path / "0000_experiment.npz")
    again = run_trial(study, tmp_path)
    for made, before in zip(again.iterations[0].experiments, first.iterations[0].experiments, strict=True):
        assert made.frames == study.task.horizon
        np.testing.assert_array_equal(made.states[0], before.states[0])
