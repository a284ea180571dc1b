"""The implemented paper's Tables 1 to 3, made of our own runs: four statistics of the errors, improvements, time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.reports.model.board import Board, Cell
from dynslam_bench.reports.model.row import SEEN, RunRow
from dynslam_bench.reports.tables.errors import Value, column_marks, median_of
from dynslam_bench.reports.tables.table import Column, Emphasis, Table, TableCell, mm

SUBJECT = "emfoa-oft"
"""Tracker whose improvement over the others is shown, where it was run."""
STATISTICS = {"rmse": "RMSE", "mean": "mean", "median": "median", "std": "SD"}
LOST_MARK = "¶"
LOST_NOTE = f"{LOST_MARK} Frames were lost in a run of the cell: the error is of the tracked ones only."
Found = Mapping[tuple[str, str], float]
"""Variant key and sequence to a number."""


def subject_of(board: Board) -> str | None:
    """The tracker that is compared with the others: `SUBJECT` as it is by default, else the best ranked one."""
    own = [key for key in board.trackers if board.first(key).tracker == SUBJECT and key not in board.hopeless]
    ranked = board.ranked_order()
    return min(own, key=lambda key: len(board.first(key).variant), default=ranked[0] if ranked else None)


def absolute_table(board: Board, protocol: Protocol) -> Table | None:
    """Table 1: RMSE, mean, median and standard deviation of the absolute error; None if no run has it."""
    return _statistics_table(
        board, {name: f"ate_{name}_m" for name in STATISTICS}, "paper_ape", "Absolute pose error, four statistics",
        f"As the paper's Table 1. {protocol.describe()}.", "Absolute pose error (mm)",
    )  # fmt: skip


def relative_table(board: Board, protocol: Protocol) -> Table | None:
    """Table 2: the same of the protocol's first relative error; None if it has none."""
    if not protocol.rpe:
        return None
    spec = protocol.rpe[0]
    return _statistics_table(
        board,
        {name: f"rpe_{spec.key}_trans_{name}_m" for name in STATISTICS},
        "paper_rpe",
        "Relative pose error, four statistics",
        f"As the paper's Table 2, over {spec.describe()}. {protocol.describe()}.",
        f"Relative pose error over {spec.describe()} (mm)",
    )


def time_table(board: Board) -> Table | None:
    """Table 3: accuracy, error and time of a frame; None if nothing was scored."""
    kinds: dict[str, tuple[Value, Callable[[float], str]]] = {
        "accuracy (%)": (lambda row: None if (share := _share(row)) is None else 100 - share, "{:.1f}".format),
        "error (%)": (_share, "{:.1f}".format),
        "time (ms)": (lambda row: row.frame_ms, "{:.1f}".format),
    }
    columns, found = _columns(board, kinds), {name: _medians(board, value) for name, (value, _) in kinds.items()}
    keys = [key for key in board.trackers if any((key, name) in found["error (%)"] for name in board.sequences)]
    if not keys:
        return None
    rows = [
        [TableCell(board.labels[key])]
        + [_number(found[name].get((key, sequence)), kinds[name][1]) for sequence in board.sequences for name in kinds]
        for key in keys
    ]
    caption = (
        "As the paper's Table 3. Error: the median ATE, lost frames held, in percent of that of a static camera"
        "; accuracy: what is left of 100 %, negative for a tracker that is worse than that. (The paper does "
        "not define its own; its numbers are 100 times one minus the standard deviation in metres.) Time: median of a "
        "frame, segmentation included, decoding excluded. Runs that succeeded."
    )
    muted = [at for at, key in enumerate(keys) if key not in board.ranked]
    brief = "Error in percent of a static camera, accuracy, and time of a frame"
    return Table("paper_accuracy", "Accuracy, error and time", caption, columns, rows, muted, brief=brief)


def _share(row: RunRow) -> float | None:
    """A run's error in percent of that of a static camera."""
    static_m = row.static_camera_ate_rmse_m
    return None if not static_m or row.hold_last_pose_ate_m is None else 100 * row.hold_last_pose_ate_m / static_m


def _statistics_table(
    board: Board, metrics: Mapping[str, str], name: str, title: str, source: str, brief: str
) -> Table | None:
    found = {kind: _medians(board, lambda row, m=metric: row.metrics.get(m)) for kind, metric in metrics.items()}  # type: ignore[misc]
    keys = [key for key in board.trackers if any((key, sequence) in found["rmse"] for sequence in board.sequences)]
    if not keys:
        return None
    marks = {kind: column_marks(board, dict(values)) for kind, values in found.items()}
    rows = [[TableCell(board.labels[key]), *_error_cells(board, key, found, marks)] for key in keys]
    subject = subject_of(board)
    others = [key for key in keys if key in board.ranked and key != subject] if subject in keys else []
    rows += [_improvement_row(board, str(subject), other, found) for other in others]
    muted = [at for at, key in enumerate(keys) if key not in board.ranked]
    lost = any(cell.text.endswith(LOST_MARK) for row in rows for cell in row)
    caption = (
        f"{source} Millimetres (metres in the CSV), median over the runs that succeeded."
        + (f" {LOST_NOTE}" if lost else "")
        + (
            f" Below the line: by how many percent the error of {board.labels[str(subject)]} is smaller than that of "
            "the other tracker."
            if others
            else ""
        )
    )
    separators = {len(keys)} if others else set()
    return Table(name, title, caption, _columns(board, metrics), rows, muted, separators, brief)


def _columns(board: Board, kinds: Mapping[str, object]) -> list[Column]:
    return [Column("tracker", numeric=False)] + [
        Column(STATISTICS.get(kind, kind), board.short[name], full=f"{name}: {STATISTICS.get(kind, kind)}")
        for name in board.sequences
        for kind in kinds
    ]


def _medians(board: Board, value: Value) -> dict[tuple[str, str], float]:
    """Median of a number over the runs that succeeded, by tracker and sequence."""
    return {
        (key, name): number
        for key in board.trackers
        for name, cell in board.cells[key].items()
        if name in board.sequences and (number := median_of(cell, value)) is not None
    }


def _error_cells(
    board: Board,
    key: str,
    found: Mapping[str, Found],
    marks: Mapping[str, Mapping[tuple[str, str], Emphasis]],
) -> Iterator[TableCell]:
    for name in board.sequences:
        cell = board.cells[key].get(name)
        lost = has_lost(cell)
        for kind, values in found.items():
            number = values.get((key, name))
            if cell is not None and not cell.success:
                yield TableCell(emphasis="failed", tip=cell.ending)
            elif number is None:
                yield TableCell()
            else:
                mark = marks[kind].get((key, name), "")
                seen = cell is not None and cell.seen
                yield TableCell(mm(number) + SEEN * seen + LOST_MARK * lost, value=number, emphasis=mark)


def has_lost(cell: Cell | None) -> bool:
    """Whether frames were lost in a run that succeeded: the errors of the cell are of the tracked ones only."""
    return cell is not None and any(row.coverage < 1 for row in cell.kept if not row.failed)


def _improvement_row(board: Board, subject: str, other: str, found: Mapping[str, Found]) -> list[TableCell]:
    cells = [TableCell(f"improvement on {board.labels[other]}")]
    for name in board.sequences:
        for values in found.values():
            own, theirs = values.get((subject, name)), values.get((other, name))
            gain = None if own is None or not theirs else 100 * (theirs - own) / theirs
            cells.append(_number(gain, "{:.1f} %".format))
    return cells


def _number(value: float | None, text: Callable[[float], str]) -> TableCell:
    return TableCell() if value is None else TableCell(text(value), value=value)


def averages(board: Board, metric: str, keys: Sequence[str]) -> dict[str, dict[str, float]]:
    """For bar charts: tracker to sequence to the median of a metric over the runs that succeeded, in metres."""
    found = _medians(board, lambda row: row.metrics.get(metric))
    return {key: {name: found[key, name] for name in board.sequences if (key, name) in found} for key in keys}
