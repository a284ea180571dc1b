"""Runs beside a page that is no board: those of two results folders, and those of a study's trials."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dynslam_bench.core import setting_text, write_atomic
from dynslam_bench.evaluation import Protocol
from dynslam_bench.reports.html.board_page import cell_content
from dynslam_bench.reports.html.page import render, write_assets, write_side
from dynslam_bench.reports.html.run_pages import RUN_PAGE, write_run_pages
from dynslam_bench.reports.model.board import Cell
from dynslam_bench.reports.model.row import RunRow


def write_runs(
    output: Path,
    cells: Mapping[str, Mapping[str, Cell]],
    shown: Sequence[RunRow],
    protocol: Protocol,
    home: str,
    *,
    words: str = "",
    **more: Any,
) -> None:
    """Write the page that shows some runs, and what it reads.

    Args:
        output: Folder of the page.
        cells: Label, of a tracker or a trial, to sequence to its runs.
        shown: Runs that have a page.
        protocol: How errors are computed.
        home: What ``index.html`` is called.
        words: The protocol in words; empty for its own.
        **more: What ``data/board.js`` holds besides.
    """
    paged = {row.run_id for row in shown}
    write_run_pages(shown, paged, protocol, output)
    names = sorted({name for some in cells.values() for name in some})
    trackers, contents, runs = [], [], []
    for at, (label, some) in enumerate(cells.items()):
        settings = next(iter(some.values())).rows[0].variant
        trackers.append({"label": label, "settings": {name: setting_text(value) for name, value in settings.items()}})
        for name, cell in some.items():
            metric = {"key": "ate_rmse_m", "which": cell.rows[0].trajectory}
            contents.append(cell_content(cell, at, names.index(name), [metric], rank_seen=True))
            for row in [row for row in cell.rows if row.run_id in paged] or [cell.typical]:
                runs.append([row.run_id, at, names.index(name), row.repeat, row.ending, 3 * (row.run_id in paged)])
    board = {
        "protocol": words or protocol.describe(),
        "pageless": "",
        "unlisted": 0,
        "trackers": trackers,
        "sequences": [{"name": name, "short": name, "tags": []} for name in names],
        "cells": contents,
        "runs": runs,
    }
    write_side(output, "board", board | more)
    write_assets(output)
    page = render("run.html.j2", title="Run", links=[("index.html", home)], scripts=["run.js"])
    write_atomic(output / RUN_PAGE, page)
