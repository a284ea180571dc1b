"""The leaderboard, its sensitivity to the rules, tables of the runs, and the cells that several tables share."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from statistics import median

import numpy as np

from dynslam_bench.core.toml import label_text
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.reports.model.board import Board, mean_skipped, rank
from dynslam_bench.reports.model.row import HINTED, SEEN, RunRow
from dynslam_bench.reports.model.statistics import FEWEST, FLOOR_M, Interval, Standing
from dynslam_bench.reports.tables.table import (
    Column,
    Emphasis,
    Table,
    TableCell,
    number,
    numbers,
    percent,
    texts,
)

_PROVENANCE = {
    "own": "put together in this project: no one paper or program describes the whole",
    "faithful-code": "follows the published code",
    "faithful-paper": "follows the paper",
    "inspired": "follows an abstract or a survey; constants are ours",
    "assumed": "identity or rule unknown, assumed",
    "external": "not part of this project",
    "control": "a control, not a system",
}
_NAMES = {"own": "our composition"}
CACHED_MARK = "†"
CACHED_NOTE = f"{CACHED_MARK} Times of features and masks come from the stage cache, not from the run itself."
SEEN_NOTE = (
    f"{SEEN} The masks come from a network that was trained on this very scene (the embedded one, on rendered "
    "scenes 0-99): its best case, no judgement."
)


def leaderboard(board: Board, protocol: Protocol) -> Table:
    """Ranking with what the data leave open, success, coverage, speed and provenance."""
    epipolar = any(row.epipolar_skipped is not None for row in board.rows)
    standings = {standing.key: standing for standing in board.standings}
    rows = []
    for key in board.trackers:
        runs = board.runs(key)
        share = mean_skipped(runs)
        *measures, origin, provenance = _run_cells(runs)
        if epipolar:
            measures.append(TableCell() if share is None else TableCell(percent(share), value=share))
        rows.append([*_standing_cells(board, key, standings.get(key)), *measures, origin, provenance])
    columns = [
        Column(
            name,
            numeric=name not in _WORDS,
            meaning=meaning.replace("{reference}", board.reference_name),
            latex=name not in _NOT_IN_LATEX,
        )
        for name, meaning in _MEANINGS.items()
        if epipolar or name != "F skipped"
    ]
    caption = _caption(board, protocol, epipolar)
    brief = f"Geometric mean of the ATE over that of {board.reference_name}"
    brief += ", with 95 % intervals" * any(_has_interval(standing.ratio) for standing in board.standings)
    muted = board.unranked_rows(board.trackers)
    return Table("leaderboard", "Leaderboard", caption, columns, rows, muted, board.separators(), brief)


_MEANINGS = {
    "#": "ranks that the data leave open; several: not separable from the others with that rank",
    "success": "runs that ended and could be evaluated, of all",
    "tracker": "",
    "ATE ratio": "geometric mean over sequences of the median ATE over that of {reference}",
    "mean rank": "mean over sequences of the rank there",
    "wins": "sequences with a smaller median ATE than the reference; behind it the probability that a run has a "
    "smaller error than one of the reference",
    "p": "paired Wilcoxon test against the reference over sequences, Holm-corrected; none where it could never be "
    "below 0.05",
    "coverage": "tracked frames over associated input frames",
    "× real time": "frame interval over mean frame time, above 1 it keeps up; behind it the median frame time, "
    "segmentation included, decoding excluded",
    "MB": "peak resident memory",
    "F skipped": "share of the tracked frames on which the epipolar test had no say, since F was not used",
    "rows": "",
    "provenance": "",
}
_WORDS = ("tracker", "rows", "provenance")
_NOT_IN_LATEX = ("mean rank", "MB", "F skipped", "rows", "provenance")


def _caption(board: Board, protocol: Protocol, epipolar: bool) -> str:
    failed = sum(row.failed for row in board.rows)
    intervals = (
        "Brackets: Student's 95 % intervals over sequences."
        if len(board.common) >= FEWEST
        else f"No intervals: they would need {FEWEST} sequences."
    )
    parts = [
        f"{protocol.describe()}; for the ranking a lost frame counts as not having moved since the last tracked one.",
        f"ATE ratio: geometric mean over {_count(len(board.common), 'sequence')} of the median ATE over that of "
        f"{board.reference_name}; below 1 is better. {intervals}",
        f"A run that failed or was lost counts as a static camera, or worse ({failed} of "
        f"{_count(len(board.rows), 'run')}); trackers without any success stand below the last line.",
        "Grey rows are shown but not ranked: controls, inspired or assumed re-implementations, runs that begin "
        "in the map of an earlier one or by an older program, real-time runs beside others, trackers that lack "
        "sequences, never succeeded, or are no better than a static camera.",
    ]
    worse, hinted = _no_better_than_static(board), _hinted(board.rows)
    rule = "Such runs rank, since that was asked for." if board.rank_seen else "Such runs do not rank."
    remarks = {
        f"No better than a static camera, although their runs ended: {worse}.": worse,
        f"{board.asked_reference} was asked for as the reference, but has not every ranked sequence: a static "
        "camera takes its place.": board.asked_reference and board.reference is None,
        "F skipped: frames on which an epipolar system did not use its fundamental matrix.": epipolar,
        CACHED_NOTE: any(row.cached for row in board.rows),
        f"{SEEN_NOTE} {rule} Instances 100-199 are held out.": any(row.seen_in_training for row in board.rows),
        f"{HINTED} The trajectories of {_count(sum(bool(row.hints) for row in board.rows), 'run')} are probably faulty "
        f"({hinted}), as the diagnostics say; no number is changed for that.": hinted,
    }
    return " ".join(parts + [remark for remark, holds in remarks.items() if holds])


def _hinted(rows: Iterable[RunRow]) -> str:
    """What is probably wrong with trajectories, with the number of runs; empty if nothing is."""
    counts = Counter(line.partition(":")[0] for row in rows for line in row.hints)
    return ", ".join(f"{name} {count}" for name, count in counts.most_common())


def _no_better_than_static(board: Board) -> str:
    """Trackers with how many sequences they are no better on than a static camera; empty if none is."""
    counts = {key: sum(board.no_better_than_static(key, name) for name in board.sequences) for key in board.trackers}
    return "; ".join(
        f"{board.labels[key]} on {count} of {_count(len(board.cells[key]), 'sequence')}"
        for key, count in counts.items()
        if count
    )


def _standing_cells(board: Board, key: str, standing: Standing | None) -> list[TableCell]:
    runs = board.runs(key)
    good = sum(not row.failed for row in runs)
    success = TableCell(f"{good}/{len(runs)}", value=good / len(runs))
    hinted = _hinted(runs)
    name = TableCell(board.labels[key] + f" {HINTED}" * bool(hinted), hinted, tip=board.first(key).tracker.id)
    if key in board.hopeless:
        return [TableCell("–"), success, name, TableCell("nothing succeeded", emphasis="failed"), *[TableCell()] * 3]
    if standing is None:
        return [TableCell("–"), success, name, *[TableCell()] * 4]
    ratio = interval_cell(standing.ratio, ".2f", _mark(board, standing))
    if standing.sequences < len(board.common):
        text = f"{ratio.small} on {standing.sequences} of {len(board.common)}".strip()
        ratio = TableCell(ratio.text, text, ratio.value)
    better = f"P {standing.better:.2f}" if standing.sequences >= FEWEST else ""
    wins = TableCell(f"{standing.wins} of {standing.sequences}", better, standing.wins)
    if key == board.reference:
        wins = TableCell("reference")
    mean_rank, p = number(standing.mean_rank, ".2f"), number(standing.p_value, ".3f")
    rank = TableCell("–", "no better than a static camera") if key in board.no_better else rank_cell(standing)
    return [rank, success, name, ratio, mean_rank, wins, p]


def _mark(board: Board, standing: Standing) -> Emphasis:
    """Bold for those that may be first, unless that is most of them: then it would say nothing."""
    first = [s for s in board.standings if s.group is not None and s.group[0] == 1]
    return "best" if standing in first and 2 * len(first) <= len(board.ranked) else ""


def _run_cells(runs: Sequence[RunRow]) -> list[TableCell]:
    coverage = float(np.mean([row.coverage for row in runs]))
    ended = [row for row in runs if not row.failed]
    origins = " + ".join(f"{count} {origin}" for origin, count in Counter(row.origin for row in runs).items())
    provenance = runs[0].tracker.provenance
    masks = " + ".join(sorted({label_text(row.segmentation) for row in runs if row.segmentation not in ("", "none")}))
    masks_words = f"{masks} masks" if masks else ""
    return [
        TableCell(f"{100 * coverage:.1f} %", value=coverage),
        speed_cell(ended),
        number(middle(row.peak_memory_mb for row in ended), ".0f"),
        TableCell(tag=origins),
        TableCell(_NAMES.get(provenance, provenance), masks_words, tip=_PROVENANCE.get(provenance, "")),
    ]


def timed(runs: Sequence[RunRow]) -> list[RunRow]:
    """The runs whose times count: those that took them themselves, where there is one; else the cached ones."""
    fresh = [row for row in runs if not row.cached and row.real_time_factor is not None]
    return fresh or [row for row in runs if row.real_time_factor is not None]


def speed_cell(ended: Sequence[RunRow]) -> TableCell:
    """Real-time factor and frame time, marked where they come from the stage cache."""
    rows = timed(ended)
    factor, frame_ms = middle(row.real_time_factor for row in rows), middle(row.frame_ms for row in rows)
    mark, tip = (CACHED_MARK, CACHED_NOTE) if any(row.cached for row in rows) else ("", "")
    small = "" if frame_ms is None else f"{frame_ms:.1f} ms{mark}"
    if factor is None:
        return TableCell(small=small, tip=tip)
    return TableCell((f"{factor:.2f}" if factor < 100 else f"{factor:.0f}") + mark, small, factor, tip=tip)


def rank_cell(standing: Standing) -> TableCell:
    """The ranks that the data leave open."""
    if standing.rank is None or standing.group is None:
        return TableCell("–")
    first, last = standing.group
    return TableCell(str(first)) if first == last else TableCell(f"{first}–{last}", "not separable")


def interval_cell(interval: Interval, digits: str, emphasis: Emphasis = "") -> TableCell:
    """A value with its interval, if it has one."""
    small = f"[{interval.low:{digits}}, {interval.high:{digits}}]" if _has_interval(interval) else ""
    return TableCell(f"{interval.value:{digits}}", small, interval.value, emphasis)


def _has_interval(interval: Interval) -> bool:
    return math.isfinite(interval.low) and math.isfinite(interval.high)


def middle(values: Iterable[float | None]) -> float | None:
    """Median of what is present; None if nothing is."""
    present = [value for value in values if value is not None]
    return median(present) if present else None


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' if count != 1 else ''}"


def failure_rule_table(board: Board) -> Table | None:
    """How much the ranking depends on how failures and lost frames are counted; None if nothing was lost."""
    if not board.ranked or all(row.coverage >= 1 and not row.failed for row in board.rows):
        return None
    rules: dict[str, Callable[[RunRow], float | None]] = {
        "lost frames held": lambda row: row.score_m,
        "lost frames left out": _tracked_error,
        "failures left out too": lambda row: None if row.failed else _tracked_error(row),
    }
    by_rule = [{s.key: s for s in rank(board, board.ranked, board.ranked, rule)} for rule in rules.values()]
    columns = [*texts("tracker"), *(column for name in rules for column in numbers("#", "ATE ratio", group=name))]
    rows = []
    for key in board.ranked:
        cells = [TableCell(board.labels[key])]
        for standings in by_rule:
            if key in standings:
                cells += [rank_cell(standings[key]), interval_cell(standings[key].ratio, ".2f")]
            else:
                cells += [TableCell(), TableCell()]
        rows.append(cells)
    caption = (
        "The same runs under three rules. Lost frames held: the report's rule, a lost frame counts as not having moved "
        "since the last tracked one. Lost frames left out: the error of the tracked frames only, which is what most "
        "papers print; a tracker gains by losing the hard frames. Failures left out too: survivors only, which also "
        "flatters trackers that fail; in the first two they count as a static camera, or worse. A ranking "
        "that changes between the rules is decided by the rule."
    )
    return Table("failure_rules", "Sensitivity to the rule for lost frames and failures", caption, columns, rows)


def _tracked_error(row: RunRow) -> float | None:
    """The ATE of the tracked frames only; a failure counts as the report's rule says."""
    return row.score_m if row.failed else row.metrics.get("ate_rmse_m")


def run_link(row: RunRow) -> str:
    """Where the page of a run lies, seen from the report's."""
    return f"run.html#{row.run_id}"


def failures(board: Board) -> Table | None:
    """Every run that failed, with its reason and its page; None if there is none."""
    failed = [row for row in board.rows if row.failed]
    if not failed:
        return None

    def order(row: RunRow) -> tuple[object, ...]:
        return board.labels[row.variant_key], board.sequence(row), row.repeat_key

    columns = [*texts("tracker", "sequence", "repeat", "ended"), Column("coverage"), *texts("reason", "run")]
    rows = [
        [
            TableCell(board.labels[row.variant_key]),
            TableCell(board.sequence(row)),
            TableCell(row.repeat),
            TableCell(row.ending),
            TableCell(f"{100 * row.coverage:.1f} %", value=row.coverage),
            TableCell(row.reason),
            TableCell(row.run_id, link=run_link(row)),
        ]
        for row in sorted(failed, key=order)
    ]
    caption = "Runs that crashed, took too long or too much, broke their contract, were lost, or cannot be evaluated."
    return Table("failures", "Failures", caption, columns, rows)


def repeatability(board: Board) -> Table | None:
    """Spread of the runs of a cell; None if no cell has several."""
    columns = [
        Column("tracker", numeric=False),
        Column("cells", meaning="sequences with several runs that differ"),
        Column("deterministic", meaning="sequences on which several seeds gave one result to the last digit"),
        Column("runs a cell"),
        Column("worst / best", meaning="median over cells of the largest over the smallest ATE"),
        Column("largest worst / best"),
        Column("where", numeric=False, latex=False),
    ]
    rows = [cells for key in board.trackers if (cells := _spread_cells(board, key))]
    if not rows:
        return None
    caption = (
        "How far the runs of one tracker on one sequence lie apart when only seed, start offset or sensor noise "
        "differ. Differences between trackers that are smaller than this are noise. Copies (several seeds, one result "
        "to the last digit) are no repeats: they are counted as deterministic and take no part. Neither do failures."
    )
    return Table("repeatability", "Repeatability", caption, columns, rows)


def _spread_cells(board: Board, key: str) -> list[TableCell]:
    """How far the runs of a tracker lie apart; empty if it has no cell with several."""
    cells = {name: board.cells[key][name] for name in board.sequences if name in board.cells[key]}
    scores = {name: [row.score_m or 0.0 for row in cell.succeeded] for name, cell in cells.items()}
    several = {name: errors for name, errors in scores.items() if len(errors) > 1}
    copies = sum(cell.deterministic and cell.success > 1 for cell in cells.values())
    counts = [TableCell(board.labels[key]), number(len(several)), number(copies)]
    if not several:
        return [*counts, *[TableCell()] * 4] if copies else []
    spreads = {name: max(errors) / max(min(errors), FLOOR_M) for name, errors in several.items()}
    where, worst = max(spreads.items(), key=lambda item: (item[1], item[0]))
    size = f"{median(len(errors) for errors in several.values()):g}"
    ratios = [number(median(spreads.values()), ".2f"), number(worst, ".2f")]
    return [*counts, TableCell(size), *ratios, TableCell(where)]


def machines(board: Board) -> Table:
    """Computers and versions behind the runs."""
    counts = Counter(row.machine_words or "not recorded" for row in board.rows)
    columns = [Column("runs"), Column("machine and versions", numeric=False)]
    rows = [[number(count), TableCell(name)] for name, count in counts.most_common()]
    caption = "Times of different machines are not comparable."
    return Table("machines", "Machines and versions", caption, columns, rows)
