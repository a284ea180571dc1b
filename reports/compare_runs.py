"""Two sets of results against each other: before and after a change of the code, or of the settings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from operator import itemgetter
from pathlib import Path

import numpy as np

from dynslam_bench.core import ReportError, setting_text, sweep_temporary, write_atomic
from dynslam_bench.evaluation import Protocol, get_protocol
from dynslam_bench.reports.html.board_page import cell_data, ratio_numbers, settings_data
from dynslam_bench.reports.html.page import render, write_assets, write_side
from dynslam_bench.reports.html.run_pages import RUN_PAGE, write_run_pages
from dynslam_bench.reports.model.board import Cell, group_of, group_weights, make_cell, mean_of
from dynslam_bench.reports.model.load import check_one_protocol, load_runs, open_stores
from dynslam_bench.reports.model.names import make_labels, name_columns
from dynslam_bench.reports.model.row import REPORT_FILE, SEEN, ReportData, RunRow, grouped
from dynslam_bench.reports.model.statistics import FEWEST, FLOOR_M, Interval, ratio_interval
from dynslam_bench.reports.tables.leaderboard import interval_cell
from dynslam_bench.reports.tables.table import Table, TableCell, mm, number, numbers, texts
from dynslam_bench.runs.record import coverage_text
from dynslam_bench.runs.store import RunStore

Paired = tuple[str, Cell, Cell]
"""A sequence, with `SEEN` behind it if a side's network was trained on it, and one tracker's runs on both sides."""


@dataclass(frozen=True)
class Comparison:
    """What changed from A to B.

    Attributes:
        overall: Tracker and what differs to the geometric mean over sequences of B's median ATE
            over A's, with an interval from `FEWEST` sequences on; all categories weigh the same.
        table: Every tracker and sequence with both medians.
        only_a: Runs that only A has.
        only_b: Runs that only B has.
        differences: Tracker, as in `overall`, to the settings that differ, e.g.
            ``epipolar.threshold_px: default in A, 2 in B``; empty where the settings are the same.
        page: The page that shows it; None where none was asked for.
    """

    overall: dict[str, Interval]
    table: Table
    only_a: int
    only_b: int
    differences: dict[str, list[str]]
    page: Path | None = None


def compare(
    a: Path | str | RunStore,
    b: Path | str | RunStore,
    *,
    protocol: Protocol | str = "tum-rgbd/v1",
    output: Path | str | None = None,
) -> Comparison:
    """Compare two results folders, or two reports, on the sequences that both have.

    A tracker with the same settings on both sides is compared with itself. Settings that only one
    side has are compared with those of the same tracker that only the other has and that differ in
    the fewest values.

    Args:
        a: Results folder, store, or folder of a report (``report.json``).
        b: Likewise.
        protocol: How results folders are evaluated; a report brings its own.
        output: Folder of a page that shows it; None for none.

    Raises:
        ReportError: One holds no runs, nothing is in both, or their numbers stem from different
            protocols.
    """
    protocol = get_protocol(protocol)
    (rows_a, evaluated) = _read(a, protocol)
    (rows_b, _) = _read(b, protocol)
    check_one_protocol([*rows_a, *rows_b])
    variants_a, variants_b = (
        grouped(rows, lambda row: row.variant_key) for rows in (rows_a, rows_b)
    )
    pairs = pair_variants(variants_a, variants_b)
    name_a, name_b = (
        str(source.root if isinstance(source, RunStore) else source) for source in (a, b)
    )
    if not pairs:
        raise ReportError(
            f"{name_a} ({len(rows_a)} runs) and {name_b} ({len(rows_b)} runs) have no tracker and sequence in common",
            "compare results of the same suite",
        )
    columns = name_columns([*rows_a, *rows_b])
    labels = make_labels(
        [row for one, other in pairs for row in (*variants_a[one], *variants_b[other])]
    )
    compared: dict[str, list[Paired]] = {}
    differences: dict[str, list[str]] = {}
    only_a = len(rows_a)
    only_b = len(rows_b)
    for one, other in pairs:
        name = labels[one] if one == other else f"{labels[one]} → {labels[other]}"
        by_column_a = _by_column(variants_a[one])
        by_column_b = _by_column(variants_b[other])
        shared = by_column_a.keys() & by_column_b.keys()
        only_a -= sum(len(by_column_a[column]) for column in shared)
        only_b -= sum(len(by_column_b[column]) for column in shared)
        paired = []
        for column in shared:
            sides = by_column_a[column], by_column_b[column]
            repeats = {row.repeat_key for row in sides[0]} & {row.repeat_key for row in sides[1]}
            a_cell, b_cell = (
                make_cell([row for row in side if row.repeat_key in repeats] or side)
                for side in sides
            )
            if a_cell.scores and b_cell.scores:
                mark = f" {SEEN}" * (a_cell.in_training or b_cell.in_training)
                paired.append((columns[column] + mark, a_cell, b_cell))
        if paired:
            compared[name] = sorted(paired, key=itemgetter(0))
            differences[name] = _differences(variants_a[one][0], variants_b[other][0])
    if not compared:
        raise ReportError("none of the runs in common has ground truth", "nothing can be compared")
    overall = {name: overall_ratio(paired) for name, paired in compared.items()}
    changed = "; ".join(
        f"{name}: {', '.join(words)}" for name, words in differences.items() if words
    )
    caption = (
        f"{evaluated}. Median ATE (millimetres), lost frames held, over the repeats that both have, or all where they "
        "share none; failures count as a static camera, or worse. B / A below 1: B is better; all categories weigh the "
        "same. Brackets: "
        f"Student's 95 % interval over sequences, from {FEWEST} of them on. "
        + (f"What differs: {changed}." if changed else "The settings are the same.")
    )
    page = (
        None
        if output is None
        else _write_page(Path(output), protocol, evaluated, compared, overall)
    )
    table = _table(f"{name_a} (A) against {name_b} (B)", caption, compared, overall)
    return Comparison(overall, table, only_a, only_b, differences, page)


def _write_page(
    output: Path,
    protocol: Protocol,
    evaluated: str,
    compared: Mapping[str, Sequence[Paired]],
    overall: Mapping[str, Interval],
) -> Path:
    """Write the page: both sides of every tracker, with the pages of the runs that stand for a cell."""
    output = output.expanduser().absolute()
    cells = {
        f"{side}: {name}": {sequence: sides[at] for sequence, *sides in pairs}
        for name, pairs in compared.items()
        for at, side in enumerate("AB")
    }
    typical = {
        cell.typical.run_id: cell.typical for some in cells.values() for cell in some.values()
    }
    # a report alone brings no files
    paged = {run_id: row for run_id, row in typical.items() if row.folder.is_dir()}
    write_run_pages(list(paged.values()), paged, protocol, output)
    names = sorted({name for some in cells.values() for name in some})
    contents = []
    runs = []
    for at, some in enumerate(cells.values()):
        for name, cell in some.items():
            metric = {"key": "ate_rmse_m", "which": cell.rows[0].trajectory}
            run = cell.typical
            contents.append(cell_data(cell, at, names.index(name), [metric], rank_seen=True))
            runs.append(
                [
                    run.run_id,
                    at,
                    names.index(name),
                    run.repeat,
                    run.ending,
                    3 * (run.run_id in paged),
                ]
            )
    board = {
        "protocol": evaluated,
        "pageless": "",
        "unlisted": 0,
        "trackers": [
            {"label": label, "settings": settings_data(next(iter(some.values())).rows[0])}
            for label, some in cells.items()
        ],
        "sequences": [{"name": name, "short": name, "tags": []} for name in names],
        "cells": contents,
        "runs": runs,
        "pairs": [[2 * at, 2 * at + 1] for at in range(len(compared))],
    }
    sweep_temporary(output, "**/.*")
    write_side(output, "board", board)
    ratios = [
        [2 * at, 2 * at + 1, *ratio_numbers(overall[name]), len(pairs), ""]
        for at, (name, pairs) in enumerate(compared.items())
    ]
    write_side(output, "ratios", ratios)
    write_assets(output)
    shown = {"links": [("index.html", "Comparison")], "scripts": ["run.js"]}
    write_atomic(output / RUN_PAGE, render("run.html.j2", title="Run", **shown))
    compare_page = {
        "title": "B against A",
        "here": "index.html",
        "scripts": ["run.js", "compare.js"],
    }
    write_atomic(output / "index.html", render("compare.html.j2", **(shown | compare_page)))
    return output / "index.html"


def _read(source: Path | str | RunStore, protocol: Protocol) -> tuple[list[RunRow], str]:
    """The rows of results or of a report, and how they were evaluated, in words."""
    if not isinstance(source, RunStore):
        path = Path(source).expanduser()
        for file in (path, path / REPORT_FILE):
            if file.is_file():
                rows = ReportData.read(file).rows
                return rows, rows[0].protocol_id if rows else ""
    return load_runs(open_stores(source), protocol, trials=True).rows, protocol.describe()


def _by_column(rows: Sequence[RunRow]) -> dict[str, list[RunRow]]:
    return grouped(rows, lambda row: row.column_id)


def pair_variants(
    a: Mapping[str, list[RunRow]], b: Mapping[str, list[RunRow]]
) -> list[tuple[str, str]]:
    """Variants of A and B that share a column: equal ones, then those that differ least, each at most once.

    Of several programs those that rank come first.
    """
    candidates = [
        (
            one != other,
            len(_differences(a[one][0], b[other][0])),
            _not_current(a[one][0], b[other][0]),
            one,
            other,
        )
        for one, other in product(a, b)
        if (a[one][0].tracker.id, a[one][0].kind) == (b[other][0].tracker.id, b[other][0].kind)
        and (one == other or (one not in b and other not in a))
    ]
    pairs: list[tuple[str, str]] = []
    for *_, one, other in sorted(candidates, key=itemgetter(0, 1, 2)):
        unused = all(one != pair[0] and other != pair[1] for pair in pairs)
        if unused and _by_column(a[one]).keys() & _by_column(b[other]).keys():
            pairs.append((one, other))
    return pairs


def _not_current(first: RunRow, second: RunRow) -> int:
    """How many of two rows are by programs that do not rank."""
    return (not first.is_current) + (not second.is_current)


def _differences(first: RunRow, second: RunRow) -> list[str]:
    """The settings that set a variant of A apart from one of B, in words."""
    names = sorted(
        name
        for name in {*first.variant, *second.variant}
        if first.variant.get(name) != second.variant.get(name)
    )
    sides = [
        {name: setting_text(row.variant.get(name, "default")) for name in names}
        for row in (first, second)
    ]
    return [f"{name}: {sides[0][name]} in A, {sides[1][name]} in B" for name in names]


def ratio_of(_: str, a: Cell, b: Cell) -> float:
    """B's median error over A's."""
    return max(b.median or 0.0, FLOOR_M) / max(a.median or 0.0, FLOOR_M)


def overall_ratio(paired: Sequence[Paired]) -> Interval:
    """Geometric mean of the ratios over sequences, with its interval; categories weigh the same, as on a board."""
    groups = [group_of(a.rows[0].sequence.tags) for _, a, _ in paired]
    return ratio_interval(np.log([ratio_of(*pair) for pair in paired]), group_weights(groups))


def _table(
    title: str,
    caption: str,
    compared: Mapping[str, Sequence[Paired]],
    overall: Mapping[str, Interval],
) -> Table:
    """Every tracker and sequence with both medians, and one line a tracker over all sequences."""
    rows: list[list[TableCell]] = []
    separators = set()
    for name, paired in compared.items():
        separators.add(len(rows))
        for sequence, *sides in paired:
            coverages = [mean_of(row.coverage for row in cell.rows) for cell in sides]
            rows.append(
                [
                    TableCell(name),
                    TableCell(sequence),
                    *(TableCell(mm(cell.median or 0.0), value=cell.median) for cell in sides),
                    number(ratio_of(sequence, *sides), ".3f"),
                    TableCell(),
                    *(TableCell(coverage_text(coverage), value=coverage) for coverage in coverages),
                    TableCell(" + ".join(str(len(cell.scores)) for cell in sides)),
                ]
            )
        wins = sum(ratio_of(*pair) < 1 for pair in paired)
        ratio = interval_cell(overall[name], ".3f", "best")
        verdict = TableCell(_verdict(overall[name], wins, len(paired)))
        words = [TableCell(name), TableCell(f"all {len(paired)} sequences")]
        rows.append([*words, *[TableCell()] * 2, ratio, verdict, *[TableCell()] * 3])
    columns = [
        *texts("tracker", "sequence"),
        *numbers("ATE A", "ATE B", "B / A"),
        *texts("verdict"),
    ]
    columns += numbers("coverage A", "coverage B", "runs")
    return Table("paired", title, caption, columns, rows, separators=separators - {0})


def _verdict(ratio: Interval, wins: int, sequences: int) -> str:
    if sequences < FEWEST:
        return (
            "equal" if ratio.value == 1 else f"B better on {wins} of {sequences}, too few to tell"
        )
    return "better" if ratio.high < 1 else "worse" if ratio.low > 1 else "no difference shown"
