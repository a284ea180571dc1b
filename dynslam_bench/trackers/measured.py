"""What was measured of the built-in trackers with their default settings and is shown where they are described."""

from __future__ import annotations

import json
from importlib.resources import files

FILE = "epipolar_skipped.json"


def epipolar_skipped(tracker: str) -> dict[str, float]:
    """Share of the tracked frames on which no fundamental matrix judged, by sequence; empty where nothing was measured.

    Written by ``tests/benchmarks/epipolar_share.py --write``; a run's own share is `RunRecord.epipolar_skipped`.
    """
    table = json.loads((files("dynslam_bench.trackers") / FILE).read_text(encoding="utf-8"))
    return {sequence: float(share) for sequence, share in table.get(tracker, {}).items()}
