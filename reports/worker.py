"""A helper process of a report, see `model.crew`: jobs come as lines of JSON on its input, answers go to its output.

The first line is the setup: protocol, the report's folder, time for pictures, and how many frames a run's page shows.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TextIO

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.reports.html.explore import write_pages
from dynslam_bench.reports.html.pictures import PictureBook
from dynslam_bench.reports.model.common_frames import Tracked, common_of
from dynslam_bench.reports.model.load import LoadedRun, RowCache
from dynslam_bench.reports.model.row import RunRow
from dynslam_bench.runs.store import RunStore

Job = Mapping[str, Any]
Told = Callable[[str], None]
"""Called as ``told(what)`` for every run that is done."""


class Worker:
    """What a helper can do.

    Args:
        setup: ``protocol``, ``output``, ``picture_seconds`` and ``most_frames``.
        told: Told of every run.
    """

    def __init__(self, setup: Job, told: Told) -> None:
        self._protocol = Protocol.model_validate_json(setup["protocol"])
        self._output = Path(setup["output"])
        self._book = PictureBook(self._output, setup["picture_seconds"])
        self._most = setup["most_frames"]
        self._told = told

    def do(self, kind: str, job: Job) -> Any:
        """One job of a kind."""
        return {"rows": self.rows, "pages": self.pages, "common": self.common}[kind](job)

    def rows(self, job: Job) -> list[Any]:
        """The rows of some runs: ``store`` is the folder of their store, ``runs`` holds their ids."""
        rows = RowCache(RunStore(job["store"]), self._protocol)
        taken, unreadable = rows.take_all(job["runs"], self._told)
        return [[each.answer() for each in taken], unreadable]

    def pages(self, job: Job) -> list[Any]:
        """Write the pages of some runs of one column; see `write_pages`."""
        share = {int(frame): value for frame, value in job["share"].items()}
        runs, shown = _loaded(job), set(job["shown"])
        return write_pages(runs, shown, share, self._protocol, self._book, self._most, lambda: self._told("")).answer()

    def common(self, job: Job) -> list[Any]:
        """Errors of the runs on one sequence on the frames that all of them have; see `common_of`."""
        return list(common_of([Tracked(**each) for each in job["runs"]], self._protocol))


def _loaded(job: Job) -> list[LoadedRun]:
    """The runs of a job."""
    runs = []
    for each in job["runs"]:
        store, row = RunStore(each["store"]), RunRow.model_validate(each["row"])
        runs.append(LoadedRun(row, each["part"], store))
    return runs


def main(source: TextIO, target: TextIO) -> None:
    """Answer until the input ends."""

    def say(**message: Any) -> None:
        target.write(json.dumps(message) + "\n")
        target.flush()

    worker = Worker(json.loads(source.readline()), lambda what: say(done=1, what=what))
    for line in source:
        asked = json.loads(line)
        try:
            say(answer=worker.do(asked["kind"], asked["job"]))
        except DynslamError as error:
            say(fault=[str(error.args[0]), error.hint])


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever else is printed is no answer
    try:
        main(sys.stdin, answers)
    except BrokenPipeError:  # whoever asked is gone, and with it everybody who could be told
        os._exit(1)
