"""The implemented paper's Tables 1 to 3, made of our own runs: four statistics of the errors, improvements, time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.reports.model.board import Board, Cell
from dynslam_bench.reports.model.row import SEEN, RunRow
from dynslam_bench.reports.tables.errors import Value, column_marks, medians
from dynslam_bench.reports.tables.leaderboard import Marks
from dynslam_bench.reports.tables.table import Column, Table, TableCell, mm, number, texts

SUBJECT = "emfoa-oft"
"""Tracker whose improvement over the others is shown, where it was run."""
STATISTICS = {"rmse": "RMSE", "mean": "mean", "median": "median", "std": "SD"}
LOST_MARK = "¶"
LOST_NOTE = f"{LOST_MARK} Frames were lost in a run of the cell: the error is of the tracked ones only."


def subject_of(board: Board) -> str | None:
    """The tracker that is compared with the others: `SUBJECT` as it is by default, else the best ranked one."""
    own = [key for key in board.trackers if board.first(key).tracker.id == SUBJECT and key not in board.hopeless]
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
    columns: dict[str, Value] = {
        "accuracy (%)": lambda row: None if (share := _share(row)) is None else 100 - share,
        "error (%)": _share,
        "time (ms)": lambda row: row.frame_ms,
    }
    medians_of = {name: medians(board, value, board.trackers) for name, value in columns.items()}
    keys = list(dict.fromkeys(key for key, _ in medians_of["error (%)"]))
    if not keys:
        return None
    rows = []
    for key in keys:
        numbers = [of_cell.get((key, name)) for name in board.sequences for of_cell in medians_of.values()]
        rows.append([TableCell(board.labels[key]), *(number(value, ".1f") for value in numbers)])
    caption = (
        "As the paper's Table 3. Error: the median ATE, lost frames held, in percent of that of a static camera"
        "; accuracy: what is left of 100 %, negative for a tracker that is worse than that. (The paper does "
        "not define its own; its numbers are 100 times one minus the standard deviation in metres.) Time: median of a "
        "frame, segmentation included, decoding excluded. Runs that succeeded."
    )
    muted = board.unranked_rows(keys)
    brief = "Error in percent of a static camera, accuracy, and time of a frame"
    return Table(
        "paper_accuracy", "Accuracy, error and time", caption, _columns(board, columns), rows, muted, brief=brief
    )


def _share(row: RunRow) -> float | None:
    """A run's error in percent of that of a static camera."""
    static_m = row.static_camera_ate_rmse_m
    return None if not static_m or row.hold_last_pose_ate_m is None else 100 * row.hold_last_pose_ate_m / static_m


def _statistics_table(
    board: Board, metrics: Mapping[str, str], name: str, title: str, source: str, brief: str
) -> Table | None:
    errors = {
        kind: medians(board, lambda row, metric=metric: row.metrics.get(metric), board.trackers)  # type: ignore[misc]
        for kind, metric in metrics.items()
    }
    keys = list(dict.fromkeys(key for key, _ in errors["rmse"]))
    if not keys:
        return None
    marks = {kind: column_marks(board, values) for kind, values in errors.items()}
    rows = [[TableCell(board.labels[key]), *_error_cells(board, key, errors, marks)] for key in keys]
    subject = subject_of(board)
    others = [key for key in keys if key in board.ranked and key != subject] if subject in keys else []
    for other in others:
        cells = [TableCell(f"improvement on {board.labels[other]}")]
        for sequence in board.sequences:
            for values in errors.values():
                ours, theirs = values.get((str(subject), sequence)), values.get((other, sequence))
                gain = None if ours is None or not theirs else 100 * (theirs - ours) / theirs
                cells.append(number(gain, ".1f", " %"))
        rows.append(cells)
    muted = board.unranked_rows(keys)
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


def _columns(board: Board, kinds: Iterable[str]) -> list[Column]:
    return texts("tracker") + [
        Column(STATISTICS.get(kind, kind), board.short[name], full=f"{name}: {STATISTICS.get(kind, kind)}")
        for name in board.sequences
        for kind in kinds
    ]


def _error_cells(
    board: Board, key: str, errors: Mapping[str, Mapping[tuple[str, str], float]], marks: Mapping[str, Marks]
) -> Iterator[TableCell]:
    for name in board.sequences:
        cell = board.cells[key].get(name)
        for kind, values in errors.items():
            if cell is not None and not cell.success:
                yield TableCell(emphasis="failed", tip=cell.ending)
            elif cell is None or (key, name) not in values:
                yield TableCell()
            else:
                error, mark = values[key, name], marks[kind].get((key, name), "")
                yield TableCell(mm(error) + SEEN * cell.seen + LOST_MARK * has_lost(cell), value=error, emphasis=mark)


def has_lost(cell: Cell | None) -> bool:
    """Whether frames were lost in a run that succeeded: the errors of the cell are of the tracked ones only."""
    return cell is not None and any(row.coverage < 1 for row in cell.kept if not row.failed)
