"""Nothing that was done is done again, and going on ends as if nothing had come between."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from records import assert_equal, timeless

import simbias
from simbias.config import ConfigError
from simbias.core import Hardware, HardwareError, Policy, Waiting
from simbias.core.records import Array, Iteration, Rollout
from simbias.trial.journal import Journal, write_whole
from simbias.trial.run import Outcome, run_trial
from simbias.trial.study import Observer, Study

SHORT = [
    "task.horizon=400",
    "optimizer.max_evaluations=30",
    "method.max_iterations=3",
    "cost.max_cost=1e-3",  # never reached
]
ROBUST = [
    *SHORT,
    *("bias=sparse_gp", "evaluation=domain_randomization", "optimizer=hybrid", "method=model_based"),
    "optimizer.explorations=10",
    "evaluation.rollouts=3",
    "evaluation.sample_bias=true",
    "method.retry_search=1",
    "method.stop_at_failure=false",
]


class Stop(KeyboardInterrupt):
    """As a kill: nothing of the trial hears of it."""


class Counted(Hardware):
    """Counts the experiments that are really made, and stops the trial before or after one."""

    def __init__(self, hardware: Hardware, before: int = -1, after: int = -1) -> None:
        self._hardware, self._before, self._after = hardware, before, after
        self.made = 0

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        if self.made == self._before:
            raise Stop
        self.made += 1
        rollout = self._hardware.run(policy, theta, start, rng)
        if self.made - 1 == self._after:
            raise Stop
        return rollout


class StopAt(Observer):
    """Stops a trial at the n-th thing that happens in it."""

    def __init__(self, n: int) -> None:
        self.left = n

    def experimenting(self, theta: Array, start: Array) -> None:
        self._count()

    def experimented(self, rollout: Rollout) -> None:
        self._count()

    def iterated(self, iteration: Iteration) -> None:
        self._count()

    def _count(self) -> None:
        self.left -= 1
        if self.left == 0:
            raise Stop


def study(overrides: list[str]) -> Study:
    return simbias.load(["tracking=none", *overrides])


@pytest.mark.slow
@pytest.mark.parametrize("overrides", [SHORT, ROBUST], ids=["paper", "robust"])
def test_stopped_anywhere_a_trial_ends_as_undisturbed(overrides: list[str], tmp_path: Path) -> None:
    undisturbed = timeless(run_trial(study(overrides)))
    assert undisturbed.outcome is Outcome.NOT_SUCCEEDED
    hardware = Counted(study(overrides).hardware)
    for n in range(1, 20):
        stopping = StopAt(n)
        journal = Journal(tmp_path / "stopped at each")
        try:
            record = run_trial(replace(study(overrides), hardware=hardware), journal, stopping)
            break
        except Stop:
            pass
    assert stopping.left > 0
    assert_equal(timeless(record), undisturbed)
    assert hardware.made == undisturbed.experiments


@pytest.mark.slow
@pytest.mark.parametrize("lost", [0, 1])
def test_an_experiment_lost_on_the_way_is_made_again_and_no_other(lost: int, tmp_path: Path) -> None:
    """What the hardware had not returned cannot be kept."""
    undisturbed = timeless(run_trial(study(SHORT)))
    for number in range(6):
        plain = study(SHORT)
        limits = {"before": 1} if lost == 0 else {"after": 0}
        hardware = Counted(plain.hardware, **limits)
        try:
            record = run_trial(replace(plain, hardware=hardware), Journal(tmp_path / "trial"))
        except Stop:
            kept = len(list((tmp_path / "trial").glob("*experiment.npz")))
            assert kept == (number + 1 if lost == 0 else 0)
            if lost:
                record = run_trial(study(SHORT), Journal(tmp_path / "trial"))
                break
    assert_equal(timeless(record), undisturbed)


def test_an_experiment_is_on_disk_before_it_is_used(tmp_path: Path) -> None:
    kept = []

    class Watching(Observer):
        def experimented(self, rollout: Rollout) -> None:
            kept.append(len(list(tmp_path.glob("*experiment.npz"))))

    run_trial(study(SHORT), Journal(tmp_path), Watching())
    assert kept == [1, 2, 3, 4, 5, 6]
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.slow
def test_waiting_stops_in_good_order_and_goes_on(tmp_path: Path) -> None:
    class Slow(Hardware):
        def __init__(self, hardware: Hardware) -> None:
            self._hardware = hardware

        def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
            asked = tmp_path / "asked"
            if not asked.exists():
                asked.touch()
                raise Waiting("trajectory.csv is not there yet.")
            asked.unlink()
            return self._hardware.run(policy, theta, start, rng)

    for number in range(6):
        plain = study(SHORT)
        record = run_trial(replace(plain, hardware=Slow(plain.hardware)), Journal(tmp_path / "trial"))
        assert (record.outcome, record.experiments) == (Outcome.WAITING, number)
        assert record.reason == "trajectory.csv is not there yet."
    plain = study(SHORT)
    last = run_trial(replace(plain, hardware=Slow(plain.hardware)), Journal(tmp_path / "trial"))
    assert_equal(timeless(last), timeless(run_trial(study(SHORT))))


def test_what_was_half_written_is_forgotten(tmp_path: Path) -> None:
    (tmp_path / "0000_search.json.part").write_text("{")
    run_trial(study([*SHORT, "method.max_iterations=1"]), Journal(tmp_path))
    assert sorted(path.name for path in tmp_path.glob("0*")) == [
        "0000_search.json",
        "0001_experiment.npz",
        "0002_experiment.npz",
    ]


def test_two_processes_do_not_run_the_same_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simbias.trial.journal.LOCK_SECONDS", 0.1)
    journal = Journal(tmp_path)
    with pytest.raises(ConfigError, match="another process is running this trial"):
        Journal(tmp_path)
    journal.discard()
    assert not tmp_path.exists()


@pytest.mark.slow
def test_a_journal_of_another_trial_is_refused(tmp_path: Path) -> None:
    run_trial(study(SHORT), Journal(tmp_path))
    search = tmp_path / "0000_search.json"
    fields = json.loads(search.read_text())
    search.write_text(json.dumps({**fields, "parameters": [0.0] * 5}))
    record = run_trial(study(SHORT), Journal(tmp_path))
    assert record.outcome is Outcome.ERROR
    assert "0001_experiment.npz: does not fit the trial" in record.reason


class Breaking(Hardware):
    def __init__(self, error: BaseException) -> None:
        self._error = error

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        raise self._error


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise ValueError


INSTEAD = "HardwareError: Breaking.run: expected a Rollout, got"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (HardwareError("no power"), "HardwareError: no power"),
        (ZeroDivisionError(), f"{INSTEAD} ZeroDivisionError"),
        (SystemExit(3), f"{INSTEAD} SystemExit: 3"),
        (RecursionError("deep\nand deeper"), f"{INSTEAD} RecursionError: deep and deeper"),
        (SpeechlessError(), f"{INSTEAD} SpeechlessError: (its message cannot be read)"),
        (OSError("\udcff"), f"{INSTEAD} OSError: \\udcff"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_what_a_component_raises_is_told_in_the_record(error: BaseException, reason: str) -> None:
    record = run_trial(replace(study(SHORT), hardware=Breaking(error)))
    assert (record.outcome, record.reason) == (Outcome.ERROR, reason)
    assert "Traceback" in record.traceback
    assert record.traceback.encode()
    assert (record.experiments, np.isnan(record.experiments_until_success)) == (0, True)


def test_a_file_is_there_in_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_whole(path, lambda file: file.write(b"old"))

    def fail(file: object) -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_whole(path, fail)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) in (["file"], ["file", "file.part"], ["file.part", "file"])


@pytest.mark.slow
def test_what_breaks_the_contract_is_refused_and_not_kept(tmp_path: Path) -> None:
    """Else it would be recalled for ever, and no mended hardware would be asked again."""

    class Broken(Hardware):
        def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
            return Rollout(np.zeros((3, 6)), np.zeros((1, 1)), 1, "distance")

    broken = replace(study(SHORT), hardware=Broken())
    record = run_trial(broken, Journal(tmp_path))
    assert record.outcome is Outcome.ERROR
    assert record.reason.startswith("HardwareError: Broken.run: states: expected the shape (2, 6)")
    assert [path.name for path in tmp_path.glob("0*")] == ["0000_search.json"]
    assert_equal(timeless(run_trial(study(SHORT), Journal(tmp_path))), timeless(run_trial(study(SHORT))))


class Returning(Hardware):
    def __init__(self, returned: object) -> None:
        self._returned = returned

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        return self._returned  # type: ignore[return-value]


class Odd:
    def __init__(self) -> None:
        self.angles = [1, 2, 3]
        self.camera = {"left"}

    def __repr__(self) -> str:
        raise ValueError


LONG = np.arange(3000.0) / 7.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("returned", "arrays", "texts"),
    [
        (None, {}, {"returned": "None"}),
        (LONG, {"returned": LONG}, {}),
        ([[1, 2], [3, 4]], {"returned": [[1, 2], [3, 4]]}, {}),
        ([LONG, "caf\udce9", {}], {"0": LONG}, {"1": r"'caf\udce9'", "2": "{}"}),
        ({"a b": 1.5, "a/b": 2j, "file": [1, [2]]}, {"a_b": 1.5, "a_b_": 2j}, {"file": "[1, [2]]"}),
        (Odd(), {"angles": [1, 2, 3]}, {"camera": "{'left'}"}),
        ([Odd()], {}, {"0": "a Odd that cannot be shown"}),
        (np.array([LONG, None], dtype=object), {}, {"returned": "4.2842857142857144e+02"}),
    ],
    ids=["None", "array", "list", "tuple", "mapping", "object", "speechless", "objects"],
)
def test_all_that_a_hardware_returned_is_kept(
    tmp_path: Path, returned: object, arrays: dict[str, object], texts: dict[str, str]
) -> None:
    """Numbers as such, without pickle; the rest in words."""
    record = run_trial(replace(study(SHORT), hardware=Returning(returned)), Journal(tmp_path))
    assert record.outcome is Outcome.ERROR
    assert record.reason.endswith(f"; it is kept in {tmp_path / 'refused_0000.npz'} and .txt")
    with np.load(tmp_path / "refused_0000.npz", allow_pickle=False) as file:
        kept = {name: file[name] for name in file.files}
    assert (kept.pop("asked_parameters").shape, kept.pop("asked_start").shape) == ((5,), (6,))
    assert kept.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(kept[name], array)  # type: ignore[arg-type]
    first, *lines = (tmp_path / "refused_0000.txt").read_text().splitlines()
    assert first.startswith("Returning.run: expected a Rollout, got ")
    for name, text in texts.items():
        assert any(line.startswith(f"{name}: ") for line in lines)
        assert text in "\n".join(lines)
    assert not [name for name in arrays if any(line.startswith(f"{name}: ") for line in lines)]


def test_what_cannot_be_kept_hides_no_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    journal = Journal(tmp_path)
    monkeypatch.setattr(journal, "refuse", full)
    record = run_trial(replace(study(SHORT), hardware=Returning(None)), journal)
    assert record.reason.startswith(
        "HardwareError: Returning.run: expected a Rollout, got NoneType; it could "
    )
    assert record.reason.endswith("No space left on device)")


def test_a_traceback_is_kept_until_the_trial_goes_on(tmp_path: Path) -> None:
    record = run_trial(replace(study(SHORT), hardware=Breaking(OSError("caf\udce9"))), Journal(tmp_path))
    assert record.traceback_file == str(tmp_path / "error.txt")
    assert (tmp_path / "error.txt").read_text() == record.traceback
    assert r"OSError: caf\udce9" in record.traceback
    assert "test_journal.py" in record.traceback
    assert run_trial(study(SHORT), Journal(tmp_path)).traceback_file == ""
    assert not (tmp_path / "error.txt").exists()
