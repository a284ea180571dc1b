"""Text and names from elsewhere, made harmless: for terminals, for UTF-8 files, for messages, for paths."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Any

from dynslam_bench.core.errors import DynslamError

_UNSEEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]")
"""What a terminal acts upon (escape sequences, directions of writing) and what no encoding takes; not tab, newline."""
_SURROGATE = re.compile("[\ud800-\udfff]")
LONGEST_NAME = 255
"""Most bytes that file systems take of one part of a path."""


def printable(text: str) -> str:
    r"""The text with everything that a terminal would act upon shown as an escape, e.g. ``\x1b``; newlines stay."""
    return text if text.isprintable() else _UNSEEN.sub(_escaped, text)


def storable(value: Any) -> Any:
    r"""A value whose texts UTF-8 can hold: half characters (lone surrogates) become ``\udc80`` in so many letters.

    They come from file names and command lines of another encoding, and from foreign programs.
    """
    if isinstance(value, str):
        return _SURROGATE.sub(_escaped, value)
    if isinstance(value, dict):
        return {storable(key): storable(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(storable(each) for each in value)
    return value


def is_inside(name: str) -> bool:
    """Whether a relative path in somebody's data stays below its folder, and can be a file's name at all."""
    path = PurePosixPath(name)
    return (
        bool(path.parts)
        and not path.is_absolute()
        and ".." not in path.parts
        and "\\" not in name
        and name.isprintable()
        and all(len(part.encode()) <= LONGEST_NAME for part in path.parts)
    )


def inside(folder: Path, name: str, *, where: str, kind: type[DynslamError] = DynslamError) -> Path:
    """The file that a name in somebody's data stands for, below a folder.

    Args:
        folder: The folder.
        name: The name.
        where: What names it, for the message.
        kind: What is raised.

    Raises:
        DynslamError: Of the given kind: the name is absolute, leads outside, or cannot be a file's.
    """
    if not is_inside(name):
        raise kind(f"{where} names {name[:100]!r}, which does not lie in {folder}", "names are relative, without '..'")
    return folder / name


def _escaped(found: re.Match[str]) -> str:
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"
