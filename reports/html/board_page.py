"""The first page of a report: the ranking by category, and what the pages of errors, runs and comparisons read."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from dynslam_bench.core import setting_text, write_atomic
from dynslam_bench.evaluation import Protocol
from dynslam_bench.reports.figures import significant
from dynslam_bench.reports.html.page import render, write_assets, write_side
from dynslam_bench.reports.html.run_pages import RUN_PAGE, write_run_pages
from dynslam_bench.reports.model.board import Board, Cell, compare_pairs
from dynslam_bench.reports.model.row import SEEN, RunRow, grouped
from dynslam_bench.reports.model.statistics import FLOOR_M, Interval, Standing, Verdict
from dynslam_bench.reports.tables.leaderboard import leaderboard, middle, rank_cell, run_link, timed
from dynslam_bench.reports.tables.table import TableCell, number

_OPPOSITE: dict[Verdict, Verdict] = {"better": "worse", "worse": "better", "cannot tell": "cannot tell"}
MOST_LISTED = 5000
"""Runs that are listed one by one; of more, those that have a page, and the first of every cell."""


MEANINGS = {
    "static": "nothing moves",
    "low dynamic": "people sit",
    "high dynamic": "people walk",
    "unknown objects": "objects of no class",
    "fixed camera": "the camera stands still",
}
"""Categories in everyday words."""


def entries_of(
    board: Board, whole: Board, boards: Mapping[str, Board], protocol: Protocol, paged: Collection[str] = ()
) -> list[dict[str, Any]]:
    """The rows of one category, cells by the names that `board.html.j2` calls them by.

    ``at`` numbers the tracker on all pages; ``group`` is 0 for ranked trackers, 1 for others, 2 for controls (bounds).
    The name leads to the tracker's run with the median error on the first sequence where that has a page, and the
    successes lead to its first failure.

    Args:
        board: Of the category.
        whole: Of all sequences: the numbers of trackers.
        boards: Of all categories, for the column that shows them side by side.
        protocol: How errors were computed.
        paged: Ids of the runs that have a page.
    """
    keys = [*whole.trackers, *whole.final_only]
    standings = {standing.key: standing for standing in board.standings}
    limits = _limits([s.ratio for s in board.standings])
    table = leaderboard(board, protocol)
    names = [column.name for column in table.columns]
    entries = []
    for key, row in zip(board.trackers, table.rows, strict=True):
        standing, cells, runs = standings.get(key), dict(zip(names, row, strict=True)), board.cells[key]
        first = board.first(key)
        typical = [runs[name].typical for name in board.sequences if name in runs] or [first]
        start = next((run for run in typical if run.run_id in paged), typical[0])
        kind = TableCell("imported") if first.imported else cells["provenance"]
        ended = [run for run in board.runs(key) if not run.failed]
        marks = cells["tracker"].text.removeprefix(board.labels[key])
        failure = next((run for run in board.runs(key) if run.failed), None)
        if failure is not None:
            tip = f"{board.sequence(failure)}: {failure.ending}"
            cells["success"] = replace(cells["success"], link=run_link(failure), tip=tip)
        entries.append(
            {
                "at": keys.index(key),
                "group": 2 if first.tracker.provenance == "control" else int(key not in board.ranked),
                "name": replace(cells["tracker"], text=board.names[key] + marks, link=run_link(start)),
                "kind": kind,
                "rank": TableCell("–") if standing is None else rank_cell(standing),
                "ratio": _ratio_cell(board, key, standing),
                "bar": Markup("") if standing is None else interval_bar(standing.ratio, limits),
                "verdict": TableCell("not ranked", why) if (why := board.unranked_why(key)) else cells["better?"],
                "success": cells["success"],
                "coverage": cells["coverage"],
                "time": number(middle(run.frame_ms for run in timed(ended)), ".1f"),
                "memory": cells["MB"],
                "by_category": _by_category(key, boards),
            }
        )
    return sorted(entries, key=itemgetter("group"))


def _ratio_cell(board: Board, key: str, standing: Standing | None) -> TableCell:
    if key in board.hopeless:
        return TableCell("nothing succeeded", emphasis="failed")
    if standing is None or not math.isfinite(standing.ratio.value):
        return TableCell()
    ratio = standing.ratio
    tip = f"95 % interval {ratio.low:.2f} to {ratio.high:.2f}" if math.isfinite(ratio.low) else ""
    missing = standing.sequences < len(board.common)
    small = f"{standing.sequences} of {len(board.common)} sequences" if missing else ""
    return TableCell(f"{ratio.value:.2f}", small, ratio.value, tip=tip)


def _limits(ratios: Sequence[Interval]) -> tuple[float, float]:
    """Ends of the axis of interval bars, in logarithms; 1 lies between them."""
    ends = [end for ratio in ratios for end in (ratio.value, ratio.low, ratio.high) if math.isfinite(end) and end > 0]
    low, high = min([0.8, *ends]), max([1.25, *ends])
    return math.log(max(low, 0.02)), math.log(min(high, 20.0))


def interval_bar(ratio: Interval, limits: tuple[float, float]) -> Markup:
    """A ratio with its interval on a logarithmic axis, and a line at 1."""
    if not math.isfinite(ratio.value):
        return Markup("")

    def x(value: float) -> str:
        share = (math.log(max(value, FLOOR_M)) - limits[0]) / (limits[1] - limits[0])
        return f"{4 + 112 * min(max(share, 0.0), 1.0):.1f}"

    better = "worse" if ratio.value >= 1 else "better"
    line = ""
    if math.isfinite(ratio.low):
        line = f'<line x1="{x(ratio.low)}" x2="{x(ratio.high)}" y1="8" y2="8" class="{better}"/>'
    dot = f'<circle cx="{x(ratio.value)}" cy="8" r="3.6" class="{better}"/>'
    one = f'<line x1="{x(1.0)}" x2="{x(1.0)}" y1="0" y2="16" class="one"/>'
    return Markup(f'<svg class="bar" viewBox="0 0 120 16" aria-hidden="true">{one}{line}{dot}</svg>')


def _by_category(key: str, boards: Mapping[str, Board]) -> Markup:
    """A dot a category: its height is the ratio there, the line in the middle is 1; empty for a single category."""
    ratios = [
        (name, standing.ratio.value)
        for name, board in list(boards.items())[1:]
        for standing in board.standings
        if standing.key == key and math.isfinite(standing.ratio.value)
    ]
    if not ratios:
        return Markup("")
    words = ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios)
    dots = []
    for at, (_, ratio) in enumerate(ratios):
        y = 12 + 8 * min(max(math.log(max(ratio, FLOOR_M)) / math.log(8), -1.0), 1.0)
        kind = "worse" if ratio >= 1 else "better"
        dots.append(f'<circle cx="{8 + 14 * at}" cy="{24 - y:.1f}" r="3.6" class="{kind}"/>')
    width = 14 * len(ratios) + 4
    one = f'<line x1="0" x2="{width}" y1="12" y2="12" class="one"/>'
    shape = f'<svg class="spark" viewBox="0 0 {width} 24" style="width: {width}px" role="img"'
    title = Markup("<title>{}</title>").format(words)
    return Markup(f"{shape}>{title}{one}{''.join(dots)}</svg>")


# -- what the pages of errors, runs and comparisons read


def side_content(
    board: Board, boards: Mapping[str, Board], protocol: Protocol, paged: set[str], pictured: set[str], pageless: str
) -> dict[str, Any]:
    """What ``data/board.js`` holds: trackers, sequences, cells and runs.

    Args:
        board: The board.
        boards: Of its categories.
        protocol: How errors were computed.
        paged: Ids of the runs that have a page.
        pictured: Ids of those whose pictures lie beside it.
        pageless: Which runs have no page, in words.
    """
    keys, names = [*board.trackers, *board.final_only], [*board.sequences, *board.unscored]
    place, column = ({name: at for at, name in enumerate(items)} for items in (keys, names))
    metrics = _metrics(protocol)
    first = {cell.rows[0].run_id for cells in board.cells.values() for cell in cells.values()}
    all_listed = len(board.rows) <= MOST_LISTED  # a page of a hundred thousand would open slowly
    listed = [row for row in board.rows if all_listed or row.run_id in paged or row.run_id in first]
    ordered = sorted(listed, key=lambda row: (place[row.variant_key], column[board.sequence(row)], row.repeat_key))
    tags = {
        name: {tag for row in rows for tag in row.sequence.tags}
        for name, rows in grouped(board.rows, board.sequence).items()
    }
    categories = {category: {column[name] for name in some.sequences} for category, some in list(boards.items())[1:]}
    return {
        "protocol": protocol.describe(),
        "seen": SEEN,
        "pageless": pageless,
        "reference": board.reference_name,
        "referenceAt": None if board.reference is None else place[board.reference],
        "metrics": metrics,
        "trackers": [_tracker(board, key) for key in keys],
        "sequences": [
            {"name": name, "short": board.short.get(name, name), "tags": sorted(tags[name]),
             "static": significant(board.static_camera.get(name))}
            for name in names
        ],
        "categories": {category: sorted(members) for category, members in categories.items()},
        "cells": [
            cell_content(cell, place[key], column[name], metrics, rank_seen=board.rank_seen)
            for key in keys
            for name, cell in board.cells[key].items()
        ],
        "runs": [
            [row.run_id, place[row.variant_key], column[board.sequence(row)], row.repeat, row.ending,
             (row.run_id in paged) + 2 * (row.run_id in pictured)]
            for row in ordered
        ],
        "unlisted": len(board.rows) - len(listed),
    }  # fmt: skip


def ratios_content(board: Board) -> list[list[Any]]:
    """What ``data/ratios.js`` holds of every two trackers: their numbers, and the second against the first."""
    keys = [*board.trackers, *board.final_only]
    place = {key: at for at, key in enumerate(keys)}
    verdicts = {standing.key: standing.verdict for standing in board.standings}
    ratios = []
    for pair in compare_pairs(board, keys[::-1]):  # of the later one over the earlier one
        verdict = pair.verdict
        if pair.other == board.reference:  # as on the board, which asks it of fewer pairs
            verdict = verdicts.get(pair.one, "")
        elif pair.one == board.reference:
            verdict = _OPPOSITE.get(verdicts.get(pair.other, ""), verdict)
        ratios.append([place[pair.other], place[pair.one], *ratio_numbers(pair.ratio), pair.sequences, verdict])
    return ratios


def ratio_numbers(ratio: Interval) -> list[float | None]:
    """A ratio and the ends of its interval."""
    return [significant(value) for value in (ratio.value, ratio.low, ratio.high)]


def cell_content(
    cell: Cell, tracker: int, sequence: int, metrics: Sequence[Mapping[str, str]], *, rank_seen: bool
) -> list[Any]:
    """Place, runs, failures, what speaks against it, the median of every number, typical run, the error's quartiles."""
    doubt = any(not row.rotation_reliable for row in cell.rows) + 2 * (cell.in_training and not rank_seen)
    medians = [significant(middle(_value(row, metric) for row in cell.kept)) for metric in metrics]
    quartiles = np.percentile(cell.scores, [25, 75]).tolist() if len(cell.scores) > 1 else []
    place = [tracker, sequence, len(cell.rows), cell.failed, doubt]
    return [*place, medians, cell.typical.run_id, [significant(value) for value in quartiles]]


def _tracker(board: Board, key: str) -> dict[str, Any]:
    first = board.first(key)
    return {
        "label": board.names[key],
        "ranked": key in board.ranked,
        "settings": {name: setting_text(value) for name, value in first.variant.items()},
    }


def _metrics(protocol: Protocol) -> list[dict[str, str]]:
    """The numbers to choose from, the one that ranks first."""
    numbers = [("ATE", "m", "ate_rmse_m")]
    for spec in protocol.rpe:
        numbers.append((f"RPE over {spec.describe()}", "m/s" if spec.rate else "m", spec.metric("trans")))
    for spec in protocol.rpe:
        numbers.append((f"RPE over {spec.describe()}, rotation", "deg/s" if spec.rate else "deg", spec.metric("rot")))
    numbers.append(("absolute rotation", "deg", "ape_rot_rmse_deg"))
    return [
        {"name": name, "unit": unit, "key": key, "which": which}
        for which in dict.fromkeys([protocol.trajectory, "final"])
        for name, unit, key in numbers
    ]


def _value(row: RunRow, metric: Mapping[str, str]) -> float | None:
    """A run's number; only the ATE that ranks counts failures."""
    if metric["which"] != row.trajectory:
        return None if row.failed or metric["which"] == "online" else row.final_metrics.get(metric["key"])
    if metric["key"] == "ate_rmse_m":
        return row.score_m
    return None if row.failed else row.metrics.get(metric["key"])


def write_runs(
    output: Path,
    cells: Mapping[str, Mapping[str, Cell]],
    shown: Sequence[RunRow],
    protocol: Protocol,
    home: str,
    *,
    words: str = "",
    **more: Any,
) -> None:
    """Write the page that shows some runs, and what it reads.

    Args:
        output: Folder of the page.
        cells: Label, of a tracker or a trial, to sequence to its runs.
        shown: Runs that have a page.
        protocol: How errors are computed.
        home: What ``index.html`` is called.
        words: The protocol in words; empty for its own.
        **more: What ``data/board.js`` holds besides.
    """
    paged = {row.run_id for row in shown}
    write_run_pages(shown, paged, protocol, output)
    names = sorted({name for some in cells.values() for name in some})
    trackers, contents, runs = [], [], []
    for at, (label, some) in enumerate(cells.items()):
        settings = next(iter(some.values())).rows[0].variant
        trackers.append({"label": label, "settings": {name: setting_text(value) for name, value in settings.items()}})
        for name, cell in some.items():
            metric = {"key": "ate_rmse_m", "which": cell.rows[0].trajectory}
            contents.append(cell_content(cell, at, names.index(name), [metric], rank_seen=True))
            for row in [row for row in cell.rows if row.run_id in paged] or [cell.typical]:
                runs.append([row.run_id, at, names.index(name), row.repeat, row.ending, 3 * (row.run_id in paged)])
    board = {
        "protocol": words or protocol.describe(),
        "pageless": "",
        "unlisted": 0,
        "trackers": trackers,
        "sequences": [{"name": name, "short": name, "tags": []} for name in names],
        "cells": contents,
        "runs": runs,
    }
    write_side(output, "board", board | more)
    write_assets(output)
    page = render("run.html.j2", title="Run", links=[("index.html", home)], scripts=["run.js"])
    write_atomic(output / RUN_PAGE, page)
