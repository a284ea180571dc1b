"""The report of a results folder: its pages, what it refuses, its tables in every format, two folders compared."""

import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
from itertools import product
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import pytest
from helpers.reports_fake_store import (
    PROTOCOL,
    add_frames,
    add_run,
    crashed,
    fill,
    page_data,
    row,
    rows_of,
    truth_of,
)

from dynslam_bench.core import DynslamError, InfrastructureError, ReportError, reading
from dynslam_bench.core.records import digest
from dynslam_bench.geometry.trajectory_files import write_tum
from dynslam_bench.reports import ReportData, build_report, compare, figures, make_board
from dynslam_bench.reports.build_report import FEWER_PAGES, MOST_PAGES, masks_section, pages_for
from dynslam_bench.reports.compare_runs import overall_ratio
from dynslam_bench.reports.html import board_page
from dynslam_bench.reports.html.run_pages import broken, exact_shares
from dynslam_bench.reports.model import workers
from dynslam_bench.reports.model.board import make_cell
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.reports.tables import table as tables
from dynslam_bench.reports.tables.leaderboard import repeatability
from dynslam_bench.reports.tables.table import (
    Column,
    Table,
    TableCell,
    csv_text,
    emphasise,
    escape_latex,
    to_latex,
    to_markdown,
)
from dynslam_bench.runs.store import RunStore

PAGES = ("index", "errors", "compare", "paper", "diagnostics", "reproduce", "run")


@pytest.mark.slow
def test_every_page_loads_nothing_but_what_lies_beside_it(made):
    folder = made[1].html.parent
    for name in PAGES:
        text = (folder / f"{name}.html").read_text()
        loaded = re.findall(
            r"<(?:script|img|link|iframe|source)\b[^>]*\b(?:src|href)=\"?([^\">]+)", text
        )
        assert {"assets/plotly.min.js", "assets/page.css"} <= set(loaded)
        files = [path for path in loaded if not path.startswith("data:image/svg+xml;base64,")]
        assert all((folder / path).is_file() for path in files)
        ids = re.findall(
            r'<[^<>]*\bid="([^"]+)"', re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
        )
        assert len(ids) == len(set(ids)) > 0
        assert "default-src 'none'" in text
        assert set(re.findall(r'href="([a-z]+\.html)[#"]', text)) <= {
            f"{page}.html" for page in PAGES
        }


def test_the_first_page_is_small_before_plotly(made):
    folder = made[1].html.parent
    text = (folder / "index.html").read_text()
    files = [
        path for path in re.findall(r'(?:src|href)="(assets/[^"]+)"', text) if "plotly" not in path
    ]
    assert len(files) >= 5
    assert len(text.encode()) + sum((folder / path).stat().st_size for path in files) < 1e6


def test_figures_are_plotly_figures(made):
    folder = made[1].html.parent
    texts = ((folder / f"{name}.html").read_text() for name in PAGES)
    pages = [
        re.search(r"const FIGURES = (\{.*?\});</script>", text, re.DOTALL)[1] for text in texts
    ]
    figures_of_pages = [figure for page in pages for figure in json.loads(page).values()]
    assert len(figures_of_pages) >= 6  # speed, masks, and four of the paper
    assert all(
        go.Figure(figure).data and figure["layout"]["height"] > 100 for figure in figures_of_pages
    )
    run = page_data(folder, f"run-{made[0].ids()[0]}")
    for figure in map(json.dumps, run["figures"].values()):
        assert set(re.findall(r'"@(\w+)"', figure)) <= set(run["series"])
        assert go.Figure(json.loads(re.sub(r'"@\w+"', "[1, 2]", figure))).data


def test_every_run_has_its_side_file_and_a_cell_that_leads_to_it(made):
    folder = made[1].html.parent
    ids = made[0].ids()
    linked = set(re.findall(r"run\.html#([0-9a-f]+)", (folder / "errors.html").read_text()))
    # 5 trackers on 4 sequences, and an import
    assert linked <= set(ids)
    assert len(linked) == 21
    board = page_data(folder, "board")
    assert {cell[6] for cell in board["cells"]} == linked
    listed = (run[0] for run in board["runs"])
    paged = (path.stem[4:] for path in folder.glob("data/run-*.js"))
    assert sorted(listed) == sorted(paged) == sorted(ids)


def test_the_leaderboard_orders_and_compares(made):
    _, paths = made
    board = rows_of(paths.csv["leaderboard"])
    ranked = [row["tracker"].removesuffix(" (our back end)") for row in board[:4]]
    assert ranked == ["DynaSLAM N+G", "Mask R-CNN", "DS-SLAM", "ORB-SLAM2"]
    assert float(board[3]["ATE ratio"]) == 1.0
    assert {row["#"] for row in board[:4]} == {"1–4"}  # four sequences tell nobody apart
    assert {row["tracker"]: row["#"] for row in board[4:]} == {
        "ORB-SLAM3": "– lacks sequences",
        "constant velocity": "– control",
    }
    medians = pd.read_csv(paths.csv["per_sequence"], index_col="tracker").filter(like="synthetic")
    best, reference = (
        medians.loc[f"{name} (our back end)"].astype(float)
        for name in ("DynaSLAM N+G", "ORB-SLAM2")
    )
    assert float(board[0]["ATE ratio"]) == pytest.approx(np.exp(np.log(best / reference).mean()))


def test_failures_are_rows_and_count_as_not_moving(made):
    store, paths = made
    (failed,) = rows_of(paths.csv["failures"])
    assert (failed["ended"], failed["reason"]) == (
        "crashed at 30/120",
        "RuntimeError: the map is empty",
    )
    (row,) = (row for row in rows_of(paths.csv["runs"]) if row["run_id"] == failed["run"])
    assert (
        float(row["score_m"]) == float(row["static_camera_ate_rmse_m"]) != float(row["ate_rmse_m"])
    )
    assert (
        f'href="run.html#{failed["run"]}"' in (paths.html.parent / "diagnostics.html").read_text()
    )
    page = page_data(paths.html.parent, f"run-{failed['run']}")
    assert (page["level"], page["verdict"]) == (
        "red",
        "Crashed at 30/120 frames: RuntimeError: the map is empty",
    )
    assert page["log"] == (store.folder(failed["run"]) / "log.txt").read_text() == "a log\n"
    markdown = paths.markdown.read_text()
    assert "1/2 succeeded" in markdown
    assert "counts as a static camera, or worse (1 of 41 runs)" in markdown


@pytest.mark.slow
def test_a_report_can_be_made_again_under_another_protocol(made, tmp_path):
    store, paths = made
    other = build_report(store, tmp_path / "other", protocol="vslam-lab", most_pages=0)
    assert "Sim(3)-aligned" in other.html.read_text()
    assert "SE(3)-aligned" in paths.html.read_text()
    first = ReportData.read(paths.data)
    second = ReportData.read(other.data)
    assert {row.protocol_digest for row in first.rows}.isdisjoint(
        {row.protocol_digest for row in second.rows}
    )
    assert not any(name.startswith("rpe_") for name in other.csv)
    mixed = r"cannot mix 2 protocols: tum-rgbd/v1 \[1190f97bbd77\] \(41 rows\) and vslam-lab"
    with pytest.raises(ReportError, match=mixed):
        compare(paths.data.parent, other.data.parent)
    with pytest.raises(ReportError, match=mixed):
        make_board(first.rows + second.rows)


def test_reference_that_was_not_run_everywhere_gives_way_to_not_moving(made, tmp_path):
    store, _ = made
    with pytest.raises(ReportError) as caught:
        build_report(store, tmp_path / "none", reference="orb-slam4")
    assert "orb-slam3" in caught.value.hint
    assert not (tmp_path / "none").exists()
    paths = build_report(store, tmp_path, reference="orb-slam3", most_pages=0)
    assert "static camera (from ground truth)" in rows_of(paths.csv["per_sequence"])[-1]["tracker"]
    assert ReportData.read(paths.data).reference == "static camera (from ground truth)"
    assert float(rows_of(paths.csv["leaderboard"])[0]["ATE ratio"]) < 0.2


@pytest.mark.slow
def test_small_and_odd_results(tmp_path):
    """One run; a sequence without ground truth; nothing but failures; hostile names."""
    hostile = "</script><script>alert(1)</script> & | % _ $"
    stores = {name: RunStore(tmp_path / name) for name in ("one", "blind", "dead")}
    add_run(stores["one"], "a", "s/a", mask_iou=0.5)
    add_run(stores["blind"], "a", "s/a", ground_truth=False)
    for (tracker, label), seed in product({"evil": hostile, "orb-slam2": ""}.items(), (0, 1)):
        add_run(
            stores["dead"],
            tracker,
            "s/a",
            seed,
            label=label,
            status="crashed",
            reason=label,
            lost=range(120),
        )
    made = {
        name: build_report(store, tmp_path / f"report-{name}", title=hostile)
        for name, store in stores.items()
    }
    assert made["one"].markdown.read_text().startswith("# &lt;/script>&lt;script>")
    assert "a alone is ranked" in made["one"].markdown.read_text()
    assert "in no table of errors: s/a" in made["blind"].markdown.read_text()
    ratios = [row["ATE ratio"] for row in rows_of(made["dead"].csv["leaderboard"])]
    assert ratios == ["nothing succeeded"] * 2
    assert len(rows_of(made["dead"].csv["failures"])) == 4
    text = made["dead"].html.read_text()
    assert "<script>alert(1)" not in text
    assert "&lt;script&gt;alert(1)" in text
    assert r"\textless{}script\textgreater{}" in made["dead"].latex.read_text()


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("", "there are no runs in"),
        ("results/x", "there are no runs in"),
        ("results/runs/x", "there are no runs in"),
        (f"results/runs/{'a' * 16}/run.json", "Invalid JSON"),
    ],
)
def test_what_cannot_be_reported_is_one_clear_line(tmp_path, file, text):
    if file:
        (tmp_path / file).parent.mkdir(parents=True)
        (tmp_path / file).write_text("{")
    with pytest.raises(DynslamError, match=text):
        build_report([tmp_path / "results"], tmp_path / "report")
    assert [path.name for path in tmp_path.iterdir()] == (["results"] if file else [])


# -- reported rows


def test_published_numbers_stand_apart_and_never_compete(store, tmp_path):
    for name, seed in product(("orb-slam2", "dynaslam"), (0, 1)):
        add_run(store, name, "tum/fr3/walking_xyz", seed, duration_s=28.8)
    paths = build_report(store, tmp_path / "report")
    names = {row["tracker"] for row in rows_of(paths.csv["per_sequence"])}
    assert {
        "DynaSLAM N+G (authors: DynaSLAM paper) reported",
        "EMFOA-OFT-SLAM claimed by the paper",
    } <= names
    assert not any("DROID-W" in name for name in names)  # aligned by Sim(3)
    assert [name for name in names if name.endswith(" record")] == [
        "lowest error found in print, real time on a CPU record"
    ]
    assert {row["tracker"] for row in rows_of(paths.csv["leaderboard"])} == {
        "orb-slam2",
        "dynaslam",
    }
    assert (
        "Rows marked &#39;reported&#39; are published numbers"
        in (paths.html.parent / "errors.html").read_text()
    )


# -- pieces


def test_lines_are_broken_at_gaps_of_more_than_twice_the_median():
    stamps = np.r_[0:0.95:0.1, 1.05:2:0.1, 2.6:3:0.1]
    t, v = broken(stamps, stamps[:, None] * [1.0, 2.0], most=500)
    # 0.65 s is a gap of more than twice 0.1 s, 0.15 s is none
    (gap,) = np.flatnonzero(np.isnan(v[:, 0]))
    assert 1.95 < t[gap] < 2.6
    assert np.array_equal(np.delete(t, gap), stamps)
    long = np.arange(10000) / 30.0
    long[5000:] += 10
    t, v = broken(long, long[:, None], most=400)
    assert len(t) < 420
    assert np.isnan(v[:, 0]).sum() == 1
    assert {long[0], long[4999], long[5000], long[-1]} <= set(t.tolist())


def contents(folder):
    """Every file of a report but those that hold the time when it was made."""
    files = (
        path for path in folder.rglob("*.*") if path.suffix != ".html" and path.name != "report.md"
    )
    return {path.relative_to(folder).as_posix(): digest(path.read_bytes().hex()) for path in files}


def refuse(kind):
    if kind == "die":
        os._exit(3)
    raise ReportError("no", "a hint")


@pytest.fixture
def two_cores(monkeypatch):
    monkeypatch.setattr(workers, "MANY", 1)
    monkeypatch.setattr(workers.os, "sched_getaffinity", lambda _: {0, 1}, raising=False)


@pytest.mark.slow
def test_workers_make_the_same_report(tmp_path, two_cores, monkeypatch):
    store = fill(tmp_path / "results", sequences=["synthetic/sitting_xyz"], seeds=(0,))
    add_run(store, "orb-slam2", "synthetic/sitting_xyz", 7, lost=range(30), status="lost")
    events = []
    build_report(
        store, tmp_path / "helped", command="c", on_progress=lambda *event: events.append(event)
    )
    (store.root / "index.sqlite").unlink()  # or there would be nothing left to read
    monkeypatch.setattr(workers, "MANY", 1000)
    build_report(store, tmp_path / "alone", command="c")
    alone = contents(tmp_path / "alone")
    helped = contents(tmp_path / "helped")
    assert alone == helped
    assert len(alone) > len(store.ids())
    scored = [
        done
        for done, total, what in events
        if what.startswith("scoring") and total == len(store.ids())
    ]
    assert scored[-1] == len(store.ids())


@pytest.mark.slow
def test_workers_run_no_script_of_the_caller_and_their_errors_and_deaths_are_named(
    two_cores, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "__main__", ModuleType("__main__"))
    sys.modules["__main__"].__file__ = str(tmp_path / "script.py")
    (tmp_path / "script.py").write_text(
        "raise SystemExit('a script need not guard what it does at import')"
    )
    with workers.worker_pool(1) as pool:
        assert list(workers.run_jobs(pool, abs, [(-2,), (3,)])) == [2, 3]
        for kind, error in (("raise", ReportError), ("die", InfrastructureError)):
            with pytest.raises(error):
                list(workers.run_jobs(pool, refuse, [(kind,)] * 3))


@pytest.mark.parametrize(("runs", "cores"), [(workers.MANY - 1, 8), (10_000, 1)])
def test_few_runs_and_one_core_need_no_workers(runs, cores, monkeypatch):
    monkeypatch.setattr(workers.os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    with workers.worker_pool(runs) as pool:
        assert pool is None


@pytest.fixture
def opened(monkeypatch):
    """Files that are read."""
    found = []
    real = reading.read_bytes
    monkeypatch.setattr(
        reading, "read_bytes", lambda path, **how: found.append(path.name) or real(path, **how)
    )
    return found


@pytest.mark.slow
def test_known_runs_cost_no_file_each(store, tmp_path, opened):
    for number in range(20):
        add_run(store, f"tracker-{number % 5}", f"s/{number % 2}", number // 10, n=20)
    load_runs([store], PROTOCOL)
    opened.clear()
    assert len(load_runs([store], PROTOCOL).rows) == 20
    assert opened == []
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
    wanted = {
        (MOST_PAGES, 10): MOST_PAGES, (MOST_PAGES + 1, 10): FEWER_PAGES, (100_000, 1000): FEWER_PAGES,
        (100_000, 3000): 3000, (100_000, 90_000): MOST_PAGES,
    }  # fmt: skip
    assert {case: pages_for(*case) for case in wanted} == wanted


@pytest.mark.slow
def test_unlisted_runs_count_in_every_cell(tmp_path, monkeypatch):
    store = fill(tmp_path / "results", sequences=["synthetic/walking_xyz"])
    add_run(store, "dies", "synthetic/walking_xyz", status="crashed", reason="RuntimeError: no")
    build_report(store, tmp_path / "whole")
    monkeypatch.setattr(board_page, "MOST_LISTED", 3)
    build_report(store, tmp_path / "short", most_pages=2)
    whole = page_data(tmp_path / "whole", "board")
    short = page_data(tmp_path / "short", "board")
    assert len(whole["runs"]) == len(store.ids()) == len(short["runs"]) + short["unlisted"]
    assert short["unlisted"] > 5
    assert short["cells"] == whole["cells"]
    assert whole["unlisted"] == 0
    assert {(run[1], run[2]) for run in short["runs"]} == {
        (cell[0], cell[1]) for cell in whole["cells"]
    }


def test_long_tables_are_shown_in_part_and_written_whole(monkeypatch):
    monkeypatch.setattr(tables, "MOST_ROWS", 3)
    long = Table(
        "long",
        "Long",
        "All of it.",
        [Column("x")],
        [[TableCell(str(at), value=at)] for at in range(5)],
    )
    assert len(long.displayed().rows) == 3
    assert csv_text(long.frame()).splitlines() == ["x", *"01234"]
    assert "All of it. These are the first 3 of 5 rows; all stand in csv/long.csv." in to_markdown(
        long
    )


@pytest.mark.slow
def test_the_figure_of_masks_thins_many_points_and_keeps_the_best(tmp_path, monkeypatch):
    board = make_board(
        load_runs(
            [fill(tmp_path / "results", sequences=["s/a", "s/b"], seeds=range(4))], PROTOCOL
        ).rows
    )
    whole = figures.mask_figure(board)
    monkeypatch.setattr(figures, "MOST_POINTS", 3)
    thin = figures.mask_figure(board)
    assert {len(trace.x) for trace in thin.data} <= {2, 3}
    assert "more than 3 runs" in str(masks_section(board))
    assert [min(trace.y) for trace in thin.data] == [min(trace.y) for trace in whole.data]
    assert whole.layout.yaxis.title.text == "ATE (mm)"
    assert 5 < min(whole.data[0].y) < 20


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
    path = tmp_path / "report.json"
    for some in (rows, rows[:1], []):
        ReportData(title="t", protocol="p", reference="r", version="1", rows=some).write(path)
        assert [each.run_id for each in ReportData.read(path).rows] == [
            each.run_id for each in some
        ]
        assert "secret" not in path.read_text()
        assert len(path.read_text().splitlines()) == len(some) + 2


HEAD = b"index,timestamp,state,frame_error_trans_m,dynamic_share\n"
DAMAGE = {
    "no text": b"\xff\xfe\x00\x01",
    "words": HEAD + b"0,1000.0,ok,much,0.1\n",
    "no stamp": HEAD + b"0,,ok,0.1,0.1\n",
    "no index": HEAD + b",1000.0,ok,0.1,0.1\n",
    "huge index": HEAD + b"9" * 40 + b",1000.0,ok,0.1,0.1\n",
    "another heading": b"a,b\n1,2\n",
    "heading alone": HEAD,
    "too many cells": HEAD + b"0,1000.0,ok,0.1,0.1,7,8,9\n",
    "null bytes": b"\x00" * 64,
}


@pytest.mark.slow
def test_damaged_files_of_a_store_cost_only_their_own_figures_and_are_named(store, tmp_path):
    sound = add_run(store, "b", "s/a", n=40)
    add_frames(store.folder(sound), 40)
    hurt = {add_run(store, "a", "s/a", seed, n=40): damage for seed, damage in enumerate(DAMAGE)}
    for run_id, damage in hurt.items():
        (store.folder(run_id) / "frames.csv").write_bytes(DAMAGE[damage])
    for name, text in (("d" * 16, "{"), ("e" * 16, '{"schema_version": 99, "new": 1}')):
        (store.runs / name).mkdir()
        (store.runs / name / "run.json").write_text(text)
    paths = build_report(store, tmp_path / "report")
    for run_id, damage in hurt.items():
        page = page_data(paths.html.parent, f"run-{run_id}")
        assert any("frames.csv" in note for note in page["notes"]), damage
        assert "t" not in page["series"], damage
        assert "track_x" in page["series"], damage
    assert "t" in page_data(paths.html.parent, f"run-{sound}")["series"]
    assert "2 folders without a valid record" in paths.html.read_text()
    assert {"d" * 16, "e" * 16} <= set(
        re.findall(r"runs/(\w{16})", (paths.html.parent / "reproduce.html").read_text())
    )


def test_a_tracker_that_always_crashes_is_not_called_repeatable():
    rows = [row("good", s, 0.1 + 0.01 * seed, seed=seed) for s in "st" for seed in (0, 1)]
    rows += [crashed("c", s, seed=seed) for s in "st" for seed in (0, 1)]
    rows += [
        row("half", "s", 0.2),
        row("half", "s", 0.3, seed=1),
        row("half", "t", 0.2),
        crashed("half", "t", seed=1),
    ]
    board = make_board(rows)
    assert {cells[0].text: cells[1].text for cells in repeatability(board).rows} == {
        "GOOD": "2",
        "HALF": "1",
    }


@pytest.mark.slow
def test_a_run_that_crashed_hides_no_exact_share(tmp_path):
    """What the masks show of a frame is known if any run saw the frame, not only the first one of the sequence."""
    store = RunStore(tmp_path / "r")
    for name, count in (("crashed", 30), ("whole", 60)):
        add_frames(store.folder(add_run(store, name, "s/a", n=60)), count)
    assert [
        *exact_shares(sorted(load_runs([store], PROTOCOL).rows, key=lambda row: row.tracker.id))
    ] == [*range(60)]


def test_a_final_trajectory_of_few_frames_is_no_success(tmp_path):
    """Under a protocol of the final trajectory, coverage and success are those of what is scored."""
    store = RunStore(tmp_path / "r")
    for name, kept in (("whole", None), ("thin", [0, 1, 2, 3])):
        add_run(store, name, "s/a", error=0.01, final_error=0.005, final_frames=kept)
    protocol = PROTOCOL.model_copy(update={"id": "x/v1", "trajectory": "final"})
    thin, whole = sorted(load_runs([store], protocol).rows, key=lambda row: row.tracker.id)
    assert (whole.coverage, whole.failed) == (1.0, False)
    assert (thin.n_tracked, thin.failed, thin.status) == (4, True, "lost")
    assert thin.coverage < 0.1
    assert "the final trajectory has poses of 4 of" in thin.reason
    assert thin.ending.startswith("lost, 4/")
    assert not any(row.failed for row in load_runs([store], PROTOCOL).rows)
    build_report(store, tmp_path / "out", most_pages=0)
    marked = r'title="it has poses of only 3 % of the tracked frames">[0-9.]+‡'
    assert re.search(marked, (tmp_path / "out/errors.html").read_text())


def test_what_was_lost_as_it_came_and_found_in_the_end_is_a_success_of_the_final_trajectory(
    tmp_path,
):
    store = RunStore(tmp_path / "r")
    protocol = PROTOCOL.model_copy(update={"id": "x/v1", "trajectory": "final"})
    add_run(store, "found", "s/a", error=0.01, status="lost", final_error=0.005, final_whole=True)
    add_run(
        store,
        "sparse",
        "s/a",
        error=0.01,
        kind="imported",
        lost=[at for at in range(120) if at % 5],
    )
    rows = {row.tracker.id: row for row in load_runs([store], protocol).rows}
    assert (rows["found"].status, rows["found"].failed, rows["found"].coverage) == (
        "ok",
        False,
        1.0,
    )
    rows = {row.tracker.id: row for row in load_runs([store], PROTOCOL).rows}
    assert rows["found"].failed
    assert rows["found"].status == "lost"
    assert not rows["sparse"].failed, (
        "a file of keyframes says what it covers, and that no more was asked for"
    )


@pytest.fixture(scope="module")
def pattern(tmp_path_factory):
    """A store with runs of every kind, and the rows of a first report."""
    store = fill(tmp_path_factory.mktemp("rows") / "results", sequences=["s/a", "s/b"], seeds=(0,))
    add_run(store, "orb-slam2", "s/a", 7, lost=range(5), status="lost", n=60)
    add_run(store, "orb-slam2", "s/a", 8, status="stopped", n=60)
    add_run(store, "elsewhere", "s/b", kind="imported", n=60, online=False, final_error=0.02)
    add_run(store, "no-truth", "s/c", ground_truth=False, n=60)
    loaded_from(store)
    return store


@pytest.fixture
def known(pattern, tmp_path):
    """A copy of it, and the rows of a first report on the copy."""
    shutil.copytree(pattern.root, tmp_path / "results", symlinks=True)
    copy = RunStore(tmp_path / "results")
    loaded_from(copy)
    return copy


def loaded_from(store):
    """What a report knows of a store."""
    loaded = load_runs([store], PROTOCOL)
    rows = {row.run_id: row.model_dump() for row in loaded.rows}
    return rows, loaded.stopped, loaded.superseded, sorted(loaded.unreadable)


@pytest.mark.slow
def test_unchanged_runs_are_not_read_and_rows_are_equal(known, tmp_path, reads):
    kept = loaded_from(known)
    assert reads == []
    assert kept[1] == 1
    assert len(kept[0]) == len(known.ids()) - 1
    known.root.rename(tmp_path / "moved")
    moved = RunStore(tmp_path / "moved")
    rows = load_runs([moved], PROTOCOL).rows
    assert reads == []
    assert all(row.folder.is_dir() and row.estimate(row.trajectory) for row in rows)
    moved.index.path.unlink()
    assert loaded_from(moved) == kept
    assert sorted(reads) == moved.ids()


CHANGES = {
    "edited": lambda store, run: store.rewrite(store.read_whole(run), coverage=0.5),
    "damaged": lambda store, run: (store.folder(run) / "run.json").write_text("{"),
    "tracked otherwise": lambda store, run: write_tum(
        store.folder(run) / "trajectory_online.txt", store.trajectory(run).select(slice(9))
    ),
    "true otherwise": lambda store, run: write_tum(
        store.root / "sequences" / store.read_whole(run).sequence.part / "groundtruth.txt",
        truth_of("another"),
    ),
    "removed": lambda store, run: store.remove(run),
    "linked": lambda store, run: (store.folder(run) / "frames.csv").symlink_to(store.root.parent),
    "added": lambda store, run: add_run(store, "new", "s/a", n=60),
}


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES)
def test_what_changed_shows_at_once(known, reads, change):
    before = loaded_from(known)
    CHANGES[change](
        known, next(run_id for run_id, row in before[0].items() if row["status"] == "lost")
    )
    reads.clear()
    after = loaded_from(known)
    assert len(set(reads)) <= len(known.ids()) // 2
    known.index.path.unlink()
    assert after == loaded_from(known)
    assert after != before


@pytest.mark.slow
@pytest.mark.parametrize(
    "change", ["value = '{'", "value = x'ff'", "run_id = '0000000000000000'", "state = 'x'"]
)
def test_rows_that_somebody_made_count_as_missing(known, reads, change):
    before = loaded_from(known)
    first, second, *_ = known.ids()
    report = f"name = 'report {PROTOCOL.digest()}'"
    with sqlite3.connect(known.index.path) as index:
        index.execute(f"UPDATE computed SET {change} WHERE {report} AND run_id = ?", (first,))
        other = f"(SELECT max(value) FROM computed WHERE {report})"
        index.execute(
            f"UPDATE computed SET value = {other} WHERE {report} AND run_id = ?", (second,)
        )
    assert loaded_from(known) == before
    assert first in reads


@pytest.mark.slow
def test_trials_of_studies_are_left_out_counted_and_shown_on_request(tmp_path):
    trial = {"error": 0.001, "overrides": {"features": 500}, "study": "mine"}
    store = RunStore(tmp_path / "r")
    only = RunStore(tmp_path / "only")
    add_run(store, "orb-slam2", "s/a", study="mine")
    for some in (store, only):
        add_run(some, "orb-slam2", "s/a", **trial)
    with pytest.raises(ReportError, match="--trials"):
        build_report(only, tmp_path / "none")
    for trials in (False, True):
        paths = build_report(store, tmp_path / str(trials), trials=trials)
        text = paths.markdown.read_text()
        page = (paths.html.parent / "reproduce.html").read_text()
        assert paths.trials == (not trials)
        assert ("Left out: 1 runs that studies made" in text) == (not trials)
        commands = page.split("The commands that")[1]
        shown = (
            "features=500" in text,
            "--trials" in commands,
            "trial of the study &#39;mine&#39;" in page,
        )
        assert shown == (trials,) * 3


# Tables: the frames behind them, and the formats that they are written in.


def test_best_and_second_share_their_marks():
    assert emphasise([3.0, 1.0, 2.0, 1.0, None]) == ["", "best", "second", "best", ""]
    assert emphasise([1.0, None]) == ["", ""]


def test_tables_in_every_format():
    table = Table(
        "t",
        "A & B",
        "50 % of_it.",
        [Column("name", numeric=False), Column("x", "G"), Column("y", "G")],
        [
            [
                TableCell("a|b_*", tag="imported"),
                TableCell("0.5", "±0.1", 0.51234, "best"),
                TableCell(),
            ],
            [TableCell("c"), TableCell(), TableCell("2")],
        ],
    )
    assert "| a\\|b\\_\\* (imported) | **0.5** ±0.1 |  |" in to_markdown(table)
    assert csv_text(table.frame()) == "name,G: x,G: y\na|b_* imported,0.51234,\nc,,2\n"
    latex = to_latex(table)
    assert r"\caption{A \& B.}" in latex
    assert r"\multicolumn{2}{c}{G}" in latex
    assert r"a\textbar{}b\_* & \textbf{0.5} &  \\" in latex


def test_a_column_in_which_nothing_is_written_is_in_the_csv_only():
    columns = [Column("tracker", numeric=False), Column("p"), Column("ATE")]
    rows = [[TableCell("a"), TableCell(), TableCell("1.0", value=1.0)]]
    table = Table("t", "Title", "Caption.", columns, rows)
    assert csv_text(table.frame()).splitlines()[0] == "tracker,p,ATE"
    assert "| tracker | ATE |" in to_markdown(table)
    assert " p " not in to_latex(table)
    for others in ([*rows, [TableCell("b"), TableCell("0.04"), TableCell("2.0")]], []):
        assert "| tracker | p | ATE |" in to_markdown(
            Table("t", "Title", "Caption.", columns, others)
        )


def test_the_page_s_python_goes_as_it_stands(made, monkeypatch):
    pytest.importorskip("matplotlib", reason="pandas draws with it")
    page = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "report.md"
    (text,) = re.findall(r"^```python\n(.*?)^```", page.read_text(), flags=re.S | re.M)
    monkeypatch.chdir(made[0].root.parent)
    names = {}
    exec(compile(text, "docs/how-to/report.md", "exec"), names)
    assert len(names["board"].frame()) == len(names["frame"]) > 5


NAMES = (
    "ORB-SLAM2 (our back end)",
    'quotes "here" and `there`',
    r"100 % of_it & {\bf $x^2$} #1 ~ \end{table}",
    "émoji 😀 猫",
    "<b>bold</b>",
    "a name that goes on and on until no column of a page could hold it",
)


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """Six oddly named trackers on five sequences, one of which fails everywhere."""
    root = tmp_path_factory.mktemp("latex")
    store = RunStore(root / "results")
    for number in range(5):
        for place, label in enumerate(NAMES):
            add_run(
                store, f"t{place}", f"synthetic/walking_halfsphere_{number}", label=label, n=40,
                error=0.01 * (1 + place + 0.1 * number), status="crashed" if place == 4 else "ok",
                lost=(5, 6) if place == 1 else (),
            )  # fmt: skip
    return build_report(store, root / "report")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdflatex")
def test_latex_compiles_and_fits_a_column(odd):
    (odd.latex.parent / "paper.tex").write_text(
        r"\documentclass[twocolumn]{article}\usepackage{booktabs}\begin{document}\input{report.tex}\end{document}"
    )
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    subprocess.run(command, cwd=odd.latex.parent, capture_output=True, check=True)
    log = (odd.latex.parent / "paper.log").read_text(errors="replace")
    assert (odd.latex.parent / "paper.pdf").stat().st_size > 10_000
    assert (
        re.findall(r"Overfull \\hbox.*|Missing character.*|LaTeX Warning: Float too large.*", log)
        == []
    )


@pytest.mark.slow
def test_captions_are_short_and_name_no_ids(odd):
    text = odd.latex.read_text()
    captions = re.findall(r"\\caption\{(.*)\}", text)
    assert 3 <= len(captions) <= 12, "a page of tables, not a book"
    for caption in captions:
        assert len(caption) < 140, caption
        assert "tum-rgbd/v1" in caption, caption
        assert not re.search(r"[0-9a-f]{12}", caption), caption
    assert "synthetic/" not in text
    assert text.count(r"\begin{table}") == len(captions)
    assert r"$^*$\,our back end" in text


def test_a_bracket_never_follows_the_end_of_a_line_of_latex(tmp_path):
    """It would be an optional argument there: on parts of sequences LaTeX went on for ever."""
    columns = [Column("tracker", numeric=False), Column("walking_xyz? scene=102 [0:60]")]
    long = "Mask R-CNN culling · segmentation.source=oracle, segmentation.dilation_px=12"
    rows = [[TableCell(name), TableCell("6.50")] for name in (long, "[mine]", "[other]")]
    text = to_latex(Table("t", "T", "long", columns, rows), "p")
    assert "0:60" in text
    assert "mine" in text
    assert not re.search(r"\\\\\s*\[", text)
    if shutil.which("pdflatex") is None:
        return
    (tmp_path / "paper.tex").write_text(
        r"\documentclass[twocolumn]{article}\usepackage{booktabs}\begin{document}"
        + text
        + r"\end{document}"
    )
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    subprocess.run(command, cwd=tmp_path, capture_output=True, check=True, timeout=60)
    assert "Overfull" not in (tmp_path / "paper.log").read_text(errors="replace")


def test_latex_stands_in_blocks_and_floats():
    names = [
        Column("tracker", numeric=False),
        *(Column(f"walking_xyz_{i}", "high dynamic") for i in range(12)),
    ]
    rows = [
        [TableCell(f"t{i}"), *(TableCell(f"{10 * i + j}.5") for j in range(12))] for i in range(15)
    ]
    text = to_latex(Table("t", "T", "long", names, rows), "p")
    assert text.count(r"\begin{tabular}") > text.count(r"\caption{T, protocol p") > 1
    assert sorted(re.findall(r"(\d+\.5)", text)) == sorted(
        f"{10 * i + j}.5" for i in range(15) for j in range(12)
    )


def test_no_name_is_more_than_a_name():
    assert escape_latex("a\nb\x00c") == "a b c"
    assert escape_latex("😀 é 猫 “q”") == "{[}U+1F600] é {[}U+732B] ``q''"
    cells = [
        [TableCell("=HYPERLINK(1)"), TableCell("-1.5", value=-1.5)], [TableCell("@x"), TableCell("+2")],
        [TableCell("\x1b[2J\u202e"), TableCell()],
    ]  # fmt: skip
    table = Table(
        "t", "a\n# b", "c\n\n# d <i>", [Column("=1+1", numeric=False), Column("y")], cells
    )
    assert csv_text(table.frame()).splitlines() == [
        "'=1+1,y",
        "'=HYPERLINK(1),-1.5",
        "'@x,'+2",
        "\\x1b[2J\\u202e,",
    ]
    markdown = to_markdown(table)
    assert "## a # b" in markdown
    assert "\nc # d &lt;i>" in markdown
    assert not set(markdown + to_latex(table)) & {"\x1b", "\u202e"}


@pytest.mark.slow
def test_compare_finds_what_changed(made, tmp_path):
    store, paths = made
    walking = ["synthetic/walking_xyz", "synthetic/walking_rpy"]
    comparison = compare(
        store, fill(tmp_path / "b", {"orb-slam2": 0.10, "mask-rcnn": 0.002}, walking, seeds=(0, 1))
    )
    changed, same = (
        comparison.overall[f"{name} (our back end)"] for name in ("Mask R-CNN", "ORB-SLAM2")
    )
    assert changed.ratio == pytest.approx(0.1, rel=0.1)
    assert same.ratio == pytest.approx(1.0)
    assert changed.high is None, "two sequences give no interval"
    verdicts = {
        row[0].text: row[5].text for row in comparison.table.rows if row[1].text.startswith("all ")
    }
    assert verdicts == {label: verdict.value for label, verdict in comparison.verdicts.items()}
    assert set(verdicts.values()) == {"cannot tell"}, "two sequences are too few for a claim"
    found = comparison.findings["Mask R-CNN (our back end)"]
    assert found[0].endswith("on 2 scenes, and 6 are the fewest for a claim")
    assert (comparison.only_a, comparison.only_b) == (8 + 8 + 1 + 3 * 4, 0)
    itself = compare(paths.data.parent, paths.data).overall
    assert len(itself) == 6
    assert all(ratio.ratio == 1 for ratio in itself.values())
    assert "| Mask R-CNN (our back end) | all 2 sequences |" in to_markdown(comparison.table)


def test_compare_refuses_what_has_nothing_in_common(made, tmp_path):
    store, _ = made
    other = RunStore(tmp_path / "b")
    add_run(other, "new-tracker", "s/a")
    with pytest.raises(
        ReportError, match=r"\(41 runs\) and .* \(1 runs\) have no tracker and sequence in common"
    ):
        compare(store, other)


@pytest.mark.slow
def test_compare_pairs_runs_of_different_settings_and_says_what_differs(tmp_path):
    before = RunStore(tmp_path / "a")
    after = RunStore(tmp_path / "b")
    for name in [f"s/{i}" for i in range(9)]:
        add_run(before, "ours", name, error=0.05, overrides={"epipolar.threshold_px": 1.0})
        add_run(after, "ours", name, error=0.02, overrides={"epipolar.threshold_px": 2.0})
        add_run(before, "same", name)
        add_run(after, "same", name)
    found = compare(before, after)
    name = "ours · epipolar.threshold_px=1.0 → ours · epipolar.threshold_px=2.0"
    assert found.differences == {name: ["epipolar.threshold_px: 1.0 in A, 2.0 in B"], "same": []}
    assert found.overall.keys() == found.differences.keys()
    assert found.overall[name].high < 1
    assert (found.only_a, found.only_b) == (0, 0)
    assert "What differs" in found.table.caption
    verdicts = {
        cells[0].text: cells[5].text
        for cells in found.table.rows
        if cells[1].text.startswith("all ")
    }
    assert verdicts[name] == "proven"
    assert verdicts["same"] == "no difference that matters"
    assert found.findings[name][0].startswith("B has ")
    assert found.findings["same"][1] == "Differences above 0 % are excluded"


def test_compare_counts_lost_sequences_by_name_and_a_recording_once(tmp_path):
    before = RunStore(tmp_path / "a")
    after = RunStore(tmp_path / "b")
    for number in range(8):
        broken = {"status": "crashed", "reason": "boom"} if number < 2 else {}
        add_run(before, "ours", f"s/{number}", error=0.05)
        add_run(after, "ours", f"s/{number}", error=0.02, **broken)
    # the last one once more, with other pixels
    for store, error in ((before, 0.05), (after, 0.02)):
        add_run(store, "ours", "s/7", error=error, content="blurred", block={"content": "blurred"})
    found = compare(before, after)
    ratio = found.overall["ours"]
    assert ratio.lost == ("s/0", "s/1")
    assert (ratio.scenes, ratio.all_scenes) == (6, 8)
    assert found.verdicts["ours"].value == "smaller typical error, but lost"
    assert "B alone lost 2 scenes (s/0, s/1)" in found.findings["ours"]
    line = next(cells for cells in found.table.rows if cells[1].text.startswith("all "))
    assert (line[1].text, line[5].small) == ("all 8 sequences", "lost 2 of 8, A 0")
    assert [cells[3].small for cells in found.table.rows[:3]] == ["lost", "lost", ""]


def test_compare_counts_what_is_lost_before_a_fixed_camera():
    """Such a cell has no error, since a static camera has none there."""
    still = {"tags": ["fixed-camera"], "static_camera_ate_rmse_m": 0.0}
    good = make_cell([row("a", "s", 0.01, **still)])
    gone = make_cell([crashed("a", "s", 0.01, **still)])
    assert gone.scores == ()
    ratio = overall_ratio([("s", good, gone)])
    assert (ratio.ratio, ratio.lost, ratio.all_scenes) == (None, ("s",), 1)
    assert overall_ratio([("s", gone, good)]).lost_baseline == ("s",)


def test_compare_takes_the_nearest_settings_and_leaves_the_rest(tmp_path):
    before = RunStore(tmp_path / "a")
    after = RunStore(tmp_path / "b")
    add_run(before, "ours", "s/a")
    for seed in (0, 1):
        add_run(after, "ours", "s/a", seed, overrides={"x": 1})
    add_run(after, "ours", "s/a", overrides={"x": 1, "y": 2})
    found = compare(before, after)
    assert list(found.differences.values()) == [["x: default in A, 1 in B"]]
    assert (found.only_a, found.only_b) == (0, 1)
    assert found.table.rows[0][-1].text == "1 + 1", "of the repeats that both have"
