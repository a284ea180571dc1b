"""Data sets as plug-ins: each serves the sequences below one prefix, ``tum/...`` for example."""

from __future__ import annotations

from collections.abc import Iterable

from dynslam_bench.contracts.sequence import DatasetSpec
from dynslam_bench.core.plugins import Registry

__all__ = ["DATASETS", "DatasetSpec"]


def _builtin() -> Iterable[DatasetSpec]:
    from ..catalogue import builtin_datasets

    return builtin_datasets()


DATASETS: Registry[DatasetSpec] = Registry("sequences", DatasetSpec, _builtin)
