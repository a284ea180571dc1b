"""Read files that somebody else may have written: bounded in size, and one clear error whatever they hold.

Every reader of text, JSON or bytes goes through here, so that what is no UTF-8, nested too deeply, longer than it
should be or not readable at all is the same one line everywhere.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import DynslamError

MEGABYTE = 1 << 20
RECORD_BYTES = 16 * MEGABYTE
"""Most bytes of a record, a settings file or anything else that people and this package write by hand or by frame."""
TABLE_BYTES = 1024 * MEGABYTE
"""Most bytes of a table with a line a frame."""

_MOST_FILES = 1 << 16
"""Bytes that hold most files whole."""


def read_bytes(path: Path, *, limit: int = RECORD_BYTES, kind: type[DynslamError] = DynslamError) -> bytes:
    """The content of a file of at most `limit` bytes.

    Args:
        path: The file.
        limit: Most bytes that are read.
        kind: What is raised.

    Raises:
        DynslamError: Of the given kind: it cannot be read, or is larger.
    """
    try:
        with path.open("rb") as file:  # at first no more room than most files need: asking for `limit` takes as long
            data = file.read(min(_MOST_FILES, limit + 1))
            if len(data) == _MOST_FILES:
                data += file.read(limit + 1 - len(data))
    except (OSError, ValueError) as error:  # ValueError: a name with a null byte
        raise kind(f"cannot read {path}: {_reason(error)}") from error
    if len(data) > limit:
        raise kind(f"{path} has more than the {limit / MEGABYTE:g} MB that are read of such a file")
    return data


def read_text(path: Path, *, limit: int = RECORD_BYTES, kind: type[DynslamError] = DynslamError) -> str:
    """The content of a UTF-8 file of at most `limit` bytes; a byte order mark is left out.

    Raises:
        DynslamError: Of the given kind: it cannot be read, is larger, or is no UTF-8.
    """
    try:
        return read_bytes(path, limit=limit, kind=kind).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise kind(_no_text(path, error)) from error


def read_lines(path: Path, *, limit: int = TABLE_BYTES, kind: type[DynslamError] = DynslamError) -> Iterator[str]:
    """The lines of a UTF-8 file, one after the other, so that a long file needs no memory of its own size.

    Raises:
        DynslamError: Of the given kind: it cannot be read, has more than `limit` bytes, or is no UTF-8.
    """
    done = 0
    try:
        with path.open(encoding="utf-8-sig") as file:
            while line := file.readline(limit + 1):
                done += len(line)
                if done > limit:
                    raise kind(f"{path} has more than the {limit / MEGABYTE:g} MB that are read of such a file")
                yield line
    except UnicodeDecodeError as error:
        raise kind(_no_text(path, error)) from error
    except (OSError, ValueError) as error:
        raise kind(f"cannot read {path}: {_reason(error)}") from error


def read_json(path: Path, *, limit: int = RECORD_BYTES, kind: type[DynslamError] = DynslamError) -> Any:
    """The value in a JSON file.

    Raises:
        DynslamError: Of the given kind: it cannot be read, is larger than `limit` bytes, or is no JSON.
    """
    return parse_json(read_text(path, limit=limit, kind=kind), str(path), kind=kind)


def parse_json(text: str, where: str, *, kind: type[DynslamError] = DynslamError) -> Any:
    """The value of a JSON text.

    Args:
        text: The text.
        where: What it is, for the message.
        kind: What is raised.

    Raises:
        DynslamError: Of the given kind: it is no JSON, nested too deeply, or holds a number of thousands of digits.
    """
    try:
        return json.loads(text)
    except ValueError as error:
        raise kind(f"{where} is no valid JSON: {error}") from error
    except RecursionError as error:
        raise kind(f"{where} is no valid JSON: it is nested too deeply") from error


def _reason(error: OSError | ValueError) -> str:
    return str(getattr(error, "strerror", None) or error)


def _no_text(path: Path, error: UnicodeDecodeError) -> str:
    return f"{path} is not a text file: byte {error.start} ({error.object[error.start]:#04x}) is no UTF-8"
