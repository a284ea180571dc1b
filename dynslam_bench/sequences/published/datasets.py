"""Data sets as plug-ins: each serves the sequences below one prefix, ``tum/...`` for example."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from dynslam_bench.core.plugins import Registry


@dataclass(frozen=True)
class DatasetSpec:
    """Announces a data set; importable without torch or OpenCV.

    Attributes:
        id: Prefix of its sequences: the data set ``mine`` serves ``mine/anything``.
        entry_point: ``"module:factory"``, called as ``factory(sequence_id, data_root=Path)``; it returns a
            `dynslam_bench.contracts.sequence.Sequence` or raises a `SequenceError`.
        sequences: Ids that are listed; the factory may accept more.
        summary: One line.
        license: SPDX id or remark.
        citation: What to cite.
    """

    id: str
    entry_point: str
    sequences: tuple[str, ...] = ()
    summary: str = ""
    license: str = ""
    citation: str = ""


def _builtin() -> Iterable[DatasetSpec]:
    from ..catalogue import builtin_datasets

    return builtin_datasets()


DATASETS: Registry[DatasetSpec] = Registry("sequences", DatasetSpec, _builtin)
