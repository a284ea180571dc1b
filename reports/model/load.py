"""From results folders to rows: which runs count, scored under one protocol.

Rows of unchanged runs are taken from the store's SQLite index. Many runs are scored by several
processes.
"""

import os
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import starmap
from multiprocessing import get_context, parent_process
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from pydantic import ValidationError

from dynslam_bench.core import DynslamError, InfrastructureError, ReportError, translate_errors
from dynslam_bench.core.module_graph import PACKAGE, PLUMBING, module_graph
from dynslam_bench.evaluation.protocol import MONOCULAR, Protocol
from dynslam_bench.reports.model.programs import choose_runs
from dynslam_bench.reports.model.row import RunRow, grouped, make_row
from dynslam_bench.runs.store import RunStore, open_store, warn_of_unreadable

T = TypeVar("T")
OnProgress = Callable[[float, float | None, str], None]
"""Called as ``on_progress(done, total, what)``; the total is None where it is not known."""
MANY = 250
"""Runs from which on worker processes save more time than they need to start."""
MOST_WORKERS = 8
_AT_ONCE = 40
"""Jobs that a worker takes at once."""
_ROW_CODE = (f"{PACKAGE}.reports.model.row",)
"""What rows are computed by, with all that it uses."""


def no_progress(done: float, total: float | None, what: str) -> None:
    """Ignore progress."""


# -- worker processes


@contextmanager
def worker_pool(runs: int) -> Iterator[Executor | None]:
    """As many worker processes as so many runs are worth on this machine; None where they are worth none."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    if runs < MANY or cores == 1:
        yield None
        return
    context = get_context("spawn")  # a library cannot know which threads its caller has: no fork
    with ProcessPoolExecutor(min(cores, MOST_WORKERS), context, _start_worker) as pool:
        yield pool


def _start_worker() -> None:
    """Leave Ctrl-C to the parent process, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def run_jobs(
    pool: Executor | None, function: Callable[..., T], jobs: Sequence[tuple[Any, ...]]
) -> Iterator[T]:
    """Call a function once a job, in worker processes or here.

    Args:
        pool: The workers; None to call it here.
        function: A function of a module.
        jobs: Its arguments.

    Yields:
        The answers in the order of the jobs, each as soon as it is there.

    Raises:
        DynslamError: A job cannot be done.
        InfrastructureError: A worker has died.
    """
    if pool is None:
        yield from starmap(function, jobs)
        return
    with _without_main():
        answers = pool.map(function, *zip(*jobs, strict=True), chunksize=_AT_ONCE)
    with translate_errors(
        InfrastructureError, "a worker process of the report ended early", of=BrokenProcessPool
    ):
        yield from answers


@contextmanager
def _without_main() -> Iterator[None]:
    """Let workers start without the caller's script, which need not guard what it does at import.

    A worker that is spawned imports the parent's ``__main__`` before it does anything: a script without
    ``if __name__ == "__main__"`` would run again in every worker. The spawn and the forkserver contexts
    both do so, and neither has an option against it. They look the module up in `sys.modules` when a
    worker starts, so an empty one stands there meanwhile.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


# -- rows of unchanged runs


def _place(protocol: Protocol) -> tuple[str, str]:
    """Under which name and version a store's index holds the rows of a protocol."""
    return f"report {protocol.digest()}", module_graph().digest(_ROW_CODE, PLUMBING)


def _unchanged_rows(
    store: RunStore, protocol: Protocol, run_ids: Sequence[str]
) -> dict[str, RunRow]:
    """The rows of those runs that are unchanged, by run id; damaged rows, and rows of other runs, count as missing."""
    rows = {}
    for run_id, text in store.index.read(*_place(protocol), run_ids, check_links=True).items():
        with suppress(ValidationError):
            row = RunRow.model_validate_json(text)
            if (row.run_id, row.protocol_digest) == (run_id, protocol.digest()):
                row.store = store
                rows[run_id] = row
    return rows


def _score_run(store: RunStore, protocol: Protocol, run_id: str) -> tuple[RunRow, str] | str:
    """Read a run and score it: its row and the state of its files, or its folder and why that holds no valid record."""
    try:
        record, state = store.read_with_state(run_id)
        return make_row(store, record, protocol), state
    except DynslamError as error:
        return f"{store.place(run_id)}: {error}"


def _keep_rows(store: RunStore, protocol: Protocol, rows: Iterable[tuple[RunRow, str]]) -> None:
    """Keep rows for later reports, as far as the store can be written."""
    entries = []
    for row, state in rows:
        # half characters, of the name of a folder: the run is read every time
        with suppress(ValueError):
            entries.append((row.run_id, state, row.model_dump_json(exclude_defaults=True)))
    if entries:
        store.index.write(*_place(protocol), entries)


# -- runs that count


@dataclass
class Loaded:
    """Everything read from the stores.

    Attributes:
        rows: One run of every variant, column and repeat, see `model.programs.choose_runs`.
        superseded: How many others of them there were.
        in_future: Runs that started in the future by their records.
        not_installed: What of a ranked program is another one here, by its variant key, where
            several programs made runs and none of them is installed.
        stopped: How many runs were left out since they were ended on request.
        without_scale: How many were left out since their scale is unknown and the protocol's
            alignment finds none.
        trials: How many were left out since they are trials of studies.
        unreadable: Folders without a valid record, with reasons.
        conflicts: Runs that should be equal and are not, in words.
    """

    rows: list[RunRow] = field(default_factory=list)
    superseded: int = 0
    in_future: list[RunRow] = field(default_factory=list)
    not_installed: dict[str, str] = field(default_factory=dict)
    stopped: int = 0
    without_scale: int = 0
    trials: int = 0
    unreadable: list[str] = field(default_factory=list)
    conflicts: list[str] = field(default_factory=list)


def load_runs(
    stores: Sequence[RunStore],
    protocol: Protocol,
    on_progress: OnProgress = no_progress,
    pool: Executor | None = None,
    *,
    trials: bool = False,
) -> Loaded:
    """Read all runs of some stores and score them under a protocol; SLAM is never run again for it.

    Args:
        stores: The stores.
        protocol: How to evaluate.
        on_progress: As in `build_report`.
        pool: Workers that score the runs; None to score them here.
        trials: Whether trials of studies count like other runs.

    Raises:
        ReportError: There is no run at all.
    """
    on_progress(0, None, "looking for what has changed")
    loaded = Loaded()
    everything = []
    for store in stores:
        run_ids = store.ids()
        unchanged = _unchanged_rows(store, protocol, run_ids)
        unread = [run_id for run_id in run_ids if run_id not in unchanged]
        scored: list[tuple[RunRow, str]] = []
        for done, answer in enumerate(
            run_jobs(pool, _score_run, [(store, protocol, run_id) for run_id in unread]), 1
        ):
            if isinstance(answer, str):
                loaded.unreadable.append(answer)
                on_progress(done, len(unread), "")
            else:
                scored.append(answer)
                on_progress(
                    done, len(unread), f"scoring {answer[0].tracker.id} on {answer[0].sequence.id}"
                )
        _keep_rows(store, protocol, scored)
        everything += [*unchanged.values(), *(row for row, _ in scored)]
    warn_of_unreadable(loaded.unreadable)
    ended = [row for row in everything if row.status != "stopped"]
    scaled = [row for row in ended if protocol.finds_scale or row.tracker.sensors != "rgb"]
    rows = [row for row in scaled if trials or not row.trial_of]
    loaded.stopped = len(everything) - len(ended)
    loaded.without_scale, loaded.trials = len(ended) - len(scaled), len(scaled) - len(rows)
    loaded.conflicts = _two_results(rows)
    chosen = choose_runs(rows)
    loaded.rows = chosen.rows
    loaded.superseded = len(rows) - len(chosen.rows)
    loaded.in_future = chosen.in_future
    loaded.not_installed = chosen.not_installed
    if loaded.rows:
        return loaded
    if loaded.without_scale:
        raise ReportError(f"all {without_scale_words(loaded.without_scale, protocol)}")
    if loaded.trials:
        raise ReportError(f"all {trial_words(loaded.trials)}")
    places = ", ".join(str(store.source) for store in stores)
    raise ReportError(
        f"there are no runs in {places}", next(iter(loaded.unreadable), "make some with 'run'")
    )


def without_scale_words(count: int, protocol: Protocol) -> str:
    """Why runs of monocular trackers are in no table, and what shows them."""
    return (
        f"{count} runs of monocular trackers: their scale is unknown and {protocol.id} aligns without scale; "
        f"--protocol {MONOCULAR} shows them"
    )


def trial_words(count: int) -> str:
    """Why trials of studies are in no table, and which option shows them."""
    return (
        f"{count} runs that studies made with settings of their own, by which such settings are chosen; "
        "'report --trials' shows them"
    )


def _two_results(rows: Iterable[RunRow]) -> list[str]:
    """Which runs of one id from several stores have different results although they should be equal, in words."""
    conflicts = []
    for first, *others in grouped(rows, lambda row: row.run_id).values():
        errors = sorted(
            {row.metrics["ate_rmse_m"] for row in (first, *others) if "ate_rmse_m" in row.metrics}
        )
        if len(errors) > 1 and first.tracker.deterministic and not first.realtime:
            results = ", ".join(f"{1000 * error:.3f}" for error in errors)
            conflicts.append(
                f"{first.label} on {first.sequence.id} (run {first.run_id}): ATE {results} mm"
            )
    return conflicts


def check_one_protocol(rows: Sequence[RunRow]) -> None:
    """Refuse rows whose numbers were taken under different protocols.

    Raises:
        ReportError: Names the protocols and how many rows each has.
    """
    counts = Counter((row.protocol_id, row.protocol_digest) for row in rows)
    if len(counts) > 1:
        named = " and ".join(
            f"{name} [{digest}] ({count} rows)" for (name, digest), count in sorted(counts.items())
        )
        raise ReportError(
            f"one table cannot mix {len(counts)} protocols: {named}",
            "score all runs under one protocol first",
        )


def open_stores(runs: Sequence[Path] | Sequence[str] | RunStore | Path | str) -> list[RunStore]:
    """Stores of results folders, and of archives of such.

    Raises:
        DynslamError: There are no runs in one.
    """
    if isinstance(runs, RunStore):
        return [runs]
    roots = [Path(runs)] if isinstance(runs, str | Path) else map(Path, runs)
    return [
        open_store(root.parent if root.name == "runs" and not (root / "runs").is_dir() else root)
        for root in roots
    ]
