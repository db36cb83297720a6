"""Disks that fail, crashes at any write, several processes, archives and words that mean harm."""

from __future__ import annotations

import csv
import io
import json
import os
import random
import resource
import shutil
import signal
import sqlite3
import sys
import time
import warnings
import zipfile
from collections.abc import Callable
from contextlib import closing, redirect_stderr, redirect_stdout, suppress
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np

from attack.recordings import table
from attack.values import QUICK
from attack.verdict import Result, attempt
from simbias.__main__ import main
from simbias.engine import workplace

FOLDERS = "tracking=folders"
TRIAL = [*QUICK, "cost.max_cost=1e-3", "method.max_iterations=2"]  # it never succeeds
TESTED = [*TRIAL, "policy_test.episodes=3"]  # with test episodes after its end
STORES = [[FOLDERS], [FOLDERS], [FOLDERS], ["tracking=mlflow"]]
OTHERS = ("attempts", "trial", "outcome", ".lock", "error_0000", "error_0001")  # have times, or are empty


def _silently(command: list[str], before: Callable[[], object] = lambda: None) -> int:
    """Run simbias in a fork, its output nowhere; the number of the fork."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    with suppress(BaseException):
        workplace.workplace.cache_clear()
        before()
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
            main(command)
    os._exit(0)


def _steps(folder: Path) -> dict[str, str]:
    """What a trial's folder holds, but for times."""
    (trial,) = (file.parent for file in folder.glob("trials/*/trial.json"))
    kept: dict[str, str] = {}
    for file in sorted(trial.iterdir()):
        if file.suffix == ".npz":
            with np.load(file) as arrays:
                kept[file.name] = str({name: arrays[name].tolist() for name in sorted(arrays)})
        elif file.suffix == ".json" and file.name[0].isdigit():
            kept[file.name] = str(_timeless(json.loads(file.read_text())))
        elif file.is_file() and file.stem not in OTHERS:
            kept[file.name] = ""
    return kept


def _timeless(content: Any) -> Any:
    """JSON without what is measured by a clock."""
    if isinstance(content, dict):
        clocks = {key for key in content if "second" in key or key == "ended"}
        return {key: _timeless(value) for key, value in content.items() if key not in clocks}
    return [_timeless(each) for each in content] if isinstance(content, list) else content


_WHOLE: dict[str, dict[str, str]] = {}  # by the trial's last override


def _is_whole(folder: Path, trial: list[str] = TRIAL) -> bool:
    """Whether the trial is that of a run that nothing befell, with nothing left behind."""
    return "Did not succeed" in (folder / "stdout").read_text() and _steps(folder) == _WHOLE[trial[-1]]


def _uninterrupted(work: Path, trial: list[str] = TRIAL) -> None:
    """Make the trial once that all others are held against."""
    if trial[-1] not in _WHOLE:
        folder, here = work.parent / f"whole {trial[-1]}", Path.cwd()
        folder.mkdir()
        os.chdir(folder)
        try:
            os.waitpid(_silently([*trial, FOLDERS]), 0)
        finally:
            os.chdir(here)
        _WHOLE[trial[-1]] = _steps(folder)


def _is_exported_once(folder: Path) -> bool:
    """Whether MLflow's store shows the one trial, ended, with no metric twice."""
    with closing(sqlite3.connect(folder / "mlflow.db")) as database:
        runs = database.execute("SELECT status FROM runs WHERE lifecycle_stage = 'active'").fetchall()
        steps = "SELECT count(*) FROM metrics GROUP BY run_uuid, key, step HAVING count(*) > 1"
        return runs == [("FINISHED",)] and not database.execute(steps).fetchall()


# Crashes and disks


def _at(n: int, what: Callable[[], object]) -> None:
    """Let something happen at the n-th write to disk: before or after it, by fsync, rename or open."""
    count = [0]

    def struck(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            count[0] += 1
            if count[0] == n:
                what()
            return function(*arguments, **options)

        return call

    os.fsync = struck(os.fsync)
    os.replace, os.rename = struck(os.replace), struck(os.rename)


def _full() -> None:
    raise OSError(28, "No space left on device")


def _broken() -> None:
    raise OSError(5, "Input/output error")


def disks(rng: random.Random, work: Path) -> list[Result]:
    """A trial or an export that dies, or whose disk fails, at its n-th write; the same command goes on."""
    trial = rng.choice([TRIAL, TESTED])
    _uninterrupted(work, trial)
    n, store = rng.randint(1, 40), rng.choice(STORES)
    kind = rng.choice(["killed", "killed", "full", "broken", "small"])
    size = int(10 ** rng.uniform(2.5, 5.0))  # room for the line that says it
    befalls: dict[str, Callable[[], object]] = {
        "killed": lambda: _at(n, lambda: os.kill(os.getpid(), signal.SIGKILL)),
        "full": lambda: _at(n, _full),
        "broken": lambda: _at(n, _broken),
        "small": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY)),
    }
    exported = rng.random() < 0.3
    command = ["export"] if exported else [*trial, *store]

    def twice_before() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        if exported:
            os.waitpid(_silently([*trial, FOLDERS]), 0)
        for _ in range(rng.choice([1, 2])):
            os.waitpid(_silently(command, befalls[kind]), 0)

    case = f"{kind} at {size if kind == 'small' else n}, {'export' if exported else store[0]}, {trial[-1]}"
    inspect = _is_exported_once if exported else partial(_is_whole, trial=trial)
    again = attempt("disks", f"{case}, again", command, twice_before, None, inspect, seconds=40.0)
    if kind == "killed" or exported:
        return [again]

    def befall() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        befalls[kind]()

    return [attempt("disks", case, command, befall, seconds=40.0), again]


# Several processes


def together(rng: random.Random, work: Path) -> list[Result]:
    """Two processes with one trial, or one whose experiment is withdrawn under a kill."""
    _uninterrupted(work)
    store = rng.choice(STORES)
    kind = rng.choice(["two", "withdrawn", "withdrawn twice", "moved", "moved while it runs"])
    command, n, steps = [*TRIAL, *store], rng.randint(1, 8), rng.randint(1, 6)
    taken = rng.choice(
        ["trials", "trials", "mlflow.db", "mlartifacts"] if store[-1] != FOLDERS else ["trials"]
    )
    place = rng.choice(["0001_experiment.npz", "0002_experiment.npz", "0005_experiment.npz"])

    def before() -> None:
        if kind == "moved while it runs":
            _taken_away(command, taken, steps)
            return
        if kind == "two":
            delay = rng.uniform(0.0, 0.5)
            other = _silently(command)
            time.sleep(delay)
            first = _silently(command)
            for child in (other, first):
                os.waitpid(child, 0)
            return
        os.waitpid(_silently(command), 0)
        if kind == "moved":
            shutil.copytree("trials", "copy")
            shutil.rmtree("trials")
            Path("copy").rename("trials")
            return
        (experiment,) = Path("trials").glob(f"*/{place}")
        crash = (lambda: _at(n, lambda: os.kill(os.getpid(), signal.SIGKILL))) if n < 7 else (lambda: None)
        withdrawal = ["withdraw", str(experiment), "--reason", "<b>a loose cable</b>\n\x1b[31m"]
        os.waitpid(_silently(withdrawal, crash), 0)
        if kind == "withdrawn twice":
            os.waitpid(_silently(withdrawal), 0)

    inspect = _has_ended if kind.startswith("withdrawn") else _is_whole
    return [
        attempt("together", f"{kind} {place} {n}, {store[0]}", command, before, None, inspect, seconds=60.0)
    ]


def _taken_away(command: list[str], taken: str, steps: int) -> None:
    """Move a folder or a store away while a trial runs, after so many of its files, and back at its end."""
    child = _silently(command)
    end = time.monotonic() + 30.0
    while time.monotonic() < end and len(list(Path().glob("trials/*/*"))) < 3 + steps:
        time.sleep(0.002)
    with suppress(OSError):  # it may be none yet
        os.rename(taken, "away")
    os.waitpid(child, 0)
    if Path("away").exists():
        assert not Path(taken).exists(), f"{taken} is in two places"
        os.rename("away", taken)


def _has_ended(folder: Path) -> bool:
    """Whether a trial has ended, with no half-written file."""
    parts = [path for path in folder.glob("trials/**/*") if path.suffix == ".part"]
    return not parts and "Did not succeed" in (folder / "stdout").read_text()


# Archives

ENTRIES = {
    "pickle": lambda: np.array([{"a": 1}], dtype=object),
    "words": lambda: np.array(["x"] * 3),
    "scalar": lambda: np.float64(1.0),
    "complex": lambda: np.ones((3, 6), dtype=complex),
    "none": lambda: np.zeros((0, 6)),
    "NaN": lambda: np.full((21, 6), np.nan),
    "wide": lambda: np.zeros((21, 60)),
}


def archives(rng: random.Random, work: Path) -> list[Result]:
    """An experiment's archive that means harm: bombs, paths, pickles, arrays of other kinds and shapes."""
    kind = rng.choice(["bomb", "header", "path", "twice", "extra", *ENTRIES])
    place = rng.choice(["0001_experiment.npz", "0002_experiment.npz", "0005_experiment.npz"])
    number = rng.randrange(10**9)

    def damage() -> None:
        os.waitpid(_silently([*TRIAL, FOLDERS]), 0)
        (file,) = Path("trials").glob(f"*/{place}")
        (file.parent / "outcome.json").unlink()
        _harm(file, kind, random.Random(number))
        resource.setrlimit(resource.RLIMIT_AS, (12 * 2**30, resource.RLIM_INFINITY))

    def nothing_escaped(folder: Path) -> bool:
        return not any((folder.parents[depth] / "escaped.npy").exists() for depth in range(3))

    return [
        attempt(
            "archives", f"{kind} in {place}", [*TRIAL, FOLDERS], damage, None, nothing_escaped, seconds=40.0
        )
    ]


def _harm(file: Path, kind: str, rng: random.Random) -> None:
    """Put something into an archive."""
    with np.load(file) as archive:
        arrays = {name: archive[name] for name in archive}
    name = rng.choice(sorted(arrays))
    written = io.BytesIO()
    np.savez(written, **arrays)
    if kind in ENTRIES:
        np.savez(file, **{**arrays, name: ENTRIES[kind]()})
        return
    with zipfile.ZipFile(written) as old, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.namelist():
            content = old.read(entry)
            if entry == f"{name}.npy" and kind == "header":
                header = io.BytesIO()
                shape = (10**10, 6)
                np.lib.format.write_array_header_1_0(
                    header, {"descr": "<f8", "fortran_order": False, "shape": shape}
                )
                content = header.getvalue()
            if entry == f"{name}.npy" and kind == "bomb":
                content = _array_header((2 * 10**7,)) + b"\x00" * (16 * 10**7)
            new.writestr(entry, content)
            if kind == "twice":
                with warnings.catch_warnings(action="ignore"):  # of our own writing
                    new.writestr(entry, content[: len(content) // 2])
        if kind == "path":
            new.writestr("../../escaped.npy", _array_header((0,)))
        if kind == "extra":
            new.writestr("__class__.npy", _array_header((0,)))


def _array_header(shape: tuple[int, ...]) -> bytes:
    """The first bytes of an array's file."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return header.getvalue()


# Words

WORDS = [
    *("<script>alert(1)</script>", "<img src=x onerror=alert(1)>", '"><svg onload=alert(1)>', "$\\frac{1$"),
    *("'; alert(1) //", "\x1b[31mred", "a\nb", "[x](javascript:alert(1))", "{{7*7}}", "*/ system(0); /*"),
    *(
        "\u202egnp.exe",
        "`whoami`",
        "%s%n",
        "</style><script>alert(1)</script>",
        "&lt;script&gt;",
        "\U0001f916",
    ),
]
TASK = """
defaults: [cartpole, _self_]
failure:
  falls: {{value: abs(angle), above: 0.8, unit: {unit}, words: {words}}}
"""


class _Scripts(HTMLParser):
    """Finds what would run in a page, if it comes from our words."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            if name.startswith("on") or "javascript:" in (value or "").lower():
                self.found.append(f"{tag} {name}={value}")

    def handle_data(self, data: str) -> None:
        if self.lasttag == "script" and "alert(1)" in data:
            self.found.append(data)


def words(rng: random.Random, work: Path) -> list[Result]:
    """Units, words and reasons that mean something to HTML, Markdown, C or a terminal, in all pages."""
    word, unit = rng.choice(WORDS), rng.choice(WORDS)
    store = [FOLDERS] if rng.random() < 0.9 else STORES[-1]
    command = ["--config-dir", "conf", "preset=cartpole", "task=own", *TRIAL, *store]
    kind = rng.choice(["trial", "trial", "sweep", "recording"])
    if kind != "trial":
        return [_of_sweep(word, unit) if kind == "sweep" else _of_recording(word, unit)]

    def before() -> None:
        Path("conf/task").mkdir(parents=True)
        text = TASK.format(
            unit=json.dumps(unit, ensure_ascii=False), words=json.dumps(word, ensure_ascii=False)
        )
        Path("conf/task/own.yaml").write_text(text, encoding="utf-8")
        os.waitpid(_silently(command), 0)
        for experiment in list(Path("trials").glob("*/0001_experiment.npz")):
            os.waitpid(_silently(["withdraw", str(experiment), "--reason", word]), 0)
            os.waitpid(_silently(command), 0)
            Path("trial").symlink_to(experiment.parent)

    report = ["report", "--config-dir", "conf", "trial"]
    return [attempt("words", f"{word!r}, {unit!r}, {store[0]}", report, before, None, _safe, seconds=60.0)]


def _safe(folder: Path) -> bool:
    """Whether there is a page, in none anything would run, and nothing moves the terminal."""
    pages = list(folder.glob("**/*.html"))
    for page in pages:
        scripts = _Scripts()
        scripts.feed(page.read_text(encoding="utf-8"))
        if scripts.found:
            return False
    return bool(pages) and "\x1b" not in (folder / "stdout").read_text()


def _of_sweep(word: str, label: str) -> Result:
    """The page of a sweep whose labels are such words."""
    axes = {"x": {"keys": ["hardware.inertia_error"], "values": [[0.0], [0.1]], "labels": [label, word]}}
    sweep = {"trials": 1, "axes": axes, "figures": {}}
    command = ["--config-dir", "conf", "+sweep=mine", "engine=sequential", *QUICK, FOLDERS]

    def before() -> None:
        Path("conf/sweeps").mkdir(parents=True)
        Path("conf/sweeps/mine.yaml").write_text(json.dumps({"sweep": sweep}))
        with open("stderr", "w") as said, redirect_stderr(said), redirect_stdout(io.StringIO()):
            main(command)  # which may refuse the words; then there is no page to look at
        Path("stderr").write_text("")
        if not list(Path("trials").glob("sweeps/*")):
            os._exit(2)

    return attempt(
        "words", f"sweep {label!r}, {word!r}", ["report", "trials"], before, None, _safe, seconds=60.0
    )


def _of_recording(word: str, unit: str) -> Result:
    """The page of `identify` of a recording whose name and columns are such words."""
    name = f"{word[:80].replace('/', '|')}.csv"
    columns = json.dumps({"pos1": f"{word} [rad]", "tau1": "tau1 [N m]"})
    command = ["identify", name, "preset=double_pendulum", "tracking=none", "--columns", columns]
    quick = ["identification.starts=1", "identification.rounds=1"]

    def before() -> None:
        rows = table(random.Random(0))
        rows[0][1] = word
        with Path(name).open("w", newline="") as file:
            csv.writer(file).writerows(rows)

    case = f"recording {word!r}"
    return attempt("words", case, [*command, *quick], before, None, _safe, seconds=60.0)
