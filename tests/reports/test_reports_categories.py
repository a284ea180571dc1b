"""Boards by category, and what a board says in words."""

import numpy as np
import pytest
from reports_rows import row

from dynslam_bench.reports.html.board_page import ratios_content
from dynslam_bench.reports.model.board import OVERALL, category_boards, compare_pairs, make_board
from dynslam_bench.reports.model.summary import explanation, headline, mean_rank_note
from dynslam_bench.reports.tables import leaderboard as tables


def rows_of_truth(sizes, sequences, spread=0.05, seed=0):
    """Runs of trackers whose errors are `sizes` of the category times a common hardness; `orb-slam2` has 1."""
    rng = np.random.default_rng(seed)
    rows = []
    for category, number in sequences.items():
        for i in range(number):
            hardness = rng.uniform(0.02, 0.06)
            for tracker, by_category in ({"orb-slam2": dict.fromkeys(sequences, 1.0)} | sizes).items():
                error = hardness * by_category[category] * np.exp(rng.normal(0, spread))
                tags = [category, *(["fast"] if i == 0 else [])]
                name = f"synthetic/{category}?scene={i}"
                rows.append(row(tracker, name, error, tags=tags, static_camera_ate_rmse_m=1.0))
    return rows


SIZES = {
    "masks": {"high-dynamic": 0.2, "low-dynamic": 1.0},
    "flow": {"high-dynamic": 0.2, "low-dynamic": 0.9},
    "bad": {"high-dynamic": 3.0, "low-dynamic": 3.0},
}


def test_every_category_has_a_board_and_the_overall_one_is_a_mean_over_what_moves():
    board = make_board(rows_of_truth(SIZES, {"high-dynamic": 12, "low-dynamic": 6}))
    boards = category_boards(board)
    assert {name: len(part.common) for name, part in boards.items()} == {
        OVERALL: 18, "low dynamic": 6, "high dynamic": 12, "fast": 2,
    }  # fmt: skip
    ratio = {name: {s.key.split("|")[0]: s.ratio.value for s in part.standings} for name, part in boards.items()}
    assert ratio["high dynamic"]["masks"] == pytest.approx(0.2, rel=0.05)
    assert ratio["low dynamic"]["masks"] == pytest.approx(1.0, rel=0.05)
    both = ratio["high dynamic"]["masks"] * ratio["low dynamic"]["masks"]
    assert ratio[OVERALL]["masks"] == pytest.approx(np.sqrt(both)), "not the mean over 18 sequences"


def test_verdicts_are_those_of_the_category():
    boards = category_boards(make_board(rows_of_truth(SIZES, {"high-dynamic": 12, "low-dynamic": 6})))
    verdicts = {name: {s.key.split("|")[0]: s.verdict for s in part.standings} for name, part in boards.items()}
    assert verdicts["high dynamic"] == {
        "masks": "better", "flow": "better", "orb-slam2": "reference", "bad": "worse",
    }  # fmt: skip
    assert verdicts["low dynamic"]["masks"] == "cannot tell"
    assert set(verdicts["fast"].values()) == {"cannot tell", "reference"}, "two sequences"
    table = tables.category_table(boards)
    assert [column.name for column in table.columns] == ["tracker", OVERALL, "low dynamic", "high dynamic", "fast"]


def test_the_headline_names_the_best_and_whether_they_can_be_told_apart():
    boards = category_boards(make_board(rows_of_truth(SIZES, {"high-dynamic": 12, "low-dynamic": 6})))
    said = headline(boards["high dynamic"])
    assert said.startswith("On 12 high dynamic sequences ") and "ORB-SLAM2's error by" in said
    assert "MASKS" in said and "FLOW" in said and said.endswith("these cannot be told apart.")
    assert "below 5 sequences" in headline(boards["fast"])
    alone = make_board(rows_of_truth({"bad": SIZES["bad"]}, {"high-dynamic": 12}))
    assert (
        headline(alone) == "On 12 high dynamic sequences no tracker is shown to be better than ORB-SLAM2; 1 is worse."
    )
    assert "not as evidence" in explanation(boards["fast"])
    assert "2 are better, 1 is worse" in explanation(boards["high dynamic"])


def test_all_pairs_stand_in_a_matrix():
    board = make_board(rows_of_truth(SIZES, {"high-dynamic": 12}))
    pairs = compare_pairs(board, board.ranked)
    assert len(pairs) == 6
    apart = {frozenset((board.labels[p.one], board.labels[p.other])): p.verdict != "cannot tell" for p in pairs}
    assert not apart[frozenset({"MASKS", "FLOW"})] and sum(apart.values()) == 5
    table = tables.pair_table(board)
    assert [len(cells) for cells in table.rows] == [5] * 4
    assert "critical" not in mean_rank_note(board) and "Nemenyi" in mean_rank_note(board)
    assert tables.pair_table(make_board(rows_of_truth(SIZES, {"high-dynamic": 4}))) is None


def test_two_trackers_side_by_side_have_the_numbers_of_the_board():
    board = make_board(rows_of_truth(SIZES, {"high-dynamic": 12, "low-dynamic": 6}))
    keys = [*board.trackers, *board.final_only]
    assert len(set(board.weights.values())) == 2, "the categories have unequal sizes"
    reference, shown = keys.index(board.reference), ratios_content(board)
    assert len(shown) == len(keys) * (len(keys) - 1) // 2
    for standing in board.standings:
        place = keys.index(standing.key)
        for a, b, *ratio, sequences, verdict in shown:
            if {a, b} == {place, reference}:
                value, low, high = ratio if a == reference else (1 / ratio[0], 1 / ratio[2], 1 / ratio[1])
                expected = standing.ratio
                assert (value, low, high) == pytest.approx((expected.value, expected.low, expected.high), rel=1e-3)
                turned = {"better": "worse", "worse": "better"}.get(verdict, verdict)
                assert standing.verdict == (verdict if a == reference else turned) and sequences == 18


def test_exact_masks_are_a_bound_and_never_rank_beside_others():
    rows = rows_of_truth(SIZES, {"high-dynamic": 12})
    bound_info = dict(variant={"segmentation.source": "oracle"}, tags=["high-dynamic"], segmentation="oracle")
    plain = [other for other in rows if other.tracker.id == "orb-slam2"]
    exact = [row("masks", other.sequence.id, 0.1 * other.score_m, **bound_info) for other in plain]
    board = make_board([*rows, *exact])
    ratios = {s.key: s.ratio.value for s in board.standings}
    bound = next(key for key in board.labels if "oracle" in key)
    assert bound not in board.ranked and len(board.ranked) == 4 and ratios[bound] == pytest.approx(0.1)
    assert make_board(exact).ranked == [bound], "alone they rank"
