"""Numbers of calibration files in YAML, OpenCV's dialect (``%YAML:1.0``, ``!!opencv-matrix``) included."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.reading import read_text

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
    found = [float(x) for x in listed if isinstance(x, (int, float)) and _finite(x)]
    if not len(found) == len(listed) == count:
        raise SequenceError(f"{where} holds no {count} numbers")
    return found


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
