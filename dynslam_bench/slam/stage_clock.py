"""How long each stage of a frame took."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Protocol


class CachedStage(Protocol):
    """A stage that may have answered its last call from the stage cache.

    Attributes:
        hit: Whether it did.
        saved_s: Seconds that this saved.
    """

    hit: bool
    saved_s: float


class StageClock:
    """Wall-clock seconds by stage, in the order of first use; what the stage cache saved is added again.

    Args:
        cached: Stages that answer from the stage cache, by name.
    """

    def __init__(self, cached: Mapping[str, CachedStage]) -> None:
        self.seconds: dict[str, float] = {}
        self._cached = cached

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time what happens inside as part of a stage."""
        cached = self._cached.get(stage)
        if cached is not None:
            cached.hit, cached.saved_s = False, 0.0
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start + (0.0 if cached is None else cached.saved_s)
            self.seconds[stage] = self.seconds.get(stage, 0.0) + elapsed
