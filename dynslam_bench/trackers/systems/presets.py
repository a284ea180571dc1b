"""The presets that ship; what each is worth beside the defaults, on scenes that no choice has seen: docs/tuning.md."""

from __future__ import annotations

FAST = {"fast": {"segmentation.schedule": "every_nth", "segmentation.n": 3}}
"""The network sees every third frame; between them masks are carried along by optical flow.

A quarter to a half of the processor time less. Not worse on rendered scenes; on recorded people, who move as they like,
6 to 11 % more error was measured.
"""
