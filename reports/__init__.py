"""Leaderboards and study reports: one offline HTML page, with Markdown, CSV and LaTeX beside it."""

from .build import ReportData, ReportPaths, build_report
from .compare import Comparison, compare
from .frame import load_frame
from .rows import RunRow

__all__ = ["Comparison", "ReportData", "ReportPaths", "RunRow", "build_report", "compare", "load_frame"]
