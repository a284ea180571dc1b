"""Building the report: load, order, tabulate, draw, write."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

from pydantic import Field

import dynslam_bench
from dynslam_bench.core.records import Record, write_atomic
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.runs.storage.store import RunStore

from .figures import leaderboard as figures
from .figures.sequence import sequence_figures
from .figures.style import Figure
from .html.page import Block, Section, render
from .model.board import DEFAULT_REFERENCE, Board, On, make_board
from .model.common import common_errors, representatives
from .model.missing import missing_commands, missing_note
from .model.published import is_excerpt, reported_for
from .model.row import RunRow
from .model.rows import Loaded, load_runs, open_stores
from .model.statistics import FEWEST, power_note
from .tables import fairness as fairness_tables
from .tables import leaderboard as tables
from .tables import runs as run_tables
from .tables import sequences as sequence_tables
from .tables.formats import significant_text
from .tables.table import Table, to_csv, to_latex, to_markdown

SCHEMA_VERSION = 1


class ReportData(Record):
    """What a report was made of; `compare` reads it back.

    Attributes:
        schema_version: Of this record.
        title: Title of the report.
        protocol: Description of the protocol.
        reference: Tracker that errors are divided by.
        version: Version of the package.
        rows: One a run.
    """

    schema_version: int = SCHEMA_VERSION
    title: str
    protocol: str
    reference: str
    version: str
    rows: list[RunRow] = Field(default_factory=list)


@dataclass(frozen=True)
class ReportPaths:
    """The files of a report.

    Attributes:
        html: The page, complete in one file.
        markdown: The tables as Markdown.
        latex: The main tables as LaTeX.
        csv: The tables as CSV, by name.
        data: All rows, for `compare`.
    """

    html: Path
    markdown: Path
    latex: Path
    csv: dict[str, Path]
    data: Path


@dataclass
class _Draft:
    """What the pages are rendered from."""

    sections: list[Section] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    figures: dict[str, Figure] = field(default_factory=dict)

    def add(self, section: Section) -> None:
        if section.blocks or section.notes:
            self.sections.append(section)

    def table(self, table: Table, title: str = "") -> Block:
        self.tables.append(table)
        return Block(kind="table", title=title, table=table)

    def figure(self, name: str, figure: Figure, caption: str = "", title: str = "") -> Block:
        self.figures[name] = figure
        return Block(kind="figure", title=title, figure=name, caption=caption)


def build_report(
    runs: Sequence[Path] | Sequence[str] | RunStore | Path | str,
    output: Path | str,
    *,
    protocol: Protocol | str = "tum-rgbd/v1",
    reference: str = DEFAULT_REFERENCE,
    on: On = "common",
    title: str = "Visual SLAM in dynamic scenes",
    command: str = "",
) -> ReportPaths:
    """Make one offline HTML page of stored runs, with Markdown, CSV and LaTeX beside it.

    SLAM is not run; metrics that are missing under the protocol are computed from the stored trajectories.

    Args:
        runs: Results folders, or a store.
        output: Folder of the report; files in it that the report does not make are left alone.
        protocol: How to evaluate.
        reference: Tracker id that errors are divided by; where it was not run on every ranked sequence, a camera that
            never moves takes its place.
        on: ``common`` ranks on the sequences that all ranked trackers have, ``all`` only the trackers that have all.
        title: Heading.
        command: Command that makes this report again, shown in it; empty for a derived one.

    Raises:
        ReportError: There are no runs, or their numbers stem from different protocols.
        DynslamError: The output folder cannot be written.
    """
    protocol = get_protocol(protocol)
    output = Path(output).expanduser().absolute()
    stores = open_stores(runs)
    loaded = load_runs(stores, protocol)
    board = make_board([run.row for run in loaded.runs], reference, on)
    draft = _Draft()
    _leaderboard(draft, board, protocol, loaded)
    _sequences(draft, board, protocol, loaded)
    _details(draft, board, protocol, loaded)
    _behaviour(draft, board, output)
    again = command or shlex.join(
        ["dynslam-bench", "report", *(str(store.root) for store in stores), "-o", str(output)]
        + (["--on", on] if on != "common" else [])
    )
    _provenance(draft, board, again)
    data = ReportData(
        title=title, protocol=protocol.describe(), reference=board.reference_name,
        version=dynslam_bench.__version__, rows=board.rows,
    )  # fmt: skip
    return _write(draft, board, protocol, title, output, data)


def _leaderboard(draft: _Draft, board: Board, protocol: Protocol, loaded: Loaded) -> None:
    cells = [cell for key in board.ranked for name, cell in board.cells[key].items() if name in board.common]
    notes = [power_note(board.standings, len(board.common), min((len(c.scores) for c in cells if c.scores), default=0))]
    missing = missing_note(board)
    if missing:
        notes.insert(0, missing)
    if board.final_only:
        named = ", ".join(board.labels[key] for key in board.final_only)
        notes.append(f"Only in the table of final trajectories, as nothing else is known of them: {named}.")
    if board.unscored:
        notes.append(f"Without ground truth, and so in no table of errors: {', '.join(board.unscored)}.")
    if loaded.superseded or loaded.stopped or loaded.unreadable:
        left = [
            (loaded.superseded, f"{loaded.superseded} older runs of the same tracker, settings, frames and repeat"),
            (loaded.stopped, f"{loaded.stopped} runs that were stopped on request"),
            (len(loaded.unreadable), f"{len(loaded.unreadable)} folders without a valid record"),
        ]
        notes.append("Left out: " + ", ".join(text for count, text in left if count) + ".")
    section = Section("leaderboard", "Leaderboard", "Leaderboard", notes=notes)
    section.blocks.append(draft.table(tables.leaderboard(board, protocol)))
    ratio = figures.ratio_figure(board)
    if ratio is not None:
        caption = (
            f"Points: geometric-mean ATE ratio; bars: 95 % interval over sequences, from {FEWEST} sequences on. Open "
            "points are not ranked."
        )
        section.blocks.append(draft.figure("ratio", ratio, caption))
    commands = missing_commands(board)
    if commands:
        section.blocks.append(Block(kind="code", title="The commands that fill the gaps", text="\n".join(commands)))
    draft.add(section)
    speed = figures.speed_figure(board)
    if speed is not None:
        section = Section("speed", "Accuracy against speed", "Speed")
        caption = (
            "Lower right is better. The dotted line joins ranked trackers that no other beats in both. Frame times "
            "include segmentation and exclude decoding; they hold for the machine named below."
        )
        if any(row.cached for row in board.rows):
            caption += f" {tables.CACHED_NOTE}"
        section.blocks.append(draft.figure("speed", speed, caption))
        draft.add(section)


def _sequences(draft: _Draft, board: Board, protocol: Protocol, loaded: Loaded) -> None:
    if not board.sequences:
        return
    section = Section("errors", "Errors by sequence", "Errors")
    excerpts = {board.sequence(row) for row in board.rows if is_excerpt(row.sequence, row.duration_s)}
    recorded = [row for row in board.rows if not row.sequence.startswith("synthetic/")]
    parts = sorted(excerpts | {board.sequence(row) for row in recorded if row.frames})
    if parts:
        section.notes.append("Parts of recordings, beside which no published number stands: " + ", ".join(parts) + ".")
    published = reported_for([name for name in board.sequences if name not in parts], protocol.alignment)
    table_of_errors = sequence_tables.per_sequence(board, protocol, published)
    section.blocks.append(draft.table(table_of_errors, "Absolute trajectory error"))
    common, frames = common_errors(board, protocol, loaded)
    table = fairness_tables.common_frames_table(board, common, frames)
    if table is not None:
        section.blocks.append(draft.table(table, table.title))
    final = sequence_tables.metric_table(
        board, lambda row: row.final_ate_m, "final_trajectory", "Error of the final trajectory",
        "Median ATE (RMSE, millimetres) of the trajectory as it was after the last frame, whatever was optimised until "
        f"then, of the trackers that have one; all other tables show the {protocol.trajectory} one.",
        trackers=[*board.trackers, *board.final_only],
    )  # fmt: skip
    if final is not None and protocol.trajectory == "online":
        section.blocks.append(draft.table(final, final.title))
    if any(row.coverage < 1 and not row.failed for row in board.rows):
        excluded = sequence_tables.metric_table(
            board, lambda row: row.metrics.get("ate_rmse_m"), "lost_frames_excluded", "Error without the lost frames",
            "Median ATE (RMSE, millimetres) of the tracked frames only, of the runs that succeeded: the sensitivity to "
            f"lost frames, not what ranks. {protocol.describe()}.",
        )  # fmt: skip
        if excluded is not None:
            section.blocks.append(draft.table(excluded, excluded.title))
    rule = fairness_tables.failure_rule_table(board)
    if rule is not None:
        section.blocks.append(draft.table(rule, rule.title))
    for table in sequence_tables.relative_errors(board, protocol):
        section.blocks.append(draft.table(table, table.title))
    draft.add(section)


def _details(draft: _Draft, board: Board, protocol: Protocol, loaded: Loaded) -> None:
    section = Section("trajectories", "Trajectories and error over time", "Trajectories")
    for position, sequence in enumerate(board.sequences):
        chosen = representatives(board, sequence, loaded)
        estimates: dict[str, Trajectory] = {}
        truth = None
        for key, run in chosen.items():
            trajectory = run.store.trajectory(run.row.run_id, protocol.trajectory)
            truth = truth or run.store.ground_truth(run.record.sequence.part)
            if trajectory is not None and run.row.metrics:
                estimates[key] = trajectory
        if truth is None or not estimates:
            continue
        paths, errors = sequence_figures(board, truth, estimates, protocol)
        draft.figures |= {f"path-{position}": paths, f"error-{position}": errors}
        caption = (
            f"The run with the median error of each tracker, aligned ({protocol.alignment}), seen along the three "
            "axes. Lines are broken where a gap exceeds twice the median interval. Click a name to show or hide it."
        )
        over_time = "Absolute translational error of the same runs, frame by frame."
        section.blocks.append(
            Block(
                kind="details",
                summary=sequence,
                small=", ".join(filter(None, (board.groups[sequence], f"{len(estimates)} trackers"))),
                open=position == 0,
                figures=[(f"path-{position}", caption), (f"error-{position}", over_time)],
            )
        )
    draft.add(section)


def _behaviour(draft: _Draft, board: Board, output: Path) -> None:
    repeat = run_tables.repeatability(board)
    if repeat is not None:
        section = Section("repeatability", "Repeatability", "Repeatability")
        figure = figures.repeat_figure(board)
        if figure is not None:
            caption = "One point a run: its error over the median of the same tracker on the same sequence."
            section.blocks.append(draft.figure("repeat", figure, caption))
        section.blocks.append(draft.table(repeat))
        draft.add(section)
    masks = figures.mask_figure(board)
    table = sequence_tables.metric_table(
        board, lambda row: row.mask_iou, "mask_iou", "Mask quality",
        "Mean overlap (IoU) of the tracker's dynamic mask with the exact masks of people, median over runs.",
        text=significant_text, larger_is_better=True,
    )  # fmt: skip
    if masks is not None or table is not None:
        section = Section("masks", "Mask quality and pose error", "Masks")
        if masks is not None:
            section.blocks.append(draft.figure("masks", masks, "One point a run."))
        if table is not None:
            section.blocks.append(draft.table(table))
        draft.add(section)
    failed = run_tables.failures(board, output)
    section = Section("failures", "Failures", "Failures")
    if failed is not None:
        section.blocks.append(draft.table(failed))
    else:
        section.blocks.append(Block(kind="list", entries=[f"None of {len(board.rows)} runs failed."]))
    draft.add(section)


def _provenance(draft: _Draft, board: Board, again: str) -> None:
    section = Section("provenance", "Machines, versions, commands", "Reproduce")
    section.blocks.append(draft.table(run_tables.machines(board)))
    commands = list(dict.fromkeys(row.command for row in board.rows if row.command))
    section.blocks.append(
        Block(kind="code", title="The commands that reproduce it", text="\n".join([*commands, again]))
    )
    notes = [
        f"{board.labels[r.variant_key]} on {board.sequence(r)}, {r.repeat}: {n}" for r in board.rows for n in r.notes
    ]
    if notes:
        shown = notes[:60]
        if len(notes) > len(shown):
            shown.append(f"... and {len(notes) - len(shown)} more in report.json")
        section.blocks.append(Block(kind="list", title="Diagnostics", entries=shown))
    draft.add(section)


def _write(draft: _Draft, board: Board, protocol: Protocol, title: str, output: Path, data: ReportData) -> ReportPaths:
    failed = sum(1 for row in board.rows if row.failed)
    counts = (
        (len(board.labels), "tracker"),
        (len(board.sequences) + len(board.unscored), "sequence"),
        (len(board.rows), "run"),
    )
    facts = [(str(count), name + ("" if count == 1 else "s")) for count, name in counts] + [(str(failed), "failed")]
    now = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    footer = f"Made by dynslam-bench {data.version} on {now}. This page works without a network."
    page = render(draft.sections, draft.figures, title=title, protocol=protocol.describe(), facts=facts, footer=footer)
    paths = ReportPaths(
        html=output / "index.html",
        markdown=output / "report.md",
        latex=output / "report.tex",
        csv={},
        data=output / "report.json",
    )
    for table in draft.tables:
        paths.csv[table.id] = output / "csv" / f"{table.id}.csv"
        write_atomic(paths.csv[table.id], to_csv(table))
    paths.csv["runs"] = output / "csv" / "runs.csv"
    write_atomic(paths.csv["runs"], board.frame().to_csv(index=False))
    head = f"# {title}\n\n{protocol.describe()}\n\n" + ", ".join(f"{value} {name}" for value, name in facts) + "\n\n"
    notes = "".join(f"> {note}\n\n" for section in draft.sections for note in section.notes)
    write_atomic(
        paths.markdown, head + notes + "\n".join(to_markdown(table) for table in draft.tables) + f"\n{footer}\n"
    )
    latex = [to_latex(table) for table in draft.tables if table.id not in ("machines", "failures")]
    write_atomic(paths.latex, "% needs \\usepackage{booktabs}\n" + "\n".join(latex))
    write_atomic(paths.data, data.to_json())
    write_atomic(paths.html, page)
    return paths
