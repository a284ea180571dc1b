"""How closely a re-implementation follows its source."""

from __future__ import annotations

from typing import Literal

Provenance = Literal["own", "faithful-code", "faithful-paper", "inspired", "assumed", "external", "control"]
"""``faithful-code``: as the authors' code does; ``faithful-paper``: as the paper says; ``inspired``: its idea in
another form; ``assumed``: the source is silent on what matters; ``own``: put together here, no one paper or
program describes the whole; ``external``: somebody else's program;
``control``: a yardstick, no system."""
