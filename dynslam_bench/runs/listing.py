"""The list of the runs of a store with their errors; what scoring all runs again changes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass

from dynslam_bench.core import DynslamError
from dynslam_bench.core.module_graph import PLUMBING, module_graph
from dynslam_bench.core.records import digest
from dynslam_bench.evaluation import PROTOCOLS, Protocol, get_protocol
from dynslam_bench.runs.layout import Unreadable
from dynslam_bench.runs.rows import FIELDS, Row, make_run_row
from dynslam_bench.runs.store import DEFAULT_PROTOCOL, Records, RunStore, metrics_name

OnProgress = Callable[[int, int], None]
"""Called with how many runs are done, of how many."""
_PROGRESS_EVERY = 100
"""Runs of a list between two calls of `OnProgress`."""


def list_runs(
    store: RunStore,
    protocol: Protocol | str = DEFAULT_PROTOCOL,
    *,
    on_progress: OnProgress = lambda done, total: None,
) -> tuple[list[Row], list[Unreadable]]:
    """Every run as `make_run_row` gives it, from the oldest to the newest, and the folders that hold no valid record.

    Rows are taken from the store's index while the files of their run are the same; a store that
    cannot be written is read without it.

    Args:
        store: The store.
        protocol: What the errors hold under; runs that were not scored under it are scored now.
        on_progress: Called now and then.
    """
    protocol = get_protocol(protocol)
    # rows of the index hold for one protocol, one version of this code and the present columns
    name = f"list {protocol.digest()}"
    version = digest([module_graph().digest([__name__], PLUMBING), *FIELDS])
    ids = store.ids()
    rows: dict[str, Row] = {}
    for run_id, text in store.index.read(name, version, ids).items():
        row = _parsed_row(run_id, text)
        if row is not None:
            rows[run_id] = row

    # all other rows are made of the records
    entries: list[tuple[str, str, str]] = []
    unreadable: list[Unreadable] = []
    for position, run_id in enumerate(ids):
        if position % _PROGRESS_EVERY == 0:
            on_progress(position, len(ids))
        if run_id in rows:
            continue
        try:
            record, state = store.read_with_state(run_id)
            metrics = None if record.status == "stopped" else store.score(record, protocol)
            rows[run_id] = make_run_row(record, metrics)
            entries.append((run_id, state, json.dumps(list(rows[run_id].values()))))
        except DynslamError as error:
            unreadable.append(Unreadable(store.shown_folder(run_id), str(error)))
    store.index.write(name, version, entries)
    return sorted(rows.values(), key=lambda row: (row["started"], row["run_id"])), unreadable


def _parsed_row(run_id: str, text: str) -> Row | None:
    """A row of the index, if it is one of that run, and can be sorted."""
    try:
        row = dict(zip(FIELDS, json.loads(text), strict=True))
    except (ValueError, TypeError, RecursionError):
        return None
    return row if row["run_id"] == run_id and isinstance(row["started"], str) else None


@dataclass(frozen=True)
class Rescored:
    """Runs whose metrics changed when all runs of a store were scored again.

    Attributes:
        protocol: Id of the protocol.
        runs: Runs that were scored.
        changed: Ids of those whose stored metrics had other values.
        unreadable: Folders without a valid record, or with a damaged trajectory, with reasons; they
            are not scored.
    """

    protocol: str
    runs: int
    changed: tuple[str, ...]
    unreadable: tuple[str, ...]


def rescore(
    store: RunStore,
    protocol: Protocol | str | None = None,
    *,
    on_progress: OnProgress = lambda done, total: None,
) -> list[Rescored]:
    """Compute the metrics of all stored runs again, whatever is stored.

    Args:
        store: The store.
        protocol: The protocol; None for every known one under which the store has metrics, at least
            the default one.
        on_progress: Called after every run.

    Returns:
        What has changed, by protocol.
    """
    ended, unreadable = _scorable_runs(store)
    reasons = tuple(f"{entry.path}: {entry.reason}" for entry in unreadable)
    protocols = _protocols_in_use(store) if protocol is None else [get_protocol(protocol)]
    total = len(protocols) * len(ended)
    outcomes: list[Rescored] = []
    for current in protocols:
        changed = []
        for number, record in enumerate(ended, start=1):
            before = store.index.last(metrics_name(current), record.run_id)
            after = store.score(record, current, again=True)
            if before is not None and _evaluations(before) != _evaluations(after.to_line()):
                changed.append(record.run_id)
            on_progress(len(outcomes) * len(ended) + number, total)
        outcomes.append(Rescored(current.id, len(ended), tuple(changed), reasons))
    return outcomes


def _scorable_runs(store: RunStore) -> tuple[Records, list[Unreadable]]:
    """The runs that were not stopped and whose files can be read, and the folders that cannot be read."""
    records, unreadable = store.all()
    readable = []
    for record in records:
        if record.status == "stopped":
            continue
        try:
            store.check(record)
            readable.append(record.run_id)
        except DynslamError as error:
            unreadable.append(Unreadable(store.shown_folder(record.run_id), str(error)))
    return Records(store, readable), unreadable


def _protocols_in_use(store: RunStore) -> list[Protocol]:
    """The known protocols under which a store has metrics, and the default one."""
    names = store.index.names()
    return [
        protocol
        for protocol in PROTOCOLS.values()
        if protocol.id == DEFAULT_PROTOCOL or metrics_name(protocol) in names
    ]


def _evaluations(text: str) -> object:
    """The evaluations of a metrics record; its text where it is damaged."""
    try:
        record = json.loads(text)
        return [record[name] for name in ("online", "final")]
    except (ValueError, LookupError, TypeError, RecursionError):
        return text
