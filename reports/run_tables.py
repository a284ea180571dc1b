"""Tables about the runs themselves: failures, repeatability, machines, and all numbers for CSV."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from statistics import median

from .board import Board
from .table import Column, Table, TableCell
from .tables import number_cell


def failures(board: Board, output: Path) -> Table | None:
    """Every run that failed, with its reason and log; None if there is none."""
    failed = [row for row in board.rows if row.failed]
    if not failed:
        return None
    columns = [
        Column("tracker", numeric=False), Column("sequence", numeric=False), Column("seed"),
        Column("status", numeric=False), Column("coverage"), Column("reason", numeric=False),
        Column("log", numeric=False),
    ]  # fmt: skip
    rows = [
        [
            TableCell(board.labels[row.variant_key]),
            TableCell(row.sequence_key),
            TableCell(str(row.seed), value=row.seed),
            TableCell(row.status if row.status != "ok" else "not evaluated"),
            TableCell(f"{100 * row.coverage:.1f} %", value=row.coverage),
            TableCell(row.reason),
            TableCell(row.run_id, link=_relative(row.log, output)),
        ]
        for row in sorted(failed, key=lambda row: (board.labels[row.variant_key], row.sequence_key, row.seed))
    ]
    caption = "Runs that crashed, took too long or too much, broke their contract, were lost, or cannot be evaluated."
    return Table("failures", "Failures", caption, columns, rows)


def repeatability(board: Board) -> Table | None:
    """Spread of the runs of a cell; None if no cell has several."""
    columns = [
        Column("tracker", numeric=False), Column("cells", meaning="sequences with several runs"), Column("runs a cell"),
        Column("worst / best", meaning="median over cells of the largest over the smallest ATE"),
        Column("largest worst / best"), Column("where", numeric=False),
    ]  # fmt: skip
    rows = []
    for key in board.trackers:
        spreads = []
        for sequence in board.sequences:
            cell = board.cells[key].get(sequence)
            if cell and len(cell.scores) > 1:
                spreads.append((max(cell.scores) / max(min(cell.scores), 1e-6), sequence, len(cell.scores)))
        if not spreads:
            continue
        worst = max(spreads)
        middle = median(spread for spread, _, _ in spreads)
        rows.append(
            [
                TableCell(board.labels[key]),
                TableCell(str(len(spreads)), value=len(spreads)),
                TableCell(f"{median(n for _, _, n in spreads):g}"),
                TableCell(f"{middle:.2f}", value=middle),
                TableCell(f"{worst[0]:.2f}", value=worst[0]),
                TableCell(worst[1]),
            ]
        )
    if not rows:
        return None
    caption = (
        "How far the runs of one tracker on one sequence lie apart when only the seed differs; 1.00 is a repetition "
        "to the digit. Differences between trackers that are smaller than this are noise."
    )
    return Table("repeatability", "Repeatability", caption, columns, rows)


def machines(board: Board) -> Table:
    """Computers and versions behind the runs."""
    counts = Counter(row.machine or "not recorded" for row in board.rows)
    columns = [Column("runs"), Column("machine and versions", numeric=False)]
    rows = [[TableCell(str(count), value=count), TableCell(name)] for name, count in counts.most_common()]
    caption = "Times of different machines are not comparable."
    return Table("machines", "Machines and versions", caption, columns, rows)


def all_runs(board: Board) -> Table:
    """Every run with every metric, for CSV."""
    metrics = sorted({name for row in board.rows for name in row.metrics})
    plain = ["run_id", "kind", "tracker", "sequence_key", "seed", "status", "protocol_id", "protocol_digest"]
    numbers = [
        "coverage",
        "n_frames",
        "score_m",
        "held_ate_m",
        "final_ate_m",
        "never_move_m",
        "frame_ms",
        "real_time_factor",
        "peak_memory_mb",
        "mask_iou",
    ]
    columns = [Column(name, numeric=False) for name in ["label", *plain]] + [Column(name) for name in numbers + metrics]
    rows = []
    for row in sorted(board.rows, key=lambda row: (board.labels[row.variant_key], row.sequence_key, row.seed)):
        cells = [TableCell(board.labels[row.variant_key])]
        cells += [TableCell(str(getattr(row, name))) for name in plain]
        cells += [number_cell(getattr(row, name)) for name in numbers]
        cells += [number_cell(row.metrics.get(name)) for name in metrics]
        rows.append(cells)
    return Table("runs", "All runs", "One line a run.", columns, rows)


def _relative(path: str, output: Path) -> str:
    return Path(os.path.relpath(path, output)).as_posix() if path else ""
