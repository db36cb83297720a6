"""Units of recordings, and factors between them."""

from __future__ import annotations

import re
from math import pi

from simbias.core.quantities import TURNS

# For each unit: the quantity it measures, and its factor to that quantity's first unit.
_ANGLE = {unit: 2 * pi / turn for unit, turn in TURNS.items()}
_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
_TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
_TORQUE = {"N m": 1.0, "mN m": 1e-3, "N cm": 1e-2, "N mm": 1e-3, "kN m": 1e3}
_FORCE = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
_OTHERS = {"A": 1.0, "mA": 1e-3}
_VOLTAGE = {"V": 1.0, "mV": 1e-3}
_RATES = {f"{unit}/s": factor for unit, factor in _ANGLE.items()} | {"rpm": pi / 30, "1/min": pi / 30}
_SPEEDS = {f"{unit}/s": factor for unit, factor in _LENGTH.items()}
_SPELLED = {  # in any case, by regular expressions
    "deg(ree)?s?": "deg",
    "rad(ian)?s?": "rad",
    "met(er|re)s?": "m",
    "sec(ond)?s?$": "s",
    "centi": "c",
    "milli": "m",
    "micro": "u",
    "nano": "n",
    "rpm": "rpm",
}
KINDS = (_ANGLE, _LENGTH, _TIME, _TORQUE, _FORCE, _OTHERS, _VOLTAGE, _RATES, _SPEEDS)


def factor(unit: str, wanted: str) -> float:
    """The factor that converts a value from a unit to the wanted one.

    Raises
    ------
    ValueError
        If the unit is unknown, or measures something else.
    """
    given, asked = _plain(unit), _plain(wanted)
    if given == asked:
        return 1.0
    for kind in KINDS:
        if given in kind and asked in kind:
            return kind[given] / kind[asked]
    known = [name for kind in KINDS if asked in kind for name in kind]
    raise ValueError(f"cannot be in {unit}; expected one of {', '.join(known) or wanted}")


def _plain(unit: str) -> str:
    """The listed form of a unit: Nm, N*m and N-m are N m, degrees are deg, milliseconds are ms."""
    text = re.sub(r"[·*.-]", " ", unit.strip())
    for spelled, listed in _SPELLED.items():
        text = re.sub(spelled, listed, text, flags=re.IGNORECASE)
    return next((listed for listed in _TORQUE if listed.replace(" ", "") == text), text)
