"""The presets that ship, one TOML file each: `TRACKER.NAME.toml`, as its study wrote it, and what it is worth there.

The study behind `mask-rcnn.fast.toml` is `docs/studies/fast-mask-rcnn.toml`; `docs/tuning.md` has the figures of all.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dynslam_bench.core.toml import read_settings

FOLDER = Path(__file__).parent


def shipped(tracker: str) -> Mapping[str, Mapping[str, Any]]:
    """The presets of a built-in tracker: name to overrides, dotted name to value."""
    files = sorted(FOLDER.glob(f"{tracker}.*.toml"))
    return {file.name.split(".")[1]: read_settings(file) for file in files}
