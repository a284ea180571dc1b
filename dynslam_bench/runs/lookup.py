"""Finds the stored run of a request: the one of which all that was read is unchanged."""

from collections import defaultdict
from functools import cached_property

from dynslam_bench.core.reads import Verifier
from dynslam_bench.runs.identity import ResolvedRun
from dynslam_bench.runs.record import ASKED_DIGITS, RunRecord
from dynslam_bench.runs.store import RunStore


class LookUp:
    """Finds stored runs.

    A run of built-in parts is known by its id: all that it reads is known beforehand. What plug-ins
    and programs read stands in the record of each run that they made; of the runs of one request
    the one is taken whose files, environment variables and packages are unchanged.

    Args:
        store: Where the runs lie. Those that are stored later are not found.
    """

    def __init__(self, store: RunStore) -> None:
        self._store = store
        self._verifier = Verifier()

    def find(self, run: ResolvedRun) -> RunRecord | None:
        """The record of a run, None if there is none whose reads are unchanged.

        Of several the newest is taken: a file may have been changed and put back.
        """
        # a run of built-in parts is found by its id alone
        if not run.has_plugins_or_programs and run.run_id in self._stored_ids[run.request_digest]:
            record = self._store.get(run.run_id)
            if record is not None and record.identity == run.identity:
                return record
        matching = [record for record in self._candidates(run) if self._is_current(record, run)]
        return max(matching, key=lambda record: record.started, default=None)

    def changed(self, run: ResolvedRun) -> str:
        """Why none of the stored runs of a request can be taken; empty where one can, or none is stored."""
        candidates = self._candidates(run)
        if not candidates or self.find(run) is not None:
            return ""
        newest = max(candidates, key=lambda record: record.started)
        differing = [
            name for name, value in run.identity.items() if newest.identity.get(name) != value
        ]
        if differing:
            return ", ".join(differing)
        return (
            "" if newest.reads is None else self._verifier.changed(newest.reads, run.base_folders)
        )

    def _candidates(self, run: ResolvedRun) -> list[RunRecord]:
        """The stored runs of a request, whatever they have read."""
        records = map(self._store.get, self._stored_ids[run.request_digest])
        return [record for record in records if record is not None]

    @cached_property
    def _stored_ids(self) -> defaultdict[str, list[str]]:
        """The ids of the stored runs by their first digits: one listing serves many requests."""
        by_request: defaultdict[str, list[str]] = defaultdict(list)
        for run_id in self._store.ids():
            by_request[run_id[:ASKED_DIGITS]].append(run_id)
        return by_request

    def _is_current(self, record: RunRecord, run: ResolvedRun) -> bool:
        """Whether a stored run is what is asked for, and nothing that it read has changed."""
        known_before = {
            name: value for name, value in record.identity.items() if name in run.identity
        }
        if known_before != run.identity:
            return False
        if not run.has_plugins_or_programs:
            return True
        reads = record.reads
        return reads is not None and not self._verifier.changed(reads, run.base_folders)
