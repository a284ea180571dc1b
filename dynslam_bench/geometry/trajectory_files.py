"""Trajectory files of the TUM RGB-D benchmark: ``timestamp tx ty tz qx qy qz qw``, one pose a line.

Reading follows the benchmark's own tools: ``#`` begins a comment, commas and tabs separate like
spaces. Lines with NaN or with an all-zero quaternion are skipped; quaternions are normalised. Lines
may come in any order, and of several lines with one stamp the last holds. Stamps in another unit
than seconds are recognised (`stamp_units`). Whatever is not taken as it stands is counted in
`FileNotes`.

A heading above the poses, behind ``#`` or not, puts the columns in another order or states the unit
of the stamps: so the tables of EuRoC and VSLAM-LAB are read. A comment that is no heading of the
rows below it is passed over.
"""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core import TrajectoryError, read_lines, write_atomic
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.headings import Heading, parse_heading
from dynslam_bench.geometry.rigs import nearest_rotation
from dynslam_bench.geometry.stamp_units import SECONDS, SLOWEST_S, StampUnit, median_step, unit_of
from dynslam_bench.geometry.stamps import format_ns, parse_ns, refuse_close, to_seconds
from dynslam_bench.geometry.trajectory import RepeatedStamps, Trajectory

_TUM_COLUMNS = "timestamp tx ty tz qx qy qz qw"
"""Columns of a line in TUM's format."""
MOST_LINES = 4_000_000
"""More than an hour at 1 kHz; a longer file is refused before it fills the memory."""
_ZERO_NORM = 1e-8
"""A quaternion of a smaller norm is all zero."""
_UNIT_TOLERANCE = 0.01
"""A quaternion whose norm is off by more is counted as normalised."""


@dataclass(frozen=True)
class FileNotes:
    """Counts of what a file held that was not taken as it stands.

    Attributes:
        lines: Lines with a pose, skipped ones included.
        not_finite: Lines skipped for NaN or infinity.
        zero_quaternions: Lines skipped for an all-zero quaternion.
        duplicates: Lines replaced by a later line with the same stamp.
        out_of_order: Lines whose stamp is before the previous line's; they were sorted.
        renormalised: Quaternions whose norm was off by more than 1 %.
        back_s: Longest step back in time from one line to the next, seconds.
        stamps: In which unit the stamps were taken and why, one phrase; empty for seconds.
    """

    lines: int = 0
    not_finite: int = 0
    zero_quaternions: int = 0
    duplicates: int = 0
    out_of_order: int = 0
    renormalised: int = 0
    back_s: float = 0.0
    stamps: str = ""

    def describe(self, *, repeats: bool = False) -> list[str]:
        """One phrase for every count that is not zero, e.g. ``3 of 800 lines skipped: not finite``.

        Args:
            repeats: Whether all lines with the same stamp were taken, not only the last.
        """
        if repeats:
            duplicates = "repeat the next line's stamp, all are taken"
        else:
            duplicates = "replaced by a later line with the same stamp"
        of = f"of {self.lines} lines"
        # a count and its phrase
        phrases = [
            (self.not_finite, f"{self.not_finite} {of} skipped: not finite"),
            (self.zero_quaternions, f"{self.zero_quaternions} {of} skipped: all-zero quaternion"),
            (self.duplicates, f"{self.duplicates} {of} {duplicates}"),
            (self.out_of_order, f"{self.out_of_order} {of} out of order, sorted"),
            (
                self.renormalised,
                f"{self.renormalised} {of} with a quaternion far from unit norm, normalised",
            ),
        ]
        described = [phrase for count, phrase in phrases if count]
        if self.stamps:
            described.append(self.stamps)
        return described


@dataclass(frozen=True, eq=False)
class LoadedTrajectory:
    """A trajectory and the notes on the file it came from, TUM's or KITTI's.

    Attributes:
        trajectory: The last pose of every stamp.
        notes: What was not taken as it stands.
        every_line: All poses, where stamps repeat; None where none does.
    """

    trajectory: Trajectory
    notes: FileNotes
    every_line: RepeatedStamps | None = None

    def poses(self, *, repeats: bool) -> Trajectory:
        """All poses where stamps may repeat, else the last of every stamp."""
        return self.every_line if repeats and self.every_line is not None else self.trajectory


class NoPoseError(TrajectoryError):
    """A file of poses is sound, and no row of it holds a valid pose."""


def read_tum(path: str | Path) -> Trajectory:
    """The trajectory of a TUM file; see `load_tum` for the counts of what was skipped.

    Raises:
        TrajectoryError: The file is missing or damaged, or holds no valid pose, see `load_tum`.
    """
    return load_tum(path).trajectory


def load_tum(path: str | Path) -> LoadedTrajectory:
    """Read a TUM trajectory file together with the counts of skipped, sorted and replaced lines.

    Raises:
        TrajectoryError: The file is missing, is no text, has a malformed line (named by its
            number), stamps of a unit that is not known or that mostly repeat each other, two stamps
            that differ by less than 1 us, or no valid pose.
    """
    # the table, in the order of columns that the heading states
    path = Path(path)
    heading, line_of_heading = _find_heading(path)
    heading = heading or Heading(8, tuple(range(8)), None)
    table = _read_table(
        path, heading.columns, _TUM_COLUMNS, without=line_of_heading, stamp_column=heading.order[0]
    )

    # columns in TUM's order; lines without a pose are left out
    values = table.values[:, list(heading.order)]
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(values).all(axis=1))
    norm = np.linalg.norm(np.where(finite[:, None], values[:, 4:8], 0.0), axis=1)
    valid = finite & (norm >= _ZERO_NORM)
    counted = FileNotes(
        lines=len(values),
        not_finite=int((~finite).sum()),
        zero_quaternions=int((finite & (norm < _ZERO_NORM)).sum()),
        renormalised=int((np.abs(norm[valid] - 1) > _UNIT_TOLERANCE).sum()),
    )
    if not valid.any():
        raise NoPoseError(f"{path} holds no valid pose", "; ".join(counted.describe()))

    # stamps in nanoseconds, exactly as they are written
    kept = values[valid]
    texts = [table.texts[row] for row in np.flatnonzero(valid)]
    moved = (np.diff(kept[:, 1:], axis=0) != 0).any(axis=1)
    ns, unit_note = _stamps_of(texts, kept[:, 0], str(path), stated=heading.unit, moved=moved)
    line_of = dict(zip(ns.tolist(), np.array(table.line_numbers)[valid].tolist(), strict=True))
    refuse_close(np.sort(ns), str(path), TrajectoryError, line_of.get)

    # poses, sorted by their stamps
    poses = se3.from_quaternion(kept[:, 1:4], kept[:, 4:8])
    return ordered_file(ns, poses, replace(counted, stamps=unit_note))


def _stamps_of(
    texts: list[str],
    values: NDArray[np.float64],
    source: str,
    *,
    stated: StampUnit | None = None,
    moved: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.int64], str]:
    """Stamps in nanoseconds ``[N]``, exactly, and a phrase on their unit (see `unit_of`).

    Args:
        texts: The stamps as they are written ``[N]``.
        values: The stamps as numbers ``[N]``.
        source: The file.
        stated: The unit that its heading states; None where it states none.
        moved: Whether the pose of each line but the first differs from the one before ``[N - 1]``;
            None without poses.

    Raises:
        TrajectoryError: Most stamps, or a third of them with other poses, repeat the one before;
            their unit is not known; or one lies beyond the range of 64 bits.
    """
    # stamps that lost their last digits repeat each other
    repeated = np.diff(values) == 0
    repeats = np.flatnonzero(repeated)
    others = 0 if moved is None else int((repeated & moved).sum())
    if 2 * len(repeats) > len(values) or (others and 3 * others >= len(values)):
        raise TrajectoryError(
            f"{len(repeats)} of {len(values)} lines of {source} repeat the stamp of the line before, e.g. "
            f"{texts[repeats[0]][:40]}: digits were lost when they were written",
            "write all digits of the stamps, e.g. with the format %.9f in place of %g, and no 32-bit floats",
        )

    # whole nanoseconds from the text, so that no digit is lost in a float
    unit, note = unit_of(values, source, stated)
    try:
        return np.array([parse_ns(text, unit.digits) for text in texts], dtype=np.int64), note
    except ValueError as error:
        raise TrajectoryError(f"{source}: {error}") from None


def _find_heading(path: Path) -> tuple[Heading | None, int]:
    """The heading above the first row, and the number of its line where it is no comment, else 0.

    A comment counts only if it names as many columns as the first row has values. The last heading
    gives the columns, and the unit of the stamps is what any of them states.

    Raises:
        TrajectoryError: The file cannot be read, or begins with a line that is neither a row nor a
            heading.
    """
    commented: list[Heading] = []
    for number, line in enumerate(read_lines(path, kind=TrajectoryError), start=1):
        # comments that are headings, until the first row
        text = line.strip()
        if text.startswith(("#", "%")):
            heading = parse_heading(text)
            commented += [] if heading is None else [heading]
            continue
        parts = _fields(text)
        if not parts:
            continue
        # the first row, or a heading that is no comment
        if is_number(parts[0]):
            return _joined([heading for heading in commented if heading.columns == len(parts)]), 0
        heading = parse_heading(text)
        if heading is None:
            hint = (
                "a heading names the stamp, x y z of the position and x y z w of the quaternion, "
                f"e.g. '{_TUM_COLUMNS}'"
            )
            if ";" in text:
                hint = "separate the values by white space or commas, not by semicolons"
            raise TrajectoryError(
                f"{path} line {number} is neither a pose nor a known heading: '{text[:100]}'", hint
            )
        return _joined([*commented, heading]), number
    return None, 0


def _joined(headings: list[Heading]) -> Heading | None:
    """The last of several headings, with the unit that any of them states; None for none."""
    if not headings:
        return None
    units = [heading.unit for heading in headings if heading.unit is not None]
    return replace(headings[-1], unit=units[-1] if units else None)


def ordered_file(
    ns: NDArray[np.int64], T_world_cam: NDArray[np.float64], notes: FileNotes
) -> LoadedTrajectory:
    """Poses in the order of their stamps, with the counts of sorted and replaced lines.

    Args:
        ns: Stamps in nanoseconds ``[N]``, as the file's lines have them.
        T_world_cam: Camera-to-world poses ``[N, 4, 4]``.
        notes: The counts of skipped lines.
    """
    # in order of time; of equal stamps the last line counts
    order = np.argsort(ns, kind="stable")
    exact = ns[order]
    last_of_stamp = np.append(np.diff(exact) > 0, True)
    notes = replace(
        notes,
        duplicates=int((~last_of_stamp).sum()),
        out_of_order=int((np.diff(ns) < 0).sum()),
        back_s=float(-np.diff(ns).min(initial=0)) / 1e9,
    )
    every_line = RepeatedStamps(to_seconds(exact), T_world_cam[order], exact)
    trajectory = Trajectory(
        every_line.timestamps[last_of_stamp],
        every_line.T_world_cam[last_of_stamp],
        exact[last_of_stamp],
    )
    return LoadedTrajectory(trajectory, notes, every_line if notes.duplicates else None)


def write_tum(path: str | Path, trajectory: Trajectory, *, comment: str = "") -> None:
    """Write a trajectory with stamps to the nanosecond; the file appears whole or not at all.

    Args:
        path: Target file.
        trajectory: Camera-to-world poses; may be empty.
        comment: Written behind ``#`` above the header, line by line.

    Raises:
        DynslamError: The file cannot be written.
    """
    write_atomic(Path(path), format_tum(trajectory, comment=comment))


def format_tum(trajectory: Trajectory, *, comment: str = "") -> str:
    """The text of a TUM trajectory file: nine decimals for stamps (seconds) and all other numbers.

    The heading states the unit of the stamps where their steps do not tell it.
    """
    # position and quaternion of each pose
    stamps = [format_ns(ns) for ns in trajectory.timestamps_ns.tolist()]
    position, quaternion = se3.to_quaternion(trajectory.T_world_cam)
    rows = np.concatenate([position, quaternion], axis=1).tolist()

    # the heading, with the unit where steps as long as these leave it open
    is_sparse = (median_step(trajectory.timestamps) or 0.0) > SLOWEST_S
    columns = _TUM_COLUMNS
    if is_sparse:
        columns = columns.replace("timestamp", f"timestamp [{SECONDS.symbol}]")
    heading = [f"# {line}" for line in (*comment.splitlines(), columns)]

    # one pose a line
    lines = [
        " ".join([stamp, *map("{:.9f}".format, row)])
        for stamp, row in zip(stamps, rows, strict=True)
    ]
    return "\n".join([*heading, *lines]) + "\n"


def read_table(path: Path, columns: int, meaning: str) -> NDArray[np.float64]:
    """Numbers ``[N, columns]`` of a text file; comments and blank lines are left out.

    Raises:
        TrajectoryError: The file cannot be read, is no text, or a line does not hold `columns`
            numbers.
    """
    return _read_table(path, columns, meaning).values


def read_stamps(path: Path) -> NDArray[np.int64]:
    """The first numbers of all lines, in nanoseconds ``[N]``; comments and blank lines are left out.

    Raises:
        TrajectoryError: The file cannot be read, a line does not begin with a stamp, or the unit of
            the stamps is not known.
    """
    return _load_stamps(path)[0]


def _load_stamps(path: Path) -> tuple[NDArray[np.int64], str]:
    """The stamps of `read_stamps`, and a phrase on their unit (see `unit_of`)."""
    texts: list[str] = []
    for number, parts in _lines(path):
        if not is_number(parts[0]) or not np.isfinite(float(parts[0])):
            raise TrajectoryError(
                f"{path} line {number}: '{parts[0][:40]}' is not a stamp in seconds"
            )
        texts.append(parts[0])
    if not texts:
        return np.zeros(0, dtype=np.int64), ""
    return _stamps_of(texts, np.array([float(text) for text in texts]), str(path))


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Number and parts of all lines that hold anything.

    Raises:
        TrajectoryError: The file cannot be read or is too long.
    """
    for number, line in enumerate(read_lines(path, kind=TrajectoryError), start=1):
        if number > MOST_LINES:
            raise TrajectoryError(
                f"{path} has more than {MOST_LINES} lines, too many for a trajectory"
            )
        parts = _fields(line)
        if parts:
            yield number, parts


def _fields(line: str) -> list[str]:
    """The fields of a line, split at commas and spaces; a comment is left out."""
    return line.partition("#")[0].replace(",", " ").split()


@dataclass(frozen=True, eq=False)
class _Table:
    """A table of numbers as a file has it.

    Attributes:
        values: ``[N, K]``.
        line_numbers: Number of each row's line in the file ``[N]``, from 1.
        texts: Its stamps as they are written ``[N]``.
    """

    values: NDArray[np.float64]
    line_numbers: list[int]
    texts: list[str]


def _read_table(
    path: Path, columns: int, meaning: str, *, without: int = 0, stamp_column: int = 0
) -> _Table:
    """The rows of a table; `without` is the number of a line that is none of them.

    Raises:
        TrajectoryError: The file cannot be read, is no text, or a line does not hold `columns`
            numbers.
    """
    values = array("d")
    line_numbers = list[int]()
    texts = list[str]()
    for number, parts in _lines(path):
        if number == without:
            continue
        line_numbers.append(number)
        if len(parts) != columns:
            raise TrajectoryError(
                f"{path} line {number} has {len(parts)} values, not the {columns} of '{meaning}'",
                _hint(parts),
            )
        # the stamp's text is kept, as a float may not hold all of its digits
        texts.append(parts[stamp_column])
        try:
            values.extend(map(float, parts))
        except ValueError:
            bad = next(part for part in parts if not is_number(part))
            raise TrajectoryError(
                f"{path} line {number}: {bad[:40]!r} is not a number", meaning
            ) from None
    if not values:
        raise TrajectoryError(f"{path} holds no poses", f"expected lines of '{meaning}'")
    table = np.frombuffer(values, dtype=np.float64).reshape(-1, columns)
    return _Table(table, line_numbers, texts)


def is_number(text: str) -> bool:
    """Whether a text is a number, as tables of numbers are read."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _hint(parts: list[str]) -> str:
    """Name the format that a line of another length is of; empty where that is not known."""
    if len(parts) == 12:
        return "12 values a line are KITTI's format: `eval` and `import` take its stamps with --timestamps FILE"
    if len(parts) in (15, 16):  # the stamp may be a whole number
        return "a comma separates values: write decimal points, 1.25 and not 1,25"
    if len(parts) == 17:
        return "17 values a line are EuRoC's ground truth: leave its heading in, which says that qw comes first"
    if len(parts) == 2 and is_number(parts[0]) and not is_number(parts[1]):
        return "this looks like a list of images"
    return ""


# Trajectory files of the KITTI odometry benchmark: the 3x4 matrix ``[R|t]`` in row order, twelve
# numbers a line.

_KITTI_COLUMNS = "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"
"""Columns of a line in KITTI's format: a 3x4 matrix row by row."""


def read_kitti(path: str | Path, times: str | Path) -> Trajectory:
    """Read a KITTI pose file.

    Args:
        path: The poses.
        times: A file whose lines begin with the stamps in seconds, one a pose.

    Returns:
        Camera-to-world poses; rotations are made orthonormal exactly (files hold about seven
        digits).

    Raises:
        TrajectoryError: A file cannot be read, a line is malformed or no rigid pose, or the stamps
            do not fit.
    """
    return _load_kitti(Path(path), Path(times)).trajectory


def _load_kitti(path: Path, times: Path) -> LoadedTrajectory:
    """The camera-to-world trajectory of a KITTI pose file and its stamps, with notes on both."""
    # rigid poses, whose rotations are made orthonormal
    rows = read_table(path, 12, _KITTI_COLUMNS)
    matrices = rows.reshape(-1, 3, 4)
    poses = se3.from_matrix(matrices[:, :, 3], matrices[:, :, :3])
    for index, pose in enumerate(poses):
        if not se3.is_pose(pose, tolerance=1e-3):
            raise TrajectoryError(
                f"{path}: pose {index} of {len(poses)} is no rigid transformation", _KITTI_COLUMNS
            )
    poses = se3.with_rotation(poses, nearest_rotation(poses[:, :3, :3]))

    # a stamp for each, from the other file
    ns, unit_note = _load_stamps(times)
    if len(ns) != len(poses):
        raise TrajectoryError(f"{path} has {len(poses)} poses but {times} has {len(ns)} stamps")
    return LoadedTrajectory(
        Trajectory(to_seconds(ns), poses, ns), FileNotes(lines=len(poses), stamps=unit_note)
    )


def write_kitti(path: str | Path, trajectory: Trajectory, times: str | Path | None = None) -> None:
    """Write poses in KITTI's format and, if `times` is given, their stamps beside them (nine decimals).

    Raises:
        DynslamError: A file cannot be written.
    """
    rows = trajectory.T_world_cam[:, :3].reshape(-1, 12).tolist()
    lines = [" ".join(f"{value:.9e}" for value in row) + "\n" for row in rows]
    write_atomic(Path(path), "".join(lines))
    if times is not None:
        stamps = [f"{format_ns(ns)}\n" for ns in trajectory.timestamps_ns.tolist()]
        write_atomic(Path(times), "".join(stamps))


# Trajectory files of either format: TUM's, which carry their stamps, and KITTI's, whose stamps lie
# in another file.


def load_trajectory(path: str | Path, timestamps: str | Path | None = None) -> LoadedTrajectory:
    """Read a trajectory with the counts of what was not taken as it stands.

    Args:
        path: Lines of 8 values (TUM), a table with a heading (EuRoC, VSLAM-LAB) or, where
            `timestamps` is given, lines of 12 values (KITTI).
        timestamps: A file whose lines begin with a stamp each: a ``times.txt``, or a list such as
            ``rgb.txt``; used for lines of 12 values only.

    Raises:
        TrajectoryError: A file cannot be read, is malformed, or the stamps do not fit the poses.
    """
    path = Path(path)
    if timestamps is None or len(next(_lines(path), (0, []))[1]) != 12:
        return load_tum(path)
    return _load_kitti(path, Path(timestamps))
