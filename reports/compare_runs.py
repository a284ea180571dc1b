"""Two sets of results against each other: before and after a change of the code, or of the settings."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any

from dynslam_bench.core import ReportError, setting_text, sweep_temporary, write_atomic
from dynslam_bench.core.number_text import mm
from dynslam_bench.evaluation import Protocol, get_protocol
from dynslam_bench.evaluation.verdicts import (
    FEWEST,
    FLOOR_M,
    ComparisonVerdict,
    PairedRatio,
    findings,
    paired_ratio,
    verdict_of,
)
from dynslam_bench.reports.figures import significant
from dynslam_bench.reports.html.board_page import cell_data, settings_data
from dynslam_bench.reports.html.page import render, write_assets, write_side
from dynslam_bench.reports.html.run_pages import RUN_PAGE, write_run_pages
from dynslam_bench.reports.model.board import TrackerOnSequence, copies_of, make_cell, mean_coverage
from dynslam_bench.reports.model.load import check_one_protocol, load_runs, open_stores
from dynslam_bench.reports.model.names import make_labels, name_columns
from dynslam_bench.reports.model.row import REPORT_FILE, SEEN, ReportData, RunRow, grouped
from dynslam_bench.reports.tables.table import Table, TableCell, number, numbers, texts
from dynslam_bench.runs.record import coverage_text
from dynslam_bench.runs.store import RunStore

Paired = tuple[str, TrackerOnSequence, TrackerOnSequence]
"""A sequence, with `SEEN` behind it if a side's network was trained on it, and one tracker's runs in A and in B."""
Variants = Mapping[str, list[RunRow]]
"""Variant key of a tracker to its rows."""


@dataclass(frozen=True)
class Comparison:
    """Changes from A to B: every tracker's errors on the common sequences, and the verdict.

    Attributes:
        overall: Tracker and what differs to B's median ATE over A's: the typical ratio over
            sequences where both succeed, and the sequences that either lost; A is the baseline.
        verdicts: Tracker, as in `overall`, to the verdict on B.
        findings: Tracker, as in `overall`, to what was found, in sentences without full stops.
        table: Every tracker and sequence with both medians.
        only_a: Runs that only A has.
        only_b: Runs that only B has.
        differences: Tracker, as in `overall`, to the settings that differ, e.g.
            ``epipolar.threshold_px: default in A, 2 in B``; empty where the settings are the same.
        page: The page that shows it; None where none was asked for.
    """

    overall: dict[str, PairedRatio]
    verdicts: dict[str, ComparisonVerdict]
    findings: dict[str, list[str]]
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
    conclusion: str = "",
) -> Comparison:
    """Compare two results folders, or two reports, on the sequences that both have.

    A tracker with the same settings on both sides is compared with itself. Settings that only one
    side has are compared with those of the same tracker that only the other has and that differ in
    the fewest values.

    Args:
        a: First side: a results folder, a store, or the folder of a report (``report.json``).
        b: Second side, named in one of these ways.
        protocol: How results folders are evaluated; a report brings its own.
        output: Folder of a page that shows it; None for none.
        conclusion: What the page says in place of the verdict, where another rule judged the runs.

    Raises:
        ReportError: One holds no runs, nothing is in both, or their numbers stem from different
            protocols.
    """
    # read both sides
    protocol = get_protocol(protocol)
    (rows_a, evaluated) = _read(a, protocol)
    (rows_b, _) = _read(b, protocol)
    check_one_protocol([*rows_a, *rows_b])
    name_a = _source_name(a)
    name_b = _source_name(b)

    # pair the variants of trackers
    variants_a = grouped(rows_a, lambda row: row.variant_key)
    variants_b = grouped(rows_b, lambda row: row.variant_key)
    pairs = pair_variants(variants_a, variants_b)
    if not pairs:
        raise ReportError(
            f"{name_a} ({len(rows_a)} runs) and {name_b} ({len(rows_b)} runs) have no tracker and sequence in common",
            "compare results of the same suite",
        )
    columns = name_columns([*rows_a, *rows_b])
    labels = make_labels(
        [row for one, other in pairs for row in (*variants_a[one], *variants_b[other])]
    )

    # pair the runs of each on the sequences that both have
    compared: dict[str, list[Paired]] = {}
    differences: dict[str, list[str]] = {}
    only_a = len(rows_a)
    only_b = len(rows_b)
    for one, other in pairs:
        name = labels[one] if one == other else f"{labels[one]} → {labels[other]}"
        columns_a = _by_column(variants_a[one])
        columns_b = _by_column(variants_b[other])
        for column in columns_a.keys() & columns_b.keys():
            only_a -= len(columns_a[column])
            only_b -= len(columns_b[column])
        paired = _pair_cells(columns_a, columns_b, columns)
        if paired:
            compared[name] = paired
            differences[name] = _differences(variants_a[one][0], variants_b[other][0])
    if not compared:
        raise ReportError("none of the runs in common has ground truth", "nothing can be compared")

    # B beside A over all sequences, as a table and as a page
    overall = {name: overall_ratio(paired) for name, paired in compared.items()}
    verdicts = {name: verdict_of(ratio) for name, ratio in overall.items()}
    sentences = {name: findings(ratio, "B") for name, ratio in overall.items()}
    page = None
    if output is not None:
        page = _write_page(Path(output), protocol, evaluated, compared, overall, conclusion)
    title = f"{name_a} (A) against {name_b} (B)"
    table = _table(title, _caption(evaluated, differences), compared, overall)
    return Comparison(overall, verdicts, sentences, table, only_a, only_b, differences, page)


def _source_name(source: Path | str | RunStore) -> str:
    """The folder of results or of a report."""
    return str(source.root if isinstance(source, RunStore) else source)


def _pair_cells(a: Variants, b: Variants, columns: Mapping[str, str]) -> list[Paired]:
    """The runs of one tracker in A and in B on the sequences on which both have errors or are lost, by sequence.

    Args:
        a: Column id to the runs in A.
        b: Column id to the runs in B.
        columns: Column id to the name of its sequence.
    """
    paired = []
    for column in a.keys() & b.keys():
        # the repeats that both have, or all where they share none
        repeats = {row.repeat_key for row in a[column]} & {row.repeat_key for row in b[column]}
        cell_a = make_cell([row for row in a[column] if row.repeat_key in repeats] or a[column])
        cell_b = make_cell([row for row in b[column] if row.repeat_key in repeats] or b[column])
        # before a fixed camera a lost cell has no error
        is_known = all(cell.scores or cell.lost for cell in (cell_a, cell_b))
        if is_known and (cell_a.scores or cell_b.scores):
            mark = f" {SEEN}" if cell_a.in_training or cell_b.in_training else ""
            paired.append((columns[column] + mark, cell_a, cell_b))
    return sorted(paired, key=itemgetter(0))


def _caption(evaluated: str, differences: Mapping[str, list[str]]) -> str:
    """Sentences on reading the table, and on the settings in which the trackers differ."""
    changed = "; ".join(
        f"{name}: {', '.join(words)}" for name, words in differences.items() if words
    )
    what_differs = f"What differs: {changed}." if changed else "The settings are the same."
    return (
        f"{evaluated}. Median ATE (millimetres), lost frames held, over the repeats that both have, or all where they "
        "share none; failures count as a static camera, or worse. B / A below 1: B is better. Over all sequences: the "
        "typical ratio where both succeed, with the exact 95 % interval of Wilcoxon's signed-rank test; a sequence is "
        "lost where half of its runs failed or the error is three times the other's, and counts beside it. One "
        f"recording counts once. From {FEWEST} sequences on something is claimed. {what_differs}"
    )


def _write_page(
    output: Path,
    protocol: Protocol,
    evaluated: str,
    compared: Mapping[str, Sequence[Paired]],
    overall: Mapping[str, PairedRatio],
    conclusion: str,
) -> Path:
    """Write the page: both sides of every tracker, with the pages of the runs that stand for a cell."""
    output = output.expanduser().absolute()

    # label to sequence to cell; every tracker is listed twice, first in A and then in B
    cells: dict[str, dict[str, TrackerOnSequence]] = {}
    for name, pairs in compared.items():
        cells[f"A: {name}"] = {sequence: cell_a for sequence, cell_a, _ in pairs}
        cells[f"B: {name}"] = {sequence: cell_b for sequence, _, cell_b in pairs}

    # the pages of the typical runs, as far as there are files: a report alone brings none
    paged = {}
    for by_sequence in cells.values():
        for cell in by_sequence.values():
            if cell.typical.folder.is_dir():
                paged[cell.typical.run_id] = cell.typical
    write_run_pages(list(paged.values()), paged, protocol, output)

    # what the page reads; trackers come in pairs
    sweep_temporary(output, "**/.*")
    board = _board_data(cells, evaluated, paged)
    write_side(output, "board", board)
    ratios = [
        [
            2 * at,
            2 * at + 1,
            *_numbers(ratio),
            ratio.scenes,
            verdict_of(ratio),
            "",
            conclusion or _sentence(ratio),
        ]
        for at, ratio in enumerate(overall.values())
    ]
    write_side(output, "ratios", ratios)

    # the page, and that of a run
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


def _board_data(
    cells: Mapping[str, Mapping[str, TrackerOnSequence]], evaluated: str, paged: Collection[str]
) -> dict[str, Any]:
    """Content of ``data/board.js``, see `html.board_page.board_data`; of every cell the typical run is listed.

    Args:
        cells: Label to sequence to cell, A and B of each tracker after each other.
        evaluated: How errors were computed, in words.
        paged: Ids of the runs that have a page and pictures.
    """
    names = sorted({name for by_sequence in cells.values() for name in by_sequence})
    cells_data = []
    runs = []
    for tracker, by_sequence in enumerate(cells.values()):
        for name, cell in by_sequence.items():
            sequence = names.index(name)
            metric = {"key": "ate_rmse_m", "which": cell.rows[0].trajectory}
            cells_data.append(cell_data(cell, tracker, sequence, [metric], rank_seen=True))
            run = cell.typical
            has_page_and_pictures = 3 * (run.run_id in paged)
            place = (tracker, sequence)
            runs.append([run.run_id, *place, run.repeat, run.ending, has_page_and_pictures])
    trackers = []
    for label, by_sequence in cells.items():
        first = next(iter(by_sequence.values())).rows[0]
        trackers.append({"label": label, "settings": settings_data(first)})
    return {
        "protocol": evaluated,
        "pageless": "",
        "unlisted": 0,
        "trackers": trackers,
        "sequences": [{"name": name, "short": name, "tags": []} for name in names],
        "cells": cells_data,
        "runs": runs,
        "pairs": [[at, at + 1] for at in range(0, len(cells), 2)],
    }


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
    """Column id to the rows of it."""
    return grouped(rows, lambda row: row.sequence_key)


def pair_variants(a: Variants, b: Variants) -> list[tuple[str, str]]:
    """Variants of A and B that share a column: equal ones, then those that differ least, each at most once.

    Of several programs those that rank come first.
    """
    # runs of one tracker, with the same settings or with settings that the other side has not
    candidates = []
    for one, other in product(a, b):
        first = a[one][0]
        second = b[other][0]
        is_one_tracker = (first.tracker.id, first.kind) == (second.tracker.id, second.kind)
        if is_one_tracker and (one == other or (one not in b and other not in a)):
            n_differences = len(_differences(first, second))
            order = (one != other, n_differences, _not_current(first, second))
            candidates.append((*order, one, other))

    # the best first, as long as both are unused
    pairs: list[tuple[str, str]] = []
    for *_, one, other in sorted(candidates, key=itemgetter(0, 1, 2)):
        unused = all(one != pair[0] and other != pair[1] for pair in pairs)
        if unused and _by_column(a[one]).keys() & _by_column(b[other]).keys():
            pairs.append((one, other))
    return pairs


def _not_current(first: RunRow, second: RunRow) -> int:
    """Number of the two rows that are by a program that does not rank."""
    return (not first.is_current) + (not second.is_current)


def _differences(first: RunRow, second: RunRow) -> list[str]:
    """The settings that set a variant of A apart from one of B, in words."""
    names = sorted(
        name
        for name in {*first.variant, *second.variant}
        if first.variant.get(name) != second.variant.get(name)
    )
    words = []
    for name in names:
        in_a = setting_text(first.variant.get(name, "default"))
        in_b = setting_text(second.variant.get(name, "default"))
        words.append(f"{name}: {in_a} in A, {in_b} in B")
    return words


def ratio_of(a: TrackerOnSequence, b: TrackerOnSequence) -> float | None:
    """B's median error over A's; None where one of them has none: lost before a fixed camera."""
    if a.median is None or b.median is None:
        return None
    return max(b.median, FLOOR_M) / max(a.median, FLOOR_M)


def overall_ratio(paired: Sequence[Paired]) -> PairedRatio:
    """B beside A over the sequences, each recording once."""
    # a recording that is there under several names counts once
    copies = copies_of({sequence: [*a.rows, *b.rows] for sequence, a, b in paired})
    log_ratios = {}
    lost: list[str] = []
    lost_by_a: list[str] = []
    floored: list[str] = []
    runs = 0
    for sequence, cell_a, cell_b in paired:
        if sequence in copies:
            continue
        # losses of either side, and the ratio where both have an error
        lost += [sequence] * cell_b.lost
        lost_by_a += [sequence] * cell_a.lost
        runs += min(len(cell_a.kept), len(cell_b.kept))
        ratio = ratio_of(cell_a, cell_b)
        if ratio is not None:
            log_ratios[sequence] = math.log(ratio)
            smallest = min(cell.median or 0.0 for cell in (cell_a, cell_b))
            floored += [sequence] * (smallest < FLOOR_M)
    return paired_ratio(log_ratios, lost, lost_by_a, runs=runs, floored=floored)


def _numbers(ratio: PairedRatio) -> list[float | None]:
    """A typical ratio and the ends of its interval, as the page reads them."""
    return [significant(value) for value in (ratio.ratio, ratio.low, ratio.high)]


def _sentence(ratio: PairedRatio) -> str:
    """The finding in a sentence, as the page says it."""
    return f"{'. '.join(findings(ratio, 'B'))}. Verdict: {verdict_of(ratio).value}."


def _table(
    title: str,
    caption: str,
    compared: Mapping[str, Sequence[Paired]],
    overall: Mapping[str, PairedRatio],
) -> Table:
    """Every tracker and sequence with both medians, and one line a tracker over all sequences."""
    rows: list[list[TableCell]] = []
    separators = set()
    for name, paired in compared.items():
        separators.add(len(rows))

        # a line for every sequence
        for sequence, cell_a, cell_b in paired:
            rows.append(
                [
                    TableCell(name),
                    TableCell(sequence),
                    _error_cell(cell_a),
                    _error_cell(cell_b),
                    number(ratio_of(cell_a, cell_b), ".3f"),
                    TableCell(),
                    _coverage_cell(cell_a),
                    _coverage_cell(cell_b),
                    TableCell(f"{len(cell_a.scores)} + {len(cell_b.scores)}"),
                ]
            )

        # a line over all sequences
        ratio = overall[name]
        words = [TableCell(name), TableCell(_all_sequences(ratio))]
        rows.append(
            [
                *words,
                *[TableCell()] * 2,
                _ratio_cell(ratio),
                _verdict_cell(ratio),
                *[TableCell()] * 3,
            ]
        )
    columns = [
        *texts("tracker", "sequence"),
        *numbers("ATE A", "ATE B", "B / A"),
        *texts("verdict"),
    ]
    columns += numbers("coverage A", "coverage B", "runs")
    return Table("paired", title, caption, columns, rows, separators=separators - {0})


def _error_cell(cell: TrackerOnSequence) -> TableCell:
    """The median error of runs, in millimetres, and whether the cell is lost."""
    text = "" if cell.median is None else mm(cell.median)
    return TableCell(text, "lost" if cell.lost else "", cell.median)


def _coverage_cell(cell: TrackerOnSequence) -> TableCell:
    """The mean coverage of runs."""
    coverage, truth_share = mean_coverage(cell.rows)
    return TableCell(coverage_text(coverage, truth_share), value=coverage)


def _all_sequences(ratio: PairedRatio) -> str:
    """Over how many sequences a line is."""
    count = ratio.all_scenes
    return f"all {count} sequences" if count != 1 else "1 sequence"


def _ratio_cell(ratio: PairedRatio) -> TableCell:
    """The typical ratio with its interval, if it has one."""
    if ratio.ratio is None:
        return TableCell()
    return TableCell(f"{ratio.ratio:.3f}", ratio.interval, ratio.ratio, "best")


def _verdict_cell(ratio: PairedRatio) -> TableCell:
    """The verdict on B, and how many sequences either alone lost."""
    small = ""
    if ratio.losses or ratio.losses_baseline:
        small = f"lost {len(ratio.losses)} of {ratio.all_scenes}, A {len(ratio.losses_baseline)}"
    return TableCell(verdict_of(ratio).value, small)
