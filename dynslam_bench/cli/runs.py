"""``runs list|show|rescore|merge|export|rm``, ``bank add|verify|pull|push|reproduce|check|index``.

Beside these verbs: runs as the rows of a table.
"""

from __future__ import annotations

import re
import sys
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise, product
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Optional

import typer

from dynslam_bench import runs as stored
from dynslam_bench.cli.metric_tables import statistics_table
from dynslam_bench.cli.options import (
    AsJson,
    DataRoot,
    ProtocolId,
    Results,
    complete_sequences,
    complete_statuses,
    complete_trackers,
    names_of,
)
from dynslam_bench.cli.output import (
    SOME_RUNS_FAILED,
    announce,
    fields,
    json_mode,
    present,
    progress,
    table,
    warn,
    write,
    write_prose,
)
from dynslam_bench.core import (
    RunError,
    assignments,
    did_you_mean,
    label_text,
    translate_errors,
    write_atomic,
)
from dynslam_bench.core.number_text import mm
from dynslam_bench.core.version import install_hint

if TYPE_CHECKING:
    from dynslam_bench.runs.store import Merged

COLUMNS = {
    "run": "run_id",
    "tracker": "tracker",
    "ATE (mm)": "ate_rmse_m",
    "sequence": "sequence",
    "status": "status",
    "ms/frame": "frame_ms",
    "frames": "frames",
    "repeat": "repeat",
    "settings": "settings",
    "coverage": "coverage",
    "masks": "segmentation",
    "static camera (mm)": "static_camera_ate_rmse_m",
    "false motion (mm)": "false_motion_max_m",
    "identity": "identity",
    "from the store": "from_store",
    "study": "study",
}
"""Headings of the table, the most important first, and the names of what stands below them (see `make_run_row`)."""
_IN_METRES = ("ate_rmse_m", "static_camera_ate_rmse_m", "false_motion_max_m")
"""Errors of a row in metres, which are shown in millimetres."""
MOST_REMARKS = 10
"""Warnings, hints and reasons that are written below a table."""
HINT_FRAMES = 60
"""Frames of a recording that are checked when a run on it fails: a few seconds."""
COLOURS = {
    "ok": 32,
    "lost": 33,
    "stopped": 33,
    "crashed": 31,
    "timeout": 31,
    "out-of-memory": 31,
    "invalid": 31,
}
"""Colours of the statuses on a terminal, as ANSI codes."""
# Columns that `runs list` sorts by, and the names of those in a row that differ (see `make_run_row`).
SORTED_BY = ("started", "tracker", "sequence", "status", "ate", "ms", "coverage")
_SORT_KEYS = {"ate": "ate_rmse_m", "ms": "frame_ms"}
_ID_DIGITS = 8
"""Digits of an id that a terminal shows at least; runs of one request share their first twelve."""
# The folders of a path in a setting's value: `file=/data/maps/a.npz` is shown as `file=a.npz`.
_FOLDERS = re.compile(r"(?<==)(\w+:)?(?:~|\.{0,2})/(?:[^,/]*/)*")

app = typer.Typer(help="Stored runs.", no_args_is_help=True)
banks = typer.Typer(
    help="Banks: archives of trajectories with checksums, which are results folders.",
    no_args_is_help=True,
)
Folder = Annotated[Path, typer.Argument(metavar="BANK", help="Folder of the bank.")]


@app.command("list")
def list_(
    results: Results = Path("results"),
    status: Annotated[
        Optional[str],
        typer.Option(
            help="Only runs that ended so, e.g. ok or crashed.", autocompletion=complete_statuses
        ),
    ] = None,
    tracker: Annotated[
        Optional[str],
        typer.Option(
            help="Only trackers of this id, or with this in it.", autocompletion=complete_trackers
        ),
    ] = None,
    sequence: Annotated[
        Optional[str],
        typer.Option(
            help="Only sequences of this id, or with this in it.", autocompletion=complete_sequences
        ),
    ] = None,
    sort: Annotated[
        str,
        typer.Option(
            help=f"{', '.join(SORTED_BY)}; with a - before it the other way round.",
            autocompletion=lambda: list(SORTED_BY),
        ),
    ] = "started",
    protocol: ProtocolId = "tum-rgbd/v1",
    as_json: AsJson = False,
) -> None:
    """List the runs of a results folder, oldest first unless sorted otherwise."""
    # refuse names that no run can have
    if status not in (None, *complete_statuses()):
        raise RunError(f"unknown status '{status}'", did_you_mean(str(status), complete_statuses()))
    column = sort.removeprefix("-")
    if column not in SORTED_BY:
        raise RunError(f"runs are not sorted by '{column}'", did_you_mean(column, SORTED_BY))
    store = stored.open_store(results)
    with progress("reading runs") as advance:
        rows, unreadable = stored.list_runs(store, protocol, on_progress=advance)
    chosen = [
        row
        for row in rows
        if status in (None, row["status"])
        and (tracker or "") in row["tracker"]
        and (sequence or "") in row["sequence"]
    ]
    # runs without a value come last, in either direction
    key = _SORT_KEYS.get(column, column)
    with_value = [row for row in chosen if row[key] is not None]
    without_value = [row for row in chosen if row[key] is None]
    with_value.sort(key=itemgetter(key), reverse=sort.startswith("-"))
    show_rows(with_value + without_value, store, protocol)
    for file in unreadable:
        warn(f"unreadable: {file.path}: {file.reason}")


@app.command()
def show(
    run: Annotated[
        str, typer.Argument(help="The run's id, its first digits, or latest.")
    ] = "latest",
    results: Results = Path("results"),
    protocol: ProtocolId = "tum-rgbd/v1",
    as_json: AsJson = False,
) -> None:
    """Show everything about a run."""
    store = stored.open_store(results)
    record = store.read(run)
    metrics = store.score(record, protocol)
    # what it is and how it ended
    lines = [fields(run_facts(store, record))]

    # how long each stage of a frame took
    if record.timings:
        rows = [
            (name, 1000 * stage.median_s, 1000 * stage.p95_s, 1000 * stage.mean_s)
            for name, stage in record.timings.items()
        ]
        lines += ["", table(("stage", "median ms", "p95 ms", "mean ms"), rows)]

    # the errors of both trajectories
    for which, evaluation in (("online", metrics.online), ("final", metrics.final)):
        if evaluation is None:
            lines += ["", f"{which}: {metrics.reasons.get(which, 'not evaluated')}"]
        else:
            lines += [
                "",
                f"{which}: {evaluation.summary()}",
                statistics_table(evaluation.metrics),
                *evaluation.diagnostics,
            ]
    lines += metrics.remarks
    present(
        {"record": record, "metrics": metrics, "folder": store.shown_folder(record.run_id)}, *lines
    )


@app.command()
def rescore(
    results: Results = Path("results"),
    protocol: Annotated[Optional[str], typer.Option(help="Only under this one.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compute the errors of all runs again from their trajectories, and list those that have changed."""
    with progress("scoring runs") as advance:
        outcomes = stored.rescore(stored.open_store(results), protocol, on_progress=advance)
    lines = []
    for outcome in outcomes:
        changed = f"{len(outcome.changed)} with other errors than stored"
        if outcome.changed:
            changed += f": {', '.join(outcome.changed)}"
        plural = "s" if outcome.runs != 1 else ""
        lines.append(f"{outcome.protocol}: {outcome.runs} run{plural} scored, {changed}")
    present(outcomes, *lines)
    for reason in outcomes[0].unreadable if outcomes else ():
        announce(f"unreadable: {reason}")


@app.command()
def merge(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="RESULTS...", help="Results folders, or archives of them."),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Results folder that gets the runs.")
    ],
    as_json: AsJson = False,
) -> None:
    """Copy the runs of results folders into one; exit with 3 if another result of a run is there, which stays."""
    store = stored.RunStore(output)
    show_merged(stored.merge(map(stored.open_store, sources), store), str(store.root))


@app.command()
def export(
    output: Annotated[
        Path, typer.Argument(metavar="FILE", help="A .csv, or a .parquet (extra \\[parquet]).")
    ],
    results: Results = Path("results"),
    protocol: ProtocolId = "tum-rgbd/v1",
) -> None:
    """Write all runs but studies' trials, with their errors, into one table, as `RunStore.frame` has it."""
    from dynslam_bench.reports.tables.table import csv_text

    # the kind by the file's name
    kind = output.suffix.lower()
    if kind not in (".csv", ".parquet"):
        raise RunError(f"a table is not written as '{output.name}'", "name a .csv or .parquet file")
    frame = stored.open_store(results).frame(protocol)
    with translate_errors(
        RunError, f"cannot write {output}", install_hint("parquet"), of=ImportError
    ):
        write_atomic(output, csv_text(frame) if kind == ".csv" else frame.to_parquet())
    write(str(output))


@app.command()
def archive(
    server: Annotated[
        str,
        typer.Argument(
            help="eth3d or kitti.",
            autocompletion=names_of("runs.exchange.server_archives:SERVERS"),
        ),
    ],
    output: Annotated[Path, typer.Argument(metavar="FILE", help="The archive, a .zip.")],
    tracker: Annotated[
        str, typer.Option(help="Id or label of the tracker.", autocompletion=complete_trackers)
    ],
    online: Annotated[
        bool, typer.Option("--online", help="The causal poses, not the final ones.")
    ] = False,
    results: Results = Path("results"),
    as_json: AsJson = False,
) -> None:
    """Write a tracker's runs as an archive for the server of ETH3D or KITTI."""
    from dynslam_bench.runs.exchange.server_archives import write_server_archive

    which: Literal["online"] | None = "online" if online else None
    written = write_server_archive(server, output, tracker, results=results, which=which)
    lines = [f"{name}: run {run_id}" for name, run_id in sorted(written.runs.items())]
    present(written, *lines, str(written.file))
    for line in written.notes:
        announce(line)


def describe(
    source: Annotated[
        str,
        typer.Argument(
            help="Folder of a rendered sequence, a Minari data set or a bank; or a rendered id."
        ),
    ],
    url: Annotated[str, typer.Option(help="Where the data set is published.")] = "",
    creator: Annotated[str, typer.Option(help="Who publishes it.")] = "dynslam-bench contributors",
    data_root: DataRoot = None,
    as_json: AsJson = False,
) -> None:
    """Write Croissant metadata and a data card beside a data set."""
    from dynslam_bench.runs.exchange.dataset_metadata import describe_data

    described = describe_data(source, url=url, creator=creator, data_root=data_root)
    present(described, f"{described.kind}:", str(described.croissant), str(described.card))


@app.command()
def rm(
    runs: Annotated[Optional[list[str]], typer.Argument(help="Ids or their first digits.")] = None,
    results: Results = Path("results"),
    failed: Annotated[bool, typer.Option("--failed", help="All runs that failed.")] = False,
) -> None:
    """Delete runs and their metrics."""
    if not runs and not failed:
        raise RunError("no run was named", "name ids, or --failed")
    store = stored.RunStore(results)
    # named ones, and those that failed
    chosen = [store.find(run) for run in runs or ()]
    if failed and not store.ids():
        raise RunError(f"there are no runs in {store.root}", "name the folder with --results")
    if failed:
        chosen += [record.run_id for record in store.all()[0] if record.failed]
    for run_id in dict.fromkeys(chosen):
        store.remove(run_id)
        write(run_id)


@banks.command()
def add(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...", help="Results folders, and manifests of trajectories (.toml)."
        ),
    ],
    bank: Folder,
    protocol: Annotated[
        str, typer.Option(help="Protocol of a new bank's errors; default tum-rgbd/v1.")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Add runs without trials of studies; exit with 3 if one is left out, e.g. for another result that is there."""
    from dynslam_bench.runs.bank import add

    show_merged(add(sources, bank, protocol=protocol), str(bank))


@banks.command()
def verify(bank: Folder, as_json: AsJson = False) -> None:
    """Name each file that is missing, changed or not listed, and each record that does not fit; exit with 4 then."""
    from dynslam_bench.runs.bank import verify

    faults = verify(bank)
    present(
        {"faults": faults},
        *faults,
        f"{bank}: {len(faults)} fault{'s' * (len(faults) != 1)}",
        verified=not faults,
    )


@banks.command()
def pull(
    source: Annotated[
        str,
        typer.Argument(help="A bank: a folder, a git repository, or an archive's https address."),
    ],
    bank: Folder,
    as_json: AsJson = False,
) -> None:
    """Add the runs of another bank; refuse it if it has faults."""
    from dynslam_bench.runs.bank import pull

    show_merged(pull(source, bank), str(bank))


@banks.command()
def push(
    bank: Folder,
    target: Annotated[
        str, typer.Argument(help="A folder, or a git repository, which gets a commit.")
    ],
    as_json: AsJson = False,
) -> None:
    """Add the runs of a bank to another one; refuse if either has faults."""
    from dynslam_bench.runs.bank import push

    show_merged(push(bank, target), target)


@banks.command()
def reproduce(
    bank: Folder,
    row: Annotated[str, typer.Argument(help="Id of the row, or its first digits.")],
    by: Annotated[str, typer.Option("--by", help="Your name, as the mark shows it.")],
    tracker: Annotated[
        str, typer.Option(help="Where the tracker is here, if its id does not find it.")
    ] = "",
    sequence: Annotated[
        str, typer.Option(help="Folder of the sequence here, if its id does not find it.")
    ] = "",
    repeats: Annotated[
        int, typer.Option(min=1, help="Further starts, run where the result is not equal.")
    ] = 2,
    results: Annotated[Path, typer.Option(help="Results folder for the new runs.")] = Path(
        "results/reproduced"
    ),
    data_root: DataRoot = None,
    as_json: AsJson = False,
) -> None:
    """Run a row again, and add a mark if it comes out as it did; exit with 4 if it does not."""
    from dynslam_bench.runs.reproducing import reproduce as run_again

    with progress("reproducing") as advance:
        done = run_again(
            bank,
            row,
            by=by,
            tracker=tracker,
            sequence=sequence,
            repeats=repeats,
            results=results,
            data_root=data_root,
            on_step=lambda step: advance(0, None, step),
        )
    lines = [f"{done.mark.run_id}: {done.describe()}"]
    if done.mark.changed:
        lines.append(f"other parts here: {', '.join(done.mark.changed)}")
    lines.append(f"marked by {by}" if done.reproduced else f"no mark; the new run is {done.folder}")
    present({"reproduced": done.reproduced, "mark": done.mark}, *lines, verified=done.reproduced)


@banks.command()
def check(
    submission: Annotated[Path, typer.Argument(help="A bank with the rows that are to be added.")],
    bank: Annotated[
        Optional[Path], typer.Option("--bank", help="The bank that is to get them.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Say whether a submission is accepted: exit with 0 if it is, with 4 if not, with 1 if it is no bank."""
    from dynslam_bench.runs.submissions import check_submission

    checked = check_submission(submission, bank)
    facts = f"{checked.rows} rows, {len(checked.new)} new"
    verdict = f"accepted: {facts}, errors under {checked.protocol}"
    if not checked.accepted:
        verdict = f"refused: {len(checked.faults)} fault{'s' * (len(checked.faults) != 1)}"
    present(
        {**asdict(checked), "accepted": checked.accepted},
        *checked.faults,
        f"{checked.checker}: {submission} is {verdict}",
        verified=checked.accepted,
    )


@banks.command()
def index(bank: Folder, as_json: AsJson = False) -> None:
    """List the rows of a bank, and write its index page: sequences, trackers, protocol, rows, marks."""
    from dynslam_bench.runs.bank_index import write_bank_index

    page, rows = write_bank_index(bank)
    columns = ("row", "tracker", "sequence", "ATE (mm)", "standing", "status", "coverage")
    cells = [
        (
            row.run_id,
            row.tracker,
            row.sequence,
            None if row.ate_m is None else 1000 * row.ate_m,
            row.standing,
            row.status,
            row.coverage,
        )
        for row in rows
    ]
    present({"page": page, "rows": [asdict(row) for row in rows]}, table(columns, cells), str(page))


def show_merged(merged: Merged, target: str) -> None:
    """Show what was copied into a store; exit with 3 if something was left out."""
    plural = "s" if len(merged.added) != 1 else ""
    copied = f"{len(merged.added)} run{plural} copied to {target}"
    others = f"{len(merged.stored)} were there already, {len(merged.left_out)} left out"
    present(merged, f"{copied}, {others}")
    for entry in merged.left_out:
        warn(f"left out {entry.path}: {entry.reason}")
    if merged.left_out:
        raise typer.Exit(SOME_RUNS_FAILED)


def run_facts(store: stored.RunStore, record: stored.RunRecord) -> dict[str, Any]:
    """The facts of a run by name; empty values are not shown."""
    from dynslam_bench.runs.record import coverage_text

    # empty and zero values stand for "nothing to say"
    identity = "unverified: its id does not tell the contents of data and code"
    return {
        "run": record.run_id,
        "folder": store.shown_folder(record.run_id),
        "identity": "" if record.verified else identity,
        "status": record.status,
        "reason": record.reason,
        "tracker": f"{record.tracker.label} [{record.tracker.id}, {record.tracker.provenance}]",
        "sequence": record.sequence.id,
        "frames": stored.part_words(record),
        "tracked": record.poses_words,
        "lost": record.n_lost,
        "initialising": record.n_initialising or None,
        "coverage": coverage_text(record.coverage, record.truth_share),
        "repeat": record.repeat,
        "masks": record.segmentation,
        "device": record.device,
        "threads": record.threads,
        "study": record.study,
        "started": record.started,
        "wall_s": record.wall_s,
        "peak_memory_mb": record.peak_memory_mb,
        "keyframes": record.keyframes,
        "map_points": record.map_points,
        "maps": record.maps,
        "overrides": assignments(record.overrides),
        "notes": record.notes,
        "command": " ".join(record.command),
    }


def show_runs(
    records: Iterable[stored.RunRecord],
    store: stored.RunStore,
    protocol: str,
    reused: Collection[str] = (),
) -> list[dict[str, Any]]:
    """Show runs with their errors under a protocol, as a table or JSON.

    Args:
        records: The runs.
        store: Store that holds the runs.
        protocol: How their errors are evaluated.
        reused: Ids of the runs that are marked as taken from the store.

    Returns:
        The table's rows, see `make_run_row`.
    """
    rows = []
    for record in records:
        # a stopped run has no errors
        metrics = None if record.status == "stopped" else store.score(record, protocol)
        rows.append(stored.make_run_row(record, metrics) | {"from_store": record.run_id in reused})
    if len(rows) == 1 and not json_mode():
        show_run(rows[0], store)
    else:
        show_rows(rows, store, protocol)
    return rows


def covariance_words(row: Mapping[str, Any]) -> str:
    """How the covariances of a run's motions fit its errors; empty for a tracker that gives none."""
    parts = []
    for span, over in (("1f", "one frame"), ("1s", "one second")):
        ratio = row.get(f"nees_{span}_mean")
        if ratio is not None:
            within = row.get(f"within95_{span}", 0.0)
            parts.append(
                f"NEES / 6 {ratio:.3g} over {over} ({within:.0%} within the 95 % ellipsoid)"
            )
    return ", ".join(parts)


def show_run(row: Mapping[str, Any], store: stored.RunStore) -> None:
    """Show a single run in a few lines: its errors in millimetres, its trajectory, what is to be said of it."""
    record = store.read_whole(row["run_id"])
    part = f" [{row['frames']}]" if row["frames"] else ""
    where = f"{label_text(row['tracker'])} on {row['sequence']}{part}, {row['repeat']}"
    write(f"{where}: {row['status']}{' (from the store)' if row['from_store'] else ''}")

    # the error beside that of a camera that does not move
    error = ""
    if row["ate_rmse_m"] is not None:
        error = f"{mm(row['ate_rmse_m'])} mm"
    static_m = row["static_camera_ate_rmse_m"]
    if error and static_m and row["false_motion_max_m"] is None:
        error += f", not moving {mm(static_m)} mm"
    false_motion = row["false_motion_max_m"]

    # the trajectories that the run left
    trajectories = {}
    for name, which in (("trajectory", "online"), ("final trajectory", "final")):
        path = store.folder(row["run_id"]) / f"trajectory_{which}.txt"
        if path.is_file():
            trajectories[name] = str(path)
    facts = {
        "ATE": error,
        "false motion": "" if false_motion is None else f"{mm(false_motion)} mm at most",
        "covariances": covariance_words(row),
        "tracked": record.poses_words,
        "time": "" if row["frame_ms"] is None else f"{row['frame_ms']:.3g} ms a frame",
        "settings": shown_cell("settings", row["settings"]),
        "masks": shown_cell("segmentation", row["segmentation"]),
        "identity": row["identity"],
        **trajectories,
        "run": row["run_id"],
    }
    write(fields(facts))
    for line in summary_lines([dict(row)]):
        write_prose(line)
    show_remarks([dict(row)])


def show_rows(rows: Sequence[dict[str, Any]], store: stored.RunStore, protocol: str) -> None:
    """Show rows as `list_runs` gives them, as a table or JSON; the table has the columns in which a run has a value."""
    if json_mode():
        present(
            [
                row | {"protocol": protocol, "folder": store.shown_folder(row["run_id"])}
                for row in rows
            ]
        )
        return
    # columns without any value are left out
    columns = {
        title: name
        for title, name in COLUMNS.items()
        if any(row.get(name) not in (None, "") and row[name] is not False for row in rows)
    }
    # a terminal gets short ids, and a pipe whole ones
    shown = list(rows)
    if sys.stdout.isatty():
        short = short_ids([*store.ids(), *(row["run_id"] for row in rows)])
        shown = [row | {"run_id": short[row["run_id"]]} for row in rows]
    # the table, what it comes to, and the remarks on its runs
    cells = [[shown_cell(name, row[name]) for name in columns.values()] for row in shown]
    write(table(list(columns), cells), colours=COLOURS)
    for line in summary_lines(rows):
        write_prose(line)
    show_remarks(rows)


def summary_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Lines below a table of runs: how many are not ok, or worse than a static camera; what the ATE is of."""
    lines = []
    # runs that failed, were lost or stopped, by status
    counts = Counter(row["status"] for row in rows if row["status"] != "ok")
    if counts and len(rows) > 1:
        statuses = ", ".join(f"{count} {status}" for status, count in counts.items())
        lines.append(f"{counts.total()} of {len(rows)} runs are not ok: {statuses}.")

    # false motion is measured where the true camera stands still: no bound there
    moving = [row for row in rows if row["false_motion_max_m"] is None]
    errors = [(row["ate_rmse_m"], row["static_camera_ate_rmse_m"]) for row in moving]
    worse = sum(None not in pair and pair[0] > (1 + 1e-9) * pair[1] for pair in errors)
    if worse and len(rows) == 1:
        lines.append("The run is worse than a static camera.")
    elif worse:
        lines.append(f"{worse} of {len(rows)} runs are worse than a static camera.")

    # lost frames are in no ATE: it must not be compared as it stands
    scored = [row for row in rows if None not in (row["ate_rmse_m"], row["coverage"])]
    if any(row["coverage"] < 1 for row in scored):
        lines.append(
            "ATE: of the tracked frames alone; static camera: of all. A report uses hold-last-pose."
        )
    return lines


def show_remarks(rows: Sequence[dict[str, Any]]) -> None:
    """Write why runs ended, their warnings and hints, once for all runs that share one; `MOST_REMARKS` at most."""
    runs_by_remark = defaultdict[str, list[dict[str, Any]]](list)
    for row in rows:
        remarks = list(row.get("remarks", ()))
        if row.get("reason"):
            remarks.insert(0, f"{row['status']}: {row['reason']}")
        for remark in remarks:
            if row["tracker"] == "never-move" and remark.startswith("warning: static-camera:"):
                continue  # it is that camera
            runs_by_remark[remark].append(row)
    # one line for all runs with the same remark
    for remark, (first, *others) in list(runs_by_remark.items())[:MOST_REMARKS]:
        kind, _, text = remark.partition(": ")
        subject = (
            f"{label_text(first['tracker'])} on {first['sequence']}: " if len(rows) > 1 else ""
        )
        if others:
            plural = "s" if len(others) != 1 else ""
            subject = subject.removesuffix(": ") + f" and {len(others)} more run{plural}: "
        write_prose(f"{kind}: {subject}{text}")
    more = len(runs_by_remark) - MOST_REMARKS
    if more > 0:
        write(f"{more} more such lines: `dynslam-bench runs show RUN` has those of a run.")


def short_ids(run_ids: Iterable[str]) -> dict[str, str]:
    """The first digits of each id: as many as no other id begins with, and at least `_ID_DIGITS`."""
    ordered = sorted(set(run_ids))
    digits = dict.fromkeys(ordered, _ID_DIGITS)
    # of sorted ids, an id shares most digits with a neighbour
    for run_id, following in pairwise(ordered):
        lengths = range(len(following) + 1)
        shared = next(at for at in lengths if run_id[: at + 1] != following[: at + 1])
        digits[run_id] = max(digits[run_id], shared + 1)
        digits[following] = max(digits[following], shared + 1)
    return {run_id: run_id[:count] for run_id, count in digits.items()}


def shown_cell(name: str, value: Any) -> Any:
    """A cell of the table: errors in millimetres, paths without folders."""
    if name in ("tracker", "segmentation"):
        return label_text(value)
    if name in _IN_METRES and isinstance(value, float):
        return mm(value)
    return _FOLDERS.sub(r"\1", value) if name == "settings" else value


def show_files(
    rows: Sequence[dict[str, Any]], store: stored.RunStore, names: Sequence[str]
) -> set[str]:
    """Write the paths of the requested pictures and maps, and to standard error why a run has none.

    Returns:
        The names of which a run has none.
    """
    missing = set[str]()
    statuses = {row["run_id"]: row["status"] for row in rows}
    for (run_id, status), name in product(statuses.items(), names):
        path = store.folder(run_id) / name
        if path.is_file():
            if not json_mode():
                write(str(path))
            continue
        missing.add(name)
        # why there is none: the run says so, or it ended before
        notes = store.read_whole(run_id).notes
        stated = (text for text in notes if text.startswith(f"no {name}"))
        reason = next(stated, f"no {name}: the run ended early, {status}")
        warn(f"{reason} ({run_id})")
    return missing


def training_scene_note(rows: Sequence[dict[str, Any]]) -> str:
    """One line on the runs on scenes that the segmentation network was trained on; empty without any."""
    ids = [row["sequence"] for row in rows if row["seen_in_training"]]
    if not ids:
        return ""
    # an id without scene and frames: `synthetic/walking_xyz`
    base = ids[0].partition("?")[0].partition("@")[0]
    return (
        f"{len(ids)} of {len(rows)} runs have masks of a network that was trained on their scene, the first on "
        f"{ids[0]}: a best case, which reports mark and do not rank; scenes 100-199 are held out, e.g. "
        f"{base}?scene=100"
    )


def recording_note(
    opened: Mapping[str, tuple[str, str | None, str | None]], rows: Sequence[dict[str, Any]]
) -> str:
    """One line on a fault of the first recording whose run failed, was lost or was no better than a static camera.

    Empty without such a run, or where a short check of the recording finds no fault.

    Args:
        opened: Sequence, data root and camera that were asked for, by the runs' ids.
        rows: The runs.
    """
    from dynslam_bench.sequences.doctor import diagnose

    for row in rows:
        sequence, data_root, camera = opened[row["run_id"]]
        if sequence.startswith("synthetic/") or not (
            row["status"] != "ok" or _is_no_better_than_static(row)
        ):
            continue
        # the first such recording alone: each check takes seconds
        diagnosis = diagnose(sequence, data_root=data_root, camera=camera, most_frames=HINT_FRAMES)
        if diagnosis.ok:
            return ""
        command = f"dynslam-bench sequences doctor {sequence}"
        if camera:
            command += f" --camera {camera}"
        return f"{row['sequence']} has a fault: {diagnosis.findings[0].text}; more by: {command}"
    return ""


def _is_no_better_than_static(row: Mapping[str, Any]) -> bool:
    """Whether a tracker that is to follow a moving camera was no better than a static camera."""
    # `false_motion_max_m` is measured before a fixed camera only, where a static camera has no error
    error = row["ate_rmse_m"]
    bound = row["static_camera_ate_rmse_m"]
    if row["tracker"] == "never-move" or row["false_motion_max_m"] is not None:
        return False
    return None not in (error, bound) and bool(error >= bound)
