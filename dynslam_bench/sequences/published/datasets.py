"""Data sets as plug-ins: each serves the sequences below one prefix, ``tum/...`` for example."""

from __future__ import annotations

from collections.abc import Iterator

from dynslam_bench.contracts.sequence import DatasetSpec
from dynslam_bench.core.plugins import Registry

from ..synthetic import SYNTHETIC_IDS
from .entries import catalogue, public_datasets

__all__ = ["DATASETS", "DatasetSpec"]

OPENERS = "dynslam_bench.sequences.catalogue"
"""The module that opens sequences of the built-in data sets; loaded when the first one is opened."""


def _builtin() -> Iterator[DatasetSpec]:
    """The data sets that come with the package."""
    for name, first in public_datasets().items():
        ids = tuple(entry.id for entry in catalogue().values() if entry.dataset == name)
        yield DatasetSpec(name, f"{OPENERS}:open_public", ids, first.title, first.license, first.citation)
    summary = "rendered rooms with exact poses, masks and flow"
    yield DatasetSpec("synthetic", f"{OPENERS}:open_rendered", SYNTHETIC_IDS, summary, "CC0-1.0", "dynslam-bench")


DATASETS: Registry[DatasetSpec] = Registry("sequences", DatasetSpec, _builtin)
