"""Leaderboards: one offline HTML page with Markdown, CSV and LaTeX beside it, and pandas frames to go on with.

`build_report` writes the page, `publish` makes a site of it, `compare` holds two results folders against each other,
`load_frame` gives every run as a row of a pandas frame, and `make_board` orders rows into the board that tables and
figures are made of.
"""

from .build_report import ReportPaths, build_report
from .compare_runs import Comparison, compare
from .model.board import Board, make_board
from .model.load import load_board, load_frame
from .model.report_data import ReportData
from .model.row import RunRow
from .publish import Site, publish

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
