"""The setting of `coherent`, the same for every test that asks the neighbours of a failing point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dynslam_bench.core.settings import Scalar, tunable


def coherent_share(when: Mapping[str, Sequence[Scalar]]) -> Any:
    """A field for the share of the tested neighbours that must fail too, tunable under conditions on its siblings."""
    return tunable(
        0.4, low=0.0, high=0.8, limits=(0.0, 1.0), online=True, when=when,
        meaning="share of the tested points around a failing one that must fail too; 0 takes every failure for motion",
    )  # fmt: skip
