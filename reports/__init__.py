"""Leaderboards: one offline HTML page with Markdown, CSV and LaTeX beside it, and pandas frames to go on with.

`build_report` writes the page, `publish` makes a site of it, `compare` holds two results folders
against each other, `load_frame` gives every run as a row of a pandas frame, and `make_board` orders
rows into the board that tables and figures are made of.

How a metric, which is a function in `evaluation.evaluate.METRICS`, comes from ``run.json`` to a
cell of the leaderboard:

1. `model.row.make_row`: a `RunRecord` and its stored trajectories, scored under the protocol, become a `RunRow`
   (`RunRow.score_m` is the error that ranks).
2. `model.load.load_runs`: which rows count; rows of unchanged runs come from the store's index.
   `model.programs.choose_runs`: of which program, and which programs share a row.
3. `model.board.make_board`: rows of one tracker and sequence become a `TrackerOnSequence`, whose error is its `median`;
   `rank` makes a `Standing` of a tracker's cells with `model.statistics.standings`.
4. `tables.leaderboard`: a `TableCell` for each of these numbers (`leaderboard`, `per_sequence`, `metric_table`).
5. `build_report`: the tables as sections of the page, and as files.
"""

from dynslam_bench.reports.build_report import ReportPaths, Site, build_report, publish
from dynslam_bench.reports.compare_runs import Comparison, compare
from dynslam_bench.reports.model.board import Board, load_board, load_frame, make_board
from dynslam_bench.reports.model.row import ReportData, RunRow

__all__ = [
    "Board",
    "Comparison",
    "ReportData",
    "ReportPaths",
    "RunRow",
    "Site",
    "build_report",
    "compare",
    "load_board",
    "load_frame",
    "make_board",
    "publish",
]
