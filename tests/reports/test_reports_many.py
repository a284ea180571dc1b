"""Reports of very many runs: what is read, and that what is left out is said while every number counts all runs."""

import pandas as pd
import pytest
from reports_fake_store import add_run, fill
from reports_rows import page_data, row

from dynslam_bench.core import reading
from dynslam_bench.core.records import digest
from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.reports import ReportData, build_report, figures
from dynslam_bench.reports.build_report import FEWER_PAGES, MOST_PAGES, masks_section, pages_for
from dynslam_bench.reports.html import board_page
from dynslam_bench.reports.model.board import make_board
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.reports.tables import table as tables
from dynslam_bench.reports.tables.table import Column, Table, TableCell, csv_text, to_csv, to_markdown

PROTOCOL = get_protocol("tum-rgbd/v1")


@pytest.fixture
def opened(monkeypatch):
    """Files that are read."""
    found = []
    real = reading.read_bytes
    monkeypatch.setattr(reading, "read_bytes", lambda path, **how: found.append(path.name) or real(path, **how))
    return found


def test_fifty_known_runs_cost_no_file_each(store, tmp_path, opened):
    for number in range(50):
        add_run(store, f"tracker-{number % 5}", f"s/{number % 2}", number // 10, n=20)
    load_runs([store], PROTOCOL)
    assert opened.count("run.json") == 50
    opened.clear()
    assert len(load_runs([store], PROTOCOL).rows) == 50 and opened == []
    build_report(store, tmp_path / "report", most_pages=7)
    assert opened.count("run.json") == 7  # those that have a page, and every one once
    opened.clear()
    pages = {path: path.read_text() for path in (tmp_path / "report" / "data").glob("*.js")}
    build_report(store, tmp_path / "report", most_pages=7)
    assert opened.count("run.json") == 0, "nothing has changed"
    assert pages == {path: path.read_text() for path in pages}
    victim = next(store.folder(path.stem[4:]) for path in pages if path.stem.startswith("run-"))
    (victim / "log.txt").write_text("another log\n")
    build_report(store, tmp_path / "report", most_pages=7)
    assert "another log" in (tmp_path / "report" / "data" / f"run-{victim.name}.js").read_text()
    assert opened.count("run.json") == 1


def test_of_very_many_runs_few_have_a_page():
    assert pages_for(MOST_PAGES, 10) == MOST_PAGES
    assert pages_for(MOST_PAGES + 1, 10) == pages_for(100_000, 1000) == FEWER_PAGES
    assert pages_for(100_000, 3000) == 3000 and pages_for(100_000, 90_000) == MOST_PAGES


def test_unlisted_runs_count_in_every_cell(tmp_path, monkeypatch):
    store = fill(tmp_path / "results", sequences=["synthetic/walking_xyz"])
    add_run(store, "dies", "synthetic/walking_xyz", status="crashed", reason="RuntimeError: no")
    build_report(store, tmp_path / "whole")
    monkeypatch.setattr(board_page, "MOST_LISTED", 3)
    build_report(store, tmp_path / "short", most_pages=2)
    whole, short = page_data(tmp_path / "whole", "board"), page_data(tmp_path / "short", "board")
    assert len(whole["runs"]) == len(store.ids()) == len(short["runs"]) + short["unlisted"] and short["unlisted"] > 5
    assert short["cells"] == whole["cells"] and whole["unlisted"] == 0
    assert {(run[1], run[2]) for run in short["runs"]} == {(cell[0], cell[1]) for cell in whole["cells"]}


def test_long_tables_are_shown_in_part_and_written_whole(monkeypatch):
    monkeypatch.setattr(tables, "MOST_ROWS", 3)
    long = Table("long", "Long", "All of it.", [Column("x")], [[TableCell(str(at), value=at)] for at in range(5)])
    assert len(long.displayed().rows) == 3 and to_csv(long).splitlines() == ["x", *"01234"]
    assert "All of it. These are the first 3 of 5 rows; all stand in csv/long.csv." in to_markdown(long)


def test_the_figure_of_masks_thins_many_points_and_keeps_the_best(tmp_path, monkeypatch):
    board = make_board(load_runs([fill(tmp_path / "results", sequences=["s/a", "s/b"], seeds=range(4))], PROTOCOL).rows)
    whole = figures.mask_figure(board)
    monkeypatch.setattr(figures, "MOST_POINTS", 3)
    thin = figures.mask_figure(board)
    assert {len(trace.x) for trace in thin.data} <= {2, 3} and "more than 3 runs" in str(masks_section(board))
    assert [min(trace.y) for trace in thin.data] == [min(trace.y) for trace in whole.data]


def test_csv_of_every_kind_of_column():
    frame = pd.DataFrame(
        {
            "number": pd.array([0.1, None, 1e-17], dtype="Float64"),
            "whole": pd.array([1, None, 3], dtype="Int64"),
            "flag": pd.array([True, None, False], dtype="boolean"),
            "word": pd.array(["=1+1", None, "\x1b[31m"], dtype="string"),
            "any": pd.Series([1, "-x", None], dtype=object),
        }
    )
    assert csv_text(frame).splitlines() == [
        "number,whole,flag,word,any",
        "0.1,1,True,'=1+1,1",
        ",,,,'-x",
        "1e-17,3,False,\\x1b[31m,",
    ]


def test_rows_are_written_one_a_line_and_read_back(tmp_path):
    rows = [row(run_id=digest([at], 16), reason="postgresql://me:secret@db/x") for at in range(3)]
    for some in (rows, rows[:1], []):
        ReportData(title="t", protocol="p", reference="r", version="1", rows=some).write(tmp_path / "report.json")
        text = (tmp_path / "report.json").read_text()
        read = ReportData.read(tmp_path / "report.json")
        assert [each.run_id for each in read.rows] == [each.run_id for each in some]
        assert "secret" not in text and len(text.splitlines()) == len(some) + 2
