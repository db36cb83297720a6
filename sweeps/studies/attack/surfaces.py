"""What else comes from outside: hardware, files, stores, kills, and strangers on a network."""

from __future__ import annotations

import io
import json
import os
import random
import shutil
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, redirect_stderr, redirect_stdout, suppress
from pathlib import Path

import psutil
import soak
from faulty_hardware import DEADLY, FAULTS, MENDED, RAISED, RETURNED
from sweeping import finish, start

import simbias
from attack import harm, lab
from attack.code import code
from attack.recordings import recordings
from attack.values import QUICK
from attack.verdict import Result, Verdict, attempt, judge
from simbias.__main__ import main
from simbias.core.messages import brief

TRIAL = [*QUICK, "cost.max_cost=1e-3"]  # it never succeeds
SWEEP = ["+sweep=smoke", "sweep.trials=1", "engine=sequential", *QUICK]
DEATH = (  # what a worker that dies writes
    r"(Fatal Python error: |Current thread |Thread 0x|  File |  \.\.\.|  <no |Extension modules: |$)"
)
FAULTY = ["--config-dir", "conf", "--allow", "faulty_hardware", "hardware=faulty", "experiment_timeout=2"]


def template(folder: Path) -> Path:
    """A folder with trials, a sweep and their store, a trial under way, and faulty hardware."""
    work = folder / "template"
    (work / "conf" / "hardware").mkdir(parents=True)
    (work / "conf" / "hardware" / "faulty.yaml").write_text("_target_: faulty_hardware.Faulty\nfault: none\n")
    uri = ["tracking.uri=sqlite:///mlflow.db"]
    here = Path.cwd()
    os.chdir(work)
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            assert main([*TRIAL, *uri]) == 1
            assert main([*SWEEP, *uri]) == 0
            assert main([*FAULTY, *TRIAL, *uri, "hardware.fault='NaN'"]) == 1  # it stays under way
    finally:
        os.chdir(here)
    return work


def moved(work: Path) -> None:
    """Let a copied store's runs have their files in the copy."""
    with closing(sqlite3.connect("mlflow.db")) as database:
        for table, column in (("experiments", "artifact_location"), ("runs", "artifact_uri")):
            database.execute(f"UPDATE {table} SET {column} = replace({column}, '{work}', '{Path.cwd()}')")
        database.commit()


# Hardware


def hardware_trial(rng: random.Random, work: Path) -> list[Result]:
    """A faulty hardware in a trial, and the same once it is mended."""
    fault = rng.choice(sorted(FAULTS))
    again = [*FAULTY, *TRIAL, f"hardware.fault='{fault}'", f"seed={rng.randrange(10**6)}"]
    with_prints = rng.choice([[], ["tracking.pictures=true"], ["tracking=none"]])
    first = attempt("hardware, trial", fault, [*again, *with_prints], lambda: moved(work), work)
    if fault in DEADLY and first.verdict is Verdict.CRASH:  # as the component wants it
        first = Result(**{**vars(first), "verdict": Verdict.REFUSED})

    def done(folder: Path) -> bool:
        return "Did not succeed after 2 hardware experiments" in (folder / "stdout").read_text()

    def broken_then_mended() -> None:
        moved(work)
        child = os.fork()
        if not child:
            silent = open(os.devnull, "w")  # noqa: SIM115 (as long as the process)
            with suppress(BaseException), redirect_stdout(silent), redirect_stderr(silent):
                main(again)
            os._exit(0)
        os.waitpid(child, 0)
        Path(MENDED).touch()
        sys.stdout.flush()

    mended = attempt("hardware, mended", fault, again, broken_then_mended, work, done)
    return [first, mended]


def hardware_sweep(rng: random.Random, work: Path) -> list[Result]:
    """Some faults as cells of a sweep on workers; it ends, and tells of each."""
    faults = [*rng.sample(sorted(set(FAULTS) - set(DEADLY)), 4), rng.choice(sorted(DEADLY))]
    cells = ", ".join(f"'{fault}'" for fault in faults)
    sweep = f"+sweep={{trials: 1, axes: {{hardware.fault: [{cells}]}}}}"
    told = {*RAISED, *RETURNED, *DEADLY, "hangs", "30 GB"}.intersection(faults)
    expected = 1 if told else 0

    def inspect(folder: Path) -> bool:
        lines = (folder / "stdout").read_text().splitlines()
        return sum(line.startswith("[") for line in lines) == len(faults)

    result = attempt(
        "hardware, sweep",
        cells,
        [*FAULTY, sweep, *TRIAL],
        lambda: moved(work),
        work,
        inspect,
        forked=False,
        seconds=90.0,
        tolerated=DEATH,
    )
    wrong = result.verdict in (Verdict.RAN, Verdict.REFUSED) and result.status != expected
    return [Result(**{**vars(result), "verdict": Verdict.WRONG}) if wrong else result]


# Files and stores


def _bytes(path: Path, rng: random.Random) -> None:
    """Change some bytes of a file."""
    content = bytearray(path.read_bytes())
    for _ in range(rng.choice([1, 10, 1000])):
        if content:
            content[rng.randrange(len(content))] = rng.randrange(256)
    path.write_bytes(content)


DAMAGES: dict[str, Callable[[Path, random.Random], object]] = {
    "bytes": _bytes,
    "cut": lambda path, rng: os.truncate(path, rng.randrange(path.stat().st_size + 1)),
    "empty": lambda path, rng: path.write_bytes(b""),
    "text": lambda path, rng: path.write_text("no such thing\n" * 50),
    "gone": lambda path, rng: path.unlink(),
    "folder": lambda path, rng: (path.unlink(), path.mkdir()),
    "dangling": lambda path, rng: (path.unlink(), path.symlink_to("nowhere")),
    "circle": lambda path, rng: (path.unlink(), path.symlink_to(path.name)),
    "pipe": lambda path, rng: (path.unlink(), os.mkfifo(path)),
    "device": lambda path, rng: (path.unlink(), path.symlink_to("/dev/full")),
}
STATEMENTS = [
    *(
        "DROP TABLE {table}",
        "DELETE FROM {table}",
        "UPDATE {table} SET {column} = NULL",
        "ALTER TABLE {table} RENAME TO x",
    ),
    *(
        "UPDATE {table} SET {column} = 'strange'",
        "UPDATE {table} SET {column} = -1",
        "ALTER TABLE {table} DROP COLUMN {column}",
    ),
    *("UPDATE {table} SET {column} = '<script>\x1b[31m'", "DELETE FROM {table} WHERE rowid % 2 = 0"),
    "UPDATE {table} SET {column} = hex(zeroblob(100000))",
]


def _row(rng: random.Random) -> str:
    """Change the database by hand; what was done."""
    with closing(sqlite3.connect("mlflow.db")) as database:
        database.execute("PRAGMA ignore_check_constraints = ON")
        tables = [
            "runs",
            "tags",
            "params",
            "metrics",
            "latest_metrics",
            "experiments",
            "experiment_tags",
            "alembic_version",
        ]
        table = rng.choice(tables)
        columns = [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
        statement = rng.choice(STATEMENTS).format(table=table, column=rng.choice(columns))
        with suppress(sqlite3.Error):  # which some constraint forbids
            database.execute(statement)
        database.commit()
    return statement


def store(rng: random.Random, work: Path) -> list[Result]:
    """A store or a folder that somebody changed, then a command that needs it."""
    number = rng.randrange(10**9)
    what = rng.choice(["row", "trials", "trials", "file", "database", "under way"])
    told = work.parent / f"told-{number}"

    def damage() -> None:
        own = random.Random(number)
        moved(work)
        if what == "row":
            told.write_text(_row(own))
            return
        under_way = [file.parent for file in Path().glob("trials/*/trial.json")]
        (under_way,) = (trial for trial in under_way if not (trial / "outcome.json").exists())
        folder = {"file": "mlartifacts", "trials": "trials", "database": ".", "under way": under_way}[what]
        pattern = "mlflow.db" if what == "database" else "*"
        paths = sorted(path for path in Path(folder).rglob(pattern) if path.is_file())
        kind, path = own.choice(sorted(DAMAGES)), own.choice(paths)
        told.write_text(f"{kind} {path.name}")
        DAMAGES[kind](path, own)

    commands = {
        "trial": TRIAL,
        "new": [*TRIAL, "seed=7"],
        "sweep": SWEEP,
        "dry": [*SWEEP, "sweep.dry_run=true"],
        "under way": [*FAULTY, *TRIAL, "hardware.fault='NaN'"],
        "export": ["export"],
    }
    name = "under way" if what == "under way" else rng.choice(sorted(commands))
    result = attempt("stores", name, commands[name], damage, work)
    case = f"{told.read_text() if told.exists() else what}, then {name}"
    told.unlink(missing_ok=True)
    return [Result(**{**vars(result), "case": brief(case, 200)})]


def files(rng: random.Random, work: Path) -> list[Result]:
    """An option, a sweep or components.yaml that is no such file, and a command that asks for it, or not."""
    where = rng.choice(["bias/mine", "sweeps/mine", "components", "hardware/faulty"])
    texts = [
        *("a: [1", "3", "[1, 2]", "a: " + 3000 * "[" + 3000 * "]", "a: !!python/object/apply:os.getcwd []"),
        *("defaults: [mine]", "defaults: [faulty]", "_target_: os.system", "_target_: 3", "_target_: ''"),
        *(
            "&a [*a]",
            "a: &b {c: *b}",
            "a: 1\na: 2",
            "\ta: 1",
            "%YAML 9.9\n---\n",
            "? [1]\n: 2",
            "\x00",
            "- " * 5000,
        ),
        *(
            "# @package hydra\na: 1",
            "_target_: simbias.learning.bias.none.NoBias\n_args_: [1]",
            "d: ${d}",
            "allow: 3",
            "allow: [3]",
        ),
        *(
            "_target_: simbias.learning.bias.none\n",
            "_recursive_: true\n_target_: simbias.learning.bias.none.NoBias",
            "allow: [os]\n",
        ),
        "a: &x [1,1,1,1,1,1,1,1,1]\n"
        + "".join(f"b{i}: &x{i} [{','.join(['*x' if not i else f'*x{i - 1}'] * 9)}]\n" for i in range(7)),
    ]
    kind = rng.choice([*DAMAGES, *texts, *texts])
    number = rng.randrange(10**9)

    def prepare() -> None:
        path = Path("conf", f"{where}.yaml")
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind in DAMAGES:
            path.write_text("_target_: simbias.learning.bias.none.NoBias\n")
            DAMAGES[kind](path, random.Random(number))
        else:
            path.write_text(kind)

    use = {"bias/mine": "bias=mine", "sweeps/mine": "+sweep=mine", "hardware/faulty": "hardware=faulty"}
    asked = [use[where]] if where in use and rng.random() < 0.8 else []
    command = ["--config-dir", "conf", *asked, "tracking=none", "engine=sequential", *QUICK[:3]]
    return [attempt("files", f"{where}: {kind} {asked}", command, prepare, work)]


# Kills


def kills(rng: random.Random, work: Path) -> list[Result]:
    """One campaign of the soak: killed again and again, then left alone."""
    kind = rng.choice(sorted(soak.COMMANDS))
    if kind not in _UNINTERRUPTED:
        _UNINTERRUPTED[kind] = soak.uninterrupted(kind, work.parent / "soak")
    began = time.monotonic()
    row = soak.campaign(kind, rng.randint(1, 4), rng, _UNINTERRUPTED[kind])
    verdict = Verdict.RAN if soak.good(row) else Verdict.WRONG
    status = row["status"]
    assert isinstance(status, int)
    seconds = round(time.monotonic() - began, 1)
    return [Result("kills", f"{row['kills']} kills of a {kind}", verdict, status, seconds, str(row))]


_UNINTERRUPTED: dict = {}


# Strangers


def strangers(rng: random.Random, work: Path) -> list[Result]:
    """Strangers at the ports of a sweep's local cluster; or a port that is no scheduler."""
    return rng.choice([_silent_port, _visited_cluster, _other_workers])(rng)


def _silent_port(rng: random.Random) -> list[Result]:
    """An address where something else listens."""
    words = rng.choice([b"", b"SSH-2.0-x\r\n", os.urandom(200), b"HTTP/1.1 200 OK\r\n\r\n", b"\x00" * 64])
    scheme = rng.choice(["tcp", "tls", "ucx", "inproc", "http", ""])
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

        def answer() -> None:
            with suppress(OSError):
                while True:
                    connections.append(server.accept()[0])
                    connections[-1].sendall(words)

        connections: list[socket.socket] = []
        threading.Thread(target=answer, daemon=True).start()
        address = f"{scheme}://127.0.0.1:{port}" if scheme else f"127.0.0.1:{port}"
        command = ["+sweep=smoke", "engine=dask", f"engine.address={address}", "tracking=none", *QUICK[:3]]
        result = attempt("strangers", f"{scheme} {words[:12]!r} at the port", command)
    wrong = result.verdict is Verdict.RAN
    return [Result(**{**vars(result), "verdict": Verdict.WRONG}) if wrong else result]


def _visited_cluster(rng: random.Random) -> list[Result]:
    """Strangers at every port of a sweep's own cluster, as long as it runs."""
    from distributed import Client, Security

    began, visits, entered = time.monotonic(), 0, False
    folder = Path(os.path.realpath(os.path.join(work_folder(), str(rng.randrange(10**9)))))
    folder.mkdir(parents=True)
    process = start(
        "+sweep=smoke", "engine=dask", "tracking=none", *QUICK[:3], "sweep.trials=4", folder=folder
    )
    while process.poll() is None and time.monotonic() - began < START_SECONDS:
        for ip, port in _ports(process):
            security = rng.choice([None, Security.temporary()])
            scheme = "tls" if security else "tcp"
            words = rng.choice([b"GET / HTTP/1.0\r\n\r\n", os.urandom(500), b"\x00" * 100])
            with suppress(Exception), socket.create_connection((ip, port), timeout=1) as connection:
                connection.sendall(words)
            with suppress(Exception):
                Client(
                    f"{scheme}://{ip}:{port}", security=security, timeout=0.5, set_as_default=False
                ).close()
                entered = True
            visits += 1
        time.sleep(0.2)
    status, out, err = finish(process, 120)
    shutil.rmtree(folder)
    verdict = Verdict.WRONG if entered else judge(status, out, err)
    seconds = round(time.monotonic() - began, 1)
    said = brief((err.strip() or out.strip() or " ").splitlines()[-1], 200)
    return [Result("strangers", f"{visits} visits at a cluster's ports", verdict, status, seconds, said)]


START_SECONDS = 60.0
OTHERS = {  # simbias of another version: a file and what of it is replaced
    "version": ("cost/quadratic.py", "", "# changed\n"),
    "plan": ("sweep/worker.py", '    marker: str = ""', '    mark: str = ""'),
    "gone": ("sweep/worker.py", "def run_plan", "def run_one"),
}


def _other_workers(rng: random.Random) -> list[Result]:
    """A cluster whose workers, and whose scheduler or not, have another simbias: no trial counts."""
    kind, both = rng.choice(sorted(OTHERS)), rng.random() < 0.5
    folder = Path(work_folder())
    package = Path(simbias.__file__).parent
    shutil.copytree(package, folder / "simbias", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("conf", "sweeps"):
        (folder / name).symlink_to(package.parent / name)
    name, before, after = OTHERS[kind]
    file = folder / "simbias" / name
    file.write_text(file.read_text().replace(before, after, 1))
    other, address = os.environ | {"PYTHONPATH": str(folder)}, folder / "scheduler.json"
    with ExitStack() as stack:
        for role, options in (("scheduler", ["--port=0", "--no-dashboard"]), ("worker", ["--nthreads=1"])):
            (folder / role).mkdir()
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", role, *options, f"--scheduler-file={address}"],
                cwd=folder / role,
                env=other if both or role == "worker" else None,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)
            while not address.exists():
                time.sleep(0.1)
        at = f"engine.address={json.loads(address.read_text())['address']}"
        command = ["+sweep=smoke", "engine=dask", at, "tracking=folders", *QUICK[:3], "sweep.trials=1"]
        case = f"workers{' and scheduler' * both} of another version: {kind}"
        result = attempt("strangers", case, command, seconds=60.0)
    shutil.rmtree(folder)
    wrong = result.verdict is Verdict.RAN and result.status == 0
    return [Result(**{**vars(result), "verdict": Verdict.WRONG}) if wrong else result]


def work_folder() -> str:
    """Where a sweep may run."""
    import tempfile

    return tempfile.mkdtemp(prefix="attack-")


def _ports(process: subprocess.Popen[str]) -> set[tuple[str, int]]:
    """Where a process and its children listen."""
    found = set()
    with suppress(psutil.Error):
        us = psutil.Process(process.pid)
        for each in (us, *us.children(recursive=True)):
            for connection in each.net_connections():
                if connection.status == psutil.CONN_LISTEN:
                    found.add(tuple(connection.laddr))
    return found


SURFACES: dict[str, Callable[[random.Random, Path], Sequence[Result]]] = {
    "code": code,
    "recordings": recordings,
    "controllers": lab.controllers,
    "experiments": lab.experiments,
    "disks": harm.disks,
    "together": harm.together,
    "archives": harm.archives,
    "words": harm.words,
    "hardware, trial": hardware_trial,
    "hardware, sweep": hardware_sweep,
    "stores": store,
    "files": files,
    "kills": kills,
    "strangers": strangers,
}
