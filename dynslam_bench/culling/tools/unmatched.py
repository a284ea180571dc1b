"""What becomes of a feature whose flow failed: a setting of every system that tests matches."""

from __future__ import annotations

from typing import Literal

Unmatched = Literal["keep", "drop", "judge"]
"""It stays unjudged, it goes, or it is judged by the place where it was lost."""
