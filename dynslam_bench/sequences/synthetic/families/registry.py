"""All families of rendered sequences, and their ids."""

from __future__ import annotations

from .family import Family
from .loop import LOOP
from .twins import SITTING, WALKING

FAMILIES: dict[str, Family] = {family.name: family for family in (WALKING, SITTING, LOOP)}
TWIN_IDS = (*WALKING.ids(), *SITTING.ids())
"""The eight rendered twins of TUM's fr3 dynamic sequences."""
SYNTHETIC_IDS = tuple(name for family in FAMILIES.values() for name in family.ids())
"""Every rendered sequence that is listed, instance 0, default length."""
