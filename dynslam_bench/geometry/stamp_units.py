"""In which unit the stamps of a file are written: seconds, milliseconds, microseconds or nanoseconds.

Most files do not say it. The median step from one pose to the next tells it: cameras and motion
capture systems give from one pose in a few seconds to a thousand poses a second. The size of Unix
time tells it, too. Stamps that can be seconds are seconds. Where one other unit is possible, it is
taken, with a phrase that says so. Where several are possible, the file is refused, all of them are
named, and its heading decides.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dynslam_bench.core import TrajectoryError


@dataclass(frozen=True)
class StampUnit:
    """A unit of time.

    Attributes:
        name: In the plural.
        symbol: As headings have it, in brackets.
        digits: How many decimal digits a second has more than the unit.
    """

    name: str
    symbol: str
    digits: int

    @property
    def per_s(self) -> float:
        """Number of units in a second."""
        return float(10**self.digits)


SECONDS = StampUnit("seconds", "s", 0)
"""The unit that TUM's format prescribes."""
UNITS = (
    SECONDS,
    StampUnit("milliseconds", "ms", 3),
    StampUnit("microseconds", "us", 6),
    StampUnit("nanoseconds", "ns", 9),
)
"""The units that are recognised, from the largest to the smallest."""
LATEST_S = 9e9
"""The year 2255. Later stamps are no seconds, and 64 bits of nanoseconds end there."""
SLOWEST_S = 5.0
"""Poses further apart by the median are no video and no motion capture."""
FASTEST_FINE_S = 0.9e-3
"""Shortest median step in a unit smaller than the second: a little more than 1000 Hz.

At 200 Hz, a frequent rate of motion capture, this limit and `SLOWEST_FINE_S` leave one unit.
"""
SLOWEST_FINE_S = 4.0
"""Longest median step in a unit smaller than the second: 0.25 Hz."""
SPARSE_S = 60.0
"""Keyframes of a camera that hardly moves may be as far apart."""
SHORTEST_S = 0.5
"""Duration: where a smaller unit would make a shorter recording than this, the stamps are sparse keyframes."""
UNIX_S = 1e9
"""Unix time of the year 2001: stamps between it and `LATEST_S` are Unix time."""
LEAST_STATED_S = 1e-6
"""A heading whose unit makes steps shorter than this contradicts the stamps."""
MOST_STATED_S = 1e5
"""A heading whose unit makes steps longer than this contradicts the stamps."""
MOST_FRAMES = 1e8
"""Forty days at 30 frames a second: larger whole numbers are no numbers of frames."""


@dataclass(frozen=True)
class _Measured:
    """Size, span and step of stamps, in the unit that they are written in.

    Attributes:
        latest: The largest of them, without signs.
        usual: Median of the stamps, without signs.
        span: Difference between the first and the last stamp.
        step: Median difference of distinct ones in order of time; None for fewer than two.
    """

    latest: float
    usual: float
    span: float
    step: float | None


def median_step(stamps: ArrayLike) -> float | None:
    """Median difference of stamps ``[N]`` in order of time, equal ones counted once; None for fewer than two."""
    distinct = np.unique(np.asarray(stamps, dtype=np.float64))
    return float(np.median(np.diff(distinct))) if len(distinct) > 1 else None


def unit_of(
    stamps: ArrayLike, source: str, stated: StampUnit | None = None
) -> tuple[StampUnit, str]:
    """The unit of a file's stamps.

    Args:
        stamps: The numbers as they are written ``[N]``, finite, in any order, at least one.
        source: The file, for the messages.
        stated: The unit that its heading states; None where it states none.

    Returns:
        The unit, and a phrase that says what was taken and why: empty for seconds, and for a unit
        that is stated.

    Raises:
        TrajectoryError: No unit is possible, several are, or the stated one is not.
    """
    # size, span and median step of the stamps; a stated unit only has to agree with them
    values = np.asarray(stamps, dtype=np.float64)
    sizes = np.abs(values)
    span = float(values.max() - values.min())
    measured = _Measured(float(sizes.max()), float(np.median(sizes)), span, median_step(values))
    if stated is not None:
        _check_stated(stated, measured, source)
        return stated, ""

    # what can be seconds at the rate of a camera is seconds
    step = measured.step
    if measured.latest <= LATEST_S and (step is None or step <= SLOWEST_S):
        return SECONDS, ""

    # else the only unit that is possible
    possible = _possible_units(measured)
    if possible == [SECONDS]:
        return SECONDS, ""
    if len(possible) == 1:
        unit = possible[0]
        return unit, f"stamps {_described(measured)}: taken as {_with_rate(unit, step)}"

    # none, perhaps because of one stamp that is far from the others, or several
    if not possible:
        one_is_far = measured.usual <= LATEST_S and step is not None and step <= SLOWEST_S
        cure = "write seconds"
        if one_is_far:
            cure = f"remove the line with the stamp {measured.latest:.10g}"
        raise TrajectoryError(
            f"the stamps of {source} {_described(measured)}: in no unit are they those of a trajectory",
            cure,
        )
    example = f"# timestamp [{possible[0].symbol}] tx ty tz qx qy qz qw"
    raise TrajectoryError(
        f"the stamps of {source} {_described(measured)}: {' or '.join(_with_rate(unit, step) for unit in possible)}?",
        f"write seconds, or name the unit in the first line: '{example}'",
    )


def _possible_units(measured: _Measured) -> list[StampUnit]:
    """The units that stamps may be in which are no seconds at the rate of a camera, the likeliest first."""
    # units in which no stamp lies beyond 2255, and those in which they are Unix time
    in_range = [unit for unit in UNITS if measured.latest <= LATEST_S * unit.per_s]
    unix = [unit for unit in in_range if measured.usual >= UNIX_S * unit.per_s]
    step = measured.step
    if step is None:
        return unix
    # the rate of a camera or of a motion capture system, in a unit smaller than the second
    finer = [unit for unit in in_range if unit is not SECONDS]
    rated = [unit for unit in finer if FASTEST_FINE_S <= step / unit.per_s < SLOWEST_FINE_S]
    # Unix time at such a rate: size and steps agree
    certain = [unit for unit in rated if unit in unix]
    if certain:
        return certain
    # sparse keyframes, of which only seconds and Unix time are told
    sparse = [unit for unit in in_range if unit is SECONDS or unit in unix]
    sparse = [unit for unit in sparse if SLOWEST_FINE_S <= step / unit.per_s <= SPARSE_S]
    if sparse and all(measured.span / unit.per_s < SHORTEST_S for unit in rated):
        return sparse
    return [*rated, *sparse]


def _check_stated(stated: StampUnit, measured: _Measured, source: str) -> None:
    """Refuse a unit that the stamps contradict.

    Raises:
        TrajectoryError: They do.
    """
    step_s = 0.0 if measured.step is None else measured.step / stated.per_s
    fits = measured.step is None or LEAST_STATED_S <= step_s <= MOST_STATED_S
    if fits and measured.latest <= LATEST_S * stated.per_s:
        return
    raise TrajectoryError(
        f"the heading of {source} says {stated.name}, but its stamps {_described(measured)}",
        "write the unit that the stamps have into the heading: [s], [ms], [us] or [ns]",
    )


def _described(measured: _Measured) -> str:
    """For example ``are 33.3333 apart by the median``; of a single stamp its size."""
    if measured.step is None:
        return f"reach {measured.latest:.10g}"
    step = f"{measured.step:g}" if measured.step < 1e5 else f"{measured.step:.0f}"
    if measured.step <= SLOWEST_S:
        return f"reach {measured.latest:.10g} and are {step} apart by the median"
    return f"are {step} apart by the median"


def _with_rate(unit: StampUnit, step: float | None) -> str:
    """For example ``milliseconds (30 Hz)`` or ``seconds (one pose in 33.3 s)``."""
    if step is None:
        return unit.name
    step_s = step / unit.per_s
    return (
        f"{unit.name} ({1 / step_s:.3g} Hz)"
        if step_s < 1
        else f"{unit.name} (one pose in {step_s:.3g} s)"
    )


# Numbers of frames in place of stamps.


def are_frame_numbers(stamps: ArrayLike) -> bool:
    """Whether stamps ``[N]`` in seconds may be the numbers of frames: three or more whole numbers, no Unix time."""
    values = np.asarray(stamps, dtype=np.float64)
    return (
        len(values) > 2
        and bool((values == np.round(values)).all())
        and float(np.abs(values).max()) < MOST_FRAMES
    )


def describe_frame_numbers(stamps: ArrayLike, whose: str) -> str:
    """One phrase where `are_frame_numbers` holds: ``the stamps of the estimate are whole numbers, 1 apart by ...``."""
    return (
        f"the stamps of the {whose} are whole numbers, {median_step(stamps):g} apart by the median"
    )
