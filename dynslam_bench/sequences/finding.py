"""What a check of a recording found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """One thing that a check of a recording found.

    Attributes:
        id: Stable name, for example ``truth-time-shift``.
        severity: ``fault``: results on the recording are wrong until it is mended; ``note``: good to know.
        value: The measured number; None where nothing is measured.
        unit: Its unit, for example ``s``; empty for a ratio or where nothing is measured.
        text: One line that says what was measured.
        cure: What to change, and in which file.
    """

    id: str
    severity: Literal["fault", "note"]
    value: float | None
    unit: str
    text: str
    cure: str
