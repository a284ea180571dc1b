"""Who is ranked: systems that beat a static camera, real-time runs among themselves, monocular runs by scale."""

import base64
import json

import numpy as np
import pytest
from helpers.reports_fake_store import MACHINE, PROTOCOL, add_run, cell_named, cell_of, crashed, row
from rank_groups import simulate
from scipy import stats

from dynslam_bench.cli.output import report_table
from dynslam_bench.core.errors import ReportError
from dynslam_bench.evaluation.protocol import MONOCULAR, get_protocol
from dynslam_bench.geometry import Trajectory
from dynslam_bench.reports.html.board_page import ratios_data
from dynslam_bench.reports.model.board import (
    OVERALL,
    category_boards,
    compare_pairs,
    copies_note,
    make_board,
    missing_note,
)
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.reports.model.statistics import (
    candidates_for_best,
    claims_against,
    holm,
    mean_rank_test,
    rank_groups,
    ratio_interval,
    separable,
    sequences_of,
    standings,
)
from dynslam_bench.reports.model.summary import explanation, headline, mean_rank_note
from dynslam_bench.reports.tables import leaderboard as tables
from dynslam_bench.reports.tables.leaderboard import (
    false_motion,
    leaderboard,
    per_sequence,
    time_table,
)
from dynslam_bench.runs import RunStore

LIVE = {"realtime": True, "machine": MACHINE}


def names(board, keys):
    return [board.first(key).tracker.id for key in keys]


def test_what_is_worse_than_a_static_camera_is_never_first():
    """On the page and on the terminal, though it alone came to its end everywhere, or it alone is there."""
    rows = [row("bad", s, 2.16) for s in "st"] + [
        row("still", s, 0.3, provenance="control") for s in "st"
    ]
    alone = make_board(rows)
    assert alone.ranked == []
    assert names(alone, alone.ranked_out_by_static) == ["bad"]
    assert names(alone, alone.trackers) == ["still", "bad"]
    board = make_board([*rows, row("good", "s", 0.1), crashed("good", "t")])
    assert names(board, board.trackers) == ["good", "still", "bad"]
    table = leaderboard(board, PROTOCOL)
    assert {cells[2].text: cells[0].text for cells in table.rows} == {
        "GOOD": "1",
        "STILL": "\u2013",
        "BAD": "\u2013",
    }
    lines = report_table(table, ["#", "tracker"]).splitlines()[1:4]
    assert [name in line for name, line in zip(("GOOD", "STILL", "BAD"), lines, strict=True)] == [
        True
    ] * 3


@pytest.mark.parametrize(
    ("s", "t", "ranked"),
    [(0.1, 0.8, True), (0.2, 0.5, False), (0.3, 0.3, False), (0.29, 0.3, True)],
)
def test_worse_than_a_static_camera_is_a_geometric_mean(s, t, ranked):
    board = make_board(
        [row("one", "s", s), row("one", "t", t), row("best", "s", 0.01), row("best", "t", 0.01)]
    )
    key = next(key for key in board.labels if board.first(key).tracker.id == "one")
    assert board.static_ratio(key) == pytest.approx(np.sqrt(s * t) / 0.3)
    assert (key in board.ranked) == ranked != (key in board.ranked_out_by_static)


def fixed(tracker, error, **changes):
    """A run before a fixed camera, where a static camera has no error."""
    moved = {
        "ate_rmse_m": error,
        "false_motion_max_m": 3 * error,
        "false_motion_path_m": 90 * error,
    }
    return row(
        tracker,
        "f",
        error,
        tags=["fixed-camera"],
        static_camera_ate_rmse_m=0.0,
        metrics=moved,
        **changes,
    )


def test_before_a_fixed_camera_trackers_rank_though_none_is_better_than_not_moving():
    systems = fixed("orb-slam2", 0.05), fixed("good", 0.002), fixed("bad", 0.24)
    board = make_board([*systems, fixed("never", 0.0, provenance="control")])
    assert names(board, board.ranked) == ["good", "orb-slam2", "bad"]
    assert not board.ranked_out_by_static
    assert board.groups == {"f": "fixed camera"}
    assert board.static_camera == {"f": 0.0}
    assert "no better" not in per_sequence(board, PROTOCOL).caption.replace("or are no better", "")
    cells = {
        line[0].text: [cell.text for cell in line[1:]]
        for line in false_motion(board, PROTOCOL).rows
    }
    assert cells["GOOD"] == ["6.00", "180"]
    assert cells["NEVER"] == ["0", "0"]
    assert time_table(board) is None, "no percentage of zero"
    assert make_board([fixed("good", 0.002), fixed("bad", 0.24)]).standings == [], (
        "no ratio to zero either"
    )


def test_beside_other_sequences_the_fixed_camera_is_a_category_and_no_yardstick_of_not_moving():
    rows = [
        row(name, s, error) for name, error in (("orb-slam2", 0.1), ("good", 0.05)) for s in "st"
    ]
    board = make_board([*rows, fixed("orb-slam2", 0.05), fixed("good", 0.002)])
    assert names(board, board.ranked) == ["good", "orb-slam2"]
    assert set(category_boards(board)) == {"overall", "fixed camera", "other"}
    assert [column.name for column in false_motion(board, PROTOCOL).columns] == [
        "tracker",
        "farthest",
        "path",
    ]
    assert false_motion(make_board(rows), PROTOCOL) is None


def test_who_fails_before_a_fixed_camera_does_not_win_with_an_error_of_zero():
    gone = fixed(
        "gone", 0.001, status="crashed", n_processed=20, n_tracked=20, coverage=1 / 3, reason="boom"
    )
    board = make_board([fixed("good", 0.002), fixed("orb-slam2", 0.05), gone])
    assert names(board, board.ranked) == ["good", "orb-slam2"]
    assert gone.score_m is None
    assert cell_of(per_sequence(board, PROTOCOL), "GONE").text == "crashed at 20/60"


def test_a_reference_worse_than_a_static_camera_stays_the_reference():
    board = make_board(
        [row("orb-slam2", s, 0.6) for s in "st"] + [row("good", s, 0.1) for s in "st"]
    )
    assert names(board, [board.reference]) == ["orb-slam2"]
    assert names(board, board.ranked) == ["good"]


def test_real_time_runs_are_shown_apart_and_are_never_the_reference():
    """What they dropped is the machine's doing."""
    slow = [row("orb-slam2", name, 0.01, **LIVE) for name in "stu"]
    others = [
        row(tracker, name, error) for tracker, error in (("a", 0.1), ("b", 0.2)) for name in "stu"
    ]
    board = make_board([*others, *slow])
    assert names(board, board.ranked) == ["a", "b"]
    assert len(board.trackers) == 3
    assert board.reference is None
    board = make_board([*others, *slow, *(row("orb-slam2", name, 0.05) for name in "stu")])
    (live,) = (key for key in board.labels if board.first(key).realtime)
    assert names(board, [board.reference]) == ["orb-slam2"]
    assert board.reference != live not in board.ranked
    assert board.labels[board.reference] != board.labels[live]
    alone = make_board([row(name, s, 0.1, **LIVE) for name in ("orb-slam2", "b") for s in "st"])
    assert len(alone.ranked) == 2
    assert alone.reference is None


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
    assert [row.tracker.id for row in metric.rows] == ["orb-slam2"]
    assert metric.without_scale == 1
    assert len(scaled.rows) == 2
    assert not scaled.without_scale
    assert all(row.metrics["ate_rmse_m"] > 0 for row in scaled.rows)
    with pytest.raises(ReportError, match=f"--protocol {MONOCULAR}"):
        load_runs([mixed(tmp_path / "alone", ("orb-slam2-mono",))], get_protocol("tum-rgbd/v1"))


def rows_of_truth(sizes, sequences, spread=0.05, seed=0):
    """Runs of trackers whose errors are `sizes` of the category times a common hardness; `orb-slam2` has 1."""
    rng = np.random.default_rng(seed)
    rows = []
    for category, number in sequences.items():
        for i in range(number):
            hardness = rng.uniform(0.02, 0.06)
            for tracker, by_category in (
                {"orb-slam2": dict.fromkeys(sequences, 1.0)} | sizes
            ).items():
                error = hardness * by_category[category] * np.exp(rng.normal(0, spread))
                tags = [category, *(["fast"] if i == 0 else [])]
                rows.append(
                    row(
                        tracker,
                        f"synthetic/{category}?scene={i}",
                        error,
                        tags=tags,
                        static_camera_ate_rmse_m=1.0,
                    )
                )
    return rows


SIZES = {
    "masks": {"high-dynamic": 0.2, "low-dynamic": 1.0},
    "flow": {"high-dynamic": 0.2, "low-dynamic": 0.9},
    "bad": {"high-dynamic": 3.0, "low-dynamic": 3.0},
}


@pytest.fixture(scope="module")
def boards():
    """The board of all sequences, and one of each category."""
    return category_boards(make_board(rows_of_truth(SIZES, {"high-dynamic": 12, "low-dynamic": 6})))


def test_every_category_has_a_board_and_the_overall_one_is_a_mean_over_what_moves(boards):
    assert {name: len(part.common) for name, part in boards.items()} == {
        OVERALL: 18, "low dynamic": 6, "high dynamic": 12, "fast": 2,
    }  # fmt: skip
    ratio = {
        name: {s.key.split("|")[0]: s.ratio.value for s in part.standings}
        for name, part in boards.items()
    }
    assert ratio["high dynamic"]["masks"] == pytest.approx(0.2, rel=0.05)
    assert ratio["low dynamic"]["masks"] == pytest.approx(1.0, rel=0.05)
    both = ratio["high dynamic"]["masks"] * ratio["low dynamic"]["masks"]
    assert ratio[OVERALL]["masks"] == pytest.approx(np.sqrt(both)), "not the mean over 18 sequences"
    verdicts = {
        name: {s.key.split("|")[0]: s.verdict for s in part.standings}
        for name, part in boards.items()
    }
    judged = {"masks": "better", "flow": "better", "orb-slam2": "reference", "bad": "worse"}
    assert verdicts["high dynamic"] == judged
    assert verdicts["low dynamic"]["masks"] == "cannot tell"
    assert set(verdicts["fast"].values()) == {"cannot tell", "reference"}, "two sequences"
    assert [column.name for column in tables.category_table(boards).columns] == ["tracker", *boards]


def test_the_headline_names_the_best_and_whether_they_can_be_told_apart(boards):
    said = headline(boards["high dynamic"])
    assert said.startswith("On 12 high dynamic sequences ")
    assert "ORB-SLAM2's error by" in said
    assert "MASKS" in said
    assert "FLOW" in said
    assert said.endswith(", beyond these families; each of them may be the best.")
    assert "below 5 sequences" in headline(boards["fast"])
    alone = headline(make_board(rows_of_truth({"bad": SIZES["bad"]}, {"high-dynamic": 12})))
    assert (
        alone
        == "On 12 high dynamic sequences no tracker is shown to be better than ORB-SLAM2; 1 is worse."
    )
    assert "not as evidence" in explanation(boards["fast"])
    assert "2 are better, 1 is worse" in explanation(boards["high dynamic"])


def test_all_pairs_stand_in_a_matrix():
    board = make_board(rows_of_truth(SIZES, {"high-dynamic": 12}))
    pairs = compare_pairs(board, board.ranked)
    alike = [
        {board.labels[p.one], board.labels[p.other]} for p in pairs if p.verdict == "cannot tell"
    ]
    assert len(pairs) == 6
    assert alike == [{"MASKS", "FLOW"}]
    assert [len(cells) for cells in tables.pair_table(board).rows] == [5] * 4
    assert "critical" not in mean_rank_note(board)
    assert "Nemenyi" in mean_rank_note(board)
    assert tables.pair_table(make_board(rows_of_truth(SIZES, {"high-dynamic": 4}))) is None


def test_two_trackers_side_by_side_have_the_numbers_of_the_board(boards):
    board = boards[OVERALL]
    assert len(set(board.weights.values())) == 2, "the categories have unequal sizes"
    reference = board.trackers.index(board.reference)
    shown = ratios_data(board)
    assert len(shown) == len(board.trackers) * (len(board.trackers) - 1) // 2
    for a, b, *ratio, sequences, verdict, scope in (
        line for line in shown if reference in line[:2]
    ):
        standing = board.standing_by_key[board.trackers[b if a == reference else a]]
        value, low, high = ratio if a == reference else (1 / ratio[0], 1 / ratio[2], 1 / ratio[1])
        expected = standing.ratio
        assert (value, low, high) == pytest.approx(
            (expected.value, expected.low, expected.high), rel=1e-3
        )
        turned = {"better": "worse", "worse": "better"}.get(verdict, verdict)
        assert standing.verdict == (verdict if a == reference else turned)
        assert standing.scope == scope
        assert sequences == 18


FAMILIES = ("walking_xyz", "walking_rpy", "sitting_xyz", "sitting_rpy")


def of_families(counts, sizes, spread=0.05):
    """Runs of `orb-slam2` and of trackers whose errors are `sizes` of it, on scenes of rendered families."""
    rng = np.random.default_rng(0)
    return [
        row(
            tracker, f"synthetic/{family}?scene={scene}", 0.1 * size * np.exp(rng.normal(0, spread))
        )
        for family, count in zip(FAMILIES, counts, strict=False)
        for scene in range(count)
        for tracker, size in ({"orb-slam2": 1.0} | sizes).items()
    ]


def standing_of(board, tracker):
    return next(s for s in board.standings if board.first(s.key).tracker.id == tracker)


@pytest.mark.parametrize(
    ("counts", "verdict", "scope"),
    [
        ((9,), "better", "on these families"),
        ((3, 3), "cannot tell", ""),
        ((4, 4), "better", "on these families"),
        ((2, 2, 2), "cannot tell", ""),
        ((2, 2, 2, 2), "better", "beyond these families"),
    ],
)
def test_claims_need_four_families_or_six_degrees_of_freedom_within_them(counts, verdict, scope):
    board = make_board(of_families(counts, {"good": 0.3, "bad": 2.0}))
    standing = standing_of(board, "good")
    assert (standing.verdict, standing.scope) == (verdict, scope)
    cell = cell_named(leaderboard(board, PROTOCOL), "GOOD", "better?")
    assert cell.text == verdict
    assert cell.small.startswith(scope)
    said = explanation(board)
    if not scope:
        assert headline(board).endswith("no tracker is shown to be better than ORB-SLAM2.")
        assert f"need 4 of them, and here are {len(counts)}" in said
        assert "need 6 more sequences than families" in said
        assert "This board shows" not in said
        assert "No intervals: they would need 4 families" in leaderboard(board, PROTOCOL).caption
    elif scope == "on these families":
        assert ", on these families." in headline(board)
        assert "This board shows differences from" in said
        assert "may be the best" not in said, "families are the sample"
    else:
        assert headline(board).endswith(", beyond these families; no other may be the best.")
        assert "GOOD may be the best" in said
        assert "% beyond these families, in four of five such boards." in said


def test_who_loses_more_than_the_reference_is_better_but_lost():
    rows = of_families((3, 3, 3, 3), {"good": 0.3, "other": 0.9})
    gone = [
        run
        for run in rows
        if run.tracker.id == "good" and run.sequence.id in ("synthetic/walking_xyz?scene=0",)
    ]
    lost = [crashed("good", run.sequence.id) for run in gone]
    board = make_board([*(run for run in rows if run not in gone), *lost])
    standing = standing_of(board, "good")
    assert (standing.verdict, standing.scope) == ("better, but lost", "beyond these families")
    assert standing.lost == (1, 0)
    table = leaderboard(board, PROTOCOL)
    cell = cell_named(table, "GOOD", "better?")
    assert cell.text == "better, but lost"
    assert "lost 1 of 12, reference 0" in cell.small
    assert "but lost 1 of 12, the reference 0" in headline(board)
    assert "1 is better where both succeed, but lost more" in explanation(board)

    # where the reference lost it, too, it is no reason against the tracker
    both = [
        run
        for run in board.rows
        if run.tracker.id != "orb-slam2" or run.sequence.id != lost[0].sequence.id
    ]
    board = make_board([*both, crashed("orb-slam2", lost[0].sequence.id)])
    assert standing_of(board, "good").verdict == "better"
    assert standing_of(board, "good").lost == (0, 0)


def test_a_cell_is_lost_where_half_of_its_runs_failed():
    runs = [row("a", "s", 0.1 + 0.01 * seed, seed=seed) for seed in range(3)]
    board = make_board([*runs, crashed("a", "s", seed=3)])
    (key,) = board.labels
    assert board.lost(key) == set()
    board = make_board([*runs[:2], *(crashed("a", "s", 0.01 * seed, seed=seed) for seed in (3, 4))])
    assert board.lost(key) == {"s"}


def test_a_recording_thrice_with_changed_pixels_is_one_sequence():
    """By another name or content; a fixed camera's path tells nothing."""
    same = {"duration_s": 2.5, "static_camera_ate_rmse_m": 0.2}
    rows = [
        row(tracker, name, error, **(same if name != "other" else {}))
        for tracker, error in (("orb-slam2", 0.1), ("good", 0.05))
        for name in ("desk", "desk_blurred", "desk_dark", "other")
    ]
    board = make_board(rows)
    assert board.sequences == ["desk", "desk_blurred", "desk_dark", "other"]
    assert board.common == ["desk", "other"]
    assert standing_of(board, "good").sequences == 2
    note = copies_note(board)
    assert "desk counts once for desk, desk_blurred, desk_dark" in note
    assert "error of a static camera" in note
    assert missing_note(board) == ""
    assert copies_note(make_board([run for run in rows if "_" not in run.sequence.id])) == ""

    # the first that all have counts; what differs in time or error is another recording
    short = [run for run in rows if (run.tracker.id, run.sequence.id) != ("good", "desk")]
    assert make_board(short).common == ["desk_blurred", "other"]
    for change in ({"duration_s": 2.6}, {"static_camera_ate_rmse_m": 0.2 * (1 + 1e-8)}):
        apart = [
            row("a", name, 0.1, **(same | values)) for name, values in (("s", {}), ("t", change))
        ]
        assert make_board(apart).common == ["s", "t"]


def test_a_recording_with_a_frame_fewer_and_other_stamps_is_one_sequence(tmp_path):
    """Its numbers differ, its poses do not."""
    store = RunStore(tmp_path)
    store.prepare()
    rng = np.random.default_rng(5)
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, :3, 3] = np.cumsum(rng.normal(0, 0.01, (60, 3)), axis=0)
    other = poses.copy()
    other[:, :3, 3] += rng.normal(0, 0.001, (60, 3))
    truths = {
        "whole": Trajectory(np.arange(60) / 30, poses),
        "later": Trajectory(1000 + np.arange(59) / 30, poses[1:]),
        "other": Trajectory(np.arange(60) / 30, other),
    }
    rows = []
    for at, (name, truth) in enumerate(truths.items()):
        part = f"{at:016x}"
        store.sequences.add(part, np.round(truth.timestamps * 1e9).astype(np.int64), truth)
        for tracker in ("orb-slam2", "b"):
            run = row(tracker, name, 0.1, store=store, static_camera_ate_rmse_m=0.2 + 0.001 * at)
            sequence = run.sequence.model_copy(update={"part": part, "frames": len(truth)})
            rows.append(run.model_copy(update={"sequence": sequence}))
    board = make_board(rows)
    assert board.copies == {"whole": "later"}
    assert "later counts once for later, whole" in copies_note(board)


def test_sequences_of_a_fixed_camera_are_never_one():
    still = {"duration_s": 2.5, "static_camera_ate_rmse_m": 0.0, "tags": ["fixed-camera"]}
    rows = [row(tracker, name, 0.1, **still) for tracker in ("orb-slam2", "b") for name in "st"]
    board = make_board(rows)
    assert board.common == ["s", "t"]
    assert not board.copies


def test_a_fixed_camera_by_two_names_is_one_sequence_where_its_pictures_are_equal():
    """The true path stands still and tells nothing; the pictures of frames do."""
    still = {"duration_s": 2.5, "static_camera_ate_rmse_m": 0.0, "tags": ["fixed-camera"]}
    rng = np.random.default_rng(3)
    filmed = rng.integers(0, 240, (6, 192), dtype=np.uint8)
    others = rng.integers(0, 240, (6, 192), dtype=np.uint8)
    shown = {"man": filmed, "man_jpeg": filmed + np.uint8(2), "woman": others}
    rows = []
    for name, pictures in shown.items():
        encoded = [base64.b64encode(picture).decode() for picture in pictures]
        for tracker in ("orb-slam2", "b"):
            run = row(tracker, name, 0.1, **still)
            sequence = run.sequence.model_copy(update={"thumbnails": encoded})
            rows.append(run.model_copy(update={"sequence": sequence}))
    board = make_board(rows)
    assert board.copies == {"man_jpeg": "man"}
    assert board.common == ["man", "woman"]
    assert "man counts once for man, man_jpeg" in copies_note(board)


def test_exact_masks_are_a_bound_and_never_rank_beside_others():
    rows = rows_of_truth(SIZES, {"high-dynamic": 12})
    bound_info = dict(
        variant={"segmentation.source": "oracle"}, tags=["high-dynamic"], segmentation="oracle"
    )
    plain = [other for other in rows if other.tracker.id == "orb-slam2"]
    exact = [row("masks", other.sequence.id, 0.1 * other.score_m, **bound_info) for other in plain]
    board = make_board([*rows, *exact])
    bound = next(key for key in board.labels if "oracle" in key)
    assert bound not in board.ranked
    assert len(board.ranked) == 4
    assert board.standing_by_key[bound].ratio.value == pytest.approx(0.1)
    assert make_board(exact).ranked == [bound], "alone they rank"


def cells(rng, trackers, sequences=6, runs=4, spread=0.1):
    hardness = rng.uniform(0.01, 0.5, sequences)
    return {
        name: {
            f"s{i}": list(hardness[i] * size * np.exp(rng.normal(0, spread, runs)))
            for i in range(sequences)
        }
        for name, size in trackers.items()
    }


def test_ranks_groups_and_mean_ranks():
    data = cells(np.random.default_rng(2), {"best": 0.1, "middle": 0.5, "worst": 5.0}, spread=0.01)
    places = [
        (s.key, s.group, s.mean_rank)
        for s in standings(data, data["middle"], ["worst", "middle", "best"])
    ]
    assert places == [("best", (1, 1), 1.0), ("middle", (2, 2), 2.0), ("worst", (3, 3), 3.0)]


def test_pairs_are_tested_as_scipy_does_and_corrected_together():
    rng = np.random.default_rng(4)
    logs = {"a": rng.normal(0, 0.2, 7), "b": rng.normal(0.35, 0.2, 7), "c": rng.normal(2, 0.2, 7)}
    found = separable(logs, sequences_of([*"stuvwxy"]))
    p = holm([stats.ttest_rel(logs[a], logs[b]).pvalue for a, b in found])
    assert [order.p_value for order in found.values()] == pytest.approx(p)
    assert [order.first_by != 0 for order in found.values()] == [*(p <= 0.04)]
    assert found["a", "c"].first_by < 0


def test_equal_trackers_share_their_rank():
    one = cells(np.random.default_rng(3), {"a": 1.0})["a"]
    found = standings({"a": one, "b": dict(one)}, one, ["a", "b"])
    assert [(s.rank, s.group, s.mean_rank) for s in found] == [(1, (1, 2), 1.5)] * 2


def test_an_error_of_zero_has_a_ratio():
    data = {"exact": {"s0": [0.0]}, "ref": {"s0": [0.01]}}
    found, _ = standings(data, data["ref"], ["exact", "ref"])
    assert (found.key, found.ratio.value) == ("exact", pytest.approx(1e-2))


def test_who_is_better_than_the_reference_is_tested_as_scipy_does_and_corrected_over_the_trackers():
    rng = np.random.default_rng(7)
    base = rng.normal(0, 1, 9)
    logs = {
        f"t{i}": base + rng.normal(shift, 0.2, 9) for i, shift in enumerate((-1.0, 0.02, 0.0, 1.0))
    }
    none = np.zeros(9, dtype=bool)
    lost = dict.fromkeys([*logs, "ref"], none)
    found = claims_against(logs | {"ref": base}, base, sequences_of([*"stuvwxyz!"]), lost, none)
    expected = holm([stats.ttest_rel(log, base).pvalue for log in logs.values()])
    assert [found[key].p_value for key in logs] == pytest.approx(expected)
    verdicts = [found[key].verdict for key in logs]
    assert verdicts == ["better", "cannot tell", "cannot tell", "worse"]
    assert {found[key].scope for key in logs} == {"", "beyond these families"}
    assert (found["ref"].verdict, found["ref"].p_value) == ("cannot tell", None)


def test_losses_beyond_chance_are_worse_whatever_the_errors_are_elsewhere():
    rng = np.random.default_rng(21)
    numbers = [str(number) for number in range(24)]
    sequences = sequences_of(numbers, {number: f"f{int(number) // 3}" for number in numbers})
    base = rng.normal(0, 1, 24)
    logs = {f"t{i}": base + rng.normal(-0.2, 0.1, 24) for i in range(3)}
    lost = {key: np.zeros(24, dtype=bool) for key in logs}
    lost["t0"][:12] = True
    lost["t1"][:4] = True
    found = claims_against(logs, base, sequences, lost, np.zeros(24, dtype=bool))
    assert [found[key].verdict for key in logs] == ["worse", "better, but lost", "better"]
    assert found["t0"].scope == "by lost sequences"
    assert found["t0"].p_value == pytest.approx(3 * 0.5**12)


def test_lost_cells_of_pairs_are_counted_and_not_averaged():
    rng = np.random.default_rng(22)
    sequences = sequences_of([str(number) for number in range(24)])
    logs = {"a": rng.normal(0, 0.1, 24), "b": rng.normal(0, 0.1, 24)}
    imputed = logs["b"].copy()
    imputed[:3] = 5.0
    assert separable(logs | {"b": imputed}, sequences)["a", "b"].first_by == 0

    # three lost cells of equal trackers tell nothing, as many as McNemar's test asks for do
    for lost, side in ((3, 0), (7, 0), (8, -1), (24, -1)):
        logs["b"][:lost] = np.nan
        order = separable(logs, sequences)["a", "b"]
        assert np.sign(order.first_by) == side
        groups = rank_groups(logs, sequences)
        assert groups["b"] == ((2, 2) if side else (1, 2))

    # who is better where both succeed and lost more is not called better, nor beats it
    quick = logs["a"] - 1.0
    quick[:2] = np.nan
    assert separable({"a": logs["a"], "quick": quick}, sequences)["a", "quick"].first_by == 0
    assert candidates_for_best({"a": logs["a"], "quick": quick}, sequences) == {"a", "quick"}


def test_a_board_that_lost_everything_and_one_whose_reference_did_say_so():
    every = [crashed(tracker, f"s{n}", 0.2) for tracker in ("orb-slam2", "b") for n in range(8)]
    board = make_board(every)
    assert headline(board) == "No tracker can be ranked."
    assert explanation(board) == ""
    kept = [row(tracker, f"s{n}", 0.1) for tracker in ("b", "c") for n in range(8)]
    board = make_board([run for run in every if run.tracker.id != "b"] + kept)
    assert "lost all, so no tracker can be compared" in headline(board)


@pytest.mark.filterwarnings("error")
def test_nothing_has_no_standings():
    assert standings({}, {}, []) == []
    assert standings({"a": {}}, {}, []) == []


def test_weights_make_categories_count_alike_and_one_sequence_of_many_weights_is_no_evidence():
    logs = np.concatenate([np.full(2, -1.0), np.full(20, 1.0)]) + np.random.default_rng(8).normal(
        0, 0.01, 22
    )
    numbers = [str(number) for number in range(22)]
    weights = dict(zip(numbers, np.repeat([1 / 2, 1 / 20], [2, 20]).tolist(), strict=True))
    interval = ratio_interval(logs, sequences_of(numbers, None, weights))
    assert interval.value == pytest.approx(np.exp((logs[:2].mean() + logs[2:].mean()) / 2))
    assert interval.low < 0.4, "two sequences carry half of the weight"
    assert interval.high > 2.5, "two sequences carry half of the weight"


def test_nemenyis_differences_are_those_of_scikit_posthocs():
    import scikit_posthocs as posthocs  # loads Matplotlib

    rng = np.random.default_rng(10)
    logs = {str(i): rng.normal(0.4 * i, 0.5, 10) for i in range(6)}
    p_value, difference = mean_rank_test(logs)
    p = posthocs.posthoc_nemenyi_friedman(np.stack(list(logs.values()), axis=1)).to_numpy()
    ranks = stats.rankdata(list(logs.values()), axis=0).mean(axis=1)
    apart = np.abs(ranks[:, None] - ranks) > difference
    assert p_value == pytest.approx(stats.friedmanchisquare(*logs.values()).pvalue)
    # Demsar's table 5
    assert difference == pytest.approx(2.850 * np.sqrt(6 * 7 / (6 * 10)), rel=1e-3)
    assert mean_rank_test({"0": logs["0"], "1": logs["1"]}) is None
    assert (apart == (p < 0.05)).all()
    assert apart.any()
    assert not apart.all()


@pytest.mark.parametrize(
    ("p_values", "corrected"),
    [
        ([0.01, 0.04, 0.03], [0.03, 0.06, 0.06]),
        ([0.6, 0.7], [1, 1]),
        ([], []),
    ],
)
def test_holm(p_values, corrected):
    assert holm(p_values) == pytest.approx(corrected)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["normal", "heavy tails", "unequal spread", "skewed"])
@pytest.mark.parametrize("sequences", [3, 5, 8, 20])
def test_claims_of_simulated_boards_are_right(shape, sequences):
    right, _ = simulate(shape, np.sort(np.random.default_rng(0).normal(0, 0.25, 5)), sequences, 200)
    assert right.min() >= 0.95


def test_ratio_is_the_geometric_mean_of_medians():
    data = cells(np.random.default_rng(0), {"a": 0.5, "ref": 1.0})
    (a, ref) = standings(data, data["ref"], ["a", "ref"])
    expected = stats.gmean([np.median(data["a"][s]) / np.median(data["ref"][s]) for s in data["a"]])
    assert a.ratio.value == pytest.approx(expected)
    assert a.ratio.low < a.ratio.value < a.ratio.high
    assert (ref.ratio.value, ref.ratio.low, ref.ratio.high) == (1, 1, 1)
    places = [(s.key, s.rank, s.wins, s.verdict) for s in (a, ref)]
    assert places == [("a", 1, 6, "better"), ("ref", 2, 0, "cannot tell")]


@pytest.mark.parametrize("weights", [None, 0.25])
def test_the_interval_of_a_ratio_is_students(weights):
    values = np.random.default_rng(1).normal(-0.3, 0.5, 12)
    numbers = [str(number) for number in range(13)]
    by_number = None if weights is None else dict.fromkeys(numbers, weights)
    found = ratio_interval(np.append(values, np.nan), sequences_of(numbers, None, by_number))
    assert (found.low, found.high) == pytest.approx(
        np.exp(stats.ttest_1samp(values, 0).confidence_interval(0.95))
    )
    few = ratio_interval(values[:4], sequences_of(numbers[:4]))
    assert few.value == pytest.approx(np.exp(values[:4].mean()))
    assert np.isnan([few.low, few.high]).all()


def test_below_five_sequences_there_is_one_group_and_from_five_on_clear_differences_show():
    rng = np.random.default_rng(3)
    for sequences, groups in ((4, [(1, 2), (1, 2)]), (5, [(1, 1), (2, 2)])):
        data = cells(rng, {"a": 0.1, "b": 1.0}, sequences=sequences)
        assert [s.group for s in standings(data, data["b"], ["a", "b"])] == groups


def test_a_difference_that_one_sequence_decides_is_none():
    data = {
        "a": {f"s{i}": [0.1] for i in range(6)},
        "b": {f"s{i}": [0.1] for i in range(5)} | {"s5": [3.0]},
    }
    assert [s.group for s in standings(data, data["b"], ["a", "b"])] == [(1, 2), (1, 2)]


def test_unranked_and_incomplete_trackers_come_last_and_take_no_rank():
    data = cells(np.random.default_rng(4), {"a": 0.5, "ref": 1.0, "oracle": 0.01})
    data["partial"] = {"s0": data["a"]["s0"]}
    found = standings(data, data["ref"], ["a", "ref"])
    assert [s.key for s in found] == ["a", "ref", "oracle", "partial"]
    assert [s.rank is None for s in found] == [False, False, True, True]
    assert found[3].sequences == 1
    assert found[3].ratio.value == pytest.approx(
        np.median(data["a"]["s0"]) / np.median(data["ref"]["s0"])
    )
