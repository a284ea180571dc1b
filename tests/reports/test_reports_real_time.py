"""Real-time runs: what they dropped is the machine's doing, so they are ranked among themselves and judge nobody."""

from reports_rows import row

from dynslam_bench.reports.model.board import make_board

LIVE = {"realtime": "a computer, 2 cores"}


def test_real_time_runs_are_shown_apart_and_are_never_the_reference():
    sequences = ("s", "t", "u")
    slow = [row("orb-slam2", name, 0.01, variant=LIVE) for name in sequences]
    others = [row(tracker, name, error) for tracker, error in (("a", 0.1), ("b", 0.2)) for name in sequences]
    board = make_board([*others, *slow])
    (live,) = [key for key in board.labels if board.first(key).variant == LIVE]
    assert live in board.trackers and live not in board.ranked and len(board.ranked) == 2
    assert board.reference is None
    plain = [row("orb-slam2", name, 0.05) for name in sequences]
    board = make_board([*others, *slow, *plain])
    assert board.first(board.reference).variant == {} and live not in board.ranked
    assert board.labels[board.reference] != board.labels[live]


def test_real_time_runs_alone_are_ranked_against_a_camera_that_never_moves():
    board = make_board([row(name, s, 0.1, variant=LIVE) for name in ("orb-slam2", "b") for s in ("s", "t")])
    assert len(board.ranked) == 2 and board.reference is None
