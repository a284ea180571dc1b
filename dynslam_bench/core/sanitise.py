"""Text and names from elsewhere, sanitised for terminals, files and paths; passwords, tokens and keys are hidden.

No password leaves the process: not in messages, records, reports or logs.
"""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]"
)
"""Characters that a terminal acts upon (escape sequences, directions of writing) or that no encoding takes."""
_SURROGATE = re.compile("[\ud800-\udfff]")
"""Half of a character of UTF-16, which UTF-8 does not encode."""
LONGEST_NAME = 255
"""Most bytes that file systems take of one part of a path."""


def printable(text: str) -> str:
    r"""The text with everything that a terminal would act upon shown as an escape, e.g. ``\x1b``; newlines stay."""
    return text if text.isprintable() else _CONTROL.sub(_escaped, text)


def storable(value: Any) -> Any:
    r"""A value whose texts UTF-8 can encode: lone surrogates become ``\udc80``, written with six characters.

    They come from file names and command lines of another encoding, and from foreign programs.
    """
    if isinstance(value, str):
        return _SURROGATE.sub(_escaped, value)
    if isinstance(value, dict):
        return {storable(key): storable(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(map(storable, value))
    return value


def _escaped(match: re.Match[str]) -> str:
    r"""A character as Python's escape: ``\x1b`` or ``\u200e``."""
    code = ord(match[0])
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"


def is_inside(name: str) -> bool:
    """Whether a relative path in foreign data stays below its folder, and can be a file's name at all."""
    path = PurePosixPath(name)
    stays_below = bool(path.parts) and not path.is_absolute() and ".." not in path.parts
    if not stays_below or "\\" in name or not name.isprintable():
        return False
    return all(len(part.encode()) <= LONGEST_NAME for part in path.parts)


def path_below(
    folder: Path, name: str, *, where: str, kind: Callable[[str, str], Exception]
) -> Path:
    """The file that a name in foreign data stands for, below a folder.

    Args:
        folder: The folder.
        name: The name.
        where: What names it, for the message.
        kind: Class of the error.

    Raises:
        DynslamError: Raised as `kind`: the name is absolute, leads outside, or cannot be a file's.
    """
    if not is_inside(name):
        raise kind(
            f"{where} names {name[:100]!r}, which does not lie in {folder}",
            "names are relative, without '..'",
        )
    return folder / name


_ADDRESS = re.compile(r"((?<![\w+.-])[A-Za-z][\w+.-]*://[^\s/?#:@\"']*):[^\s\"']{0,999}@")
"""An address with a password: ``scheme://user:password@``."""
_PARAMETER = re.compile(
    r"([?&;](?:password|passwd|pwd|token|secret|sslpassword)=)[^&;#\s\"']+", re.IGNORECASE
)
"""A parameter of an address that holds a secret: ``?token=...``."""
HIDDEN = "***"
"""Stands in the place of every secret."""
_HINT = re.compile(
    r"passw|passp|pwd|token|secret|credential|(?:api|access|private)[-_]?key", re.IGNORECASE
)
"""Is in every text that holds a secret by name, and is found fast."""
_NAME = (
    r"(?:password|passwd|passphrase|pwd|token|secret|credentials?|(?:api|access|private)[-_]?key)"
)
"""Endings of the names of secrets."""
_TEXT = r"(?:[^\"\\]|\\.)"
"""A character of a text in JSON."""
_BARE = r"(?:[^\s\"'\\&;#]|\\[^\"'])+"
_QUOTED = r"'[^'\"]*'|\\\"[^\"\\]*\\\""
_ASSIGNED = tuple(
    re.compile(pattern, re.IGNORECASE)
    for pattern in (
        rf"(\"-{{0,2}}[\w.-]{{0,60}}{_NAME}=){_TEXT}+(?=\")",  # a word of a command in JSON
        rf"({_NAME}=)(?:{_QUOTED}|{_BARE})",
        rf"(\"[\w.-]{{0,60}}{_NAME}\"\s*:\s*\"){_TEXT}+(?=\")",  # a setting in JSON
        # an option and its value in a list in JSON
        rf"((?<![\w-])--?[\w-]{{0,60}}{_NAME}\",\s*\")(?!-){_TEXT}+(?=\")",
        rf"((?<![\w-])--?[\w-]{{0,60}}{_NAME}(?:\s+|',\s*'))(?!-)(?:{_QUOTED}|{_BARE})",
    )
)


def without_passwords(text: str) -> str:
    """The text with every password in an address, and every value that its name calls a secret, replaced by ``***``.

    Names end in ``password``, ``token``, ``secret``, ``api-key`` or the like; a value stands behind
    ``=`` or an option.

    >>> without_passwords("cannot reach postgresql://me:secret@db/studies?sslmode=require")
    'cannot reach postgresql://me:***@db/studies?sslmode=require'
    >>> without_passwords("slam --token=s3cret --api-key s3cret --threads 2")
    'slam --token=*** --api-key *** --threads 2'
    """
    if "://" not in text and not _HINT.search(text):
        return text
    return str(json.loads(json_without_passwords(json.dumps(text, ensure_ascii=False))))


def json_without_passwords(text: str) -> str:
    """JSON without the passwords and secrets in its texts (`without_passwords`).

    It stays JSON. An option and its value may be two texts of a list.
    """
    if "://" in text:
        text = _PARAMETER.sub(rf"\1{HIDDEN}", _ADDRESS.sub(rf"\1:{HIDDEN}@", text))
    if _HINT.search(text):
        for pattern in _ASSIGNED:
            text = pattern.sub(rf"\1{HIDDEN}", text)
    return text


def words_without_passwords(words: Sequence[str]) -> list[str]:
    """The words of a command without passwords and secrets (`without_passwords`)."""
    return list(json.loads(json_without_passwords(json.dumps(list(words), ensure_ascii=False))))
