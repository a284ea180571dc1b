"""Scoring stored runs; runs are never made again for it."""

from __future__ import annotations

from dynslam_bench.evaluation.protocol import Protocol

from .evaluating import DEFAULT_PROTOCOL
from .record import MetricRecord, RunRecord
from .store import RunStore

__all__ = ["DEFAULT_PROTOCOL", "score"]


def score(
    store: RunStore, record: RunRecord, protocol: Protocol | str = DEFAULT_PROTOCOL, *, again: bool = False
) -> MetricRecord:
    """The metrics of a stored run under a protocol, from its stored trajectories and ground truth.

    Args:
        store: Where the run lies.
        record: The run.
        protocol: A protocol or its id.
        again: Compute them even if they are stored.

    Returns:
        The metrics; evaluations that are not possible are None, with the reason.
    """
    return store.score(record, protocol, again=again)
