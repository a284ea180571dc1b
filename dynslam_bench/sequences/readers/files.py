"""Parts of readers: lists of images and counts of what was not used, YAML, CSV, poses of a body."""

import math
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from dynslam_bench.core import (
    MEGABYTE,
    SequenceError,
    read_bytes,
    read_lines,
    read_text,
    translate_errors,
)
from dynslam_bench.core.images import image_size
from dynslam_bench.geometry import (
    Array,
    Camera,
    FileNotes,
    LoadedTrajectory,
    Trajectory,
    format_ns,
    load_tum,
    ns_of,
    ordered_file,
    parse_ns,
    refuse_close,
    se3,
    to_seconds,
)

MOST_LINES = 1_000_000
"""Nine hours at 30 frames a second; a longer list is refused before it fills the memory."""
MILLIMETRES = 1000.0
"""Units a metre."""


class NoRateError(SequenceError):
    """Images are named by frame numbers, and nothing says how many there are a second."""


def stated_file(folder: Path, *names: str) -> Path | None:
    """The first of these files that a folder has; None where it has none.

    Raises:
        SequenceError: The name is there but is no file, e.g. a link to a file that is gone.
    """
    path = next((folder / name for name in names if os.path.lexists(folder / name)), None)
    if path is None or path.is_file():
        return path
    if path.is_symlink() and not path.exists():
        what = f"is a link to {path.readlink()}, which is not there"
    else:
        what = "is no file" if not path.is_dir() else "is a folder, not a file"
    raise SequenceError(f"{path} {what}", "put the file there, or remove the name")


@dataclass(frozen=True, eq=False)
class ImageList:
    """Stamped image files in order of time.

    Attributes:
        stamps_ns: Nanoseconds, int64 ``[N]``, strictly increasing.
        files: Paths relative to the sequence's folder.
        irregular: How many lines of the list were dropped or moved, by the reason.
    """

    stamps_ns: NDArray[np.int64]
    files: tuple[str, ...]
    irregular: Counter[str] = field(default_factory=Counter)

    @cached_property
    def stamps(self) -> NDArray[np.float64]:
        """Seconds, float64 ``[N]``."""
        return to_seconds(self.stamps_ns)

    def __len__(self) -> int:
        return len(self.files)


def read_image_list(path: Path) -> ImageList:
    """Read lines ``timestamp filename``; ``#`` starts a comment, commas and tabs separate as well.

    Raises:
        SequenceError: The file is missing or no text, a stamp is not a number, or two differ by
            less than 1 us.
    """
    return make_image_list(
        [(stamp, " ".join(rest)) for stamp, rest in read_stamped_lines(path)], described=str(path)
    )


def read_associations(path: Path) -> tuple[ImageList, ImageList]:
    """Read lines ``timestamp colour timestamp depth``, images that are paired already.

    Raises:
        SequenceError: The file is missing or no text, a line does not have these four parts, or two
            stamps differ by less than 1 us.
    """
    # the colour images as a list of their own, and the depth image of each stamp of theirs
    rows: list[tuple[int | None, str]] = []
    pairs: dict[int | None, tuple[int, str]] = {}
    for number, (stamp, rest) in enumerate(read_stamped_lines(path), start=1):
        if len(rest) != 3:
            raise SequenceError(
                f"entry {number} of {path} has {len(rest) + 1} parts, expected 4: timestamp colour timestamp depth"
            )
        # a pair without a usable depth stamp counts as one without a stamp
        depth_stamp = _number(rest[1], path)
        rows.append((None if depth_stamp is None else stamp, rest[0]))
        if depth_stamp is not None:
            pairs[stamp] = depth_stamp, rest[2]

    # sort and clean the colour images, then take the depth images in their order
    colour = make_image_list(rows, described=str(path))
    depth = [pairs[stamp] for stamp in colour.stamps_ns.tolist()]
    return colour, ImageList(
        np.array([stamp for stamp, _ in depth], np.int64), tuple(file for _, file in depth)
    )


LEFT_OUT = "frame numbers without an image"
"""Key of `ImageList.irregular` for gaps in the frame numbers."""
_IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Suffixes of images, in small letters."""


FOLDERS = {"rgb": ("rgb", "color", "colour", "image", "images"), "depth": ("depth",)}
"""Names of the folders of colour and of depth images, TUM's first."""
_NUMBERED = re.compile(r"(?P<before>[^0-9]*)(?P<number>[0-9]+)(?P<behind>[^0-9]*)", re.ASCII)
"""A name with one whole number, such as ``frame_0001`` or ``0001.color``."""


def image_folders(folder: Path, kind: str) -> list[str]:
    """Names of the folders that may hold a sequence's images, the one to take first.

    Args:
        folder: The sequence's folder.
        kind: ``rgb`` or ``depth``.
    """
    return [name for name in FOLDERS[kind] if (folder / name).is_dir()]


def list_folder(folder: Path, kind: str, fps: float | None) -> ImageList:
    """The images of a folder without a list file, stamped by their names.

    A name with a decimal point is a stamp in seconds. Of whole numbers, those of the size of Unix
    time are stamps in seconds, milliseconds, microseconds or nanoseconds; others are frame numbers,
    which `fps` turns into seconds. Text around the numbers that is the same in all names counts
    for nothing.

    Args:
        folder: The sequence's folder.
        kind: ``rgb`` or ``depth``, see `image_folders`.
        fps: Frame rate in Hz, where it is stated.

    Raises:
        SequenceError: The folder does not exist, or the names give no stamps.
    """
    present = image_folders(folder, kind)
    if not present:
        raise SequenceError(
            f"{folder} has neither {kind}.txt nor a folder {' or '.join(FOLDERS[kind])}",
            "a sequence in TUM layout holds rgb.txt, depth.txt, the images, and groundtruth.txt where there is one",
        )

    # the images of the folder
    name = present[0]
    images = folder / name
    shown = sorted(path for path in images.iterdir() if not path.name.startswith("."))
    paths = [path for path in shown if path.suffix.lower() in _IMAGES]
    files = [f"{name}/{path.name}" for path in paths]

    # stamps by whole numbers, or each by its own name
    stamps: Sequence[int | None]
    missing = 0
    numbered = _numbers_in([path.stem for path in paths])
    if numbered:
        stamps, missing = stamps_of_numbers(numbered, fps, files, folder)
    else:
        hint = f"write {kind}.txt with lines 'timestamp {name}/FILE'"
        stamps = [_number(path.stem, images, hint) for path in paths]

    # in order of time; other files and gaps are counted
    rows = sorted(zip(stamps, files, strict=True), key=lambda row: (row[0] or 0, row[1]))
    listed = make_image_list(rows, described=str(images))
    more = Counter({"files that are no images": len(shown) - len(paths), LEFT_OUT: missing})
    return ImageList(listed.stamps_ns, listed.files, listed.irregular + more)


def _numbers_in(stems: list[str]) -> list[int]:
    """The whole numbers in names that differ in nothing else; empty where there are other names."""
    numbered = [_NUMBERED.fullmatch(stem) for stem in stems]
    matches = [match for match in numbered if match is not None]
    around = {(match["before"], match["behind"]) for match in matches}
    if len(matches) < len(stems) or len(around) != 1:
        return []
    return [int(match["number"]) for match in matches]


def rate_of(images: ImageList) -> float | None:
    """Frames a second by the median of the stamps, to 6 decimals; None for one image."""
    if len(images) < 2:
        return None
    return round(float(1 / np.median(np.diff(images.stamps))), 6)


# Images that are named by whole numbers: stamps, or frame numbers.

_UNITS = {"seconds": 1, "milliseconds": 10**3, "microseconds": 10**6, "nanoseconds": 10**9}
"""Units a second."""
_UNIX_S = (900_000_000, 4_200_000_000)
"""1998 and 2103: no clock of a recording shows other Unix time."""
_CAMERA_HZ = (0.5, 250.0)
"""Frame rates of cameras: a unit in which the steps of the names are another rate is not theirs."""
_SLOWEST_BY_NUMBER_S = 0.5
"""Frame numbers further apart than this, by the median, are more likely stamps in another unit."""
_NO_VIDEO_S = 5.0
"""Frame numbers further apart than this are none."""


def unix_unit(number: int) -> str | None:
    """The unit in which a whole number is Unix time of our days; None if it is in none."""
    low, high = _UNIX_S
    return next(
        (unit for unit, per_s in _UNITS.items() if low * per_s <= number < high * per_s), None
    )


def stamps_of_numbers(
    numbers: list[int], fps: float | None, files: list[str], folder: Path
) -> tuple[list[int], int]:
    """Stamps in nanoseconds of images that are named by whole numbers.

    Args:
        numbers: The names as numbers, in the order of `files`.
        fps: Frame rate that turns frame numbers into seconds.
        files: The images, relative to the folder.
        folder: The sequence's folder.

    Returns:
        The stamps, and how many frame numbers are left out between the first and the last.

    Raises:
        SequenceError: The numbers are frame numbers and there is no `fps`; or they may be frame
            numbers or stamps.
    """
    # Unix time has a size of its own
    units = {unix_unit(number) for number in numbers}
    unit = units.pop() if len(units) == 1 else None
    if unit is not None:
        return [number * (10**9 // _UNITS[unit]) for number in numbers], 0

    # frame numbers go up by one, or by a few; larger steps may be time
    ordered = sorted(set(numbers))
    steps = [later - earlier for earlier, later in pairwise(ordered)]
    step = float(np.median(steps)) if steps else 1.0
    likely = _unit_of_steps(step, fps)
    if likely is not None:
        raise _ambiguous_numbers_error(step, fps, likely, files, numbers, folder)

    # frame numbers: a rate turns them into time
    if fps is None:
        folder_name = files[0].partition("/")[0]
        kind = next((kind for kind, names in FOLDERS.items() if folder_name in names), folder_name)
        raise NoRateError(
            f"{files[0]} of {folder} is named by a frame number, which has no time",
            f"write {kind}.txt with lines 'timestamp {files[0]}', or 'fps = 30' into the camera.toml that is used (the "
            "folder's, or the one that --camera names)",
        )
    fault = f"{files[0]} of {folder} is no frame number at {fps:g} Hz"
    with translate_errors(SequenceError, fault, of=(ValueError, OverflowError)):
        stamps = [ns_of(number / fps) for number in numbers]
    return stamps, ordered[-1] - ordered[0] + 1 - len(ordered)


def _unit_of_steps(step: float, fps: float | None) -> str | None:
    """The unit of time in which names that go up by `step` are a camera's, where they are hardly frame numbers."""
    # the rate of the images in each unit: a camera's in at most one of them
    low, high = _CAMERA_HZ
    rates = {unit: _UNITS[unit] / step for unit in ("milliseconds", "microseconds", "nanoseconds")}
    likely = next((unit for unit, rate in rates.items() if low <= rate <= high), None)
    if likely is None or fps is None:
        return likely

    # with a stated rate: the names are time if they agree with it, or frame numbers are too far apart
    agrees_with_fps = 0.8 < rates[likely] / fps < 1.25
    return likely if agrees_with_fps or step / fps > _SLOWEST_BY_NUMBER_S else None


def _ambiguous_numbers_error(
    step: float, fps: float | None, unit: str, files: list[str], numbers: list[int], folder: Path
) -> SequenceError:
    """Names that are frame numbers or stamps: both readings, and the list that decides."""
    per_s = _UNITS[unit]
    readings = [f"{unit} would be {per_s / step:.3g} Hz"]
    lines = [f"'{format_ns(numbers[0] * (10**9 // per_s))} {files[0]}' if the names are {unit}"]
    if fps is None:
        lines.append(f"'timestamp {files[0]}' if they are frame numbers")
    else:
        readings.append(f"frame numbers at fps = {fps:g} would be {step / fps:.3g} s apart")
        if step / fps < _NO_VIDEO_S:
            lines.append(f"'{numbers[0] / fps:.9f} {files[0]}' if they are frame numbers")
    kind = files[0].partition("/")[0]
    return SequenceError(
        f"the names of the images {files[0]}, ... of {folder} go up by {step:.12g}: {', '.join(readings)}",
        f"write {kind}.txt with a line an image, in seconds: {', '.join(lines)}",
    )


def make_image_list(rows: list[tuple[int | None, str]], *, described: str) -> ImageList:
    """Sort, drop what has no usable stamp or name, and count it.

    Raises:
        SequenceError: Nothing is left, or two stamps differ by less than 1 us.
    """
    # lines with a file name, of these the ones with a stamp
    named = [(stamp, name) for stamp, name in rows if name]
    finite = [(stamp, name) for stamp, name in named if stamp is not None]
    # the last of several equal stamps wins, as in TUM's associate.py
    unique = dict(finite)
    if not unique:
        raise SequenceError(
            f"{described} lists no image ({len(rows)} lines, {len(named) - len(finite)} without a stamp)"
        )
    stamps_ns = np.array(sorted(unique), dtype=np.int64)
    refuse_close(stamps_ns, described, SequenceError)

    # counts of what was dropped or moved
    irregular = {
        "stamps not finite": len(named) - len(finite),
        "duplicate stamps": len(finite) - len(unique),
        "stamps out of order": sum(
            later < earlier for earlier, later in pairwise(stamp for stamp, _ in finite)
        ),
        "lines without a file name": len(rows) - len(named),
    }
    files = tuple(unique[stamp] for stamp in stamps_ns.tolist())
    return ImageList(stamps_ns, files, Counter(irregular))


def read_stamped_lines(path: Path) -> list[tuple[int | None, list[str]]]:
    """Lines of a TUM list file, split at white space and commas, the first part in nanoseconds; None if not finite.

    Raises:
        SequenceError: The file cannot be read, a first part is not a number (names the line), or
            there are too many.
    """
    rows: list[tuple[int | None, list[str]]] = []
    for number, line in enumerate(read_lines(path, kind=SequenceError), start=1):
        if number > MOST_LINES:
            raise SequenceError(
                f"{path} has more than {MOST_LINES} lines, too many for a list of images"
            )
        parts = line.replace(",", " ").split()
        if parts and not parts[0].startswith("#"):
            rows.append((_number(parts[0], f"{path} line {number}"), parts[1:]))
    return rows


def _number(text: str, where: object, hint: str = "") -> int | None:
    """Nanoseconds of a stamp in seconds, None where it is not finite; says where it looks like another unit."""
    try:
        return parse_ns(text) if math.isfinite(float(text)) else None
    except ValueError:
        # a whole number may be Unix time in a smaller unit
        whole = re.fullmatch(r"([0-9]{1,24})(\.[0-9]*)?", text, re.ASCII)
        unit = None if whole is None else unix_unit(int(whole[1]))
        hint = (
            hint if unit is None else f"it looks like {unit} of Unix time: divide by {_UNITS[unit]}"
        )
        raise SequenceError(f"{where}: '{text[:40]}' is not a timestamp in seconds", hint) from None


# The result of every reader, from which `RecordedSequence` is made.


@dataclass(frozen=True, eq=False)
class Contents:
    """Images and poses of a folder, whatever its layout.

    Attributes:
        colour: Colour images and their stamps in seconds.
        depth: Depth images, registered to the colour images, and their stamps.
        paired: Whether the two lists are paired already, entry by entry; otherwise they are
            associated by time.
        truth: Camera-to-world poses; None if there are none.
        truth_of_body: Whether `truth` is that of whatever body the data set tracks, so that the
            camera's `R_body_cam` applies; otherwise it is the camera's already.
        truth_dropped: One phrase on the poses that were not taken as they stand; empty for none.
        notes: Phrases on files that are there and were not used.
        camera: Intrinsics that the folder states; None where it does not.
        fps: Nominal frame rate in Hz that the folder or the layout states; None where neither does.
        furthest_m: Depth beyond this, in metres, is no measurement (a rendered sky); None for no
            limit.
        people: Exact masks of people, with the stamps of the colour images; None where there are
            none.
    """

    colour: ImageList
    depth: ImageList
    paired: bool = False
    truth: Trajectory | None = None
    truth_dropped: str = ""
    camera: Camera | None = None
    fps: float | None = None
    furthest_m: float | None = None
    people: ImageList | None = None
    truth_of_body: bool = False
    notes: tuple[str, ...] = ()


# Images of folders without lists: found by their names, sized by their headers.


def find_names(folder: Path, pattern: str) -> list[str]:
    """Paths of the files that match, relative to the folder, in the order of their names; at least one.

    Raises:
        SequenceError: There is none.
    """
    names = sorted(path.relative_to(folder).as_posix() for path in folder.glob(pattern))
    if not names or len(names) > MOST_LINES:
        raise SequenceError(
            f"{folder} holds {len(names)} files {pattern}", "is it the folder of one sequence?"
        )
    return names


def stamped(files: list[str], stamps: NDArray[np.int64], where: str) -> ImageList:
    """Images with a stamp each, in nanoseconds, put in order of time.

    Raises:
        SequenceError: Stamps are equal or less than 1 us apart.
    """
    order = np.argsort(stamps, kind="stable")
    ordered = stamps[order]
    equal = np.flatnonzero(np.diff(stamps[order]) == 0)
    if len(equal):
        raise SequenceError(
            f"{where} holds {len(equal)} stamps twice, the first is {format_ns(int(ordered[equal[0]]))} s"
        )
    refuse_close(ordered, where, SequenceError)
    return ImageList(ordered, tuple(files[i] for i in order))


def checked_camera(
    where: object,
    size: Sequence[float],
    focal: Sequence[float],
    centre: Sequence[float],
    depth_factor: float | None,
    distortion: Sequence[float] = (),
) -> Camera:
    """A camera by its size, focal lengths and principal point in pixels, and up to five coefficients of distortion.

    Raises:
        SequenceError: Size, focal length or depth factor is not positive.
    """
    if not all(value > 0 for value in (*size, *focal)):
        raise SequenceError(
            f"{where}: size {size[0]:g}x{size[1]:g} and focal lengths {focal[0]:g} and {focal[1]:g} have to be above 0"
        )
    if depth_factor is not None and not depth_factor > 0:
        raise SequenceError(
            f"{where}: depth_factor is {depth_factor:g} raw units a metre, expected more than 0"
        )
    width, height = size
    fx, fy = focal
    cx, cy = centre

    # missing coefficients are 0
    k1, k2, p1, p2, k3 = (*distortion, *[0.0] * 5)[:5]
    return Camera(int(width), int(height), fx, fy, cx, cy, (k1, k2, p1, p2, k3), depth_factor)


def size_of_first(folder: Path, images: ImageList) -> tuple[int, int]:
    """Width and height of the first image.

    Raises:
        SequenceError: It cannot be read, or has no size.
    """
    path = folder / images.files[0]
    size = image_size(read_bytes(path, limit=512 * MEGABYTE, kind=SequenceError))
    if size is None:
        raise SequenceError(f"image {path} is no PNG, JPEG, TIFF, BMP or PNM")
    return size


# Calibration files: YAML, with OpenCV's matrices.

MOST_BYTES = 1 << 16
"""A calibration has a few kilobytes."""
MOST_BRACKETS = 1000
"""Most brackets of a file that is parsed: yaml's parser takes minutes for more."""


def read_yaml(path: Path) -> Mapping[str, Any]:
    """The mapping that a YAML file holds; OpenCV's matrices are mappings with their numbers under ``data``.

    Raises:
        SequenceError: It cannot be read, or holds no mapping.
    """
    text = read_text(path, limit=MOST_BYTES, kind=SequenceError)

    # what would keep the parser busy is refused first
    opened = text.count("[") + text.count("{")
    if opened > MOST_BRACKETS:
        raise SequenceError(
            f"{path} opens {opened} lists and mappings, more than a calibration's {MOST_BRACKETS}"
        )
    with translate_errors(SequenceError, f"{path} is no valid YAML", of=Exception):
        # values such as dates make yaml's constructors raise whatever they like
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
    """The numbers of a list in a mapping, or of an OpenCV matrix's ``data``.

    Args:
        mapping: What the file holds.
        key: Which of its values.
        count: How many numbers there have to be.
        where: The file, for the message.

    Raises:
        SequenceError: There is no such value, or it is no list of so many finite numbers.
    """
    # a list, an OpenCV matrix, or a single number
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


def is_identity(pose: Array) -> bool:
    """Whether a pose ``[4, 4]`` states that two bodies are one."""
    return bool(np.array_equal(pose, np.eye(4)))


def camera_on_body(sensor: Mapping[str, Any], where: str) -> Array:
    """The camera's pose on the body, ``T_BS`` of EuRoC's files, ``[4, 4]``; the identity where it is not stated.

    Raises:
        SequenceError: It is no rigid transformation.
    """
    if sensor.get("T_BS") is None:
        return np.eye(4)
    return rigid(numbers(sensor, "T_BS", 16, where), f"{where}: T_BS")


def camera_poses_from_body(
    stamps: NDArray[np.int64], rows: Array, T_body_cam: Array, where: str
) -> LoadedTrajectory | None:
    """The camera's true poses from those of a body, e.g. an IMU: ``T_world_cam = T_world_body @ T_body_cam``.

    Rows without a rotation are left out and counted. Of several with one stamp the last counts.

    Args:
        stamps: Nanoseconds ``[N]``.
        rows: ``tx ty tz qx qy qz qw`` ``[N, 7]``, body to world, metres.
        T_body_cam: Camera to body ``[4, 4]``.
        where: What messages call the source.

    Returns:
        None where no row is left.

    Raises:
        SequenceError: Two stamps of `where` differ by less than 1 us.
    """
    refuse_close(np.sort(stamps), where, SequenceError)

    # rows with a quaternion that is not 0
    keep = np.linalg.norm(rows[:, 3:], axis=1) > 1e-8
    if not keep.any():
        return None
    notes = FileNotes(lines=len(rows), zero_quaternions=int(np.count_nonzero(~keep)))

    # the camera on the body
    T_world_body = se3.from_quaternion(rows[keep, :3], rows[keep, 3:])
    return ordered_file(stamps[keep], T_world_body @ T_body_cam, notes)


# Tables in CSV whose stamps are nanoseconds, as EuRoC and VSLAM-LAB write them.

POSE = ("ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw")
"""Heading of VSLAM-LAB's tables of poses."""


def read_pose_table(path: Path, T_body_cam: Array) -> LoadedTrajectory:
    """The camera's poses of a table of EuRoC or VSLAM-LAB.

    Args:
        path: The table.
        T_body_cam: The camera's pose on the body whose poses the table holds, ``[4, 4]``.

    Raises:
        TrajectoryError: A row is malformed, the heading is of neither kind, or no row holds a
            rotation.
    """
    # load_tum knows both headings; body's poses become the camera's
    file = load_tum(path)
    trajectory = file.trajectory.with_poses(file.trajectory.T_world_cam @ T_body_cam)
    if file.every_line is None:
        return LoadedTrajectory(trajectory, file.notes)
    return LoadedTrajectory(
        trajectory, file.notes, file.every_line.with_poses(file.every_line.T_world_cam @ T_body_cam)
    )


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
            raise SequenceError(
                f"{path} line {number} has {len(parts)} columns, the heading {len(table[0])}"
            )
        if len(table) > MOST_LINES:
            raise SequenceError(f"{path} has more than {MOST_LINES} rows")
    if len(table) < 2:
        raise SequenceError(f"{path} holds no rows")
    return table[0], table[1:]


def pick(
    heading: list[str], rows: list[list[str]], names: Sequence[str], path: Path
) -> list[list[str]]:
    """The columns of these names.

    Raises:
        SequenceError: One is missing.
    """
    missing = [name for name in names if name not in heading]
    if missing:
        raise SequenceError(
            f"{path} has no column '{missing[0]}' (it has: {', '.join(heading)[:200]})"
        )
    return [[row[heading.index(name)] for row in rows] for name in names]


def nanoseconds(texts: list[str], path: Path) -> NDArray[np.int64]:
    """Stamps of nanoseconds, written as whole numbers or with a point, int64 ``[N]``.

    Raises:
        SequenceError: One is no number, or beyond the range of 64 bits.
    """
    stamps = []
    for text in texts:
        try:
            if text.isdigit() and len(text) < 19:
                stamps.append(int(text))
            else:
                stamps.append(parse_ns(f"{Decimal(text)}e-9"))
        except (ValueError, ArithmeticError):
            raise SequenceError(f"{path}: '{text[:40]}' is not a stamp in nanoseconds") from None
    return np.array(stamps, dtype=np.int64)
