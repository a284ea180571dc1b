"""Read ``rgb.txt`` and ``depth.txt``: stamps and file names, with a count of every line that was not used."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.reading import read_lines
from dynslam_bench.geometry.stamps import ns_of, parse_ns, refuse_close, to_seconds

MOST_LINES = 1_000_000
"""Nine hours at 30 frames a second; a longer list is refused before it fills the memory."""


@dataclass(frozen=True, eq=False)
class ImageList:
    """Stamped image files in order of time.

    Attributes:
        stamps_ns: Nanoseconds, int64 ``[N]``, strictly increasing.
        files: Paths relative to the sequence's folder.
        bad_stamps: Lines whose stamp was not finite; dropped.
        duplicate_stamps: Lines whose stamp occurred again later; dropped, as the last one wins in TUM's tools.
        unsorted: Lines whose stamp was below the one before; put in order.
        unnamed: Lines without a file name; dropped.
    """

    stamps_ns: NDArray[np.int64]
    files: tuple[str, ...]
    bad_stamps: int = 0
    duplicate_stamps: int = 0
    unsorted: int = 0
    unnamed: int = 0

    @cached_property
    def stamps(self) -> NDArray[np.float64]:
        """Seconds, float64 ``[N]``."""
        return to_seconds(self.stamps_ns)

    def __len__(self) -> int:
        return len(self.files)


def read_image_list(path: Path) -> ImageList:
    """Read lines ``timestamp filename``; ``#`` starts a comment, commas and tabs separate as well.

    Raises:
        SequenceError: The file is missing or no text, a stamp is not a number, or two differ by less than 1 us.
    """
    return make_image_list([(stamp, " ".join(rest)) for stamp, rest in read_stamped_lines(path)], described=str(path))


def read_associations(path: Path) -> tuple[ImageList, ImageList]:
    """Read lines ``timestamp colour timestamp depth``, images that are paired already.

    Raises:
        SequenceError: The file is missing or no text, a line does not have these four parts, or two stamps differ by
            less than 1 us.
    """
    colour: dict[int | None, tuple[str, int | None, str]] = {}
    rows = read_stamped_lines(path)
    for number, (stamp, rest) in enumerate(rows):
        if len(rest) != 3:
            raise SequenceError(
                f"entry {number + 1} of {path} has {len(rest) + 1} parts, expected 4: timestamp colour timestamp depth"
            )
        colour[stamp] = (rest[0], _number(rest[1], path), rest[2])
    good = {
        stamp: (row[0], row[1], row[2]) for stamp, row in colour.items() if stamp is not None and row[1] is not None
    }
    if not good:
        raise SequenceError(f"{path} lists no pair of images ({len(rows)} lines, {len(colour)} with a stamp)")
    order = sorted(good)
    counts = {
        "bad_stamps": len(colour) - len(good),
        "duplicate_stamps": len(rows) - len(colour),
        "unsorted": _count_unsorted([stamp for stamp, _ in rows]),
    }
    first = ImageList(np.array(order, dtype=np.int64), tuple(good[stamp][0] for stamp in order), **counts)
    refuse_close(first.stamps_ns, str(path), SequenceError, lambda stamp: _line_of(path, stamp))
    depth_stamps = np.array([good[stamp][1] for stamp in order], dtype=np.int64)
    return first, ImageList(depth_stamps, tuple(good[stamp][2] for stamp in order))


def list_folder(folder: Path, name: str, fps: float | None) -> ImageList:
    """The images of a folder without a list file, stamped by their names.

    A name with a decimal point is a stamp in seconds; a whole number is a frame number, which `fps` turns into seconds.

    Raises:
        SequenceError: The folder does not exist, or a name gives no stamp.
    """
    images = folder / name
    if not images.is_dir():
        raise SequenceError(
            f"{folder} has neither {name}.txt nor a folder {name}",
            "a sequence in TUM layout holds rgb.txt, depth.txt, the images, and groundtruth.txt where there is one",
        )
    rows: list[tuple[int | None, str]] = []
    for path in sorted(images.iterdir()):
        if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp") or path.name.startswith("."):
            continue
        digits = path.stem.lstrip("0123456789")
        if digits == "" and fps is None:
            raise SequenceError(
                f"{name}/{path.name} of {folder} is named by a frame number, which has no time",
                f"write {name}.txt with lines 'timestamp {name}/{path.name}', or 'fps = 30' into camera.toml",
            )
        stamp = ns_of(int(path.stem) / fps) if digits == "" and fps is not None else _number(path.stem, images)
        rows.append((stamp, f"{name}/{path.name}"))
    return make_image_list(sorted(rows, key=lambda row: (row[0] or 0, row[1])), described=str(images))


def make_image_list(rows: list[tuple[int | None, str]], *, described: str) -> ImageList:
    """Sort, drop what has no usable stamp or name, and count it.

    Raises:
        SequenceError: Nothing is left, or two stamps differ by less than 1 us.
    """
    named = [(stamp, name) for stamp, name in rows if name]
    finite = [(stamp, name) for stamp, name in named if stamp is not None]
    unique = dict(finite)  # the last of several equal stamps wins, as in TUM's associate.py
    if not unique:
        raise SequenceError(
            f"{described} lists no image ({len(rows)} lines, {len(named) - len(finite)} without a stamp)"
        )
    order = sorted(unique)
    stamps = np.array(order, dtype=np.int64)
    refuse_close(stamps, described, SequenceError, lambda stamp: _line_of(Path(described), stamp))
    return ImageList(
        stamps,
        tuple(unique[stamp] for stamp in order),
        bad_stamps=len(named) - len(finite),
        duplicate_stamps=len(finite) - len(unique),
        unsorted=_count_unsorted([stamp for stamp, _ in finite]),
        unnamed=len(rows) - len(named),
    )


def read_stamped_lines(path: Path) -> list[tuple[int | None, list[str]]]:
    """Lines of a TUM list file, split at white space and commas, the first part in nanoseconds; None if not finite.

    Raises:
        SequenceError: The file cannot be read, a first part is not a number (names the line), or there are too many.
    """
    rows: list[tuple[int | None, list[str]]] = []
    for number, line in enumerate(read_lines(path, kind=SequenceError), start=1):
        if number > MOST_LINES:
            raise SequenceError(f"{path} has more than {MOST_LINES} lines, too many for a list of images")
        parts = line.replace(",", " ").split()
        if parts and not parts[0].startswith("#"):
            rows.append((_number(parts[0], f"{path} line {number}"), parts[1:]))
    return rows


def _number(text: str, where: object) -> int | None:
    try:
        return parse_ns(text) if math.isfinite(float(text)) else None
    except ValueError:
        raise SequenceError(f"{where}: '{text[:40]}' is not a timestamp in seconds") from None


def _line_of(path: Path, ns: int) -> int | None:
    """The last line of a list that begins with a stamp; None where `path` is no file."""
    found = None
    for number, line in enumerate(read_lines(path, kind=SequenceError) if path.is_file() else (), start=1):
        parts = line.replace(",", " ").split()
        if parts and not parts[0].startswith("#") and _number(parts[0], path) == ns:
            found = number
    return found


def _count_unsorted(stamps: list[int | None]) -> int:
    known = [stamp for stamp in stamps if stamp is not None]
    return sum(later < earlier for earlier, later in pairwise(known))
