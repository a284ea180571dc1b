"""What is no better than a static camera has no rank, on pages and terminals."""

import numpy as np
import pytest
from reports_rows import PROTOCOL, crashed, row

from dynslam_bench.cli.reports import show_top
from dynslam_bench.reports.model.board import make_board
from dynslam_bench.reports.tables.leaderboard import leaderboard


def test_what_is_worse_than_a_static_camera_is_never_first(capsys):
    """On the page and on the terminal, though it alone came to its end everywhere, or it alone is there."""
    rows = [row("bad", s, 2.16) for s in "st"] + [row("still", s, 0.3, provenance="control") for s in "st"]
    alone = make_board(rows)
    assert alone.ranked == [] and [alone.first(key).tracker for key in alone.no_better] == ["bad"]
    assert [alone.first(key).tracker for key in alone.trackers] == ["still", "bad"]

    rows += [row("good", "s", 0.1), crashed("good", "t")]
    board = make_board(rows)
    assert [board.first(key).tracker for key in board.trackers] == ["good", "still", "bad"]
    table = leaderboard(board, PROTOCOL)
    ranks = {cells[2].text: (cells[0].text, cells[0].small) for cells in table.rows}
    assert ranks["GOOD"] == ("1", "") and ranks["STILL"] == ("\u2013", "")
    assert ranks["BAD"] == ("\u2013", "no better than a static camera")
    show_top(table)
    lines = capsys.readouterr().out.splitlines()[1:4]
    assert [name in line for name, line in zip(("GOOD", "STILL", "BAD"), lines, strict=True)] == [True] * 3
    assert "no better than a static camera" in lines[2]


@pytest.mark.parametrize(
    ("s", "t", "ranked"), [(0.1, 0.8, True), (0.2, 0.5, False), (0.3, 0.3, False), (0.29, 0.3, True)]
)
def test_worse_than_a_static_camera_is_a_geometric_mean(s, t, ranked):
    board = make_board([row("one", "s", s), row("one", "t", t), row("best", "s", 0.01), row("best", "t", 0.01)])
    (key,) = (key for key in board.labels if board.first(key).tracker == "one")
    assert board.static_ratio(key) == pytest.approx(np.sqrt(s * t) / 0.3)
    assert (key in board.ranked) == ranked != (key in board.no_better)


def test_a_reference_worse_than_a_static_camera_stays_the_reference():
    board = make_board([row("orb-slam2", s, 0.6) for s in "st"] + [row("good", s, 0.1) for s in "st"])
    assert board.first(board.reference).tracker == "orb-slam2" and len(board.ranked) == 1
