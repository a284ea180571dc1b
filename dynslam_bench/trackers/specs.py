"""The specs of all built-in trackers; importing this loads neither torch nor OpenCV."""

from __future__ import annotations

from .protocol import TrackerSpec


def all_specs() -> list[TrackerSpec]:
    """Every built-in tracker's spec."""
    return []
