"""A recording in a task's frames: units converted, gaps found, what lacks estimated, and all of it told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simbias.core import HardwareError, Task
from simbias.core.messages import quote, words
from simbias.core.records import Array, Rollout
from simbias.core.robot import TURNS
from simbias.lab.signals import Signal, Signals, signals, split_name
from simbias.lab.units import factor
from simbias.learning.noise import noise_of

MOST_TURNS = 1.5  # from one sample of a wrapped angle to the next
GAP = 5.0  # usual intervals between samples: what is longer is a gap
FEWEST_FRAMES = 2  # of a gap
RAREST = 20.0  # frames from one sample to the next of what is measured most often: a time in other units,
RAREST_OF_UNIT = 1000.0  # where its unit is named
SMOOTH = 0.02  # s, over which a velocity is estimated from positions
SLOWEST = 0.05  # s over which positions and velocities are compared
LATEST, CLEARLY = 0.1, 0.5  # s that a rate may be late; its share of squared differences then, at most
TWICE = 2.0  # how much positions may differ from the integrals of velocities, and inputs exceed their limit
MOSTLY = 0.99  # of the frames: peaks of a sensor's noise exceed more
TOLERANCE = 1.05  # times an input's limit, up to which nothing is said
CORRELATED = 0.8  # below, velocities say too little for their size to be compared
UNRELATED, CLEAR = 0.3, 4.0  # below, however late: others, if both change by so many times their noise
LASTING = 0.5  # s of changes, which tell that
NEAR = 0.01  # of a frame from its start: a sample that is nearer belongs to it


@dataclass(frozen=True, eq=False)
class Recording:
    """Pieces of a recording, between gaps and resets."""

    pieces: tuple[Rollout, ...]
    times: tuple[Array, ...]  # of each piece (k,): when the first state was measured, in s from its start
    notes: tuple[str, ...]  # what was done to the data, and what they cannot tell


class Reader:
    """Reads recordings of a task.

    Parameters
    ----------
    columns
        Of `time`, each state and input: the name of its column, with its unit behind it if that is not the
        task's (`q1 [deg]`).
    """

    def __init__(self, task: Task, columns: Mapping[str, str]) -> None:
        self._task = task
        self._columns = columns
        self._rates = rates_of(task)

    def read(self, path: Path, whole_lines: bool = False) -> Recording:
        """The recording of a file; a last line without an end counts if it has all cells, or not at all.

        Raises
        ------
        HardwareError
            If it cannot be read or cannot be meant so, in one line that names the file.
        """
        file = signals(path, whole_lines)
        notes = list(file.notes)
        found = self._signals(file, notes)
        bounds = self._pieces(path, found, notes)
        pieces, times = [], []
        for begin, end in bounds:
            piece, measured = self._piece(found, begin, end)
            pieces.append(piece)
            times.append(measured)
        measured_rates = {i: position for i, position in self._rates.items() if i in found}
        check_rates(str(path), pieces, self._task, measured_rates)
        notes += [
            *self._late(measured_rates, pieces),
            *self._beyond_limits(path, pieces),
            *self._still(pieces),
        ]
        return Recording(tuple(pieces), tuple(times), tuple(notes))

    def _signals(self, file: Signals, notes: list[str]) -> dict[int, Signal]:
        """Signals by the place of states, then inputs, in the task's units and s; angles unwound.

        A rate that no column holds is missing.
        """
        quantities = (*self._task.states, *self._task.inputs)
        time, time_unit = self._named(file, "time")
        lacking = [
            name
            for i, quantity in enumerate(quantities)
            if not file.has(name := self._named(file, quantity.name)[0]) and i not in self._rates
        ]
        if lacking:
            file.signal(lacking[0], time)  # says what lacks
        found = {}
        for i, quantity in enumerate(quantities):
            name, unit = self._named(file, quantity.name)
            if i in self._rates and not file.has(name):
                lacks = "" if name == quantity.name else f", as there is no column {quote(name)}"
                notes.append(f"{quantity.name} is estimated from {quantities[self._rates[i]].name}{lacks}")
                continue
            signal = file.signal(name, time)
            scale = _factor(file, quantity.name, unit or file.unit(name) or quantity.unit, quantity.unit)
            second = _factor(file, "time", time_unit or file.unit(time) or "s", "s")
            times, first = np.unique(signal.times * second, return_index=True)
            if len(times) < 2:
                raise HardwareError(
                    f"{file.path}: column {name}: expected two samples at least, got {len(times)}"
                )
            values = signal.values[first] * scale
            if (turn := TURNS.get(quantity.unit)) and i < len(self._task.states):
                jumps = np.flatnonzero(np.abs(np.diff(values)) > MOST_TURNS * turn)
                if len(jumps):
                    first, then = times[jumps[0] : jumps[0] + 2]
                    jump = f"{values[jumps[0] + 1] - values[jumps[0]]:.3g} {quantity.unit}"
                    raise HardwareError(
                        f"{file.path}: column {name} jumps by {jump} from {first:.6g} s to {then:.6g} s, "
                        f"more than a turn"
                    )
                unwound = np.unwrap(values, period=turn)
                if not np.array_equal(unwound, values):
                    notes.append(f"{quantity.name} was wrapped")
                values = unwound
            found[i] = Signal(times, values)
        self._check_period(file, found, bool(time_unit or file.unit(time)))
        return found

    def _named(self, file: Signals, quantity: str) -> tuple[str, str]:
        """The name of a quantity's column, and the unit behind it that is not of the file's own name."""
        column = self._columns[quantity]
        return (column, "") if file.has(column) else split_name(column)

    def _pieces(self, path: Path, found: Mapping[int, Signal], notes: list[str]) -> list[tuple[float, float]]:
        """When pieces begin and end: where every signal goes on without a gap or a reset of its time."""
        pieces, frame, longest = [(-np.inf, np.inf)], self._task.time_step, np.inf
        for i, signal in found.items():
            runs = self._runs(signal, held=i >= len(self._task.states))
            longest = min(longest, max(d - c for c, d in runs))
            pieces = [(max(a, c), min(b, d)) for a, b in pieces for c, d in runs if min(b, d) > max(a, c)]
        pieces = [(a, b) for a, b in pieces if b - a >= frame * (1 - 1e-9)]
        if not pieces:
            problem = f"expected a frame of {frame:g} s at least, got {longest:.3g} s"
            if longest >= frame:
                problem = "its columns have no frame in common"
            raise HardwareError(f"{path}: {problem}")
        if len(pieces) > 1:
            seconds = ", ".join(f"{b - a:.2f} s" for a, b in pieces)
            notes.append(f"gaps or resets leave {len(pieces)} pieces: {seconds}")
        return pieces

    def _check_period(self, file: Signals, found: Mapping[int, Signal], has_unit: bool) -> None:
        """Refuse times of which even the most frequent samples are far apart."""
        usual, frame = min(map(_period, found.values())), self._task.time_step
        if usual > (RAREST_OF_UNIT if has_unit else RAREST) * frame:
            raise HardwareError(
                f"{file.path}: expected samples about every {frame:g} s, got one every {usual:.3g} s: "
                f"is it another unit of time?{'' if has_unit else ' Name it, as `time [ms]`'}"
            )

    def _runs(self, signal: Signal, held: bool) -> list[tuple[float, float]]:
        """When a signal's uninterrupted runs begin and end; what is held lasts until a next sample is due."""
        steps, usual = np.diff(signal.times), _period(signal)
        ends = np.flatnonzero(steps > max(GAP * usual, FEWEST_FRAMES * self._task.time_step))
        firsts, lasts = [0, *(ends + 1)], [*ends, len(steps)]
        due = usual if held else 0.0
        bounds = zip(signal.times[firsts].tolist(), signal.times[lasts].tolist(), strict=True)
        return [(first, last + due) for first, last in bounds]

    def _piece(self, found: Mapping[int, Signal], begin: float, end: float) -> tuple[Rollout, Array]:
        """A piece in the task's frames, and when its first state was measured.

        States are linear between samples. Inputs are held from each sample to the next one.
        """
        task, n = self._task, len(self._task.states)
        frames = int((end - begin) / task.time_step + 1e-9)
        at = begin + task.time_step * np.arange(frames + 1)
        columns = {i: np.interp(at, found[i].times, found[i].values) for i in range(n) if i in found}
        for i, position in self._rates.items():
            if i not in columns:
                columns[i] = self._rate(columns[position])
        states = np.array([columns[i] for i in range(n)]).T
        signals_of_inputs = [found[n + i] for i in range(len(task.inputs))]
        inputs = np.array([_held(each, begin, task.time_step, frames) for each in signals_of_inputs]).T
        times = found[0].times
        inside = times[(times >= begin) & (times <= at[-1] + NEAR * task.time_step)] - begin
        return Rollout(states, inputs, measured=states, sensed=True), inside

    def _rate(self, values: Array) -> Array:
        """The derivative (k,) of values (k,): of parabolas fitted to what is around each frame."""
        from scipy.signal import savgol_filter  # lazily: few recordings need it

        width = min(2 * max(2, round(SMOOTH / self._task.time_step / 2)) + 1, len(values) // 2 * 2 - 1)
        if width < 3:
            return np.gradient(values, self._task.time_step)
        rate: Array = savgol_filter(values, width, 2, deriv=1, delta=self._task.time_step)
        return rate

    def _late(self, measured_rates: Mapping[int, int], pieces: list[Rollout]) -> list[str]:
        """Notes on recorded rates that agree clearly better with how their values changed before."""
        frame, names, notes = self._task.time_step, [state.name for state in self._task.states], []
        latest = _frames(LATEST, frame)
        recorded = [piece.states for piece in pieces]
        for i, position in measured_rates.items():
            changes = _changes(recorded, i, position, frame)
            delayed = (_delayed(changes, late, latest) for late in range(latest + 1))
            errors = [float(np.sum((told - moved) ** 2)) for moved, told in delayed]
            late = int(np.argmin(errors))
            if errors[late] < CLEARLY * errors[0]:
                follows = f"{names[i]} follows {names[position]} by {1e3 * late * frame:.3g} ms"
                notes.append(f"{follows}; without its column, it is estimated")
        return notes

    def _beyond_limits(self, path: Path, pieces: list[Rollout]) -> list[str]:
        """Notes on inputs beyond their limits; those far beyond are refused."""
        inputs, notes = np.abs(np.concatenate([piece.inputs for piece in pieces])), []
        for each, values, limit in zip(self._task.inputs, inputs.T, self._task.input_limit, strict=True):
            told = f"of {each.name}, which is limited to {limit:g} {each.unit}"
            if (usual := np.quantile(values, MOSTLY)) > TWICE * limit:
                column = f"{path}: column {self._columns[each.name]}"
                raise HardwareError(
                    f"{column}: got {usual:.3g} {each.unit} {told}: is a unit wrong, or a column?"
                )
            if (most := values.max()) > TOLERANCE * limit:
                notes.append(f"up to {most:.3g} {each.unit} {told}")
        return notes

    def _still(self, pieces: list[Rollout]) -> list[str]:
        """Notes on quantities that never change, from which nothing can be learned."""
        notes = []
        for quantities, values in (
            (self._task.states, np.concatenate([piece.states for piece in pieces])),
            (self._task.inputs, np.concatenate([piece.inputs for piece in pieces])),
        ):
            for i, quantity in enumerate(quantities):
                if len(values) and np.ptp(values[:, i]) == 0:
                    notes.append(f"{quantity.name} never changes, so nothing is learned of what it moves")
        return notes


def rates_of(task: Task) -> dict[int, int]:
    """Of each state that is another's rate, by its place and unit: that one."""
    units, half = [state.unit for state in task.states], len(task.states) // 2
    return {i: i - half for i in range(half, len(units)) if units[i] == f"{units[i - half]}/s"}


def check_rates(source: str, pieces: Sequence[Rollout], task: Task, rates: Mapping[int, int]) -> None:
    """Refuse rates that are not those of their values: degrees, a time in ms, a wrong column.

    Rates map places of states to those of what they are the rates of.
    """
    names, noise = [state.name for state in task.states], noise_of(pieces)
    recorded = [piece.states for piece in pieces]
    for i, position in rates.items():
        changes = _changes(recorded, i, position, task.time_step)
        moved, told = _delayed(changes, 0, 0)
        if abs(_agreement(moved, told)) >= CORRELATED:
            ratio = float(told @ moved) / float(told @ told)
            if not 1 / TWICE < ratio < TWICE:
                raise HardwareError(
                    f"{source}: {names[position]} changes {ratio:.3g} times as fast as {names[i]} says: "
                    f"is a unit wrong, or a column?"
                )
        elif (
            len(moved) >= LASTING / task.time_step
            and _is_clear(moved, noise[position])
            and _is_clear(told / SLOWEST, noise[i])
        ):
            lags = range(_frames(LATEST, task.time_step) + 1)
            if max(_agreement(*_delayed(changes, late, late)) for late in lags) < UNRELATED:
                raise HardwareError(
                    f"{source}: {names[position]} does not change as {names[i]} says: is it another column?"
                )


def _changes(pieces: Sequence[Array], rate: int, position: int, frame: float) -> list[tuple[Array, Array]]:
    """Of each piece, changes (m,) of a state over a while, and those that its rate tells, by trapezoids."""
    k = _frames(SLOWEST, frame)
    sums = [frame * (np.cumsum(states[:, rate]) - states[:, rate] / 2) for states in pieces]
    moved = [states[k:, position] - states[:-k, position] for states in pieces]
    return list(zip(moved, (total[k:] - total[:-k] for total in sums), strict=True))


def _delayed(changes: Sequence[tuple[Array, Array]], late: int, latest: int) -> tuple[Array, Array]:
    """All changes, and those told some frames later; as many as there are at the latest delay."""
    counts = [max(len(moved) - latest, 0) for moved, _ in changes]
    moved = [each[:count] for (each, _), count in zip(changes, counts, strict=True)]
    told = [each[late : late + count] for (_, each), count in zip(changes, counts, strict=True)]
    return np.concatenate(moved), np.concatenate(told)


def _agreement(moved: Array, told: Array) -> float:
    """The correlation, about zero, of two series (m,); 0 where one is zero."""
    size = float(told @ told) * float(moved @ moved)
    return float(told @ moved) / np.sqrt(size) if size > 0 else 0.0


def _is_clear(changes: Array, noise: float) -> bool:
    """Whether changes (m,) are many times what noise of this deviation makes of them."""
    return float(np.sqrt(np.mean(changes**2))) > CLEAR * noise


def _frames(seconds: float, frame: float) -> int:
    """The number of frames, one at least, that are nearest to a time in s."""
    return max(1, round(seconds / frame))


def _factor(file: Signals, name: str, unit: str, wanted: str) -> float:
    """The factor from a quantity's unit in a file to the wanted one."""
    try:
        return factor(unit, wanted)
    except ValueError as error:
        raise HardwareError(f"{file.path}: {name}: {words(error)}") from error


def _period(signal: Signal) -> float:
    """The usual time in s from a sample to the next one."""
    return float(np.median(np.diff(signal.times)))


def _held(signal: Signal, begin: float, time_step: float, frames: int) -> Array:
    """Means (frames,) over each frame from `begin` on, of what is held from each sample to the next one."""
    times = (signal.times - begin) / time_step
    times = np.where(np.abs(times - np.rint(times)) < NEAR, np.rint(times), times)
    bounds = np.arange(frames + 1)
    edges = np.union1d(bounds, times[(times > 0) & (times < frames)])
    values = signal.values[np.searchsorted(times, edges[:-1], side="right") - 1]
    return np.add.reduceat(values * np.diff(edges), np.searchsorted(edges, bounds[:-1]))
