"""Read TOML on every supported Python, and write settings as ``--set`` takes them."""

import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import DynslamError, SequenceError, SettingsError, translate_errors
from dynslam_bench.core.reading import read_text

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


_PREFIXED = re.compile(r"[a-z][a-z0-9_-]*:")
"""Begins an id that names a file behind a colon: ``onnx:/home/me/net.onnx``."""
_NETWORK_SUFFIX = re.compile(r"\.(?:onnx|pt|pth|tflite)$")
"""Endings of files of networks."""


def read_toml(path: Path, *, kind: type[DynslamError] = SequenceError) -> dict[str, Any]:
    """Read a TOML file as nested dictionaries.

    Args:
        path: The file.
        kind: What is raised.

    Raises:
        DynslamError: Raised as `kind`: the file cannot be read or is not TOML; names the place.
    """
    return parse_toml(read_text(path, kind=kind), str(path), kind=kind)


def parse_toml(
    text: str, where: str, *, kind: type[DynslamError] = SequenceError
) -> dict[str, Any]:
    """Read a TOML text as nested dictionaries.

    Args:
        text: The text.
        where: What it is, for the message.
        kind: What is raised.

    Raises:
        DynslamError: Raised as `kind`: the text is not TOML, is nested too deeply, or holds a
            number of thousands of digits.
    """
    with translate_errors(
        kind, f"{where} is not valid TOML", of=(ValueError, OverflowError, RecursionError)
    ):
        return tomllib.loads(text)


def read_settings(path: Path) -> dict[str, Any]:
    """Read overrides of settings by dotted name from a TOML file; a table ``[settings]`` holds them if there is one.

    Raises:
        SettingsError: The file cannot be read, or is no TOML.
    """
    document = read_toml(path.expanduser(), kind=SettingsError)
    values = document.get("settings", document)
    if not isinstance(values, dict):
        raise SettingsError(f"'settings' in {path} is {values!r}, not a table")
    return dict(_flatten(values))


def setting_text(value: Any) -> str:
    """A setting's value for people and for ``--set``: ``true``, ``null``, a table in JSON; a text without quotes."""
    return value if isinstance(value, str) else json.dumps(value, default=str)


def label_text(value: Any) -> str:
    """A setting's value, or a tracker's id, for tables: paths without their folders, networks without their ending.

    Example:
        >>> label_text("onnx:/home/me/yolov8n-seg.onnx"), label_text("replay:/data/run 3.txt"), label_text(0.5)
        ('onnx:yolov8n-seg', 'replay:run 3.txt', '0.5')
    """
    text = setting_text(value)
    prefix = ""
    path = text
    if _PREFIXED.match(text):
        prefix, _, path = text.partition(":")
    if not path.startswith(("/", "~", "./", "../")):
        return text
    name = path.rstrip("/").rpartition("/")[2]
    return f"{prefix}:{_NETWORK_SUFFIX.sub('', name)}" if prefix else name


def assignments(values: Mapping[str, Any]) -> list[str]:
    """Settings as ``name=value``, in their order."""
    return [f"{name}={setting_text(value)}" for name, value in values.items()]


def _flatten(values: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Dotted name and value of everything in nested tables."""
    items: list[tuple[str, Any]] = []
    for key, value in values.items():
        if isinstance(value, dict):
            items += _flatten(value, f"{prefix}{key}.")
        else:
            items.append((f"{prefix}{key}", value))
    return items
