"""The section that shows our runs in the tables and figures of the implemented paper."""

from __future__ import annotations

from dynslam_bench.evaluation.protocol import Protocol

from ..figures.paper import FIGURES, bar_figure
from ..model.board import Board
from ..tables.paper import LOST_MARK, LOST_NOTE, STATISTICS, absolute_table, relative_table, time_table
from .draft import Draft
from .page import Section


def add_paper(draft: Draft, board: Board, protocol: Protocol) -> None:
    """Tables 1 to 3 and Figures 9 to 12, as the paper lays them out."""
    section = Section("paper", "As in the paper: four statistics of the errors, and time", "As in the paper")
    for table in (absolute_table(board, protocol), relative_table(board, protocol), time_table(board)):
        section.blocks += draft.titled(table)
    for statistic, number in FIGURES.items():
        figure = bar_figure(board, statistic)
        if figure is not None:
            lost = any(LOST_MARK in trace["text"] for trace in figure["data"])
            caption = (
                f"As the paper's Figure {number}: {STATISTICS[statistic]} of the absolute pose error, median over the "
                "runs that succeeded; pale bars are not ranked." + f" {LOST_NOTE}" * lost
            )
            section.blocks.append(draft.figure(f"paper-{statistic}", figure, caption))
    draft.add(section)
