"""Tables and calibration files of data sets: YAML with OpenCV's matrices, CSV with nanoseconds, poses of a body."""

import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from dynslam_bench.core import SequenceError, TrajectoryError, raising, read_lines, read_text
from dynslam_bench.geometry import Array, Trajectory, is_number, parse_ns, refuse_close, se3, to_seconds
from dynslam_bench.sequences.readers.lists import MOST_LINES

MOST_BYTES = 1 << 16
"""A calibration has a few kilobytes."""
MOST_BRACKETS = 1000
"""What opens more takes yaml's parser minutes."""


def read_yaml(path: Path) -> Mapping[str, Any]:
    """The mapping that a YAML file holds; OpenCV's matrices are mappings with their numbers under ``data``.

    Raises:
        SequenceError: It cannot be read, or holds no mapping.
    """
    text = read_text(path, limit=MOST_BYTES, kind=SequenceError)
    opened = text.count("[") + text.count("{")
    if opened > MOST_BRACKETS:
        raise SequenceError(f"{path} opens {opened} lists and mappings, more than a calibration's {MOST_BRACKETS}")
    with raising(
        SequenceError, f"{path} is no valid YAML", of=Exception
    ):  # values such as dates make yaml's constructors raise whatever they like
        document = yaml.safe_load(re.sub(r"^%YAML.*|!!opencv-matrix", "", text, flags=re.MULTILINE))
    if not isinstance(document, Mapping):
        raise SequenceError(f"{path} holds no YAML mapping")
    return document


def section(value: object, key: str, where: str) -> Any:
    """A mapping's value.

    Raises:
        SequenceError: There is none of that name.
    """
    if not isinstance(value, Mapping) or key not in value:
        raise SequenceError(f"{where} lacks '{key}'")
    return value[key]


def numbers(mapping: object, key: str, count: int, where: str) -> list[float]:
    """The numbers of a list in a mapping, or of a matrix' ``data``.

    Args:
        mapping: What the file holds.
        key: Which of its values.
        count: How many numbers there have to be.
        where: The file, for the message.

    Raises:
        SequenceError: There is no such value, or it is no list of so many finite numbers.
    """
    value = section(mapping, key, where)
    data = value.get("data") if isinstance(value, Mapping) else value
    listed: list[object] = data if isinstance(data, list) else [data]
    values = [float(x) for x in listed if isinstance(x, (int, float)) and abs(x) < 1e300]
    if not len(values) == len(listed) == count:
        raise SequenceError(f"{where}: {key} holds no {count} numbers")
    return values


# Ground truth of a body that carries the camera, turned into the camera's.


def rigid(values: Sequence[float], where: str) -> Array:
    """The pose ``[4, 4]`` of 16 numbers, unchanged.

    Raises:
        SequenceError: It is no rigid transformation.
        ValueError: There are not 16.
    """
    pose = np.array(values).reshape(4, 4)
    if not se3.is_pose(pose, tolerance=1e-3):
        raise SequenceError(f"{where} holds no rigid transformation")
    return pose


def camera_on_body(sensor: Mapping[str, Any], where: str) -> Array:
    """The camera's pose on the body, ``T_BS`` of EuRoC's files, ``[4, 4]``; the identity where it is not stated.

    Raises:
        SequenceError: It is no rigid transformation.
    """
    return np.eye(4) if sensor.get("T_BS") is None else rigid(numbers(sensor, "T_BS", 16, where), f"{where}: T_BS")


def camera_truth(stamps: NDArray[np.int64], rows: Array, T_body_cam: Array, where: str) -> Trajectory | None:
    """Camera-to-world poses of the body's, rows ``tx ty tz qx qy qz qw`` ``[N, 7]`` at stamps in nanoseconds ``[N]``.

    Rows without a rotation are left out, of several with one stamp the last holds; None where nothing is left.

    Raises:
        SequenceError: Two stamps of `where` differ by less than 1 us.
    """
    order = np.argsort(stamps, kind="stable")
    stamps, rows = stamps[order], rows[order]
    refuse_close(stamps, where, SequenceError)
    keep = np.append(np.diff(stamps) > 0, True) & (np.linalg.norm(rows[:, 3:], axis=1) > 1e-8)
    if not keep.any():
        return None
    poses = se3.from_quaternion(rows[keep, :3], rows[keep, 3:]) @ T_body_cam
    return Trajectory(to_seconds(stamps[keep]), poses, stamps[keep])


# Tables in CSV whose stamps are nanoseconds, as EuRoC and VSLAM-LAB write them.

POSE = ("ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw")
"""Heading of VSLAM-LAB's tables of poses."""


def read_pose_table(path: Path, T_body_cam: Array) -> Trajectory | None:
    """The camera's poses of a table of EuRoC or VSLAM-LAB; None where no row holds a rotation.

    Args:
        path: The table.
        T_body_cam: The camera's pose on the body whose poses the table holds, ``[4, 4]``.

    Raises:
        DynslamError: A row is malformed, or the heading is of neither kind.
    """
    heading, rows = read_rows(path)
    if POSE[0] in heading:
        columns = pick(heading, rows, POSE, path)
    elif len(heading) >= 8 and "w" in heading[4].lower():
        columns = [[row[at] for row in rows] for at in (0, 1, 2, 3, 5, 6, 7, 4)]
    else:
        raise TrajectoryError(
            f"{path} has the columns {', '.join(heading)[:200]}: neither EuRoC's nor VSLAM-LAB's",
            "EuRoC's fifth is the quaternion's w; VSLAM-LAB's are " + ", ".join(POSE),
        )
    texts = [text for column in columns[1:] for text in column]
    bad = next((text for text in texts if not is_number(text)), None)
    if bad is not None:
        raise SequenceError(f"{path}: '{bad[:40]}' is not a number")
    values = np.array([float(text) for text in texts]).reshape(7, -1).T
    if not np.isfinite(values).all():
        raise SequenceError(f"{path} holds values that are not finite")
    return camera_truth(nanoseconds(columns[0], path), values, T_body_cam, str(path))


def read_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    """The heading (without ``#``) and the rows of a table, split at commas; every row as long as the heading.

    Raises:
        SequenceError: The file cannot be read, has no row, or rows of other lengths.
    """
    table: list[list[str]] = []
    for number, line in enumerate(read_lines(path, kind=SequenceError), start=1):
        parts = [part.strip() for part in line.strip().lstrip("#").split(",")]
        if not any(parts):
            continue
        table.append(parts)
        if len(parts) != len(table[0]):
            raise SequenceError(f"{path} line {number} has {len(parts)} columns, the heading {len(table[0])}")
        if len(table) > MOST_LINES:
            raise SequenceError(f"{path} has more than {MOST_LINES} rows")
    if len(table) < 2:
        raise SequenceError(f"{path} holds no rows")
    return table[0], table[1:]


def pick(heading: list[str], rows: list[list[str]], names: Sequence[str], path: Path) -> list[list[str]]:
    """The columns of these names.

    Raises:
        SequenceError: One is missing.
    """
    missing = [name for name in names if name not in heading]
    if missing:
        raise SequenceError(f"{path} has no column '{missing[0]}' (it has: {', '.join(heading)[:200]})")
    return [[row[heading.index(name)] for row in rows] for name in names]


def nanoseconds(texts: list[str], path: Path) -> NDArray[np.int64]:
    """Stamps of nanoseconds, written as whole numbers or with a point, int64 ``[N]``.

    Raises:
        SequenceError: One is no number, or beyond the range of 64 bits.
    """
    stamps = []
    for text in texts:
        try:
            stamps.append(int(text) if text.isdigit() and len(text) < 19 else parse_ns(f"{Decimal(text)}e-9"))
        except (ValueError, ArithmeticError):
            raise SequenceError(f"{path}: '{text[:40]}' is not a stamp in nanoseconds") from None
    return np.array(stamps, dtype=np.int64)
