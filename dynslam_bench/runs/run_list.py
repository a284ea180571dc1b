"""All runs of a store as plain rows, fast: what was read once is kept in an index until the record changes."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from operator import itemgetter

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.runs.run_index import (
    FIELDS,
    FIRST,
    PART,
    RUN,
    STARTED,
    Line,
    Row,
    Stamps,
    add_verified,
    index_file,
    input_stamps,
    make_line,
    read_index,
    stamp_if_there,
    stamp_of,
    write_index,
)
from dynslam_bench.runs.scoring import DEFAULT_PROTOCOL
from dynslam_bench.runs.store import RUN_FILE, RunStore, Unreadable

OnProgress = Callable[[int, int], None]


def list_runs(
    store: RunStore,
    protocol: Protocol | str = DEFAULT_PROTOCOL,
    *,
    on_progress: OnProgress = lambda done, total: None,
) -> tuple[list[Row], list[Unreadable]]:
    """Every run as `run_row` gives it, from the oldest to the newest, and the folders that hold no valid record.

    Rows are taken from the store's index (see `run_index`) while the run's record and its stored errors are the same;
    a store that cannot be written is read without it.

    Args:
        store: The store.
        protocol: What the errors hold under; runs that were not scored under it are scored now.
        on_progress: Told of how many runs are done, of how many.
    """
    with collector_paused():
        return _list_runs(store, get_protocol(protocol), on_progress)


def _list_runs(store: RunStore, protocol: Protocol, on_progress: OnProgress) -> tuple[list[Row], list[Unreadable]]:
    path = index_file(store.root, protocol)
    index = read_index(path)
    known, is_whole = index.lines, index.is_whole
    kept: list[Line] = []
    unreadable: list[Unreadable] = []
    stored, runs, errors = store.ids(), str(store.runs), str(store.root / "metrics" / protocol.digest())
    parts = str(store.root / "sequences")
    errors_ns, _ = stamp_if_there(errors)
    as_verified = errors_ns == index.verified_ns != 0
    there = set(stored)
    ids = [run_id for run_id in known if run_id in there]  # in their order: nearly that of the list
    is_whole &= len(ids) == len(known)
    ids += [run_id for run_id in stored if run_id not in known]
    for position, run_id in enumerate(ids):
        if position % 100 == 0:
            on_progress(position, len(ids))
        try:
            line = known.get(run_id)
            scored = (
                stamp_if_there(f"{errors}/{run_id}.json") if line is None or not as_verified else (line[2], line[3])
            )
            stamps = (*stamp_of(f"{runs}/{run_id}/{RUN_FILE}"), *scored)
            if line is not None:
                stamps += input_stamps(runs, parts, run_id, line[PART])
            if line is None or (*line[:PART],) != stamps:
                is_whole = False
                line = _read(store, run_id, protocol, stamps[:4])
            kept.append(line)
        except (DynslamError, OSError) as error:
            is_whole &= run_id not in known
            unreadable.append(Unreadable(store.folder(run_id), str(error)))
    kept.sort(key=itemgetter(STARTED, RUN))
    if not is_whole:
        write_index(path, kept, errors_ns)
    elif not as_verified:
        add_verified(path, errors_ns)
    return [dict(zip(FIELDS, line[FIRST:], strict=True)) for line in kept], unreadable


def _read(store: RunStore, run_id: str, protocol: Protocol, stamps: Stamps) -> Line:
    """The line of a run that is in no index, or has changed since."""
    record = store.read_whole(run_id)
    inputs = input_stamps(str(store.runs), str(store.root / "sequences"), run_id, record.sequence.part)
    scored = None if record.status == "stopped" else store.score(record, protocol)
    # errors that were missing or out of date have just been written
    stamps = (*stamps[:2], *stamp_if_there(store.metric_file(run_id, protocol.digest())))
    return make_line(stamps + inputs, record, scored)


# Python's collector of cycles, out of the way while very many objects are made that all stay.


@contextmanager
def collector_paused() -> Iterator[None]:
    """No search for cycles while the block lasts: among 100,000 new lists it would be made again and again."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
