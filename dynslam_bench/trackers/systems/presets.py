"""The presets that ship; what each is worth beside the defaults, on scenes that no choice has seen: docs/tuning.md."""

from __future__ import annotations

from typing import Any

_SECOND: dict[str, Any] = {"segmentation.schedule": "every_nth", "segmentation.n": 2}
FAST_MASKS = {"fast": _SECOND}
"""The network sees every second frame; between them masks are carried along by optical flow.

On recorded people, who move as they like, 7 % more error was measured.
"""
FAST_FLOW = {"fast": _SECOND | {"flow.budget": 24}}
"""The same, and the flow searches for less than half as long: behind masks that changes no error that can be shown."""
