"""Plots of trajectory files: what is drawn, where lines break, and which files are written."""

import cv2
import numpy as np
import pytest
from helpers.evaluation_walks import walk

from dynslam_bench.core import ReportError
from dynslam_bench.geometry import Trajectory
from dynslam_bench.reports.trajectory_plot import PlottedTrajectory, plot_trajectories


@pytest.fixture
def truth() -> Trajectory:
    return walk(n=90)


def plotted(truth: Trajectory, rows: np.ndarray, label: str = "mine") -> PlottedTrajectory:
    errors_m = np.linspace(0.01, 0.03, len(rows))
    return PlottedTrajectory(label, truth.select(rows), errors_m, 0.02)


@pytest.mark.parametrize("ending", [".html", ".png", ".svg", ".pdf"])
def test_each_ending_is_written_and_nothing_else(truth, tmp_path, ending):
    drawn = plot_trajectories([plotted(truth, np.arange(90))], truth, tmp_path / f"new/a{ending}")
    assert [path.name for path in (tmp_path / "new").iterdir()] == [f"a{ending}"]
    assert drawn.stat().st_size > 5000


def test_a_picture_shows_lines_in_the_colours_of_the_estimates(truth, tmp_path):
    plot_trajectories([plotted(truth, np.arange(90))], truth, tmp_path / "a.png")
    image = cv2.imread(str(tmp_path / "a.png"))
    blue, green, red = 0xB2, 0x72, 0x00
    drawn = (image == (blue, green, red)).all(axis=2)
    left = drawn[:, : image.shape[1] // 2].sum()
    right = drawn[:, image.shape[1] // 2 :].sum()
    assert left > 100
    assert right > 100


def test_lines_break_where_frames_are_missing(truth, tmp_path):
    rows = np.r_[0:30, 60:90]
    plot_trajectories([plotted(truth, rows)], truth, tmp_path / "a.svg")
    whole = (tmp_path / "a.svg").read_text()
    # the truth is one path; track and error line of the estimate are two pieces each
    move_to = [path.count("M ") for path in whole.split('d="')[1:] if path.count("L ") > 50]
    assert sorted(move_to) == [1, 2, 2]


def test_markup_in_a_name_stays_text(truth, tmp_path):
    plot_trajectories([plotted(truth, np.arange(90), "<b>x</b>")], truth, tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text()
    assert "<b>x" not in page


@pytest.mark.parametrize("name", ["a.gif", "a", "a.html.txt"])
def test_other_endings_are_refused_before_anything_is_written(truth, tmp_path, name):
    with pytest.raises(ReportError, match=r"\.html, \.png, \.svg, \.pdf"):
        plot_trajectories([plotted(truth, np.arange(90))], truth, tmp_path / name)
    assert list(tmp_path.iterdir()) == []
