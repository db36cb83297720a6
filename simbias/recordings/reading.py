"""Recordings from files and folders, in a task's frames."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from simbias.core import HardwareError, Task
from simbias.core.errors import ConfigError, reason
from simbias.core.messages import counted, words
from simbias.core.records import Array, Rollout
from simbias.lab.recorded import CSV, Recorded
from simbias.lab.recording import Reader
from simbias.lab.signals import BAGS
from simbias.learning.identification.posterior import Posterior
from simbias.recordings.copies import Digest, copied, digests, new
from simbias.recordings.parts import Part
from simbias.trial.study import Study

BRACKETS = re.compile(r"(:\s*)([^\s,'\"{}][^,'\"{}]*\][^,'\"{}]*?)(?=\s*[,}])")  # `: q1 [deg],`
ENDS = (*CSV, *BAGS)
KINDS = f"{', '.join(ENDS)}, or a ROS 2 bag"
HELD_OUT = "held out, so not fitted"
LEARNED = "learned by the earlier posterior, so not counted again"
SAME = "the same as earlier data, so not counted again"
UNKNOWN = "the earlier posterior does not say which recordings it has learned, nor which doubts it has"


class Recordings(NamedTuple):
    """Rollouts read from files, with their measurement times and notes."""

    rollouts: dict[str, tuple[Rollout, ...]]  # by file: the pieces between gaps
    times: dict[str, tuple[Array, ...]]  # (k,) sample times of each piece, in s from its start
    notes: tuple[str, ...]  # changes made to the data, with the files
    extent: str  # duration and sampling rate of each file
    doubt: str = ""  # about each parameter identified from them

    @property
    def pieces(self) -> Part:
        """The pieces of all files."""
        return Part("all recordings", self.rollouts)


def read_apart(
    study: Study,
    places: Sequence[Path | str],
    held_out: Sequence[Path | str],
    columns: Mapping[str, str] | None = None,
    windows: float = 0.0,
    again: bool = False,
) -> tuple[Recordings, Recordings]:
    """Recordings for fitting and held-out recordings, which do not overlap.

    What the study's earlier posterior has learned is left out, unless it may count `again`. Errors are as for
    `read`, also if nothing is left of what is held out.
    """
    posterior = study.identification
    known = posterior.known if isinstance(posterior, Posterior) and not again else None
    try:
        learned = [Digest.of(each) for each in (known and known.learned) or ()]
    except ValueError as error:
        raise ConfigError("identification.known.learned", words(error)) from error
    kept = read(study, held_out, columns, already={LEARNED: learned})
    if held_out and not kept.rollouts:
        raise ConfigError("--held-out", "the earlier posterior has learned all of it")
    kept_blocks = digests(kept.pieces.rollouts, study.task.time_step)
    fitted = read(study, places, columns, windows, {HELD_OUT: kept_blocks, LEARNED: learned})
    if known and (known.doubts is None or known.learned is None):
        fitted = fitted._replace(notes=(UNKNOWN, *fitted.notes))
    return fitted, kept


def read(
    study: Study,
    places: Sequence[Path | str],
    columns: Mapping[str, str] | None = None,
    windows: float = 0.0,
    already: Mapping[str, Collection[Digest]] | None = None,
) -> Recordings:
    """Read recordings from files, and from all files in folders, except for copies.

    Copies of each other count once; those of blocks in `already`, by a note on them, do not count.
    Pieces between gaps are left out if shorter than `windows` windows of the study's posterior. The default
    columns are those of the study's `hardware=recorded`, or else the task's own names.

    Raises
    ------
    ConfigError
        If there is no such file, or one cannot be read or is too short; the message is one line.
    """
    reader, needed = _reader(study, columns), _needed(study, windows)
    files, time_step = _all_files(places), study.task.time_step
    rollouts, times = dict[str, tuple[Rollout, ...]](), dict[str, tuple[Array, ...]]()
    notes, extents = defaultdict[str, list[str]](list), list[str]()  # note -> its files
    seen, doubts = list[Digest](), dict[str, None]()
    for file in files:
        name = _name(file, files)
        try:
            recording = reader.read(file, whole_lines=True)
        except HardwareError as error:
            raise ConfigError("", words(error)) from error
        whole = left = [*zip(recording.pieces, recording.times, strict=True)]
        for note, known in {**(already or {}), SAME: seen}.items():
            before, left = left, []
            for each in before:
                left += (parts := [*_new(*each, known, time_step)])
                if known is seen:  # so that copies within a file count once, too
                    seen += digests([piece for piece, _ in parts], time_step)
            if seconds := time_step * (_frames(before) - _frames(left)):
                notes[f"{seconds:.3g} s are {note}" if left else note].append(name)
        if not left:
            continue
        doubts |= dict.fromkeys(recording.doubts)
        for note in recording.notes:
            notes[note].append(name)
        pieces = [each for each in left if not needed or needed.windows([each[0]])]
        if needed and not pieces and _frames(left) == _frames(whole):
            raise ConfigError(str(file), f"is shorter than a window of {needed.window:g} s")
        if needed and (short := len(left) - len(pieces)):
            notes[f"{counted(short, 'piece')} shorter than {needed.window:g} s left out"].append(name)
        if not pieces:
            continue
        rollouts[name], times[name] = zip(*pieces, strict=True)
        extents.append(f"{name} {_extent(study.task, rollouts[name], times[name])}")
    texts = tuple(f"{', '.join(names)}: {note}" for note, names in notes.items())
    return Recordings(rollouts, times, texts, ", ".join(extents), "; ".join(doubts))


def learned_files(study: Study, learned: Collection[Digest]) -> list[str]:
    """The names of those recordings of `hardware=recorded` of which blocks have been learned."""
    if not isinstance(hardware := study.hardware, Recorded):
        return []
    recordings = {file.name: hardware.reader.read(file).pieces for file in hardware.source_files}
    return [
        name for name, pieces in recordings.items() if any(copied(each, learned).any() for each in pieces)
    ]


def _reader(study: Study, columns: Mapping[str, str] | None) -> Reader:
    """A reader for these columns, those of the study's recordings, or the task's own names."""
    if isinstance(study.hardware, Recorded) and not columns:
        return study.hardware.reader
    try:
        return Recorded(study.task, ".", columns=columns).reader
    except ValueError as error:
        raise ConfigError("columns", words(error).removeprefix("columns ")) from error


def _needed(study: Study, windows: float) -> Posterior | None:
    """A posterior with the windows that a piece must contain; None if pieces are not selected."""
    posterior = study.identification
    if not windows or not isinstance(posterior, Posterior):
        return None
    return posterior.with_window(windows * posterior.window)


def _new(
    piece: Rollout, times: Array, known: Collection[Digest], time_step: float
) -> Iterator[tuple[Rollout, Array]]:
    """The parts of a piece, and their sample times, that are no copies of blocks with known digests."""
    for begin, end in new(piece, known, time_step):
        first, last = time_step * begin, time_step * end
        whole = end - begin == piece.frames
        yield (
            piece if whole else piece.part(begin, end),
            times if whole else times[(times >= first) & (times <= last)] - first,
        )


def _frames(pieces: Sequence[tuple[Rollout, Array]]) -> int:
    return sum(piece.frames for piece, _ in pieces)


def _extent(task: Task, pieces: Sequence[Rollout], times: Sequence[Array]) -> str:
    """The total duration of pieces, and their sampling rate."""
    seconds = task.time_step * sum(piece.frames for piece in pieces)
    intervals = sum(len(when) - 1 for when in times)
    return f"{seconds:.3g} s at {intervals / seconds:.3g} Hz"


def columns(text: str) -> dict[str, str]:
    """Names of columns from YAML text or a YAML file.

    Raises
    ------
    ConfigError
        If it is not a mapping of names.
    """
    import yaml

    try:
        found = _yaml(Path(text).read_text(encoding="utf-8") if text.endswith((".yaml", ".yml")) else text)
    except (OSError, yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError("--columns", reason(error)) from error
    if not isinstance(found, dict) or not all(
        isinstance(each, str) for pair in found.items() for each in pair
    ):
        raise ConfigError("--columns", "must be a mapping of names, such as '{pos1: q1, vel1: dq1}'")
    return found


def _yaml(text: str) -> Any:
    """A YAML text, in braces also with names that have a unit, such as `{pos1: q1 [deg]}`."""
    import yaml

    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return yaml.safe_load(BRACKETS.sub(r"\1'\2'", text))


def _all_files(places: Sequence[Path | str]) -> Collection[Path]:
    """The files in these places, without duplicates."""
    return {file.resolve(): file for place in places for file in _files(Path(place))}.values()


def _files(place: Path) -> list[Path]:
    """A file, a ROS 2 bag, or the files of a folder."""
    bag = (place / "metadata.yaml").is_file()
    found = [place]
    if place.is_dir() and not bag:
        found = sorted(each for end in ENDS for each in place.glob(f"*{end}"))
    if not found:
        raise ConfigError(str(place), f"is a folder that holds no recordings itself ({KINDS})")
    if not all(bag or file.is_file() for file in found):
        raise ConfigError(str(place), f"no such recording ({KINDS})")
    return found


def _name(file: Path, files: Collection[Path]) -> str:
    """A file's name, with its folder if the name is not unique."""
    return file.name if sum(other.name == file.name for other in files) == 1 else str(file)
