"""What stands beside a number is true: marks, provenance, lengths.

A network on the scenes that it was trained on is marked in every format, and ranks only where that is asked for.
"""

import pandas as pd
import pytest
from reports_fake_store import add_run

from dynslam_bench.reports import build_report, compare, load_board
from dynslam_bench.reports.model.published import is_excerpt, least_length_s
from dynslam_bench.reports.tables.table import to_markdown
from dynslam_bench.runs.store import RunStore
from dynslam_bench.segmentation.networks.checkpoints import seen_in_training
from dynslam_bench.trackers import TRACKERS

OLD, NEW = "synthetic/walking_xyz?scene=3", "synthetic/walking_xyz?scene=103"


@pytest.fixture
def store(tmp_path):
    """Four trackers, two with the network's masks, on a scene of the training set and on a held-out one."""
    store = RunStore(tmp_path / "results")
    for sequence in (OLD, NEW):
        add_run(store, "orb-slam2", sequence, error=0.05)
        add_run(store, "mask-rcnn", sequence, error=0.01, masks="embedded")
        add_run(store, "dynaslam", sequence, error=0.03, masks="embedded")
        add_run(store, "ds-slam", sequence, error=0.02, masks="yolo")
    return store


@pytest.mark.parametrize(
    ("source", "sequence", "seen"),
    [
        ("embedded", "synthetic/walking_xyz", True),
        ("embedded", "synthetic/sitting_rpy?scene=99&frames=50&noise=4", True),
        ("embedded", "synthetic/sitting_rpy?scene=100&frames=50", False),
        ("embedded", "synthetic/somebody_elses", False),
        ("embedded", "tum/fr3/walking_xyz", False),
        ("oracle", "synthetic/walking_xyz", False),
        ("", "synthetic/walking_xyz", False),
    ],
)
def test_what_the_embedded_network_was_trained_on(source, sequence, seen):
    assert seen_in_training(source, sequence) is seen


def test_such_cells_do_not_rank_unless_asked_for(store):
    board = load_board(store)
    names = {board.first(key).tracker.id: key for key in board.labels}
    assert board.common == [NEW] and set(board.ranked) == set(names.values())
    everything = load_board(store, rank_seen=True)
    assert set(everything.common) == {OLD, NEW} and len(everything.ranked) == 4


def test_a_tracker_that_was_judged_only_where_its_network_was_trained_is_not_ranked(tmp_path):
    store = RunStore(tmp_path / "results")
    for tracker, masks in (("orb-slam2", ""), ("ds-slam", "yolo"), ("mask-rcnn", "embedded")):
        add_run(store, tracker, OLD, masks=masks, error=0.001 if masks == "embedded" else 0.03)
    board = load_board(store)
    assert {board.first(key).tracker.id for key in board.ranked} == {"orb-slam2", "ds-slam"}
    assert {board.first(key).tracker.id for key in board.trackers} == {"orb-slam2", "ds-slam", "mask-rcnn"}, "but shown"
    assert len(load_board(store, rank_seen=True).ranked) == 3


@pytest.mark.parametrize("rank_seen", [False, True])
def test_every_format_carries_the_mark(store, tmp_path, rank_seen):
    paths = build_report(store, tmp_path / "report", rank_seen=rank_seen)
    markdown, latex = paths.markdown.read_text(), paths.latex.read_text()
    page = "".join((paths.html.parent / f"{name}.html").read_text() for name in ("index", "errors", "reproduce"))
    rule = "rank, since that was asked for" if rank_seen else "do not rank"
    assert "trained on this very scene (the embedded one, on rendered scenes 0-99)" in markdown and rule in markdown
    table = markdown.split("## Absolute trajectory")[1].split("\n## ")[0]
    (line,) = [line for line in table.splitlines() if line.startswith("| mask-rcnn §")]
    held_out, trained, where = [cell.strip() for cell in line.split("|")[2:-1]]
    assert "§" not in held_out and "**" in held_out and "§" in trained and ("**" in trained) is rank_seen
    assert where == "walking\\_xyz?scene=3"
    assert page.count("mask-rcnn §") > 3 and "mask-rcnn \\S{}" in latex and "§" not in latex
    errors = pd.read_csv(paths.csv["per_sequence"])
    assert errors.set_index("tracker")["§ trained on"]["mask-rcnn §"] == "walking_xyz?scene=3"
    runs = pd.read_csv(paths.csv["runs"])
    marked = runs[runs["seen_in_training"]]
    assert set(zip(marked["tracker"], marked["sequence"], strict=True)) == {("mask-rcnn", OLD), ("dynaslam", OLD)}
    assert ("--rank-seen" in markdown + page) is rank_seen
    assert "§" in to_markdown(compare(store, store).table)


def test_a_recording_of_unknown_length_beside_published_numbers_is_named(tmp_path):
    store = RunStore(tmp_path / "r")
    for name in ("bonn/balloon", "tum/fr3/walking_rpy"):
        add_run(store, "orb-slam2", name, block=name, duration_s=30.6)
    markdown = build_report(store, tmp_path / "report").markdown.read_text()
    assert "Published numbers stand beside bonn/balloon, whose full length is not known here" in markdown
    assert least_length_s("bonn/balloon") is None and not is_excerpt("bonn/balloon", 1.0), "no source, no claim"


def test_what_was_put_together_here_is_called_no_system_of_ours(tmp_path):
    """The back end in the manner of ORB-SLAM2 and masks by Mask R-CNN are others' systems in our composition."""
    store = RunStore(tmp_path / "results")
    for tracker in ("orb-slam2", "mask-rcnn", "emfoa-oft"):
        assert TRACKERS.get(tracker).provenance == "own"
        add_run(store, tracker, NEW, provenance="own")
    table = pd.read_csv(build_report(store, tmp_path / "report").csv["leaderboard"])
    assert table["provenance"].tolist() == ["our composition"] * 3
    meaning = "put together in this project: no one paper or program describes the whole"
    assert (tmp_path / "report" / "index.html").read_text().count(meaning) == 3
