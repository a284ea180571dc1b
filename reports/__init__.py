"""Leaderboards: one offline HTML page with Markdown, CSV and LaTeX beside it, and pandas frames to go on with.

`build_report` writes the page, `publish` makes a site of it, `compare` holds two results folders against each other,
`load_frame` gives every run as a row of a pandas frame, and `make_board` orders rows into the board that tables and
figures are made of.
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
