"""Who is ranked: systems that beat a static camera, real-time runs among themselves, monocular runs by scale."""

import json

import numpy as np
import pytest
from reports_fake_store import MACHINE, add_run
from reports_rows import PROTOCOL, crashed, row

from dynslam_bench.cli.output import report_table
from dynslam_bench.core.errors import ReportError
from dynslam_bench.evaluation.protocol import MONOCULAR, get_protocol
from dynslam_bench.reports.model.board import category_boards, make_board
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.reports.tables.leaderboard import false_motion, leaderboard, per_sequence, time_table
from dynslam_bench.runs import RunStore

LIVE = {"realtime": True, "machine": MACHINE}


def names(board, keys):
    return [board.first(key).tracker.id for key in keys]


def test_what_is_worse_than_a_static_camera_is_never_first():
    """On the page and on the terminal, though it alone came to its end everywhere, or it alone is there."""
    rows = [row("bad", s, 2.16) for s in "st"] + [row("still", s, 0.3, provenance="control") for s in "st"]
    alone = make_board(rows)
    assert alone.ranked == [] and names(alone, alone.no_better) == ["bad"]
    assert names(alone, alone.trackers) == ["still", "bad"]
    board = make_board([*rows, row("good", "s", 0.1), crashed("good", "t")])
    assert names(board, board.trackers) == ["good", "still", "bad"]
    table = leaderboard(board, PROTOCOL)
    ranks = {cells[2].text: cells[0].text for cells in table.rows}
    assert ranks == {"GOOD": "1", "STILL": "\u2013", "BAD": "\u2013"}
    lines = report_table(table, ["#", "tracker"]).splitlines()[1:4]
    assert [name in line for name, line in zip(("GOOD", "STILL", "BAD"), lines, strict=True)] == [True] * 3


@pytest.mark.parametrize(
    ("s", "t", "ranked"), [(0.1, 0.8, True), (0.2, 0.5, False), (0.3, 0.3, False), (0.29, 0.3, True)]
)
def test_worse_than_a_static_camera_is_a_geometric_mean(s, t, ranked):
    board = make_board([row("one", "s", s), row("one", "t", t), row("best", "s", 0.01), row("best", "t", 0.01)])
    (key,) = (key for key in board.labels if board.first(key).tracker.id == "one")
    assert board.static_ratio(key) == pytest.approx(np.sqrt(s * t) / 0.3)
    assert (key in board.ranked) == ranked != (key in board.no_better)


def fixed(tracker, error, **changes):
    """A run before a fixed camera, where a static camera has no error."""
    moved = {"ate_rmse_m": error, "false_motion_max_m": 3 * error, "false_motion_path_m": 90 * error}
    return row(tracker, "f", error, tags=["fixed-camera"], static_camera_ate_rmse_m=0.0, metrics=moved, **changes)


def test_before_a_fixed_camera_trackers_rank_though_none_is_better_than_not_moving():
    errors = {"orb-slam2": 0.05, "good": 0.002, "bad": 0.24}
    rows = [*(fixed(name, error) for name, error in errors.items()), fixed("never", 0.0, provenance="control")]
    board = make_board(rows)
    assert names(board, board.ranked) == ["good", "orb-slam2", "bad"] and not board.no_better
    assert board.groups == {"f": "fixed camera"} and board.static_camera == {"f": 0.0}
    assert "no better" not in per_sequence(board, PROTOCOL).caption.replace("or are no better", "")
    table = false_motion(board, PROTOCOL)
    cells = {line[0].text: [cell.text for cell in line[1:]] for line in table.rows}
    assert cells["GOOD"] == ["6.00", "180"] and cells["NEVER"] == ["0", "0"]
    assert time_table(board) is None, "no percentage of zero"
    assert make_board([fixed("good", 0.002), fixed("bad", 0.24)]).standings == [], "no ratio to zero either"


def test_beside_other_sequences_the_fixed_camera_is_a_category_and_no_yardstick_of_not_moving():
    rows = [row(name, s, error) for name, error in (("orb-slam2", 0.1), ("good", 0.05)) for s in "st"]
    board = make_board([*rows, fixed("orb-slam2", 0.05), fixed("good", 0.002)])
    assert names(board, board.ranked) == ["good", "orb-slam2"]
    assert set(category_boards(board)) == {"overall", "fixed camera", "other"}
    assert (
        false_motion(board, PROTOCOL).columns[1].name == "farthest" and len(false_motion(board, PROTOCOL).columns) == 3
    )
    assert false_motion(make_board(rows), PROTOCOL) is None


def test_who_fails_before_a_fixed_camera_does_not_win_with_an_error_of_zero():
    gone = fixed("gone", 0.001, status="crashed", n_processed=20, n_tracked=20, coverage=1 / 3, reason="boom")
    assert gone.score_m is None
    board = make_board([fixed("good", 0.002), fixed("orb-slam2", 0.05), gone])
    assert names(board, board.ranked) == ["good", "orb-slam2"]
    cells = {line[0].text: line[1].text for line in per_sequence(board, PROTOCOL).rows}
    assert cells["GONE"] == "crashed at 20/60"


def test_a_reference_worse_than_a_static_camera_stays_the_reference():
    board = make_board([row("orb-slam2", s, 0.6) for s in "st"] + [row("good", s, 0.1) for s in "st"])
    assert names(board, [board.reference]) == ["orb-slam2"] and names(board, board.ranked) == ["good"]


def test_real_time_runs_are_shown_apart_and_are_never_the_reference():
    """What they dropped is the machine's doing."""
    slow = [row("orb-slam2", name, 0.01, **LIVE) for name in "stu"]
    others = [row(tracker, name, error) for tracker, error in (("a", 0.1), ("b", 0.2)) for name in "stu"]
    board = make_board([*others, *slow])
    assert names(board, board.ranked) == ["a", "b"] and len(board.trackers) == 3 and board.reference is None
    board = make_board([*others, *slow, *(row("orb-slam2", name, 0.05) for name in "stu")])
    (live,) = (key for key in board.labels if board.first(key).realtime)
    assert names(board, [board.reference]) == ["orb-slam2"] and board.reference != live not in board.ranked
    assert board.labels[board.reference] != board.labels[live]
    alone = make_board([row(name, s, 0.1, **LIVE) for name in ("orb-slam2", "b") for s in "st"])
    assert len(alone.ranked) == 2 and alone.reference is None


def mixed(root, trackers):
    """A store of one run a tracker; those called ``-mono`` are monocular."""
    store = RunStore(root)
    for tracker in trackers:
        path = store.folder(add_run(store, tracker, "synthetic/sitting_xyz")) / "run.json"
        record = json.loads(path.read_text())
        record["tracker"]["sensors"] = "rgb" if tracker.endswith("-mono") else "rgbd"
        path.write_text(json.dumps(record))
    return store


def test_a_protocol_without_scale_leaves_monocular_runs_out_and_counts_them(tmp_path):
    store = mixed(tmp_path / "both", ("orb-slam2", "orb-slam2-mono"))
    metric, scaled = (load_runs([store], get_protocol(name)) for name in ("tum-rgbd/v1", MONOCULAR))
    assert [row.tracker.id for row in metric.rows] == ["orb-slam2"] and metric.without_scale == 1
    assert len(scaled.rows) == 2 and not scaled.without_scale
    assert all(row.metrics["ate_rmse_m"] > 0 for row in scaled.rows)
    with pytest.raises(ReportError, match=f"--protocol {MONOCULAR}"):
        load_runs([mixed(tmp_path / "alone", ("orb-slam2-mono",))], get_protocol("tum-rgbd/v1"))
