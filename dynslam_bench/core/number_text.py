"""Numbers as people read them: three significant digits, errors in millimetres, other lengths in metres from 1 m on."""

import math

ROUNDING_M = 5e-7
"""Lengths below this are shown as none: files of trajectories are rounded to about as much."""


def significant_text(value: float, digits: int = 3) -> str:
    """A number with so many significant digits and no exponent where that can be read."""
    if not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    text = f"{value:#.{digits}g}"
    return f"{value:.0f}" if "e+" in text else text.rstrip(".")


def mm(metres: float) -> str:
    """Metres as millimetres with three significant digits: 0.0142 is ``14.2``, 2.5 is ``2500``."""
    if 0 < abs(metres) < ROUNDING_M:
        return "0.000"
    return significant_text(1000.0 * metres)


def length_text(metres: float) -> str:
    """A round length with its unit: metres from 1 m on, else millimetres."""
    return f"{metres:g} m" if metres >= 1 else f"{1000 * metres:g} mm"
