"""Rows that a report has taken before, a line each in the store's ``index/``: an unchanged run is not read again.

A line holds for one state of everything that a row is taken from: the files of the run, its stored errors, and the
ground truth of its part of the sequence; the name of the file stands for the protocol and for the code that took the
rows. The file may be deleted at any time. Whatever it says, rows are those of runs that lie in the store, and damaged
or outdated lines count as not there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, cast

from pydantic import TypeAdapter

import dynslam_bench
from dynslam_bench.core.collector import collector_paused
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.fingerprint import package_digest
from dynslam_bench.core.records import Digest, digest
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.runs.storage.line_file import add_lines, read_line_file, remove_older, write_line_file
from dynslam_bench.runs.storage.states import Stamp, folder_state, stamp_if_there
from dynslam_bench.runs.storage.store import RunStore

from .make_row import log_of, make_row
from .row import RunRow

_CODE = ("evaluation", "geometry", "reports/model", "runs/storage")
_MOST_STALE = 0.2
"""Share of lines that hold no longer from which on the file is written anew."""

_Line = tuple[Digest, Digest, str, str, int, int, RunRow | None]
_LINES: TypeAdapter[list[_Line]] = TypeAdapter(list[_Line])


@dataclass(frozen=True)
class KnownRow:
    """A run as a report takes it.

    Attributes:
        run_id: Its id.
        part: Its part of a sequence.
        run_state: Of its files, see `folder_state`.
        part_state: Of the ground truth and the stamps of its part.
        scored: Of its stored errors.
        row: Its row; None for a run that was stopped on request, which no report shows.
    """

    run_id: str
    part: str
    run_state: str
    part_state: str
    scored: Stamp
    row: RunRow | None

    def line(self) -> str:
        """The same as a line of JSON, without what the place of the store adds."""
        row = "null" if self.row is None else self.row.model_dump_json(exclude_defaults=True, exclude={"log"})
        words = ",".join(f'"{word}"' for word in (self.run_id, self.part, self.run_state, self.part_state))
        return f"[{words},{self.scored[0]},{self.scored[1]},{row}]"

    @classmethod
    def of(cls, line: _Line) -> KnownRow:
        """What a line says."""
        return cls(*line[:4], line[4:6], line[6])

    def answer(self) -> list[Any]:
        """The same as a helper's answer."""
        row = None if self.row is None else self.row.model_dump(mode="json")
        return [self.run_id, self.part, self.run_state, self.part_state, *self.scored, row]

    @classmethod
    def answered(cls, answer: Sequence[Any]) -> KnownRow:
        """What a helper has answered."""
        row = None if answer[6] is None else RunRow.model_validate(answer[6])
        return cls.of(cast(_Line, (*answer[:6], row)))


class KnownRows:
    """The rows of a store's runs under a protocol.

    Args:
        store: The store.
        protocol: How errors are computed.

    Attributes:
        store: The store.
    """

    def __init__(self, store: RunStore, protocol: Protocol) -> None:
        self.store, self._protocol, self._digest = store, protocol, protocol.digest()
        self._older = f"rows-{self._digest}-*"
        code = digest([dynslam_bench.__version__, package_digest(_CODE)])
        self._path = store.root / "index" / self._older.replace("*", f"{code}.jsonl")
        self._part_states: dict[str, str] = {}

    def read(self) -> tuple[list[KnownRow], list[str]]:
        """All that hold, and the ids of the runs of which none does."""
        with collector_paused():
            lines, damaged = read_line_file(self._path, _LINES)
            stored = self.store.ids()
            newest = {line[0]: line for line in lines}
            known = (KnownRow.of(newest[run_id]) for run_id in stored if run_id in newest)
            found = {each.run_id: each for each in known if self._holds(each)}
        count = len(lines) + damaged
        if count - len(found) > _MOST_STALE * count:
            write_line_file(self._path, _lines(found.values()), self._older)
        elif not count:
            remove_older(self._path, self._older)
        for run_id, each in found.items():
            if each.row is not None:
                each.row.log = log_of(self.store, run_id)
        return list(found.values()), [run_id for run_id in stored if run_id not in found]

    def take_all(self, run_ids: Iterable[str], told: Callable[[str], None]) -> tuple[list[KnownRow], list[str]]:
        """Read some runs, score them, and keep their rows for later reports, as far as the store can be written.

        Args:
            run_ids: Their ids.
            told: Called with what was done, once a run.

        Returns:
            The rows, and the folders without a valid record, with reasons.
        """
        taken: list[KnownRow] = []
        unreadable: list[str] = []
        for run_id in run_ids:
            try:
                known = self._take(run_id)
                taken.append(known)
                told("" if known.row is None else f"scoring {known.row.tracker} on {known.row.sequence}")
            except DynslamError as error:
                unreadable.append(f"{self.store.folder(run_id)}: {error}")
                told("")
        if taken:
            add_lines(self._path, _lines(taken))
        return taken, unreadable

    def _take(self, run_id: str) -> KnownRow:
        """Read a run and score it.

        Raises:
            DynslamError: It has no valid record.
        """
        run_state = self._run_state(run_id)  # before anything is read
        record = self.store.read_whole(run_id)
        part = record.sequence.part
        try:
            part_state = self._part_state(part)
        except DynslamError:  # why the run cannot be evaluated
            part_state = ""
        row = None if record.status == "stopped" else make_row(self.store, record, self._protocol)
        scored = self._scored(run_id)  # errors that were missing or out of date have just been written
        return KnownRow(run_id, part, run_state, part_state, scored, row)

    def _holds(self, known: KnownRow) -> bool:
        """Whether nothing has changed of what a row was taken from, and it is that of its run."""
        row = known.row
        if row is not None and (row.run_id, row.protocol_digest) != (known.run_id, self._digest):
            return False
        try:
            return (
                known.scored == self._scored(known.run_id)
                and known.run_state == self._run_state(known.run_id)
                and known.part_state == self._part_state(known.part)
            )
        except DynslamError:  # there is a link by now
            return False

    def _scored(self, run_id: str) -> Stamp:
        return stamp_if_there(f"{self.store.root}/metrics/{self._digest}/{run_id}.json")

    def _run_state(self, run_id: str) -> str:
        return folder_state(f"{self.store.runs}/{run_id}", self.store.root)

    def _part_state(self, part: str) -> str:
        """Of the files of a part when they were first asked for."""
        if part not in self._part_states:
            self._part_states[part] = folder_state(f"{self.store.root}/sequences/{part}", self.store.root)
        return self._part_states[part]


def _lines(rows: Iterable[KnownRow]) -> Iterator[str]:
    for row in rows:
        with suppress(ValueError):  # half characters, of the name of a folder: it is read every time
            yield row.line()
