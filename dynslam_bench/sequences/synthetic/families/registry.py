"""All families of rendered sequences, and their ids."""

from __future__ import annotations

from .conditions import CONDITIONS
from .crowd import CROWD
from .family import Family
from .fast import FAST
from .loop import LOOP
from .objects import OBJECTS
from .synchronous import SYNCHRONOUS
from .tracking import TRACKING
from .twins import SITTING, WALKING

FAMILIES: dict[str, Family] = {
    family.name: family for family in (WALKING, SITTING, LOOP, FAST, OBJECTS, CROWD, SYNCHRONOUS, TRACKING, *CONDITIONS)
}
TWIN_IDS = (*WALKING.ids(), *SITTING.ids())
"""The eight rendered twins of TUM's fr3 dynamic sequences."""
SYNTHETIC_IDS = tuple(name for family in FAMILIES.values() for name in family.ids())
"""Every rendered sequence that is listed, instance 0, default length."""
