"""What `identify` and `excite` are given: tables, archives and bags that mean harm, and strange options."""

from __future__ import annotations

import gzip
import io
import os
import random
import resource
import sqlite3
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from attack.lab import CELLS, judged, study_of
from attack.values import VALUES
from attack.verdict import HIT, Result, attempt
from simbias.config import ConfigError
from simbias.recordings.reading import columns, read
from simbias.trial.study import Study

PENDULUM = "preset=double_pendulum"
NAMES = ["time", "pos1", "pos2", "vel1", "vel2", "tau1", "tau2"]
UNITS = [
    "deg",
    "ns",
    "ms",
    "mN m",
    "m",
    "parsec",
    "rad/s",
    "%",
    "1/0",
    "°",
    "<script>",
    "rad]",
    "10^9 s",
    "",
    "s s",
]
SCALES = [1e3, 1e6, 1e9, 1e12, 1e-3, 1e-9, -1.0, 0.0, 1e300, 5e-324]
SHIFTS = [1.7e18, -1e9, 1e300, np.nan]
LIMIT = 8 * 2**30  # bytes: what reads without a bound ends here, and not the machine
LINKS = {"link": "../secret.csv", "device": "/dev/zero", "circle": ""}
SECRET = "time,pos1\n0,1\n"  # beside the recordings


def table(rng: random.Random) -> list[list[str]]:
    """The cells of a recording as it should be: header and rows of two sines."""
    rate, t = rng.choice([0.002, 0.01]), np.arange(300)
    w = np.array([3.0, 5.0])
    at = rate * t[:, None]
    values = np.hstack([at, np.sin(w * at), w * np.cos(w * at), 0.1 * np.sin(7 * at), 0.1 * np.cos(at)])
    return [list(NAMES), *([repr(value) for value in row] for row in values.tolist())]


def _text(rows: list[list[str]], separator: str = ",") -> str:
    """The text of rows."""
    return "".join(f"{separator.join(row)}\n" for row in rows)


def recordings(rng: random.Random, work: Path) -> list[Result]:
    """A recording that is changed in one place, or strange options: read in finite numbers, or refused."""
    kinds = {"table": _changed, "archive": _archive, "bag": _bag, "columns": _columns}
    kind = rng.choice(["table", "table", "table", "archive", "bag", "columns", "options"])
    if kind == "options":
        return [_options(rng)]
    study = study_of(PENDULUM)
    assert isinstance(study, Study)

    with TemporaryDirectory(prefix="attack-") as name:
        folder = Path(name, "recordings", "in")
        folder.mkdir(parents=True)
        (folder.parent / "secret.csv").write_text(SECRET)
        case, file, names = kinds[kind](rng, folder)

        def attack() -> str:
            with _bounded():
                try:
                    found = read(study, [file], columns(names) if names else None)
                except ConfigError as error:
                    named = file.name.split()[-1] in str(error) or "olumns" in str(error)
                    if not named:
                        return f"no file named: {error}"
                    raise
            arrays = [array for each in found.pieces.rollouts for array in (each.states, each.inputs)]
            if not all(np.isfinite(array).all() for array in arrays):
                return "taken in, and no numbers"
            if list(Path(name).rglob(HIT)) or (folder.parent / "secret.csv").read_text() != SECRET:
                return "it wrote a file"
            return ""

        return judged("recordings", f"{kind}, {case}", attack)


@contextmanager
def _bounded() -> Iterator[None]:
    """A bound of the memory."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _changed(rng: random.Random, folder: Path) -> tuple[str, Path, str]:
    """A table with a strange cell, time, unit or row."""
    rows, file = table(rng), folder / rng.choice(["one.csv", "<img src=x>.csv", "ü \n.csv", "a=b.csv"])
    kind = rng.choice(["cell", "cell", "time", "time", "unit", "rows", "bytes", "name"])
    row, column, case = rng.randrange(1, len(rows)), rng.randrange(len(NAMES)), ""
    raw = None
    if kind == "cell":
        case = rows[row][column] = rng.choice(CELLS)
    elif kind == "time":
        scale, shift, place = (
            rng.choice(SCALES),
            rng.choice([0.0, 0.0, *SHIFTS]),
            rng.choice([1, row, len(rows) - 1]),
        )
        few = rng.random() < 0.3
        rows = [rows[0], *rows[place : place + 3]] if few else rows
        for each in rows[1 if few else place :]:
            each[0] = repr(scale * float(each[0]) + shift)
        case = f"{scale}, {shift} from {place}{', few' * few}"
    elif kind == "unit":
        unit = rng.choice(UNITS)
        case = rows[0][column] = f"{NAMES[column]} {rng.choice(['[{}]', '({})', '[[{}]'])}".format(unit)
    elif kind == "rows":
        case = rng.choice(["twice", "half", "one", "none", "shuffled", "blank"])
        rng_rows = rows[1:]
        made: dict[str, Callable[[], list[list[str]]]] = {
            "twice": lambda: [*rng_rows, *rng_rows],
            "half": lambda: [*rng_rows[:5], rng_rows[5][:3]],
            "one": lambda: rng_rows[:1],
            "none": list,
            "shuffled": lambda: rng.sample(rng_rows, len(rng_rows)),
            "blank": lambda: [[cell if rng.random() < 0.3 else "" for cell in each] for each in rng_rows],
        }
        rows = [rows[0], *made[case]()]
    elif kind == "name":
        case = rows[0][column] = rng.choice(
            ["", "time", "pos1", "vel1 [deg/s]", "<script>", "x" * 10**5, "\x00"]
        )
    elif kind == "bytes":
        raw = bytearray(_text(rows).encode())
        for _ in range(rng.choice([1, 30, 3000])):
            raw[rng.randrange(len(raw))] = rng.randrange(128)
    file.write_bytes(raw if raw is not None else _text(rows).encode())
    return f"{kind} {case!r} in {row}, {column}", file, ""


def _archive(rng: random.Random, folder: Path) -> tuple[str, Path, str]:
    """A file of another kind than its name says: archives with paths, bombs, links, devices, pipes."""
    text = _text(table(rng)).encode()
    kind = rng.choice(
        ["zip", "tar", "cut", "bomb", "twice", "link", "device", "pipe", "circle", "folder", "pickle"]
    )
    file = folder / rng.choice(["one.csv.gz", "one.csv", "one.mcap", "one.db3", "one.bag"])
    if kind == "zip":
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr(rng.choice([f"../../{HIT}", f"/tmp/{HIT}", "one.csv"]), text)
    elif kind == "tar":
        with tarfile.open(file, rng.choice(["w", "w:gz"])) as archive:
            entry = tarfile.TarInfo(rng.choice([f"../../{HIT}", f"{folder}/{HIT}", "one.csv"]))
            entry.size = len(text)
            archive.addfile(entry, io.BytesIO(text))
    elif kind in ("cut", "twice"):
        packed = gzip.compress(text)
        file.write_bytes(packed[: rng.randrange(len(packed))] if kind == "cut" else packed * 2)
    elif kind == "bomb":
        block = gzip.compress(b"0," * 2**24)
        file.write_bytes(block * 40)
    elif kind == "folder":
        file.mkdir()
    elif kind == "pipe":
        os.mkfifo(file)
    elif kind == "pickle":
        file.write_bytes(b"cos\nsystem\n(S'touch HIT'\ntR.")
    else:
        file.symlink_to(file.name if kind == "circle" else LINKS[kind])
    return f"{kind} {file.name}", rng.choice([file, folder]), ""


def _bag(rng: random.Random, folder: Path) -> tuple[str, Path, str]:
    """A ROS 2 bag whose metadata, tables or bytes mean harm."""
    kind = rng.choice(["metadata", "metadata", "table", "bytes"])
    bag = folder / "bag"
    bag.mkdir()
    path = rng.choice(["../../secret.csv", "/etc/passwd", "/dev/zero", "../bag", ".", "", "link"])
    tag = rng.choice(["!!python/object/apply:os.system [touch HIT]", "1", "[]", "{}", "null", "1e999", "-1"])
    content = {
        "version": "9",
        "storage_identifier": rng.choice(["sqlite3", "mcap", "x"]),
        "duration": "{nanoseconds: 1}",
        "starting_time": "{nanoseconds_since_epoch: 0}",
        "message_count": "1",
        "topics_with_message_count": "[]",
        "compression_format": "''",
        "compression_mode": "''",
        "relative_file_paths": f"[{path!r}]",
        "files": "[]",
    }
    if kind == "metadata":
        key = rng.choice(sorted(content))
        content[key] = content[key] if key == "relative_file_paths" else tag
        (bag / "link").symlink_to("/dev/zero")
    else:
        content |= {"storage_identifier": "sqlite3", "relative_file_paths": "[x.db3]"}
    lines = "".join(f"  {name}: {value}\n" for name, value in content.items())
    (bag / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n{lines}")
    if kind == "metadata":
        return f"{kind} {content}", bag, ""
    msgtype = rng.choice(["std_msgs/msg/Float64", "std_msgs/msg/Header", "../../x", "", "x" * 10**5])
    with closing(sqlite3.connect(bag / "x.db3")) as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT,"
                         " offered_qos_profiles TEXT)")  # fmt: skip
        database.execute("CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        database.execute("INSERT INTO topics VALUES(1, '/t', ?, 'cdr', ?)", (msgtype, rng.choice(["", tag])))
        for number in range(3):
            data = os.urandom(rng.choice([0, 4, 12, 1000]))
            database.execute(
                "INSERT INTO messages VALUES(?, 1, ?, ?)", (number, rng.choice([0, -1, 2**62]), data)
            )
        database.commit()
    if kind == "bytes":
        raw = bytearray((bag / "x.db3").read_bytes())
        for _ in range(30):
            raw[rng.randrange(len(raw))] = rng.randrange(256)
        (bag / "x.db3").write_bytes(raw)
    named = ", ".join(f"{name}: /t.data" for name in NAMES[1:])
    return f"{kind} {msgtype[:40]}", rng.choice([bag, bag / "x.db3"]), f"{{{named}}}"


def _columns(rng: random.Random, folder: Path) -> tuple[str, Path, str]:
    """Columns of another kind than a mapping of names."""
    file = folder / "one.csv"
    file.write_text(_text(table(rng)))
    name, value = rng.choice([*NAMES, "x", ""]), rng.choice(VALUES)
    given = rng.choice(
        [f"{{{name}: {value}}}", value, f"{{{name}: '{name} [{rng.choice(UNITS)}]'}}", "&a {a: *a}"]
    )
    with suppress(UnicodeEncodeError):
        given.encode()
        return given, file, given
    return "none", file, ""


def _options(rng: random.Random) -> Result:
    """Strange options of the commands, on a recording that is as it should be."""
    command = rng.choice(["identify", "excite"])
    value = rng.choice([value for value in VALUES if "\udce9" not in value])
    options = [
        *(
            ["--columns", value],
            ["--into", value],
            ["--held-out", value],
            [value],
            ["--recover"],
            ["--seconds", value],
        ),
        *(
            ["--attach", "--into", value],
            [f"identification.{rng.choice(['rounds', 'starts', 'known'])}={value}"],
        ),
        *(
            [f"identification.motors={value}"],
            [f"identification.sensors={value}"],
            [f"hardware.safety={value}"],
        ),
    ]
    option = rng.choice(options)
    name = rng.choice(["one.csv", "a=b.csv", "<b>.csv"])

    def prepare() -> None:
        Path(name).write_text(_text(table(rng)))

    words = [name, PENDULUM, "tracking=none", "identification.starts=1", "identification.rounds=1", *option]
    return attempt("recordings", f"{command} {option}", [command, *words], prepare, key="")
