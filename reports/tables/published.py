"""Published errors as tables, for a report and for the terminal: whose each is, and how it was measured."""

from typing import Any

import pandas as pd

from dynslam_bench.reports.model.published import NOT_STATED, lines_of
from dynslam_bench.reports.tables.table import Table, TableCell, number, numbers, texts

_IN_TABLE = {
    "mean (mm)": "ate_mean_m",
    "median (mm)": "ate_median_m",
    "SD (mm)": "ate_sd_m",
    "RPE over 1 s (mm)": "rpe_1s_trans_rmse_m",
    "RPE over 1 s (°)": "rpe_1s_rot_rmse_deg",
    "tracked (%)": "coverage_percent",
}


def published_table(lines: pd.DataFrame) -> Table | None:
    """Table of published numbers, a row for every system and source; None without any.

    Args:
        lines: Lines of `published_for`: one for every system and source.
    """
    if lines.empty:
        return None
    rows = [
        [
            TableCell(p.sequence),
            TableCell(p.system),
            _printed(p.ate_rmse_m, "mm"),
            TableCell(p.by or NOT_STATED),
            TableCell(p.source),
            TableCell(p.alignment),
            TableCell(NOT_STATED) if pd.isna(p.year) else number(int(p.year)),
            TableCell(p.hardware or NOT_STATED),
            *(_printed(getattr(p, metric), name) for name, metric in _IN_TABLE.items()),
            TableCell(p.remarks),
        ]
        for p in lines_of(lines)
    ]
    columns = [
        *texts("sequence", "system"),
        *numbers("ATE (mm)"),
        *texts("by", "source", "alignment"),
        *numbers("year"),
        *texts("hardware"),
        *numbers(*_IN_TABLE),
        *texts("remarks"),
    ]
    caption = (
        "Absolute trajectory errors (RMSE) and what else is printed with them, as printed; metres in the CSV. By: the "
        "authors of the system, or a third party, which may have run it or quote them. Year: of the source. Most leave "
        "lost frames out. 'SE(3) or not stated': a table of a system with depth that states no alignment."
    )
    return Table(
        "published",
        "Published errors",
        caption,
        columns,
        rows,
        brief="Published errors, as printed",
    )


def span_table(spans: pd.DataFrame) -> Table | None:
    """Between which values the published errors of one system lie; None if none has several.

    Args:
        spans: Lines of `model.published.spans`: one for every system with several values.
    """
    if spans.empty:
        return None
    rows = [
        [
            TableCell(s.sequence),
            TableCell(s.system),
            TableCell(s.alignment),
            number(int(s.numbers)),
            _printed(s.lowest_m, "mm"),
            _printed(s.highest_m, "mm"),
            number(s.ratio, ".2f"),
            TableCell(NOT_STATED) if pd.isna(s.authors_m) else _printed(s.authors_m, "mm"),
        ]
        for s in lines_of(spans)
    ]
    columns = [
        *texts("sequence", "system", "alignment"),
        *numbers("numbers", "from (mm)", "to (mm)", "ratio", "authors (mm)"),
    ]
    caption = (
        "The lowest and the highest published ATE of one system under one alignment. By its authors: the lowest that "
        "they print."
    )
    return Table(
        "published_spans", "What is published of one system differs", caption, columns, rows
    )


def _printed(value: Any, name: str) -> TableCell:
    """A number with the digits that it was printed with; metres as millimetres."""
    if pd.isna(value):
        return TableCell()
    return TableCell(f"{1000 * value if 'mm' in name else value:.6g}", value=value)
