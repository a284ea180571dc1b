"""Scoring stored runs; runs are never made again for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dynslam_bench.evaluation.protocol import PROTOCOLS, Protocol, get_protocol

from .evaluating import DEFAULT_PROTOCOL
from .record import MetricRecord, RunRecord
from .store import RunStore

__all__ = ["DEFAULT_PROTOCOL", "Rescored", "rescore", "score"]


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


@dataclass(frozen=True)
class Rescored:
    """What scoring all runs of a store again has changed.

    Attributes:
        protocol: Id of the protocol.
        runs: Runs that were scored.
        changed: Ids of those whose stored metrics had other values.
        unreadable: Folders without a valid record, with reasons.
    """

    protocol: str
    runs: int
    changed: tuple[str, ...]
    unreadable: tuple[str, ...]


def rescore(
    store: RunStore, protocol: Protocol | str | None = None, *, on_progress: Callable[[int, int], None] | None = None
) -> list[Rescored]:
    """Compute the metrics of all stored runs again, whatever is stored.

    Args:
        store: The store.
        protocol: The protocol; None for every known one under which the store has metrics, at least the default one.
        on_progress: Called with how many runs were scored, of how many.

    Returns:
        What has changed, by protocol.
    """
    records, unreadable = store.all()
    ended = [record for record in records if record.status != "stopped"]
    if protocol is None:
        there = {folder.name for folder in (store.root / "metrics").glob("*")}
        chosen = [each for each in PROTOCOLS.values() if each.id == DEFAULT_PROTOCOL or each.digest() in there]
    else:
        chosen = [get_protocol(protocol)]
    outcomes = []
    for position, each in enumerate(chosen):
        changed = []
        for number, record in enumerate(ended):
            before = store.stored_metrics(record.run_id, each)
            after = score(store, record, each, again=True)
            if before is not None and (before.online, before.final) != (after.online, after.final):
                changed.append(record.run_id)
            if on_progress is not None:
                on_progress(position * len(ended) + number + 1, len(chosen) * len(ended))
        reasons = tuple(f"{bad.path}: {bad.reason}" for bad in unreadable)
        outcomes.append(Rescored(each.id, len(ended), tuple(changed), reasons))
    return outcomes
