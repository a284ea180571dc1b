"""The report of a results folder: what is in it, what it refuses, and that the page needs no network."""

import json
import re
from itertools import product

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import pytest
from reports_fake_store import add_run
from reports_rows import page_data, rows_of

from dynslam_bench.core.errors import DynslamError, ReportError
from dynslam_bench.reports import ReportData, build_report, compare
from dynslam_bench.reports.html.run_pages import broken
from dynslam_bench.reports.model.board import make_board
from dynslam_bench.reports.model.load import check_one_protocol
from dynslam_bench.runs.store import RunStore

PAGES = ("index", "errors", "compare", "paper", "diagnostics", "reproduce", "run")


def test_every_page_loads_nothing_but_what_lies_beside_it(made):
    folder = made[1].html.parent
    for name in PAGES:
        text = (folder / f"{name}.html").read_text()
        loaded = re.findall(r"<(?:script|img|link|iframe|source)\b[^>]*\b(?:src|href)=\"?([^\">]+)", text)
        assert {"assets/plotly.min.js", "assets/page.css"} <= set(loaded)
        assert all((folder / path).is_file() for path in loaded)
        ids = re.findall(r'<[^<>]*\bid="([^"]+)"', re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL))
        assert len(ids) == len(set(ids)) > 0 and "default-src 'none'" in text
        links = set(re.findall(r'href="([a-z]+\.html)[#"]', text))
        assert links <= {f"{page}.html" for page in PAGES}


def test_the_first_page_is_small_before_plotly(made):
    folder = made[1].html.parent
    text = made[1].html.read_text()
    files = [path for path in re.findall(r'(?:src|href)="(assets/[^"]+)"', text) if "plotly" not in path]
    assert len(files) >= 5 and len(text.encode()) + sum((folder / path).stat().st_size for path in files) < 1e6


def test_figures_are_plotly_figures(made):
    folder, found = made[1].html.parent, 0
    for name in PAGES:
        text = re.search(r"const FIGURES = (\{.*?\});</script>", (folder / f"{name}.html").read_text(), re.DOTALL)[1]
        for figure in json.loads(text).values():
            assert go.Figure(figure).data and figure["layout"]["height"] > 100
            found += 1
    assert found >= 6  # speed, masks, and four of the paper
    for path in (folder / "data").glob("run-*.js"):
        run = page_data(folder, path.stem)
        for figure in run["figures"].values():
            made_of = json.dumps(figure)
            assert set(re.findall(r'"@(\w+)"', made_of)) <= set(run["series"])
            filled = json.loads(re.sub(r'"@\w+"', "[1, 2]", made_of))
            assert go.Figure(filled).data


def test_every_run_has_its_side_file_and_a_cell_that_leads_to_it(made):
    store, paths = made
    ids = set(store.ids())
    assert {path.stem.removeprefix("run-") for path in (paths.html.parent / "data").glob("run-*.js")} == ids
    errors = (paths.html.parent / "errors.html").read_text()
    linked = set(re.findall(r"run\.html#([0-9a-f]{16})", errors))
    assert linked <= ids and len(linked) == 21  # 5 trackers on 4 sequences, and an import
    board = page_data(paths.html.parent, "board")
    assert {run[0] for run in board["runs"]} == ids and len(board["runs"]) == len(ids)
    assert {cell[6] for cell in board["cells"]} == linked


def test_the_leaderboard_orders_and_compares(made):
    _, paths = made
    board = rows_of(paths.csv["leaderboard"])
    ranked = [row["tracker"].removesuffix(" (our back end)") for row in board[:4]]
    assert ranked == ["DynaSLAM N+G", "Mask R-CNN", "DS-SLAM", "ORB-SLAM2"] and float(board[3]["ATE ratio"]) == 1.0
    assert {row["#"] for row in board[:4]} == {"1–4"}  # four sequences tell nobody apart
    assert {row["tracker"]: row["#"] for row in board[4:]} == {
        "ORB-SLAM3": "– lacks sequences",
        "constant velocity": "– control",
    }
    medians = pd.read_csv(paths.csv["per_sequence"], index_col="tracker").filter(like="synthetic")
    best, reference = (medians.loc[f"{name} (our back end)"].astype(float) for name in ("DynaSLAM N+G", "ORB-SLAM2"))
    assert float(board[0]["ATE ratio"]) == pytest.approx(np.exp(np.log(best / reference).mean()))


def test_failures_are_rows_and_count_as_not_moving(made):
    store, paths = made
    (failed,) = rows_of(paths.csv["failures"])
    assert (failed["ended"], failed["reason"]) == ("crashed at 30/120", "RuntimeError: the map is empty")
    (row,) = (row for row in rows_of(paths.csv["runs"]) if row["run_id"] == failed["run"])
    assert float(row["score_m"]) == float(row["static_camera_ate_rmse_m"]) != float(row["ate_rmse_m"])
    assert f'href="run.html#{failed["run"]}"' in (paths.html.parent / "diagnostics.html").read_text()
    page = page_data(paths.html.parent, f"run-{failed['run']}")
    assert (page["level"], page["verdict"]) == ("red", "Crashed at 30/120 frames: RuntimeError: the map is empty")
    assert page["log"] == (store.folder(failed["run"]) / "log.txt").read_text() == "a log\n"
    markdown = paths.markdown.read_text()
    assert "2/3 succeeded" in markdown and "counts as a static camera, or worse (1 of 61 runs)" in markdown


def test_a_report_can_be_made_again_under_another_protocol(made, tmp_path):
    store, paths = made
    other = build_report(store, tmp_path / "other", protocol="vslam-lab")
    assert "Sim(3)-aligned" in other.html.read_text() and "SE(3)-aligned" in paths.html.read_text()
    first, second = ReportData.read(paths.data), ReportData.read(other.data)
    assert {row.protocol_digest for row in first.rows}.isdisjoint({row.protocol_digest for row in second.rows})
    assert not any(name.startswith("rpe_") for name in other.csv)
    with pytest.raises(
        ReportError, match=r"cannot mix 2 protocols: tum-rgbd/v1 \[1190f97bbd77\] \(61 rows\) and vslam-lab"
    ):
        check_one_protocol(first.rows + second.rows)
    with pytest.raises(ReportError, match="cannot mix 2 protocols"):
        compare(paths.data.parent, other.data.parent)
    with pytest.raises(ReportError, match="cannot mix"):
        make_board(first.rows + second.rows)


def test_reference_that_was_not_run_everywhere_gives_way_to_not_moving(made, tmp_path):
    store, _ = made
    with pytest.raises(ReportError) as caught:
        build_report(store, tmp_path / "none", reference="orb-slam4")
    assert "orb-slam3" in caught.value.hint and not (tmp_path / "none").exists()
    paths = build_report(store, tmp_path, reference="orb-slam3")
    assert "static camera (from ground truth)" in rows_of(paths.csv["per_sequence"])[-1]["tracker"]
    assert ReportData.read(paths.data).reference == "static camera (from ground truth)"
    assert float(rows_of(paths.csv["leaderboard"])[0]["ATE ratio"]) < 0.2


def test_small_and_odd_results(tmp_path):
    """One run; a sequence without ground truth; nothing but failures; hostile names."""
    hostile = "</script><script>alert(1)</script> & | % _ $"
    stores = {name: RunStore(tmp_path / name) for name in ("one", "blind", "dead", "hostile")}
    add_run(stores["one"], "a", "s/a", mask_iou=0.5)
    add_run(stores["blind"], "a", "s/a", ground_truth=False)
    for tracker, seed in product(("a", "orb-slam2"), (0, 1)):
        add_run(stores["dead"], tracker, "s/a", seed, status="crashed", reason="boom", lost=range(120))
    add_run(stores["hostile"], "evil", "s/a", label=hostile, reason=hostile, status="crashed")
    add_run(stores["hostile"], "orb-slam2", "s/a")
    made = {name: build_report(store, tmp_path / f"report-{name}") for name, store in stores.items()}
    assert "a alone is ranked" in made["one"].markdown.read_text()
    assert "in no table of errors: s/a" in made["blind"].markdown.read_text()
    ratios = [row["ATE ratio"] for row in rows_of(made["dead"].csv["leaderboard"])]
    assert ratios == ["nothing succeeded"] * 2 and len(rows_of(made["dead"].csv["failures"])) == 4
    text = made["hostile"].html.read_text()
    assert "<script>alert(1)" not in text and "&lt;script&gt;alert(1)" in text
    assert r"\textless{}script\textgreater{}" in made["hostile"].latex.read_text()


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
    with pytest.raises(DynslamError, match=text) as caught:
        build_report([tmp_path / "results"], tmp_path / "report")
    assert "\n" not in str(caught.value) and not (tmp_path / "report").exists()


# -- reported rows


def test_published_numbers_stand_apart_and_never_compete(store, tmp_path):
    for name, seed in product(("orb-slam2", "dynaslam"), (0, 1)):
        add_run(store, name, "tum/fr3/walking_xyz", seed, duration_s=28.8)
    paths = build_report(store, tmp_path / "report")
    names = {row["tracker"] for row in rows_of(paths.csv["per_sequence"])}
    assert {"DynaSLAM N+G (authors: DynaSLAM paper) reported", "EMFOA-OFT-SLAM claimed by the paper"} <= names
    assert not any("DROID-W" in name for name in names)  # aligned by Sim(3)
    records = {name for name in names if name.endswith(" record")}
    assert records == {"lowest error found in print, real time on a CPU record"}
    assert {row["tracker"] for row in rows_of(paths.csv["leaderboard"])} == {"orb-slam2", "dynaslam"}
    assert "Rows marked &#39;reported&#39; are published numbers" in (paths.html.parent / "errors.html").read_text()


# -- pieces


def test_lines_are_broken_at_gaps_of_more_than_twice_the_median():
    stamps = np.r_[0:0.95:0.1, 1.05:2:0.1, 2.6:3:0.1]
    t, v = broken(stamps, stamps[:, None] * [1.0, 2.0], most=500)
    (gap,) = np.flatnonzero(np.isnan(v[:, 0]))  # 0.65 s is a gap of more than twice 0.1 s, 0.15 s is none
    assert 1.95 < t[gap] < 2.6 and np.array_equal(np.delete(t, gap), stamps)
    long = np.arange(10000) / 30.0
    long[5000:] += 10
    t, v = broken(long, long[:, None], most=400)
    assert len(t) < 420 and np.isnan(v[:, 0]).sum() == 1
    assert {long[0], long[4999], long[5000], long[-1]} <= set(t.tolist())
