"""What the page of a run opens with: its level, its moment, and a caption of what is drawn; charts on paper."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import plotly.graph_objects as go
import pytest
from helpers.reports_fake_store import PROTOCOL, add_frames, add_run, page_data

from dynslam_bench.reports import build_report, figures, make_board
from dynslam_bench.reports.html.static_chart import static_chart
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.runs.store import RunStore

SEQUENCE = "synthetic/walking_xyz"


def lose(folder, first, last):
    """Write into a run's table of frames that some were lost."""
    table = folder / "frames.csv"
    heading, *lines = table.read_text().splitlines()
    state = heading.split(",").index("state")
    for at in range(first, last):
        cells = lines[at].split(",")
        cells[state] = "lost"
        lines[at] = ",".join(cells)
    table.write_text("\n".join([heading, *lines]) + "\n")


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """What the pages of some runs hold, by tracker."""
    root = tmp_path_factory.mktemp("pages")
    store = RunStore(root / "results")
    runs = {
        "good": add_run(store, "good", SEQUENCE, error=0.01),
        "near": add_run(store, "near", SEQUENCE, error=0.02),
        "far": add_run(store, "far", SEQUENCE, error=0.1),
        "astray": add_run(store, "astray", SEQUENCE, error=5.0),
        "dies": add_run(store, "dies", SEQUENCE, status="crashed", reason="RuntimeError: no map"),
    }
    add_frames(store.folder(runs["good"]), 120)
    (store.folder(runs["good"]) / "snapshots.npz").unlink()
    add_frames(store.folder(runs["near"]), 120)
    lose(store.folder(runs["near"]), 40, 50)
    add_frames(store.folder(runs["dies"]), 30)
    folder = build_report(store, root / "report").html.parent
    return {tracker: page_data(folder, f"run-{run}") for tracker, run in runs.items()}


def test_the_banner_follows_the_error(pages):
    levels = {tracker: page["level"] for tracker, page in pages.items()}
    assert levels == {
        "good": "green",
        "near": "green",
        "far": "amber",
        "astray": "red",
        "dies": "red",
    }
    # the words name what the number is compared with
    assert "times the least here" in pages["far"]["verdict"]
    assert "good" in pages["far"]["verdict"]
    assert "not moving" in pages["astray"]["verdict"]


def test_a_page_opens_at_the_failure_else_at_the_largest_error(pages):
    assert pages["near"]["moment"] == 40, "where tracking was lost first"
    assert pages["dies"]["moment"] == 29, "the last frame before the crash"
    assert pages["good"]["moment"] == 119, "the largest error"
    assert pages["far"]["moment"] is None, "no frames are known"


def test_the_caption_names_what_is_drawn_and_nothing_else(pages):
    captions = {tracker: " ".join(page["caption"]) for tracker, page in pages.items()}
    assert "Shaded" in captions["near"]
    assert "Shaded" not in captions["good"]
    assert "yellow" in captions["near"]
    assert "yellow" not in captions["good"], "its tracker showed neither features nor masks"
    assert "circles" not in captions["far"], "it has no pictures"


def test_without_pictures_a_page_keeps_track_curves_and_residuals(store, tmp_path):
    runs = [add_run(store, name, SEQUENCE) for name in ("a", "b", "c")]
    for run in runs:
        add_frames(store.folder(run), 120)
    folder = build_report(store, tmp_path / "report", most_pictures=1).html.parent
    pages = [page_data(folder, f"run-{run}") for run in runs]
    assert sorted(bool(page["pictures"]) for page in pages) == [False, False, True]
    for page in pages:
        assert {"time", "track"} <= page["figures"].keys()
        names = [trace["name"] for trace in page["figures"]["track"]["data"]]
        assert names == ["true path", "estimate", "residuals"]


def words_in(chart):
    """The texts of a static picture."""
    picture = ElementTree.fromstring(chart)
    return {element.text for element in picture.iter() if element.tag == "text"}


def test_static_pictures_have_the_trackers_and_one_mark_a_sequence(store):
    for number, error in enumerate((0.01, 0.02, 0.04, 0.08)):
        add_run(store, "one & only", f"s/{number}", error=error)
        add_run(store, "other", f"s/{number}", error=2 * error)
    board = make_board(load_runs([store], PROTOCOL).rows)
    figure = figures.error_figure(board)
    strip = static_chart(figure)
    assert {"one & only", "other", "10", "100", "not moving"} <= words_in(strip)
    assert strip.count("<circle") == 8
    # the axis is logarithmic
    places = [float(x) for x in re.findall(r'<circle cx="([0-9.]+)"', strip)[:4]]
    logs = np.log(np.array(figure.data[0].x, dtype=float))
    line = np.polynomial.Polynomial.fit(logs, places, 1)
    assert line(logs) == pytest.approx(places, abs=0.2)
    curves = static_chart(figures.cumulative_figure(board))
    assert {"one & only", "other", "0", "100"} <= words_in(curves)
    assert curves.count("<path") == 4, "a curve and its sample in the legend, twice"


def test_other_charts_have_no_static_picture():
    assert static_chart(go.Figure([go.Scatter3d(x=[1], y=[1], z=[1])])) == ""
    assert static_chart(go.Figure()) == ""


def test_the_curve_counts_the_sequences_below_an_error(store):
    for number, error in enumerate((0.01, 0.02, 0.04, 0.08)):
        add_run(store, "one", f"s/{number}", error=error)
        dies = number == 3
        add_run(
            store,
            "dies",
            f"s/{number}",
            error=error,
            status="crashed" if dies else "ok",
            reason="no" if dies else "",
        )
    board = make_board(load_runs([store], PROTOCOL).rows)
    curves = {trace.name: trace for trace in figures.cumulative_figure(board).data}
    errors_mm = np.array(curves["one"].x)
    assert list(curves["one"].y) == [0, 25, 50, 75, 100, 100]
    assert (np.diff(errors_mm) >= 0).all()
    # a failed run counts as not moving: below no error that a tracker has
    at_largest = np.searchsorted(curves["dies"].x, errors_mm[4], side="right") - 1
    assert curves["dies"].y[at_largest] == 75
