"""Copies the runs of stores into one; nothing that it holds is changed."""

from __future__ import annotations

from collections.abc import Iterable

from dynslam_bench.core import DynslamError, InfrastructureError, RunError
from dynslam_bench.runs.layout import (
    FINAL,
    ONLINE,
    STAMPS,
    TRUTH,
    Unreadable,
    check_plain,
    have_equal_files,
)
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.store import Merged, RunStore


def merge(sources: Iterable[RunStore], store: RunStore, *, trials: bool = True) -> Merged:
    """Copy the runs of stores into one, with or without the trials of studies; nothing that it holds is changed.

    A run is left out if its record is damaged, its stamps are lost or it is removed meanwhile, or
    if the store holds another result under its id, other stamps or another ground truth of its
    sequence. ``latest`` leads to the newest of the others afterwards.

    Raises:
        InfrastructureError: The store cannot be written; the runs that were copied before stay.
    """
    merged = Merged([], [], [])
    newest = ("", "")
    store.prepare()
    for source in sources:
        records, unreadable = source.all()
        merged.left_out.extend(unreadable)
        for run_id in records.run_ids:
            try:
                # copy each run that may be copied, and is not there already
                record = source.read_whole(run_id)
                if record.trial_of and not trials:
                    continue
                if reason := _why_left_out(source, record, store):
                    raise RunError(reason)
                if store.get(run_id) is not None:
                    merged.stored.append(run_id)
                else:
                    store.copy_from(source, record)
                    merged.added.append(run_id)
            except InfrastructureError:
                raise
            except DynslamError as error:
                merged.left_out.append(Unreadable(source.shown_folder(run_id), str(error)))
                continue
            newest = max(newest, (record.started, run_id))
    # the link to the newest run
    if newest[1]:
        store.link_latest(newest[1])
    return merged


def _why_left_out(source: RunStore, record: RunRecord, store: RunStore) -> str:
    """Why a run of a store may not be copied into another one; empty if it may, or is there already."""
    # its sequence: plain files, with stamps, that agree with those of the other store
    part = record.sequence.part
    source_part = source.sequences.folder(part)
    target_part = store.sequences.folder(part)
    try:
        check_plain(source_part, source.root)
    except RunError as error:
        return str(error)
    if not (source_part / STAMPS).is_file():
        return f"{source.source} has lost the stamps of its sequence"
    is_part_known = (target_part / STAMPS).is_file()
    if is_part_known and not have_equal_files(source_part, target_part, STAMPS, TRUTH):
        return f"{store.source} holds other stamps or truth of its sequence"

    # the run: there with another result, or with files that have changed
    earlier = store.get(record.run_id)
    if earlier is not None:
        folders = (source.folder(record.run_id), store.folder(record.run_id))
        if earlier.status != record.status or not have_equal_files(*folders, ONLINE, FINAL):
            return f"{store.source} holds another result of this run"
    return source.changed(record)
