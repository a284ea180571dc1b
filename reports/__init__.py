"""Leaderboards and study reports: one offline HTML page, with Markdown, CSV and LaTeX beside it."""

from .build_report import ReportData, ReportPaths, build_report
from .compare_runs import Comparison, compare
from .model.frame import load_frame
from .model.row import RunRow

__all__ = ["Comparison", "ReportData", "ReportPaths", "RunRow", "build_report", "compare", "load_frame"]
