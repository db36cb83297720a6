"""Clocks of a lab's files; a recording is cut where one is set back or ahead."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from simbias.core.records import Array, Indices

RESET = 1e4  # mean sampling intervals: the gap left by a reset of the clock
UNEQUAL = 0.02  # s, difference between times from header to arrival: a clock was set, or two differ
LASTING = 5  # messages before and after, which differ by so much, and by more than they vary
TOGETHER = 1.0  # s, within which topics first show that their clock was set


def without_resets(times: Array) -> Array:
    """Non-decreasing times (r,): a decrease is a reset of the clock, and becomes a gap."""
    steps = np.diff(times)
    # The median would be too short for rows that come in bursts, microseconds apart.
    usual = float(steps[steps > 0].mean()) if (steps > 0).any() else 0.0
    return times + np.concatenate([[0.0], np.cumsum(np.where(steps < 0, RESET * usual - steps, 0.0))])


def cuts(arrivals: Mapping[str, Array], times: Mapping[str, Array]) -> Array:
    """Arrivals (c, 2) of the first messages by a clock that was set: in the first and the last topic.

    For each topic, `arrivals` (k,) are of its messages, and `times` (k,) are those of their headers.
    """
    found: list[tuple[float, float]] = []
    seen = set[str]()
    firsts = ((at, topic) for topic, arrived in arrivals.items() for at in _set_at(arrived, times[topic]))
    for at, topic in sorted(firsts):
        if not found or topic in seen or at > found[-1][0] + TOGETHER:
            found.append((at, at))
            seen = set()
        found[-1] = (found[-1][0], at)
        seen.add(topic)
    return np.array(found).reshape(-1, 2)


def cut_at(bounds: Array, arrivals: Mapping[str, Array], times: Mapping[str, Array]) -> dict[str, Array]:
    """Times (k,) by topic, as if no clock were set, with a gap at each of the `cuts`; NaN within one."""
    every = np.concatenate(list(arrivals.values()))
    gap = RESET * np.ptp(every) / len(every)
    shifts: list[list[float]] = [[0.0] for _ in bounds]  # of clocks, after each cut
    found = dict[str, Array]()
    for topic, arrived in arrivals.items():
        part = np.searchsorted(bounds.ravel(), arrived, side="right")  # odd within a cut
        late, moved = arrived - times[topic], times[topic].copy()
        moved[part % 2 == 1] = np.nan
        for i, known in enumerate(shifts, 1):
            if (after := part == 2 * i).any():
                own = np.median(late[after]) - np.median(late[part == 0]) if (part == 0).any() else np.nan
                # A topic that shares a clock is shifted with it; one that begins later is assumed to.
                shared = [shift for shift in known if np.isnan(own) or abs(shift - own) <= UNEQUAL]
                known.append(shared[-1] if shared else float(own))
                moved[after] += known[-1] + i * gap
        found[topic] = moved
    return found


def delays(bounds: Array, arrivals: Mapping[str, Array], times: Mapping[str, Array]) -> dict[str, float]:
    """Medians by topic of the time in s from header to arrival, before the first of the `cuts`, if any."""
    end = bounds[0, 0] if len(bounds) else np.inf
    late = {topic: (arrived - times[topic])[arrived < end] for topic, arrived in arrivals.items()}
    return {topic: float(np.median(each)) for topic, each in late.items() if len(each)}


def _set_at(arrivals: Array, times: Array) -> Array:
    """Arrivals of the messages at which a topic's clock was set: header times go back, or jump ahead."""
    late, steps = arrivals - times, np.diff(times)
    if not len(steps):
        return np.empty(0)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(late, LASTING - 1, mode="edge"), LASTING)
    least, most = around.min(axis=1), around.max(axis=1)
    before, after = slice(None, len(steps)), slice(LASTING, LASTING + len(steps))
    least_step = np.maximum(UNEQUAL, np.maximum((most - least)[before], (most - least)[after]))
    back = (steps < 0) & (least[after] - most[before] > least_step)
    # Of messages that were held up and arrive at once, header times do not jump.
    ahead = (steps > np.median(steps) + UNEQUAL) & (least[before] - most[after] > least_step)
    ahead[: LASTING - 1] = False  # a first message may be old, as of a latched topic
    at: Indices = np.flatnonzero(back | ahead) + 1
    return arrivals[at]
