"""How numbers are written: millimetres with three significant digits, never more certainty than there is."""

from __future__ import annotations

import math


def mm(metres: float) -> str:
    """Metres as millimetres with three significant digits: 0.0142 is ``14.2``, 2.5 is ``2500``."""
    return significant_text(1000.0 * metres)


def significant_text(value: float, digits: int = 3) -> str:
    """A number with so many significant digits and no exponent where that can be read."""
    if not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    text = f"{value:#.{digits}g}"
    return f"{value:.0f}" if "e+" in text else text.rstrip(".")


def percent(share: float) -> str:
    """A share as whole percents, but nothing short of all is 100 % and nothing above none 0 %."""
    rounded = round(100 * share)
    if (rounded == 100 and share < 1) or (rounded == 0 and share > 0):
        return f"{100 * share:.1f} %" if 0.0005 <= share < 0.9995 else ("< 0.1 %" if share < 0.5 else "> 99.9 %")
    return f"{rounded} %"
