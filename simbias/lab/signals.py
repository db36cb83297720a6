"""Signals in a lab's files: columns of a CSV, or message fields of a ROS bag or an MCAP file."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simbias.core import HardwareError
from simbias.core.extras import library
from simbias.core.messages import words
from simbias.core.records import Array
from simbias.core.table import read_table
from simbias.lab.clocks import UNEQUAL, cut_at, cuts, delays, without_resets

NAME = re.compile(r"(?P<base>.*?)\s*[\[(](?P<unit>[^\])]+)[\])]$")  # q1 [deg], q1 (deg)
FIELD = re.compile(
    r"(?P<topic>/[\w/]*)\.(?P<fields>[\w.]+?)(?:\[(?P<item>\w+)\])?$"
)  # /joints.position[elbow]
BAGS = (".mcap", ".db3", ".bag")
NO_SAMPLE = ("", "nan", "na")  # cells without a sample
NANOSECOND = 1e-9
MOST_TOLD = 8  # places listed in a line


class Signal(NamedTuple):
    """The samples of one quantity in a file."""

    times: Array  # (k,) s, or in the unit of the file's time
    values: Array  # (k,)
    places: Array  # (k,) rows in the file, or s since its first message


class Signals(ABC):
    """The signals of a file, by name."""

    notes: tuple[str, ...] = ()  # omissions, and doubts about times of signals that were read

    def __init__(self, path: Path) -> None:
        self.path = path

    @abstractmethod
    def signal(self, name: str, time: str) -> Signal:
        """A signal; in files with columns, its times come from the column `time`.

        Raises
        ------
        HardwareError
            If there is no signal of that name; the message suggests the nearest.
        """

    @abstractmethod
    def place(self, number: float) -> str:
        """The name of a sample's place in the file, for messages."""

    def places(self, numbers: Sequence[float] | Array) -> str:
        """The names of places, of which the first few are listed."""
        text = ", ".join(self.place(number) for number in numbers[:MOST_TOLD])
        return text + f" and {len(numbers) - MOST_TOLD} other places" * (len(numbers) > MOST_TOLD)

    @abstractmethod
    def has(self, name: str) -> bool:
        """Whether the file has a signal of that name."""

    def unit(self, name: str) -> str:
        """The unit that the file states for a signal or for time; "" if none."""
        return ""

    def missing(self, names: list[str], known: list[str], where: str = "") -> HardwareError:
        """The error for names that a file lacks; it suggests the nearest known ones."""
        lower = {each.lower(): each for each in known}
        near = [lower[match] for name in names for match in get_close_matches(name.lower(), lower, 1)]
        hint = f"; did you mean {', '.join(near)}?" if near else ""
        return HardwareError(f"{self.path}: {where}expected a column {', '.join(names)}, got none{hint}")


class Columns(Signals):
    """The signals of a CSV file; blank cells, nan or NA are no samples, as with different sampling rates."""

    def __init__(self, path: Path, names: Collection[str], whole_lines: bool = False) -> None:
        super().__init__(path)
        self._asked = names
        self._table = read_table(path, may_be_cut=True, whole_lines=whole_lines)
        if self._table.cut is not None:
            self.notes = (f"row {self._table.cut}, the last one, may be cut off and is left out",)
        self._clocks: dict[int, Array] = {}  # times by column
        self._known: dict[str, list[tuple[int, str]]] = {}  # duplicates are refused once their name is used
        names = self._table.names
        for index, name in enumerate(names):
            base, unit = match.groups() if (match := NAME.match(name)) else (name, "")
            for key in {name, base} if base not in names else {name}:
                self._known.setdefault(key, []).append((index, unit))

    def place(self, number: float) -> str:
        """The name of a row."""
        return f"row {number:.0f}"

    def has(self, name: str) -> bool:
        """Whether the file has a column of that name, possibly followed by a unit."""
        return name in self._known

    def unit(self, name: str) -> str:
        """The unit in brackets after a column's name; "" if there is none."""
        return self._known[name][0][1] if name in self._known else ""

    def signal(self, name: str, time: str) -> Signal:
        """The cells of a column that hold a sample."""
        lacking = [each for each in (time, name) if each not in self._known]
        if lacking:
            raise self.missing(lacking, [each for each in self._known if each not in self._asked], "row 1: ")
        for each in (time, name):
            if len(self._known[each]) > 1:
                raise HardwareError(f"{self.path}: row 1: several columns are named {each}")
        column, table = self._known[name][0][0], self._table
        instants = self._instants(self._known[time][0][0])
        kept = [i for i, cells in enumerate(table.cells) if cells[column].strip().lower() not in NO_SAMPLE]
        if len(kept) < len(table.cells):
            table = replace(
                table, rows=tuple(table.rows[i] for i in kept), cells=[table.cells[i] for i in kept]
            )
        return Signal(instants[kept], table.numbers([column])[:, 0], np.array(table.rows))

    def _instants(self, clock: int) -> Array:
        """Non-decreasing times (r,), without resets of the file's clock."""
        if clock in self._clocks:
            return self._clocks[clock]
        times = self._table.numbers([clock])[:, 0]
        steps = np.diff(times)
        if 2 * (back := np.flatnonzero(steps < 0)).size > (steps > 0).sum():  # too many for resets
            before, after = times[back[0] : back[0] + 2]
            problem = f"expected times that increase, got {after:.9g} after {before:.9g}"
            raise self._table.error(int(back[0]) + 1, clock, problem)
        self._clocks[clock] = without_resets(times)
        return self._clocks[clock]


class Messages(Signals):
    """Signals of a ROS bag or MCAP file: `/topic.field`, `/topic.field[0]` in a list, or [name] by `name`.

    Messages that lack the name are skipped. Times in s are those of the messages' headers or, without
    headers, of their arrival.
    """

    def __init__(self, path: Path, names: Collection[str]) -> None:
        super().__init__(path)
        wanted = {match["topic"] for name in names if (match := FIELD.match(name))}
        read: dict[str, list[tuple[float, float, Any]]] = {}  # by topic: arrival, time, message
        headed = set[str]()  # topics whose messages have times in their headers
        highlevel = library("rosbags.highlevel", "rosbags", "bags")
        typesys = library("rosbags.typesys", "rosbags", "bags")
        store = typesys.get_typestore(typesys.Stores.LATEST)
        try:
            with highlevel.AnyReader([path], default_typestore=store) as reader:
                self._known = sorted({each.topic for each in reader.connections if each.msgcount})
                chosen = [each for each in reader.connections if each.topic in wanted]
                for connection, arrival, raw in reader.messages(chosen) if chosen else ():
                    message, arrived = reader.deserialize(raw, connection.msgtype), arrival * NANOSECOND
                    if (time := _stamp(message)) is None:
                        time = arrived
                    else:
                        headed.add(connection.topic)
                    read.setdefault(connection.topic, []).append((arrived, time, message))
        except Exception as error:  # the reader raises many types
            raise HardwareError(f"{path}: cannot be read ({words(error)})") from error
        self._topics = self._sorted(read, headed)

    def _sorted(
        self, read: Mapping[str, list[tuple[float, float, Any]]], headed: Collection[str]
    ) -> dict[str, tuple[Array, Array, list[Any]]]:
        """Times, places and messages of each topic, in order of time; all are cut where a clock was set."""
        arrivals = {topic: np.array([arrived for arrived, _, _ in rows]) for topic, rows in read.items()}
        times = {topic: np.array([time for _, time, _ in rows]) for topic, rows in read.items()}
        begin = min((each[0] for each in arrivals.values()), default=0.0)
        bounds = cuts(arrivals, times)
        self.notes = _misaligned(delays(bounds, arrivals, times), headed)
        if len(bounds):
            times = cut_at(bounds, arrivals, times)
            text = f"a clock is reset or stepped at {self.places(bounds[:, 0] - begin)}"
            self.notes = (*self.notes, f"{text}: all topics are cut there")
        found = {}
        for topic, instants in times.items():
            order = np.argsort(instants, kind="stable")[: np.sum(~np.isnan(instants))]  # NaN is last
            messages = [read[topic][i][-1] for i in order]
            found[topic] = instants[order], arrivals[topic][order] - begin, messages
        return found

    def unit(self, name: str) -> str:
        """The unit of time; a field has none."""
        return "" if FIELD.match(name) else "s"

    def place(self, number: float) -> str:
        """The time since the first message."""
        return f"{number:.6g} s"

    def has(self, name: str) -> bool:
        """Whether the file has the topic in a signal's name."""
        match = FIELD.match(name)
        return match is not None and match["topic"] in self._topics

    def signal(self, name: str, time: str) -> Signal:
        """The field of each message of a topic."""
        match = FIELD.match(name)
        if match is None:
            wanted = "/topic.field, such as /joint_states.position[0]"
            raise HardwareError(f"{self.path}: {name}: must be {wanted}")
        if match["topic"] not in self._topics:
            raise self.missing([match["topic"]], self._known)
        times, places, messages = self._topics[match["topic"]]
        item = match["item"] or "0"
        named = [] if item.isdecimal() else [i for i, each in enumerate(messages) if item in _names(each)]
        if named:  # messages of other joints may share the topic
            times, places, messages = times[named], places[named], [messages[i] for i in named]
        try:
            values = np.array([_field(message, match) for message in messages], dtype=np.float64)
        except (AttributeError, ValueError, IndexError, TypeError) as error:
            raise HardwareError(
                f"{self.path}: {name}: no such number in a message ({words(error)})"
            ) from error
        return Signal(times, values, places)


def signals(path: Path, names: Collection[str], whole_lines: bool = False) -> Signals:
    """The signals of a file, optionally only of its `whole_lines`, or of a folder that is a ROS 2 bag.

    Of a bag, only the topics in `names` are read.

    Raises
    ------
    HardwareError
        If it cannot be read.
    """
    if path.is_dir() or path.suffix in BAGS:
        try:
            return Messages(path, names)
        except ValueError as error:  # the reader is not installed
            raise HardwareError(f"{path}: {words(error)}") from error
    return Columns(path, names, whole_lines)


def _misaligned(late: Mapping[str, float], headed: Collection[str]) -> tuple[str, ...]:
    """A note if topics differ in the time from header to arrival, in s, or some have no headers."""
    if not late or np.ptp(list(late.values())) <= UNEQUAL:
        return ()
    texts = [
        f"{topic} {0.0 - round(each, 3):g} s" if topic in headed else f"{topic} none"
        for topic, each in late.items()
    ]
    return (f"header times minus arrival times: {', '.join(texts)}; topics may be misaligned",)


def _stamp(message: Any) -> float | None:
    """The time of a message's header in s; None without one."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None or not (stamp.sec or stamp.nanosec):
        return None
    return float(stamp.sec) + stamp.nanosec * NANOSECOND


def _names(message: Any) -> list[str]:
    """The names in a message, such as a joint's."""
    return list(getattr(message, "name", ()))


def _field(message: Any, match: re.Match[str]) -> float:
    """The number in a message; an item of a list by its index, or by its name in the message's `name`."""
    value = message
    for field in match["fields"].split("."):
        value = getattr(value, field)
    item = match["item"]
    if item is None:
        return float(value)
    return float(value[int(item) if item.isdecimal() else _names(message).index(item)])


def split_name(text: str) -> tuple[str, str]:
    """A name and the unit after it, separated by a space, as in `q1 [deg]`; "" if there is none."""
    match = re.match(r"(.*\S)\s+\[([^\]]+)\]$", text)
    return (match[1], match[2]) if match else (text, "")


def checked_columns(columns: Mapping[str, str] | None, names: list[str]) -> dict[str, str]:
    """The column for each name, by default of the same name.

    Raises
    ------
    ValueError
        If `columns` has unknown names, or one column twice.
    """
    unknown = sorted(set(columns or {}) - set(names))
    if unknown:
        problem = f"columns names quantities that the task lacks: {', '.join(unknown)}"
        raise ValueError(f"{problem}; it has {', '.join(names)}")
    found = {name: (columns or {}).get(name, name) for name in names}
    by_column: dict[str, str] = {}
    for name, column in found.items():
        if other := by_column.get(split_name(column)[0]):
            raise ValueError(f"columns names {column} for both {other} and {name}")
        by_column[split_name(column)[0]] = name
    return found
