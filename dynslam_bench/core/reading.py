"""Read files that others may have written: bounded in size, and one clear error for any fault.

Every reader of text, JSON, arrays or bytes uses this module, so that the message is the same
everywhere for files that are not UTF-8, nested too deeply, too long or not readable.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dynslam_bench.core.errors import DynslamError, translate_errors
from dynslam_bench.core.sanitise import path_below

if TYPE_CHECKING:
    from numpy.typing import NDArray


MEGABYTE = 1 << 20
RECORD_BYTES = 16 * MEGABYTE
"""Most bytes of a record, a settings file or anything else that is written by hand or by frame."""
TABLE_BYTES = 1024 * MEGABYTE
"""Most bytes of a table with a line a frame."""
MOST_BYTES = 1 << 28
"""Most bytes of an ``.npz`` file, and of all arrays in it together."""
_MOST_FILES = 1 << 16
"""Bytes that hold most files whole."""


def read_bytes(
    path: Path, *, limit: int = RECORD_BYTES, kind: type[DynslamError] = DynslamError
) -> bytes:
    """Read a file of at most `limit` bytes.

    Args:
        path: The file.
        limit: Most bytes that are read.
        kind: What is raised.

    Raises:
        DynslamError: Raised as `kind`: the file cannot be read, or is larger than `limit` bytes.
    """
    # ValueError: a name with a null byte
    with (
        translate_errors(kind, f"cannot read {path}", of=(OSError, ValueError)),
        path.open("rb") as file,
    ):
        # in two steps: taking memory for `limit` bytes costs as much as reading them
        data = file.read(min(_MOST_FILES, limit + 1))
        if len(data) == _MOST_FILES:
            data += file.read(limit + 1 - len(data))
    if len(data) > limit:
        raise kind(_too_large(path, limit))
    return data


def read_text(
    path: Path, *, limit: int = RECORD_BYTES, kind: type[DynslamError] = DynslamError
) -> str:
    """Read a UTF-8 file of at most `limit` bytes; a byte order mark is left out.

    Raises:
        DynslamError: Raised as `kind`: the file cannot be read, is larger than `limit` bytes, or is
            not UTF-8.
    """
    with translate_errors(kind, f"{path} is not a text file", of=UnicodeDecodeError):
        return read_bytes(path, limit=limit, kind=kind).decode("utf-8-sig")


def read_lines(
    path: Path, *, limit: int = TABLE_BYTES, kind: type[DynslamError] = DynslamError
) -> Iterator[str]:
    """Read the lines of a UTF-8 file one after the other, so that a long file needs no memory of its own size.

    Raises:
        DynslamError: Raised as `kind`: the file cannot be read, is larger than `limit` bytes, or is
            not UTF-8.
    """
    done = 0
    with (
        translate_errors(kind, f"cannot read {path}", of=(OSError, ValueError)),
        translate_errors(kind, f"{path} is not a text file", of=UnicodeDecodeError),
        path.open(encoding="utf-8-sig") as file,
    ):
        while line := file.readline(limit + 1):
            done += len(line)
            if done > limit:
                raise kind(_too_large(path, limit))
            yield line


def read_json(
    path: Path, *, limit: int = RECORD_BYTES, kind: type[DynslamError] = DynslamError
) -> Any:
    """Read the value in a JSON file.

    Raises:
        DynslamError: Raised as `kind`: the file cannot be read, is larger than `limit` bytes, or is
            not JSON.
    """
    return parse_json(read_text(path, limit=limit, kind=kind), str(path), kind=kind)


def parse_json(text: str, where: str, *, kind: type[DynslamError] = DynslamError) -> Any:
    """Read the value of a JSON text.

    Args:
        text: The text.
        where: What it is, for the message.
        kind: What is raised.

    Raises:
        DynslamError: Raised as `kind`: the text is not JSON, is nested too deeply, or holds a
            number of thousands of digits.
    """
    with translate_errors(kind, f"{where} is no valid JSON", of=(ValueError, RecursionError)):
        return json.loads(text)


def read_npz(path: Path, *, kind: type[DynslamError] = DynslamError) -> dict[str, NDArray[Any]]:
    """Read the arrays of an ``.npz`` file by name; nothing is unpickled.

    Args:
        path: The file.
        kind: What is raised.

    Raises:
        DynslamError: Raised as `kind`: the file cannot be read, is damaged, or holds or claims more
            than `MOST_BYTES`.
    """
    import numpy as np

    data = read_bytes(path, limit=MOST_BYTES, kind=kind)
    # zipfile and numpy raise almost anything over damaged files
    with (
        translate_errors(kind, f"{path} holds no arrays", of=Exception),
        np.load(io.BytesIO(data), allow_pickle=False) as archive,
    ):
        # a small archive may unpack to any size
        stated_bytes = sum(entry.file_size for entry in archive.zip.infolist())
        if stated_bytes > MOST_BYTES:
            raise ValueError(
                f"it claims {stated_bytes / 1e6:.0f} MB, at most {MOST_BYTES / 1e6:.0f} are read"
            )
        arrays = dict(archive)
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise kind(f"{path} holds something else than arrays")
    return arrays


def file_sha256(
    path: Path, progress: Callable[[int, int], object] = lambda done, total: None
) -> str:
    """SHA-256 of a file; `progress` is called with the bytes done and their total.

    Raises:
        OSError: It cannot be read.
    """
    digest = hashlib.sha256()
    with path.open("rb") as file:
        total = path.stat().st_size
        while block := file.read(MEGABYTE):
            digest.update(block)
            progress(file.tell(), total)
    return digest.hexdigest()


def compare_sums(folder: Path, sums: Path, kind: type[DynslamError] = DynslamError) -> list[str]:
    """Compare a folder with a list of checksums: one line for each file that is missing or differs.

    Args:
        folder: The folder.
        sums: The list, as ``sha256sum`` writes it.
        kind: What is raised.

    Raises:
        DynslamError: Raised as `kind`: the list or a file cannot be read, or a name leads out of
            the folder.
    """
    faults = []
    for line in read_lines(sums, kind=kind):
        expected, _, name = line.rstrip("\n").partition("  ")
        path = path_below(folder, name, where=str(sums), kind=kind)
        if not path.is_file():
            faults.append(f"{name} is missing")
            continue
        with translate_errors(kind, f"cannot read {path}", "check the disk and the permissions"):
            actual = file_sha256(path)
        if actual != expected:
            faults.append(f"{name} is not what {sums.name} says")
    return faults


def _too_large(path: Path, limit: int) -> str:
    return f"{path} has more than the {limit / MEGABYTE:g} MB that are read of such a file"
