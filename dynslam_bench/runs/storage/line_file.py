"""A file of JSON lines that any process may add to or delete; of what is damaged nothing counts as there."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.files import write_lines
from dynslam_bench.core.reading import MEGABYTE, TABLE_BYTES

T = TypeVar("T")

_ADDING = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
"""No link is followed, and nobody is waited for who reads a pipe."""
_PIECE = 16 * MEGABYTE
"""Bytes of lines that are read at once: a file of 100,000 long lines needs no memory of its own size beside theirs."""


def read_line_file(path: Path, lines: TypeAdapter[list[T]]) -> tuple[list[T], int]:
    """The valid lines of a file, and how many others it has; nothing of one that cannot be read.

    Args:
        path: The file; no more than `TABLE_BYTES` of it are read.
        lines: What lines are, as a list.
    """
    found: list[T] = []
    count = 0
    for piece in _pieces(path):
        found += _valid(piece, lines)
        count += piece.count(b"\n")
    return found, count - len(found)


def add_lines(path: Path, lines: Iterable[str]) -> None:
    """Add lines at once, so that those of other processes come before or after; what cannot be written is left out."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, _ADDING, 0o666)
        try:
            os.write(handle, "".join(f"{line}\n" for line in lines).encode())
        finally:
            os.close(handle)


def write_line_file(path: Path, lines: Iterable[str], older: str) -> None:
    """Write a file anew; a folder that can only be read keeps what it has.

    Args:
        path: The file.
        lines: Its lines.
        older: Pattern of the names of its older versions, which go.
    """
    with contextlib.suppress(DynslamError):
        write_lines(path, lines)
        remove_older(path, older)


def remove_older(path: Path, older: str) -> None:
    """Remove the older versions of a file, as far as the folder can be written."""
    with contextlib.suppress(OSError):
        for other in path.parent.glob(older):
            if other != path:
                other.unlink()


def _pieces(path: Path) -> Iterator[bytes]:
    """The file in pieces of whole lines; its last line ends in a newline, whether the file does or not."""
    if not path.is_file():  # nor is it waited for what comes out of a pipe
        return
    with contextlib.suppress(OSError), path.open("rb") as file:
        if os.fstat(file.fileno()).st_size > TABLE_BYTES:
            return
        while piece := file.read(_PIECE):
            piece += file.readline()
            yield piece if piece.endswith(b"\n") else piece + b"\n"


def _valid(piece: bytes, lines: TypeAdapter[list[T]]) -> list[T]:
    """The lines of a piece but for the damaged ones."""
    whole = piece[:-1]
    try:
        return lines.validate_json(b"[" + whole.replace(b"\n", b",") + b"]")
    except ValidationError:  # one is damaged: a kill tore it
        return [line for text in whole.split(b"\n") for line in _line(text, lines)]


def _line(text: bytes, lines: TypeAdapter[list[T]]) -> list[T]:
    try:
        return lines.validate_json(b"[" + text + b"]")
    except ValidationError:
        return []
