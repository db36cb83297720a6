"""A recording in a task's frames: units converted, gaps found, missing rates estimated, all reported."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simbias.core import HardwareError, Task
from simbias.core.messages import quote, words
from simbias.core.quantities import TURNS, Quantity
from simbias.core.records import Array, Indices, Rollout
from simbias.lab.rates import check_rates, jumps, late_rates, lone_jumps, rates_of
from simbias.lab.signals import Signal, Signals, signals, split_name
from simbias.lab.units import factor
from simbias.learning.noise import white_noise

ESTIMATED = "velocities are estimated"
ASKED = ": is it in degrees, or sampled too rarely?"
OFTEN_WRAPPED = 0.2  # share of samples between which an angle jumps by more than half a turn
MOST_WRAPPED = 1.1  # turns that a wrapped angle goes through, with its noise
FEW_RESETS = 2  # jumps of a counted angle that may be resets or lost samples
MOST_TURNS = 1.5  # turns between two samples of a wrapped angle
GAP = 5.0  # usual sampling intervals: a longer one is a gap
FEWEST_FRAMES = 2  # minimum length of a gap
RAREST = 20.0  # frames between samples of the most frequent signal: beyond, time has other units,
RAREST_OF_UNIT = 1000.0  # if its unit is given
SMOOTH = 0.02  # s, interval for estimating a velocity from positions
SHORT = 0.005  # s, frame length: in longer frames, a parabola over five misses changes of acceleration
AROUND = 3  # frames at most to each side of a longer frame, for the velocity of a cubic,
LONGEST = 0.06  # s, at most
COARSE = 0.012  # s: in longer frames, estimated velocities miss fast changes
SPARSE = 1.5  # frames between samples of a state: beyond, linear interpolation misses the motion
TWICE = 2.0  # factor by which inputs may exceed their limit
SAME = 0.01  # of the samples: fewer with repeated times are not reported
MOSTLY = 0.99  # of the frames: a quantile that excludes peaks of sensor noise
TOLERANCE = 1.05  # times an input's limit: tolerated without a note
MOST_TOLD = 8  # pieces listed in a line
NEAR = 0.01  # of a frame: a sample closer to its start belongs to it


@dataclass(frozen=True, eq=False)
class Recording:
    """Pieces of a recording, between gaps and resets."""

    pieces: tuple[Rollout, ...]
    times: tuple[Array, ...]  # of each piece (k,): times of the first state's samples, in s from its start
    notes: tuple[str, ...]  # changes made to the data, and limits of their information
    doubts: tuple[str, ...] = ()  # about parameters identified from the recording


class Reader:
    """Reads recordings of a task.

    Parameters
    ----------
    columns
        For `time` and each state and input: the name of its column, followed by the unit if it differs from
        the task's (`q1 [deg]`).
    """

    def __init__(self, task: Task, columns: Mapping[str, str]) -> None:
        self._task, self._columns = task, columns

    def read(self, path: Path, whole_lines: bool = False) -> Recording:
        """Read a file; an unterminated last line counts if it has all cells, or never with `whole_lines`.

        Raises
        ------
        HardwareError
            If it cannot be read or makes no sense; the message names the file in one line.
        """
        file = signals(path, [split_name(column)[0] for column in self._columns.values()], whole_lines)
        return _Reading(self._task, self._columns, file).recording()


class _Reading:
    """A file that is being read, with notes on it."""

    def __init__(self, task: Task, columns: Mapping[str, str], file: Signals) -> None:
        self._task, self._columns, self._file = task, columns, file
        self._quantities, self._rates = (*task.states, *task.inputs), rates_of(task)
        self._notes = [*file.notes]
        self._found = self._signals()

    def recording(self) -> Recording:
        """The pieces, once they have been checked."""
        frames = [self._frames(begin, end) for begin, end in self._bounds()]
        noise = np.array([self._noise(i, frames) for i in range(len(self._task.states))])
        pieces = tuple(self._piece(at, noise, continues=i > 0) for i, at in enumerate(frames))
        measured_rates = {i: position for i, position in self._rates.items() if i in self._found}
        check_rates(str(self._file.path), pieces, self._task, measured_rates)
        late = late_rates(pieces, self._task, measured_rates)
        self._notes += [*self._late(late), *self._beyond_limits(pieces), *self._still(pieces)]
        doubts = [*self._doubts(), *(["velocities lag behind their positions"] if late else [])]
        return Recording(pieces, tuple(map(self._measured, frames)), tuple(self._notes), tuple(doubts))

    def _signals(self) -> dict[int, Signal]:
        """Signals by index of states, then inputs, in the task's units and s; angles are unwound.

        A rate without a column is missing from the result.
        """
        file, quantities = self._file, self._quantities
        time, time_unit = self._named("time")
        names = {i: self._named(quantity.name) for i, quantity in enumerate(quantities)}
        for i, (name, _) in names.items():
            if i not in self._rates and not file.has(name):
                file.signal(name, time)  # raises: names what is missing
        found, same = {}, (0, 0)
        for i, quantity in enumerate(quantities):
            name, unit = names[i]
            if i in self._rates and not file.has(name):
                lacks = "" if name == quantity.name else f", as there is no column {quote(name)}"
                position = quantities[self._rates[i]].name
                self._notes.append(f"{quantity.name} is estimated from {position}{lacks}")
                continue
            signal = file.signal(name, time)
            scale = self._factor(quantity.name, unit or file.unit(name) or quantity.unit, quantity.unit)
            second = self._factor("time", time_unit or file.unit(time) or "s", "s")
            times, first = np.unique(signal.times * second, return_index=True)
            if len(times) < 2:
                problem = f"column {name}: expected two samples at least, got {len(times)}"
                if len(signal.times) > 1:
                    problem = f"column {time}: all {len(signal.times)} times are the same"
                raise HardwareError(f"{file.path}: {problem}")
            same = max(same, (len(signal.times) - len(times), len(signal.times)))
            found[i] = Signal(times, signal.values[first] * scale, signal.places[first])
            if i < len(self._task.states) and quantity.unit in TURNS:
                found[i] = found[i]._replace(values=self._unwound(name, quantity, found[i]))
        if same[0] > SAME * same[1]:
            text = f"{same[0]} of {same[1]} samples have the same time as the previous one"
            self._notes.append(f"{text}; only the first of each time counts")
        frame, has_unit = self._task.time_step, bool(time_unit or file.unit(time))
        if (usual := min(map(_period, found.values()))) > (RAREST_OF_UNIT if has_unit else RAREST) * frame:
            raise HardwareError(
                f"{file.path}: expected samples about every {frame:g} s, got one every {usual:.3g} s: "
                f"is the time in another unit?{'' if has_unit else ' Name the unit, as in `time [ms]`'}"
            )
        return found

    def _named(self, quantity: str) -> tuple[str, str]:
        """The name of a quantity's column, and the unit given after it, if the file's own name has none."""
        column = self._columns[quantity]
        return (column, "") if self._file.has(column) else split_name(column)

    def _factor(self, name: str, unit: str, wanted: str) -> float:
        """The factor from a quantity's unit in the file to the wanted one."""
        try:
            return factor(unit, wanted)
        except ValueError as error:
            raise HardwareError(f"{self._file.path}: {name}: {words(error)}") from error

    def _unwound(self, column: str, angle: Quantity, signal: Signal) -> Array:
        """The angle's values (k,) without jumps by a turn between gaps; larger jumps are refused."""
        file, turn, values = self._file, TURNS[angle.unit], signal.values
        steps, begins = np.diff(values), self._begins(signal)
        steps[begins - 1] = 0.0
        if len(jumps := np.flatnonzero(np.abs(steps) > MOST_TURNS * turn)):
            first, then = map(file.place, signal.places[jumps[0] : jumps[0] + 2])
            jump = f"{steps[jumps[0]]:.3g} {angle.unit} from {first} to {then}"
            raise HardwareError(f"{file.path}: column {column} jumps by {jump}, more than a turn{ASKED}")
        wraps = np.count_nonzero(np.abs(steps) > turn / 2)
        if wraps > OFTEN_WRAPPED * len(steps):
            often = f"more than half a turn in {wraps / len(steps):.0%} of its samples"
            raise HardwareError(f"{file.path}: column {column} jumps by {often}{ASKED}")
        runs = np.split(values, begins)
        turns = max(map(np.ptp, runs)) / turn
        if wraps > FEW_RESETS and turns > MOST_WRAPPED:
            far = f"more than half a turn {wraps} times, but goes through {turns:.3g} turns: is it in degrees"
            raise HardwareError(f"{file.path}: column {column} jumps by {far}, reset, or sampled too rarely?")
        unwound = np.concatenate([np.unwrap(run, period=turn) for run in runs])
        if not np.array_equal(unwound, values):
            self._notes.append(f"{angle.name} was wrapped, and is unwrapped")
        return unwound

    def _bounds(self) -> list[tuple[float, float]]:
        """Start and end times of pieces, in which every signal continues without gap, reset or jump."""
        pieces, frame, longest = [(-np.inf, np.inf)], self._task.time_step, np.inf
        runs_of, jumps_of = dict[int, list[tuple[float, float]]](), self._jumps()
        for i, signal in self._found.items():
            begins = self._begins(signal)
            if i in jumps_of:
                begins = np.union1d(begins, jumps_of[i])
            runs = runs_of[i] = _runs(signal, begins, held=i >= len(self._task.states))
            longest = min(longest, max(d - c for c, d in runs))
            pieces = [(max(a, c), min(b, d)) for a, b in pieces for c, d in runs if min(b, d) > max(a, c)]
        pieces = [(a, b) for a, b in pieces if b - a >= frame * (1 - 1e-9)]
        if not pieces:
            problem = f"expected at least one frame of {frame:g} s, got {longest:.3g} s"
            if longest >= frame:
                problem = "its columns have no frame in common"
            raise HardwareError(f"{self._file.path}: {problem}")
        if len(pieces) > 1:
            seconds = ", ".join(f"{b - a:.2f} s" for a, b in pieces[:MOST_TOLD])
            seconds += ", ..." * (len(pieces) > MOST_TOLD)
            gaps = {self._quantities[i].name: len(self._begins(each)) for i, each in self._found.items()}
            names = ", ".join(name for name, count in gaps.items() if count > min(gaps.values()))
            alone = f"; columns with gaps of their own: {names}" if names else ""
            self._notes.append(f"gaps, resets or jumps leave {len(pieces)} pieces: {seconds}{alone}")
        self._note_ends(runs_of, pieces[0][0], pieces[-1][1])
        return pieces

    def _note_ends(self, runs_of: Mapping[int, list[tuple[float, float]]], begin: float, end: float) -> None:
        """Note what is left out before `begin` and after `end`, where runs of some signals end."""
        found = self._found
        before = begin - min(signal.times[0] for signal in found.values())
        after = max(signal.times[-1] for signal in found.values()) - end
        for side, which, at, seconds in ((0, "first", begin, before), (1, "last", end, after)):
            lacking = [i for i, runs in runs_of.items() if any(run[side] == at for run in runs)]
            # If all signals end there, none of them is the cause.
            if len(lacking) < len(found) and seconds > max(self._gap(found[i]) for i in lacking):
                names = ", ".join(self._quantities[i].name for i in lacking)
                self._notes.append(f"the {which} {seconds:.3g} s lack {names}, and are left out")

    def _jumps(self) -> dict[int, Indices]:
        """Samples of states that their rates, or the motion around, do not explain; all are reported."""
        found, each = self._found, dict[int, Indices]()
        for rate, i in self._rates.items():
            times, values, _ = found[i]
            if rate in found:
                samples = jumps(times, values, np.interp(times, found[rate].times, found[rate].values))
            else:
                samples = lone_jumps(times, values)
            each[i] = np.setdiff1d(samples, self._begins(found[i]))
        at = sorted({float(found[i].places[j]) for i, samples in each.items() for j in samples})
        if at:
            names = ", ".join(self._quantities[i].name for i, samples in each.items() if len(samples))
            jump = f"{names}: a jump at {self._file.places(at)}"
            self._notes.append(f"{jump}, more than velocities imply: is it reset, or are rows lost?")
        return each

    def _begins(self, signal: Signal) -> Indices:
        """The first sample after each gap."""
        return np.flatnonzero(np.diff(signal.times) > self._gap(signal)) + 1

    def _gap(self, signal: Signal) -> float:
        """The interval in s without samples that makes a gap in a signal."""
        return max(GAP * _period(signal), FEWEST_FRAMES * self._task.time_step)

    def _frames(self, begin: float, end: float) -> Array:
        """The times (k + 1,) of the frames from `begin` up to `end`."""
        step = self._task.time_step
        count = int((end - begin) / step + 1e-9) + 1
        return np.asarray(begin + step * np.arange(count))

    def _piece(self, at: Array, noise: Array, continues: bool) -> Rollout:
        """A piece in the task's frames, at times (k + 1,), with white noise (n,) in its states.

        States are linear between samples. Inputs are held from each sample to the next one.
        """
        task, found, n = self._task, self._found, len(self._task.states)
        columns = {i: np.interp(at, found[i].times, found[i].values) for i in range(n) if i in found}
        for i, position in self._rates.items():
            if i not in columns:
                columns[i] = self._rate(columns[position])
        states = np.array([columns[i] for i in range(n)]).T
        signals_of_inputs = [found[n + i] for i in range(len(task.inputs))]
        inputs = np.array([_held(each, at[0], task.time_step, len(at) - 1) for each in signals_of_inputs]).T
        return Rollout(states, inputs, measured=states, sensed=True, noise=noise, continues=continues)

    def _measured(self, at: Array) -> Array:
        """The times (j,), after the start, at which the first state with a column was measured in a piece."""
        times = self._found[min(self._found)].times
        return times[(times >= at[0]) & (times <= at[-1] + NEAR * self._task.time_step)] - at[0]

    def _noise(self, i: int, pieces: Sequence[Array]) -> float:
        """The standard deviation of white noise in the i-th state in frames at times (k + 1,) of pieces.

        The noise of samples, at most one in a frame, passes through the same interpolation and, if the state
        is a rate without a column, the same differentiation.
        """
        times, values, _ = self._found[i if i in self._found else self._rates[i]]
        early, rng = NEAR * self._task.time_step, np.random.default_rng(0)
        chosen = [np.unique(np.searchsorted(times, at - early)) for at in pieces]
        of_samples = white_noise([(times[each], values[each]) for each in chosen])
        white = [rng.standard_normal(len(each)) for each in chosen]
        made = [np.interp(at, times[each], e) for at, each, e in zip(pieces, chosen, white, strict=True)]
        if i not in self._found:
            made = list(map(self._rate, made))
        passed, sampled = (np.mean(np.concatenate(each) ** 2) for each in (made, white))
        return of_samples * float(np.sqrt(passed / sampled))

    def _rate(self, values: Array) -> Array:
        """The derivative (k,) of values (k,), from polynomials fitted around each frame."""
        from scipy.signal import savgol_filter  # lazily: few recordings need it

        h = self._task.time_step
        degree, around = (2, SMOOTH / h / 2) if h <= SHORT else (3, min(AROUND, LONGEST / h))
        width = min(2 * max(2, round(around)) + 1, len(values) // 2 * 2 - 1)
        if width < 3:
            return np.gradient(values, h)
        rate: Array = savgol_filter(values, width, min(degree, width - 1), deriv=1, delta=h)
        return rate

    def _beyond_limits(self, pieces: Sequence[Rollout]) -> list[str]:
        """Notes on inputs beyond their limits; those far beyond are refused."""
        inputs, notes = np.concatenate([piece.inputs for piece in pieces]), []
        for each, values, lower, upper in zip(
            self._task.inputs, inputs.T, *self._task.input_bounds, strict=True
        ):
            limit = max(-lower, upper)
            if (usual := np.quantile(np.abs(values), MOSTLY)) > TWICE * limit:
                raise HardwareError(
                    f"{self._file.path}: column {self._columns[each.name]}: {each.name} reaches {usual:.3g} "
                    f"{each.unit}, beyond the limit of {limit:g} {each.unit}: is a unit or a column wrong?"
                )
            over, under = values.max() - upper, lower - values.min()
            if max(over, under) > (TOLERANCE - 1.0) * limit:
                most, bound = (values.max(), upper) if over > under else (values.min(), lower)
                text = f"{most:.3g} {each.unit}, beyond the limit of {bound:g} {each.unit}"
                notes.append(f"{each.name} reaches {text} (means over frames)")
        return notes

    def _late(self, delays: Mapping[int, float]) -> Iterator[str]:
        """Notes on rates with these delays in s."""
        for i, delay in delays.items():
            rate, position = (self._quantities[j].name for j in (i, self._rates[i]))
            yield f"{rate} lags {position} by {1e3 * delay:.3g} ms; without its column, it is estimated"

    def _still(self, pieces: Sequence[Rollout]) -> Iterator[str]:
        """Notes on quantities that never change, and what they cannot identify."""
        each = zip(*((*piece.states.T, *piece.inputs.T) for piece in pieces), strict=True)
        for i, (quantity, values) in enumerate(zip(self._quantities, each, strict=True)):
            if np.ptp(np.concatenate(values)) == 0:
                of_motor = "its motor's gain cannot be distinguished from an offset"
                lacks = "nothing is learned about its motion" if i < len(self._task.states) else of_motor
                yield f"{quantity.name} never changes, so {lacks}"

    def _doubts(self) -> Iterator[str]:
        """Reasons not to trust parameters identified from these signals; remedies are noted."""
        frame, n = self._task.time_step, len(self._task.states)
        if frame > COARSE and not self._rates.keys() <= self._found.keys():
            yield f"{ESTIMATED} in frames of {frame:g} s"
        period = max(_period(signal) for i, signal in self._found.items() if i < n)
        if period > SPARSE * frame:
            doubt = f"states are measured every {period:.3g} s, in frames of {frame:g} s"
            self._notes.append(f"{doubt}: set task.time_step={period:.2g}")
            yield doubt


def _period(signal: Signal) -> float:
    """The usual sampling interval in s."""
    return float(np.median(np.diff(signal.times)))


def _runs(signal: Signal, begins: Indices, held: bool) -> list[tuple[float, float]]:
    """Start and end times of a signal's uninterrupted runs; held values last until the next sample is due."""
    firsts, lasts = [0, *begins], [*(begins - 1), len(signal.times) - 1]
    due = _period(signal) if held else 0.0
    bounds = zip(signal.times[firsts].tolist(), signal.times[lasts].tolist(), strict=True)
    return [(first, last + due) for first, last in bounds]


def _held(signal: Signal, begin: float, time_step: float, frames: int) -> Array:
    """Means (frames,) over each frame from `begin` on, of a signal held between samples."""
    times = (signal.times - begin) / time_step
    times = np.where(np.abs(times - np.rint(times)) < NEAR, np.rint(times), times)
    bounds = np.arange(frames + 1)
    edges = np.union1d(bounds, times[(times > 0) & (times < frames)])
    values = signal.values[np.searchsorted(times, edges[:-1], side="right") - 1]
    return np.add.reduceat(values * np.diff(edges), np.searchsorted(edges, bounds[:-1]))
