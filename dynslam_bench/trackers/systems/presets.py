"""The presets that ship; what each is worth beside the defaults, on scenes that no choice has seen: docs/tuning.md."""

from __future__ import annotations

from typing import Any

_SECOND: dict[str, Any] = {"segmentation.schedule": "every_nth", "segmentation.n": 2}
FAST_MASKS = {"fast": _SECOND | {"segmentation.crowded_share": 0.5}}
"""The network sees every second frame, and every one while masks cover half of the view.

Between them masks are carried along by optical flow.
"""
FAST_FLOW = {"fast": _SECOND | {"flow.budget": 24}}
"""Every second frame, and the flow searches for less than half as long: behind masks no error shows a change."""
