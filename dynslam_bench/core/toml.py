"""Read TOML on every supported Python."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from .errors import DynslamError, SequenceError
from .reading import read_text

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def read_toml(path: Path, *, kind: type[DynslamError] = SequenceError) -> dict[str, Any]:
    """The file as nested dictionaries.

    Args:
        path: The file.
        kind: What is raised.

    Raises:
        DynslamError: Of the given kind: the file cannot be read or is no TOML; names the place.
    """
    return parse_toml(read_text(path, kind=kind), str(path), kind=kind)


def parse_toml(text: str, where: str, *, kind: type[DynslamError] = SequenceError) -> dict[str, Any]:
    """A TOML text as nested dictionaries.

    Args:
        text: The text.
        where: What it is, for the message.
        kind: What is raised.

    Raises:
        DynslamError: Of the given kind: it is no TOML, nested too deeply, or holds a number of thousands of digits.
    """
    try:
        return tomllib.loads(text)
    except (ValueError, OverflowError) as error:  # a TOMLDecodeError is a ValueError
        raise kind(f"{where} is not valid TOML: {error}") from error
    except RecursionError as error:
        raise kind(f"{where} is not valid TOML: it is nested too deeply") from error
