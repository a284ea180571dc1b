"""What a stored study was made with, beside what it would be made with now."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.reading import read_json

from .old_form import NEW, converted, is_old
from .study_file import StudySpec


def as_stored(spec: StudySpec, file: Path) -> StudySpec:
    """A study that is only read, with the start offsets that it had: one of before there were any began at frame 0."""
    if "offsets" in spec.model_fields_set or not file.is_file():
        return spec
    stored = read_json(file, kind=StudyError)
    return spec if not isinstance(stored, dict) or "offsets" in stored else spec.model_copy(update={"offsets": (0,)})


def same(stored: dict[str, Any], now: dict[str, Any], but: tuple[str, ...]) -> bool:
    """Whether two identities agree, but for some keys."""
    if is_old(stored):
        stored, _ = converted(stored)
        but = (*but, *NEW)
    return all(_of(stored, key) == _of(now, key) for key in (stored.keys() | now.keys()) - set(but))


def _of(identity: dict[str, Any], key: str) -> Any:
    """A part of a study's identity; studies from before there were start offsets had none."""
    return identity.get(key, [0] if key == "offsets" else None)


def difference(stored: dict[str, Any], now: dict[str, Any]) -> str:
    """The first thing in which two identities differ, in words."""
    for key in ("data", "program"):
        there, here = stored.get(key) or {}, now.get(key) or {}
        names = [name for name in here if there.get(name) != here[name]]
        if names and key == "data":
            return f"data: the content of {', '.join(names[:3])} is not what it was"
        if names:
            return f"{names[0]}: {there.get(names[0])} there, {here[names[0]]} here"
    changed = [key for key in now if _of(stored, key) != now[key]]
    first = changed[0] if changed else next(iter(stored.keys() - now.keys()), "content")
    more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
    return f"{first}{more}: {_short(stored.get(first))} there, {_short(now.get(first))} here"


def _short(value: Any, limit: int = 80) -> str:
    text = json.dumps(value)
    return text if len(text) <= limit else text[: limit - 3] + "..."
