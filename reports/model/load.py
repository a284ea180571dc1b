"""From results folders to rows: which runs count, scored under one protocol.

Rows of unchanged runs are taken from the store's SQLite index. Many runs are scored by several
processes, see `model.workers`.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from dynslam_bench.core import DynslamError, ReportError
from dynslam_bench.core.module_graph import PACKAGE, PLUMBING, module_graph
from dynslam_bench.evaluation.protocol import MONOCULAR, PROTOCOLS, Protocol
from dynslam_bench.reports.model.programs import choose_runs
from dynslam_bench.reports.model.row import RunRow, grouped, make_row
from dynslam_bench.reports.model.workers import WorkerPool, run_jobs
from dynslam_bench.runs.store import RunStore, open_store, warn_of_unreadable

OnProgress = Callable[[float, float | None, str], None]
"""Called as ``on_progress(done, total, what)``; the total is None where it is not known."""
_ROW_CODE = (f"{PACKAGE}.reports.model.row",)
"""Modules that compute rows, with all that they use."""


def no_progress(done: float, total: float | None, what: str) -> None:
    """Ignore progress."""


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
        return f"{store.shown_folder(run_id)}: {error}"


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
class LoadedRuns:
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
        monocular: One run of every variant, column and repeat of the trackers whose scale is
            unknown, scored with the scale of the truth.
        protocol_note: Why another protocol than the one asked for took its place; else empty.
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
    monocular: list[RunRow] = field(default_factory=list)
    protocol_note: str = ""


def load_for_report(
    stores: Sequence[RunStore],
    protocol: Protocol,
    on_progress: OnProgress = no_progress,
    pool: WorkerPool | None = None,
    *,
    trials: bool = False,
) -> tuple[LoadedRuns, Protocol]:
    """Read all runs for a report in which nobody is left out.

    Where all runs have final trajectories only, the protocol's variant for those takes its place.
    Runs of monocular trackers are scored under its variant with Sim(3) alignment.

    Args:
        stores: The stores.
        protocol: How to evaluate.
        on_progress: Told of what is done, of how much, and what is going on, see `OnProgress`.
        pool: Workers that score the runs; None to score them here.
        trials: Whether the trials of studies count like other runs.

    Returns:
        The runs, and the protocol that they are scored under.

    Raises:
        ReportError: There is no run at all.
    """
    scaled = PROTOCOLS.get(f"{protocol.id}-sim3")
    try:
        loaded = load_runs(stores, protocol, on_progress, pool, trials=trials)
    except ReportError:
        if scaled is None:
            raise
        # monocular trackers alone; where there is no run at all, this says so again
        loaded = load_runs(stores, scaled, on_progress, pool, trials=trials)
        words = "All trackers are monocular: they are scored with the scale of the truth"
        loaded.protocol_note = f"{words}, under {scaled.id}."
        return loaded, scaled

    # final trajectories alone
    final = PROTOCOLS.get(f"{protocol.id}-final")
    if final is not None and all(map(_has_final_only, loaded.rows)):
        loaded = load_runs(stores, final, on_progress, pool, trials=trials)
        words = "All runs have final trajectories only, which use later frames"
        loaded.protocol_note = f"{words}: they are scored under {final.id}."
        protocol = final

    # monocular trackers beside others
    if loaded.without_scale and scaled is not None:
        everything = load_runs(stores, scaled, on_progress, pool, trials=trials)
        loaded.monocular = [row for row in everything.rows if row.tracker.sensors == "rgb"]
        loaded.without_scale = 0
    return loaded, protocol


def _has_final_only(row: RunRow) -> bool:
    """Whether nothing but the final trajectory of a run is known."""
    return not row.metrics and row.final_ate_m is not None


def load_runs(
    stores: Sequence[RunStore],
    protocol: Protocol,
    on_progress: OnProgress = no_progress,
    pool: WorkerPool | None = None,
    *,
    trials: bool = False,
) -> LoadedRuns:
    """Read all runs of some stores and score them under a protocol; SLAM is never run again for it.

    Args:
        stores: The stores.
        protocol: How to evaluate.
        on_progress: Told of what is done, of how much, and what is going on, see `OnProgress`.
        pool: Workers that score the runs; None to score them here.
        trials: Whether trials of studies count like other runs.

    Raises:
        ReportError: There is no run at all.
    """
    # read every store: unchanged rows from its index, the others from the runs' files
    on_progress(0, None, "looking for what has changed")
    loaded = LoadedRuns()
    everything = []
    for store in stores:
        run_ids = store.ids()
        unchanged = _unchanged_rows(store, protocol, run_ids)
        unread = [run_id for run_id in run_ids if run_id not in unchanged]
        scored, unreadable = _score_runs(store, protocol, unread, on_progress, pool)
        _keep_rows(store, protocol, scored)
        everything += [*unchanged.values(), *(row for row, _ in scored)]
        loaded.unreadable += unreadable
    warn_of_unreadable(loaded.unreadable)

    # leave out stopped runs, runs of unknown scale, and trials of studies
    ended = [row for row in everything if row.status != "stopped"]
    scaled = [row for row in ended if protocol.finds_scale or row.tracker.sensors != "rgb"]
    rows = [row for row in scaled if trials or not row.trial_of]
    loaded.stopped = len(everything) - len(ended)
    loaded.without_scale = len(ended) - len(scaled)
    loaded.trials = len(scaled) - len(rows)

    # of several runs of one request take one
    loaded.conflicts = _conflicting_results(rows)
    chosen = choose_runs(rows)
    loaded.rows = chosen.rows
    loaded.superseded = len(rows) - len(chosen.rows)
    loaded.in_future = chosen.in_future
    loaded.not_installed = chosen.not_installed
    if loaded.rows:
        return loaded

    # no run is left: say why
    if loaded.without_scale:
        raise ReportError(f"all {without_scale_words(loaded.without_scale, protocol)}")
    if loaded.trials:
        raise ReportError(f"all {trial_words(loaded.trials)}")
    places = ", ".join(str(store.source) for store in stores)
    raise ReportError(
        f"there are no runs in {places}", next(iter(loaded.unreadable), "make some with 'run'")
    )


def _score_runs(
    store: RunStore,
    protocol: Protocol,
    run_ids: Sequence[str],
    on_progress: OnProgress,
    pool: WorkerPool | None,
) -> tuple[list[tuple[RunRow, str]], list[str]]:
    """Score runs of a store.

    Returns:
        The rows with the states of their runs' files, and the folders without a valid record, with
        reasons.
    """
    scored = []
    unreadable = []
    jobs = [(store, protocol, run_id) for run_id in run_ids]
    for done, answer in enumerate(run_jobs(pool, _score_run, jobs), 1):
        if isinstance(answer, str):
            unreadable.append(answer)
            on_progress(done, len(jobs), "")
        else:
            row, _ = answer
            scored.append(answer)
            on_progress(done, len(jobs), f"scoring {row.tracker.id} on {row.sequence.id}")
    return scored, unreadable


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


def _conflicting_results(rows: Iterable[RunRow]) -> list[str]:
    """Describe runs of one id from several stores whose results differ although they should be equal."""
    conflicts = []
    for same_run in grouped(rows, lambda row: row.run_id).values():
        first = same_run[0]
        is_deterministic = first.tracker.deterministic and not first.realtime
        errors_m = {row.metrics["ate_rmse_m"] for row in same_run if "ate_rmse_m" in row.metrics}
        if len(errors_m) > 1 and is_deterministic:
            results = ", ".join(f"{1000 * error:.3f}" for error in sorted(errors_m))
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
    stores = []
    for root in roots:
        # the folder ``runs`` of a results folder stands for that
        is_inner = root.name == "runs" and not (root / "runs").is_dir()
        stores.append(open_store(root.parent if is_inner else root))
    return stores
