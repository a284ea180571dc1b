"""Headings of tables of poses: which column holds what, and the unit of the stamps.

A heading is a line of names, among which are the stamp's, the x, y, z of a position and the x, y,
z, w of a quaternion. Prose is no heading, whatever words it has.
"""

import re
from dataclasses import dataclass

from dynslam_bench.geometry.stamp_units import UNITS, StampUnit

_NAME = re.compile(r"(?P<name>[^\s\[(]+)\s*(?:[\[(]\s*(?P<unit>[^\])]*?)\s*[\])])?")
"""A name, and its unit in brackets: ``tx (m)``, ``timestamp [ns]``, ``q_RS_w []``."""
_STAMP = re.compile(
    r"(?:time_?stamps?|times?|ts|t|stamps?|sec(?:ond)?s?)(?:_(?P<unit>[a-z]+))?", re.IGNORECASE
)
"""The name of a stamp, perhaps with its unit: ``timestamp``, ``t``, ``time_ns``."""
_PART = re.compile(r"(?P<vector>.*?)[_.]?(?P<axis>[xyzw])", re.IGNORECASE)
"""A part of a vector: ``qw``, ``p_RS_R_x``, ``position.x``, ``x``."""
_SYMBOLS = {symbol: unit for unit in UNITS for symbol in (unit.symbol, f"{unit.symbol}ec")}
"""Units by their symbols, of which headings write some with "sec" at the end."""


@dataclass(frozen=True)
class Heading:
    """The columns of a table of poses.

    Attributes:
        columns: How many there are.
        order: Which of them hold ``timestamp tx ty tz qx qy qz qw``.
        unit: The unit of the stamps; None where it is not stated.
    """

    columns: int
    order: tuple[int, ...]
    unit: StampUnit | None


def parse_heading(text: str) -> Heading | None:
    """The heading that a line is, without its ``#``, with commas or spaces between the names; None if it is none."""
    # cells between commas, else names between spaces
    text = text.strip().lstrip("#%").strip().replace('"', "")
    cells = [cell.strip() for cell in text.split(",")]
    if len(cells) == 1:
        cells = [match[0] for match in _NAME.finditer(text)]
    # a comma at the end
    if cells and not cells[-1]:
        cells.pop()

    # a column without a name numbers the rows, as pandas writes it
    names = [_NAME.fullmatch(cell) for cell in cells]
    if any(cell and name is None for cell, name in zip(cells, names, strict=True)):
        return None

    # the stamp, and the parts of vectors by the name that they share
    stamp_column = None
    unit = ""
    vectors: dict[str, dict[str, int]] = {}
    for column, name in enumerate(names):
        if name is None:
            continue
        stamp = _STAMP.fullmatch(name["name"])
        part = _PART.fullmatch(name["name"])
        if stamp is not None and stamp_column is None:
            stamp_column = column
            unit = name["unit"] or stamp["unit"] or ""
        elif part is not None:
            vectors.setdefault(part["vector"].lower(), {}).setdefault(part["axis"].lower(), column)

    # the first vector of three parts is the position, the first of four the quaternion
    position = next((axes for axes in vectors.values() if axes.keys() == set("xyz")), None)
    quaternion = next((axes for axes in vectors.values() if axes.keys() == set("xyzw")), None)
    if stamp_column is None or position is None or quaternion is None:
        return None
    order = (
        stamp_column,
        *(position[axis] for axis in "xyz"),
        *(quaternion[axis] for axis in "xyzw"),
    )
    return Heading(len(cells), order, _SYMBOLS.get(unit.lower()))
