"""Which images a training step learns from."""

from __future__ import annotations

from typing import Any

import numpy as np

from dynslam_bench.core.seeding import stream

from .prepared import Example, PreparedImages
from .settings import TrainSettings

_ORDER: dict[tuple[int, int, int], np.ndarray[Any, np.dtype[np.int64]]] = {}


def batch_of(sets: list[PreparedImages], settings: TrainSettings, step: int) -> list[Example]:
    """The step's images: sets in proportion to their size, every image once an epoch, in random order."""
    sizes = [len(one) for one in sets]
    total = sum(sizes)
    examples = []
    for position in range(step * settings.batch, (step + 1) * settings.batch):
        epoch, place = divmod(position, total)
        number = _permuted(place, total, settings.seed, epoch)
        chosen = 0
        while number >= sizes[chosen]:
            number -= sizes[chosen]
            chosen += 1
        examples.append(sets[chosen].varied(number, stream(settings.seed, "vary", position)))
    return examples


def _permuted(place: int, total: int, seed: int, epoch: int) -> int:
    key = (total, seed, epoch)
    if key not in _ORDER:
        _ORDER.clear()
        _ORDER[key] = stream(seed, "order", epoch).permutation(total)
    return int(_ORDER[key][place])
