"""Allowed ranges of numbers in a config: generous but finite, so that obvious mistakes are refused.

Every number in a constructor has one of these types, or its own bounds. Beyond them, numbers overflow, a
physics engine crashes, or a trial never ends.
"""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

# Counts.
Count = Annotated[int, Field(gt=0, le=10_000)]  # iterations, experiments, rollouts, points
CountOrZero = Annotated[int, Field(ge=0, le=10_000)]
MOST_FRAMES = 10**7  # 3 h at 1 ms
Frames = Annotated[int, Field(gt=0, le=MOST_FRAMES)]
EvaluationCount = Annotated[int, Field(gt=0, le=10**9)]
Steps = Annotated[int, Field(gt=0, le=10**15)]  # of simulation
Population = Annotated[int, Field(ge=2, le=10_000)]
Workers = Annotated[int, Field(gt=0, le=1000)]
DelayFrames = Annotated[int, Field(ge=0, le=1000)]
Seed = Annotated[int, Field(ge=0, lt=2**64)]

# Numbers with a unit.
TimeStep = Annotated[float, Field(ge=1e-6, le=3600.0)]  # s
Seconds = Annotated[float, Field(gt=0, le=1e9)]  # 30 years
RolloutSeconds = Annotated[float, Field(ge=0.01, le=1e5)]  # s; in less time, nothing can fail
Mass = Annotated[float, Field(ge=1e-6, le=1e6)]  # kg
MassOrZero = Annotated[float, Field(ge=0, le=1e6)]
Inertia = Annotated[float, Field(ge=1e-9, le=1e9)]  # kg m^2
Length = Annotated[float, Field(ge=1e-6, le=1e6)]  # m
FigureWidth = Annotated[float, Field(ge=3.2, le=20)]  # in
Force = Annotated[float, Field(ge=1e-6, le=1e9)]  # N or N m
Acceleration = Annotated[float, Field(ge=1e-6, le=1e3)]  # m/s^2
Angle = Annotated[float, Field(gt=0, le=1e3)]  # rad
Slope = Annotated[float, Field(ge=-1, le=1)]  # rad
SlopeSpread = Annotated[float, Field(ge=0, le=1)]  # rad
Lag = Annotated[float, Field(ge=0, le=10)]  # s, also for a delay
Rate = Annotated[float, Field(gt=0, le=1e6)]  # rad/s
Variance = Annotated[float, Field(ge=0, le=1e6)]  # in the square of any unit

SPAN = r"\d{1,7}(\.\d{1,9})? ?m?s"  # as text, such as 40 ms or 0.2 s


def _check_span(value: Any) -> Any:
    """Refuse a value that is neither a number of frames nor a duration with its unit."""
    if isinstance(value, str) and re.fullmatch(SPAN, value):
        return value
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError("must be a number of frames, or a duration such as 40 ms or 0.2 s")
    if not 0 < value <= MOST_FRAMES:
        raise ValueError(f"must be from 1 to {MOST_FRAMES} frames")
    return value


Span = Annotated[Frames | str, BeforeValidator(_check_span)]  # frames, or a duration


def frames_in(span: Span, time_step: float) -> int:
    """The number of frames of `time_step` s in a span, rounded, at least one."""
    if isinstance(span, int):
        return span
    number, unit = span.rstrip("ms"), 1e-3 if span.endswith("ms") else 1.0
    return max(1, round(float(number) * unit / time_step))


# Numbers without a unit, or with any.
Share = Annotated[float, Field(gt=0, le=1)]
Deviation = Annotated[float, Field(ge=1e-6, le=100)]  # in units of a box's width
Spread = Annotated[float, Field(ge=0, le=5)]  # standard deviation of a logarithm
Scale = Annotated[float, Field(ge=1e-9, le=1e9)]  # a divisor of other numbers
Positive = Annotated[float, Field(gt=0, le=1e9)]
Bound = Annotated[float, Field(gt=0, le=100)]  # of parameters that are searched
NonNegative = Annotated[float, Field(ge=0, le=1e9)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
