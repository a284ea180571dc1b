"""Tables and calibration files of data sets: YAML with OpenCV's matrices, CSV with nanoseconds, poses of a body."""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.reading import read_lines, read_text
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.stamps import parse_ns, refuse_close, to_seconds
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import is_number
from dynslam_bench.sequences.readers.lists import MOST_LINES

MOST_BYTES = 1 << 16
"""A calibration has a few kilobytes."""
MOST_BRACKETS = 1000
"""What opens more takes yaml's parser minutes."""


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # yaml has no annotations
    """Plain values only; OpenCV's matrices are mappings with their numbers under ``data``."""


_Loader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: yaml.SafeLoader.construct_mapping(loader, node, deep=True)
)


def read_yaml(path: Path) -> Mapping[str, Any]:
    """The mapping that a YAML file holds.

    Raises:
        SequenceError: It cannot be read, or holds no mapping.
    """
    text = read_text(path, limit=MOST_BYTES, kind=SequenceError)
    opened = text.count("[") + text.count("{")
    if opened > MOST_BRACKETS:
        raise SequenceError(f"{path} opens {opened} lists and mappings, more than a calibration's {MOST_BRACKETS}")
    lines = ["" if line.startswith("%YAML") else line for line in text.split("\n")]
    try:
        document = yaml.load("\n".join(lines), _Loader)
    except Exception as error:  # values such as dates make yaml's constructors raise whatever they like
        reason = " ".join(str(error).split())[:200]
        raise SequenceError(f"{path} is no valid YAML: {reason or type(error).__name__}") from error
    if not isinstance(document, Mapping):
        raise SequenceError(f"{path} holds no YAML mapping")
    return document


def numbers(value: object, count: int, where: str) -> list[float]:
    """The numbers of a list, or of a matrix' ``data``.

    Args:
        value: What the file holds there.
        count: How many there have to be.
        where: What it is, for the message.

    Raises:
        SequenceError: It is no list of so many finite numbers.
    """
    data = value.get("data") if isinstance(value, Mapping) else value
    listed: list[object] = data if isinstance(data, list) else [data]
    values = [float(x) for x in listed if isinstance(x, (int, float)) and _finite(x)]
    if not len(values) == len(listed) == count:
        raise SequenceError(f"{where} holds no {count} numbers")
    return values


def frame_rate(value: object) -> float | None:
    """A frame rate in Hz that a file states; None where the value is none."""
    return float(value) if isinstance(value, (int, float)) and 0 < value < 1e6 else None


def section(value: object, key: str, where: str) -> Any:
    """A mapping's value.

    Raises:
        SequenceError: There is none of that name.
    """
    if not isinstance(value, Mapping) or key not in value:
        raise SequenceError(f"{where} lacks '{key}'")
    return value[key]


def _finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer of hundreds of digits
        return False


# Ground truth of a body that carries the camera, turned into the camera's.

Array = NDArray[np.float64]


def camera_on_body(value: object, where: str) -> Array:
    """The camera's pose on the body, ``T_BS`` of EuRoC's files, ``[4, 4]``; the identity where it is not stated.

    Raises:
        SequenceError: It is no rigid transformation.
    """
    if value is None:
        return np.eye(4)
    pose = np.array(numbers(value, 16, f"{where}: T_BS")).reshape(4, 4)
    if not se3.is_pose(pose, tolerance=1e-3):
        raise SequenceError(f"{where}: T_BS is no rigid transformation")
    return pose


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


def read_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    """The heading (without ``#``) and the rows of a table, split at commas; every row as long as the heading.

    Raises:
        SequenceError: The file cannot be read, has no row, or rows of other lengths.
    """
    heading: list[str] = []
    rows: list[list[str]] = []
    for number, line in enumerate(read_lines(path, kind=SequenceError), start=1):
        parts = [part.strip() for part in line.strip().lstrip("#").split(",")]
        if not any(parts):
            continue
        if not heading:
            heading = parts
        elif len(parts) != len(heading):
            raise SequenceError(f"{path} line {number} has {len(parts)} columns, the heading {len(heading)}")
        elif len(rows) == MOST_LINES:
            raise SequenceError(f"{path} has more than {MOST_LINES} rows")
        else:
            rows.append(parts)
    if not rows:
        raise SequenceError(f"{path} holds no rows")
    return heading, rows


def column(heading: list[str], name: str, path: Path) -> int:
    """Index of a column.

    Raises:
        SequenceError: There is none.
    """
    if name not in heading:
        raise SequenceError(f"{path} has no column '{name}' (it has: {', '.join(heading)[:200]})")
    return heading.index(name)


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


def floats(rows: list[list[str]], path: Path) -> NDArray[np.float64]:
    """Numbers ``[N, K]`` of a table.

    Raises:
        SequenceError: One is no finite number.
    """
    texts = [text for row in rows for text in row]
    try:
        values = np.array([float(text) for text in texts])
    except ValueError:
        bad = next(text for text in texts if not is_number(text))
        raise SequenceError(f"{path}: '{bad[:40]}' is not a number") from None
    if not np.isfinite(values).all():
        raise SequenceError(f"{path} holds values that are not finite")
    return values.reshape(len(rows), -1)
