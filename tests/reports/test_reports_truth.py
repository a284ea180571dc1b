"""What a glance at the report says is true: on uneven, failing, repeated, cached and confusable results."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers.reports_fake_store import (
    PROTOCOL,
    add_frames,
    add_run,
    cell_named,
    cell_of,
    columns_of,
    crashed,
    page_data,
    row,
    rows_of,
)

from dynslam_bench.core.number_text import mm
from dynslam_bench.reports import build_report, compare, load_board, load_frame
from dynslam_bench.reports.html.run_pages import RunPage, error_by_share, share_sums
from dynslam_bench.reports.model.board import Board, make_board, missing_commands, missing_note
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.reports.model.names import make_labels, name_columns, shortened
from dynslam_bench.reports.model.published import is_excerpt, least_length_s
from dynslam_bench.reports.model.row import command_line, run_command
from dynslam_bench.reports.tables.leaderboard import leaderboard, per_sequence, relative_errors
from dynslam_bench.reports.tables.table import percent, to_markdown
from dynslam_bench.runs.record import IDENTITY_SCHEME
from dynslam_bench.runs.store import RunStore
from dynslam_bench.segmentation.training_scenes import seen_in_training
from dynslam_bench.trackers import TRACKERS

# -- what ranks


def test_losing_frames_is_not_free(store, tmp_path):
    """The loser is better where it tracks, and far off once its lost frames count as not having moved."""
    for name in ("s/a", "s/b"):
        add_run(store, "steady", name, error=0.02)
        add_run(store, "loser", name, error=0.005, lost=range(40, 95))
    paths = build_report(store, tmp_path / "report")
    runs = {r["tracker"]: r for r in rows_of(paths.csv["runs"])}
    assert float(runs["loser"]["score_m"]) > 5 * float(runs["loser"]["ate_rmse_m"])
    for table, better in (("per_sequence", "steady"), ("lost_frames_excluded", "loser")):
        errors = {r["tracker"]: float(r["s/a"]) for r in rows_of(paths.csv[table])}
        assert min(("steady", "loser"), key=errors.get) == better
    steady, loser = rows_of(paths.csv["failure_rules"])
    assert (steady["tracker"], loser["tracker"]) == ("steady", "loser")
    for rule, better in (("lost frames held", steady), ("lost frames left out", loser)):
        assert min((steady, loser), key=lambda r: float(r[f"{rule}: ATE ratio"])) is better


def test_a_failure_never_scores_better_than_not_moving():
    kinds = (
        {},
        {"hold_last_pose_ate_m": 0.7},
        {"hold_last_pose_ate_m": None},
        {"static_camera_ate_rmse_m": None},
    )
    assert [crashed(**changes).score_m for changes in kinds] == [0.3, 0.7, 0.3, None]


def test_a_tracker_that_never_succeeded_stands_below_all_and_is_never_emphasised():
    rows = (
        [row("good", s, 0.1) for s in "st"]
        + [row("bad", s, 0.25) for s in "st"]
        + [crashed("c", s) for s in "st"]
    )
    rows += [row("control", s, 0.4, provenance="control") for s in "st"]
    board = make_board(rows)
    assert [board.labels[k] for k in board.trackers] == ["GOOD", "BAD", "CONTROL", "C"]
    assert [board.labels[k] for k in board.ranked] == ["GOOD", "BAD"]
    table = leaderboard(board, PROTOCOL)
    assert table.separators == {2, 3}
    assert [cells[1].text for cells in table.rows] == ["2/2", "2/2", "2/2", "0/2"]
    assert [cell.text for cell in table.rows[3][:3]] == ["–", "0/2", "C"]
    assert cell_named(table, "C", "ATE ratio").text == "nothing succeeded"
    failed = cell_of(per_sequence(board, PROTOCOL), "C")
    assert (failed.text, failed.emphasis, failed.shade, failed.value) == (
        "crashed at 20/60",
        "failed",
        None,
        None,
    )
    half = make_board([*rows, row("c", "u"), row("good", "u"), row("bad", "u")])
    for each, partly in zip(
        relative_errors(board, PROTOCOL), relative_errors(half, PROTOCOL), strict=True
    ):
        assert [cells[0].text for cells in each.rows] == ["GOOD", "BAD", "CONTROL"]
        assert cell_of(each, "GOOD").emphasis == "best"
        assert [(cell.text, cell.emphasis) for cell in cell_of(partly, "C", slice(1, 3))] == [
            ("", "failed")
        ] * 2


def test_a_cell_with_one_failure_is_not_bold_and_not_green():
    rows = [row("good", error=0.2, seed=i) for i in range(3)] + [
        row("ref", error=0.25, seed=i) for i in range(3)
    ]
    rows += [
        row("mixed", error=0.01, seed=0),
        row("mixed", error=0.02, seed=1),
        crashed("mixed", seed=2),
    ]
    board = make_board(rows, reference="ref")
    cell = cell_of(per_sequence(board, PROTOCOL), "MIXED")
    assert (cell.emphasis, cell.shade) == ("", 0.0)
    assert "2/3 succeeded" in cell.small
    assert "crashed at 20/60" in cell.tip
    success = {cells[2].text: cells[1].text for cells in leaderboard(board, PROTOCOL).rows}
    assert success == {"GOOD": "3/3", "REF": "3/3", "MIXED": "2/3"}


def test_ways_to_fail_are_named():
    runs = (
        crashed(status="timeout"),
        crashed(status="lost", n_tracked=12),
        crashed(status="ok", not_evaluated=True),
    )
    assert [run.ending for run in (*runs, row())] == [
        "timeout at 20/60",
        "lost, 12/60 tracked",
        "not evaluated",
        "",
    ]
    board = make_board([crashed(seed=0), crashed(seed=1, n_processed=31), row("g")])
    assert (
        cell_of(per_sequence(board, PROTOCOL), "C").text
        == "2 failed: crashed at 20/60; crashed at 31/60"
    )


# -- on what it ranks


def uneven():
    """Three trackers on three sequences, one of them on a fourth, one more tracker on a single one."""
    rows = [
        row(name, s, error)
        for name, error in (("a", 0.1), ("b", 0.2), ("orb-slam2", 0.25))
        for s in "stu"
    ]
    return [*rows, row("a", "v", 0.1), row("new", "s", 0.05, frames=(0, 60))]


def test_one_more_sequence_takes_nobodys_rank_and_missing_cells_are_named_with_the_commands_that_fill_them():
    board = make_board(uneven())
    assert [board.labels[k] for k in board.ranked] == ["A", "B", "ORB-SLAM2"]
    assert (board.common, board.reference_name) == (["s", "t", "u"], "ORB-SLAM2")
    assert make_board(uneven(), on="all").ranked == []
    note = missing_note(board)
    assert note.startswith(
        "The ranking stands on the 3 of 5 sequences that all ranked trackers have."
    )
    assert "others' sequences: NEW." in note
    assert "B on s [0:60], v" in note
    wanted = {"b s --frames 0:60", "b v", "new s t u v"}
    assert {f"dynslam-bench run {words}" for words in wanted} <= set(missing_commands(board))
    assert missing_note(make_board([row("a"), row("b")])) == ""


def test_commands_carry_settings_and_repeats():
    variant = {"epipolar.threshold_px": 2.0, "device": "cpu", "threads": 4}
    rows = [row("a", "s", seed=i, offset=o, variant=variant) for i in (0, 1) for o in (0, 2)]
    rows += [row("b", s, place=f"/data/{s}") for s in "st"]
    assert list(missing_commands(make_board(rows))) == [
        "dynslam-bench run a /data/t --seed 0 1 --offset 0 2 --set epipolar.threshold_px=2.0 --threads 4"
    ]


# -- what stands where


def test_parts_get_no_published_rows(store, tmp_path):
    add_run(
        store, "orb-slam2", "tum/fr3/walking_xyz", frames=(0, 200), block="part", duration_s=6.7
    )
    add_run(store, "orb-slam2", "bonn/crowd", block="excerpt", duration_s=6.7)
    add_run(store, "orb-slam2", "tum/fr3/walking_rpy", block="whole", duration_s=30.6)
    add_run(store, "orb-slam2", "synthetic/walking_xyz", block="rendered", frames=(0, 60))
    paths = build_report(store, tmp_path / "report")
    lines = rows_of(paths.csv["per_sequence"])
    published = [
        line for line in lines if "reported" in line["tracker"] or "claimed" in line["tracker"]
    ]
    filled = {
        name for line in published for name, value in line.items() if value and name != "tracker"
    }
    assert published
    assert filled == {"tum/fr3/walking_rpy"}
    parts = "bonn/crowd, tum/fr3/walking_xyz [0:200]."
    assert f"beside which no published number stands: {parts}" in paths.markdown.read_text()
    lengths = (
        ("tum/fr3/walking_xyz", 20.0),
        ("tum/fr3/walking_xyz", 28.5),
        ("synthetic/walking_xyz", 2.0),
    )
    assert [is_excerpt(*length) for length in lengths] == [True, False, False]


@pytest.mark.slow
def test_a_final_trajectory_stands_in_no_online_table(tmp_path):
    store = RunStore(tmp_path / "r")
    only = RunStore(tmp_path / "only")
    add_run(store, "orb-slam2", "s/a", error=0.05)
    for some in (store, only):
        add_run(some, "orb-slam3", "s/a", kind="imported", final_error=0.001, online=False)
    paths = build_report(store, tmp_path / "report")
    alone = build_report(only, tmp_path / "alone")
    for name in ("per_sequence", "rpe_1s_trans"):
        assert not any("orb-slam3" in line["tracker"] for line in rows_of(paths.csv[name])), name
    # the leaderboard has its number, and neither rank nor ratio
    (row,) = (line for line in rows_of(paths.csv["leaderboard"]) if "slam3" in line["tracker"])
    assert row["#"] == "–"
    assert row["ATE ratio"] == ""
    (final,) = rows_of(paths.csv["final_trajectory"])
    assert final["tracker"] == "orb-slam3"
    assert float(final["s/a"]) < 0.005
    note = "Not ranked, since only final trajectories are known, which use later frames: orb-slam3."
    assert note in paths.markdown.read_text()
    (ranked,) = rows_of(alone.csv["leaderboard"])
    assert ranked["tracker"] == "orb-slam3"


@pytest.mark.parametrize(("kind", "kept"), [("imported", 3), ("run", 1)])
def test_imports_of_several_files_are_repeats_and_a_run_made_again_supersedes(store, kind, kept):
    for day in (1, 2, 3):
        add_run(store, "orb-slam3", "s/a", kind=kind, started=f"2026-01-0{day}T00:00:00+00:00")
    loaded = load_runs([store], PROTOCOL)
    assert (len(loaded.rows), loaded.superseded) == (kept, 3 - kept)


# -- repeats


def test_copies_are_no_repeats():
    rows = [row("copy", error=0.1, seed=i) for i in range(4)]
    board = make_board([*rows, *(row("real", error=0.1 + 0.01 * i, seed=i) for i in range(4))])
    table = per_sequence(board, PROTOCOL)
    copies = board.cells[rows[0].variant_key]["s"]
    assert [cell_of(table, name).small for name in ("COPY", "REAL")] == ["deterministic", "±7.5"]
    assert (len(copies.scores), len(copies.rows)) == (1, 4)


def test_offsets_and_noise_are_repeats_of_one_cell():
    rows = [
        row(error=0.1 + 0.01 * o, offset=o, seed=s, block="b") for o in (0, 1, 2) for s in (0, 1)
    ]
    rows += [row(error=0.15, noise=5, block="b", sequence="s?noise=5")]
    board = make_board(rows)
    assert board.sequences == ["s"]
    (cell,) = (cells["s"] for cells in board.cells.values())
    assert len(cell.rows) == 7
    assert not cell.deterministic
    assert sorted(cell.scores) == pytest.approx([0.1, 0.11, 0.12, 0.15])
    assert [r.repeat for r in cell.rows][:3] == ["seed 0", "seed 1", "seed 0, noise 5"]


def test_a_deterministic_trackers_offsets_keep_apart_in_the_store(store):
    for offset, seed in ((0, 0), (0, 1), (2, 0), (2, 1)):
        add_run(store, "a", "s/a", seed, offset=offset, block="b", copy_of=offset)
    loaded = load_runs([store], PROTOCOL)
    ((cell,),) = (cells.values() for cells in make_board(loaded.rows).cells.values())
    assert (loaded.superseded, len(cell.rows), len(cell.scores)) == (0, 4, 2)


# -- what stands beside the numbers


def test_times_from_the_cache_are_marked(store):
    add_run(store, "cached", "s/a", cached=True, frame_s=0.01)
    add_run(store, "both", "s/a", cached=True, frame_s=0.01)
    add_run(store, "both", "s/b", frame_s=0.05)
    add_run(store, "fresh", "s/a", frame_s=0.02)
    add_run(store, "real", "s/a", cached=True, frame_s=0.02, provenance="external")
    board = make_board(load_runs([store], PROTOCOL).rows)
    table = leaderboard(board, PROTOCOL)
    times = {
        cell.text: time.small
        for cell, time in zip(*columns_of(table, "tracker", "× real time"), strict=True)
    }
    assert times == {"cached": "10.0 ms†", "both": "50.0 ms", "fresh": "20.0 ms", "real": "20.0 ms"}
    assert "†" in table.caption
    flags = {(r.tracker, r.sequence): r.cached for r in board.frame().itertuples()}
    assert {place for place, cached in flags.items() if cached} == {
        ("cached", "s/a"),
        ("both", "s/a"),
    }


def test_the_share_without_fundamental_matrix_stands_beside_the_error():
    board = make_board(
        [row("ours", s, epipolar_skipped=0.98) for s in "st"] + [row("plain", s, 0.2) for s in "st"]
    )
    assert [cell.text for cell in columns_of(leaderboard(board, PROTOCOL), "F skipped")[0]] == [
        "98 %",
        "",
    ]
    errors = per_sequence(board, PROTOCOL)
    assert (cell_of(errors, "OURS").small, cell_of(errors, "PLAIN").small) == ("F skipped 98 %", "")
    assert "F skipped" not in [c.name for c in leaderboard(make_board([row()]), PROTOCOL).columns]


@pytest.mark.slow
def test_the_page_of_a_run_stacks_stages_alone_and_claims_no_share_of_people_where_there_are_no_masks(
    store, tmp_path
):
    kinds = {"exact": {}, "own": {"exact": False}, "none": {"exact": False, "masks": False}}
    shown = {name: add_run(store, name, f"s/{name}", n=40) for name in kinds}
    for name, masks in kinds.items():
        add_frames(store.folder(shown[name]), 40, **masks)
    folder = build_report(store, tmp_path / "report").html.parent
    runs = {name: page_data(folder, f"run-{run_id}") for name, run_id in shown.items()}
    stacked = {
        name: [trace["name"] for trace in run["figures"]["stages"]["data"]]
        for name, run in runs.items()
    }
    assert stacked == {name: ["features"] for name in shown}
    drawn = {
        name: [trace["name"] for trace in run["figures"]["time"]["data"]]
        for name, run in runs.items()
    }
    people = {
        "exact": "share of people: exact masks",
        "own": "share of people: the tracker's own masks",
    }
    assert {
        name: traces[-1] for name, traces in drawn.items() if traces[-1] in people.values()
    } == people


def test_numbers_have_three_digits_and_no_more():
    numbers = {
        0.2196: "220",
        0.0142: "14.2",
        0.009996: "10.0",
        0.00123: "1.23",
        2.5: "2500",
        0.0: "0",
    }
    assert {value: mm(value) for value in numbers} == numbers
    assert mm(float("nan")) == "–"
    shares = {0: "0 %", 0.5: "50 %", 1: "100 %", 0.999: "99.9 %", 0.0001: "< 0.1 %"}
    assert {value: percent(value) for value in shares} == shares


def test_little_data_claims_little():
    rows = [
        row("orb-slam2", "s", 0.2237),
        row("orb-slam2", "t", 0.02),
        row("a", "s", 0.2196),
        row("a", "t", 0.01),
    ]
    ranks, ratios, *others = columns_of(
        leaderboard(make_board(rows), PROTOCOL), "#", "ATE ratio", "better?", "wins"
    )
    assert [(cell.text, cell.small) for cell in ranks] == [("1–2", "")] * 2
    assert [(cell.small, cell.emphasis) for cell in ratios] == [("", "")] * 2
    assert [cell.text for column in others for cell in column] == ["", "reference", "2 of 2", ""]


def test_bold_is_not_given_to_most():
    """Eleven of twelve that may be first are not eleven bests."""
    names = "stuvwxyz"
    apart = [row(name, s, error * (1 + 0.02 * at)) for name, error in (("a", 0.01), ("b", 0.1), ("c", 1.0))
             for at, s in enumerate(names)]  # fmt: skip
    near = [
        row(f"n{k}", s, 0.1 * (1 + 0.4 * ((at * 7 + k * 5) % 4)))
        for k in range(3)
        for at, s in enumerate(names)
    ]
    far = [row("far", s, 50.0 + at, static_camera_ate_rmse_m=99.0) for at, s in enumerate(names)]

    def bold(rows):
        table = leaderboard(make_board(rows, reference=rows[0].tracker.id), PROTOCOL)
        return [cell.emphasis for cell in columns_of(table, "ATE ratio")[0]]

    assert bold(apart) == ["best", "", ""]
    assert bold(near + far) == [""] * 4


# -- frames


def test_the_frame_holds_all_runs_with_types_and_units(store, tmp_path):
    add_run(store, "a", "s/a", offset=2, block="b", skipped=0.5, overrides={"x.y": 3})
    add_run(store, "b", "s/a", status="crashed", reason="boom", block="b", noise=4)
    frame = load_frame(store)
    assert list(frame["tracker"]) == ["a", "b"]
    assert frame["settings"][0].startswith("x.y=3")
    assert str(frame["noise"].dtype) == "Int64"
    assert frame["noise"].isna().tolist() == [True, False]
    assert frame["failed"].tolist() == [False, True]
    assert frame["ending"][1] == "crashed at 30/120"
    assert str(frame["score_m"].dtype) == "Float64"
    assert frame["ate_rmse_m"][0] == frame["score_m"][0] > 0
    assert frame["epipolar_skipped"][1] is pd.NA
    assert list(rows_of(build_report(store, tmp_path / "report").csv["runs"])[0]) == list(
        frame.columns
    )


def test_who_follows_people_on_few_frames_is_not_shown_as_the_better_one():
    """The exploring page's error by the share of dynamic pixels; the follower is best on most frames."""
    share = np.full(100, 0.35)
    errors_mm = np.r_[np.full(90, 0.9), np.full(10, 40.0)]
    (rmse_mm,) = (
        mm for mm, _ in error_by_share([RunPage("", *share_sums(share, 1e-3 * errors_mm))]) if mm
    )
    assert rmse_mm == pytest.approx(np.sqrt(np.mean(errors_mm**2)), rel=1e-3)


def test_what_is_no_better_than_not_moving_is_named():
    rows = [row("good", s, 0.1) for s in "st"] + [row("frozen", "s", 0.3), row("frozen", "t", 0.2)]
    rows += [row("flaky", "s", 0.01), *(crashed("flaky", "s", seed=seed) for seed in (1, 2))]
    rows += [row("control", s, 0.3, provenance="control") for s in "st"]
    board = make_board(rows)
    assert (
        "No better than a static camera, although their runs ended: FROZEN on 1 of 2 sequences."
        in (leaderboard(board, PROTOCOL).caption)
    )
    small = {
        cells[0].text: [cell.small for cell in cells[1:]]
        for cells in per_sequence(board, PROTOCOL, []).rows
    }
    assert "no better than a static camera" in small["FROZEN"][0]
    worse = make_board(
        [row("frozen", s, 0.3) for s in "st"] + [row("orb-slam2", s, 0.6) for s in "st"]
    )
    cells = (cell_of(per_sequence(worse, PROTOCOL, []), name) for name in ("FROZEN", "ORB-SLAM2"))
    assert [(cell.emphasis, cell.shade) for cell in cells] == [("", 0.0)] * 2, (
        "neither bold nor blue"
    )
    assert not any(
        "no better" in text for name in ("GOOD", "CONTROL", "FLAKY") for text in small[name]
    )


def test_columns_of_two_cameras_are_named_by_them(store):
    right = {"width": 640, "height": 480, "fx": 525.0, "fy": 525.0}
    add_run(store, "a", "folder/s", camera=right, block="right")
    add_run(store, "b", "folder/s", camera=right | {"fx": 400.0}, block="wrong")
    board = make_board(load_runs([store], PROTOCOL).rows)
    assert board.sequences == [f"folder/s (camera 640x480, f {fx} 525)" for fx in (400, 525)]


def test_the_same_frames_are_one_column_in_every_spelling(store):
    add_run(store, "a", "synthetic/walking_xyz?frames=60", block="b1")
    add_run(store, "b", "synthetic/walking_xyz", frames=(0, 60), block="b1")
    add_run(store, "b", "synthetic/walking_xyz?noise=3", frames=(0, 60), block="b1", noise=3)
    board = make_board(load_runs([store], PROTOCOL).rows)
    assert board.sequences == ["synthetic/walking_xyz [0:60]"]
    assert [len(cells[board.sequences[0]].rows) for _, cells in sorted(board.cells.items())] == [
        1,
        2,
    ]


def test_names_of_columns_are_never_alike():
    same = dict(sequence="folder/x", content="c" * 12)
    rows = [
        row(**same, block="b1"),
        row(**same, block="b2"),
        row(sequence="folder/x", content="d" * 12, block="b3"),
    ]
    names = set(name_columns(rows).values())
    assert len(names) == 3
    assert all(name.startswith("folder/x (") for name in names)
    deep = [
        row(sequence="folder/x", block=str(i), place=p, frames=(0, 9))
        for i, p in enumerate(["/a/1/x", "/b/1/x"])
    ]
    assert list(name_columns(deep).values()) == ["a/1/x [0:9]", "b/1/x [0:9]"]


def test_sequences_are_grouped_from_static_to_dynamic():
    tags = {
        "z": ["static"],
        "b": ["high-dynamic"],
        "a": ["low-dynamic"],
        "c": ["high-dynamic"],
        "d": [],
    }
    board = make_board([row(sequence=name, tags=names) for name, names in tags.items()])
    groups = ["static", "low dynamic", "high dynamic", "high dynamic", "other"]
    assert [(name, board.groups[name]) for name in board.sequences] == [
        *zip("zabcd", groups, strict=True)
    ]


@pytest.mark.parametrize(
    ("names", "short"),
    [
        (
            ["synthetic/walking_xyz?scene=0&frames=60", "synthetic/sitting_xyz?scene=0&frames=60"],
            "walking_xyz sitting_xyz",
        ),
        (
            ["synthetic/walking_xyz?scene=0&frames=60", "synthetic/a?scene=1"],
            "walking_xyz?scene=0&frames=60 a?scene=1",
        ),
        (
            ["synthetic/a?scene=100&frames=60", "synthetic/a?scene=101&frames=60"],
            "a?scene=100 a?scene=101",
        ),
        (["tum/fr3/a", "tum/fr1/a", "bonn/a"], "tum/fr3/a tum/fr1/a bonn/a"),
        (["tum/fr3/a [0:9]", "tum/fr3/b [0:9]"], "a [0:9] b [0:9]"),
        (["tum/fr3/a"], "tum/fr3/a"),
    ],
)
def test_names_lose_what_all_share(names, short):
    assert list(shortened(names)) == names
    assert " ".join(shortened(names).values()) == short


def test_what_one_tracker_alone_was_asked_for_is_named_and_spelled_as_in_toml(store):
    given = "/home/me/mine.py:SPEC"
    for name, value in (("s/a", "True"), ("s/b", True)):
        add_run(
            store, "mine", name, overrides={"loop": value}, settings={"loop": True}, given=given
        )
    for tracker, name in (("a", "s/a"), ("a", "s/c"), ("b", "s/a")):
        add_run(store, tracker, name, overrides={"masks": "oracle"})
    rows = load_runs([store], PROTOCOL).rows
    assert sorted(make_board(rows).labels.values()) == ["a", "b", "mine · loop=true"]
    (mine,) = (each for each in rows if (each.tracker.id, each.sequence.id) == ("mine", "s/a"))
    assert run_command(mine) == f"dynslam-bench run {given} s/a --set loop=true"
    assert f"dynslam-bench run {given} s/c --set loop=true" in missing_commands(make_board(rows))


def test_commands_name_the_camera_of_a_folder_and_no_results_folder_of_one_machine(store):
    asked = (
        "dynslam-bench",
        "run",
        "ours",
        "mine",
        "--camera",
        "bonn",
        "--results",
        "/home/me/results",
    )
    add_run(store, "ours", "folder/mine", place="/home/me/mine", command=asked)
    add_run(store, "mine", "s/a", command=asked)
    rows = {row.tracker.id: row for row in load_runs([store], PROTOCOL).rows}
    assert run_command(rows["ours"]) == "dynslam-bench run ours /home/me/mine --camera bonn"
    assert "--camera" not in run_command(rows["mine"]), "a sequence with an id says its camera"
    assert (
        command_line(list(asked)) == "dynslam-bench run ours mine --camera bonn --results RESULTS"
    )


@pytest.mark.parametrize(
    ("sources", "named"),
    [
        (
            ("onnx:/home/me/nets/yolov8n-seg.onnx", "recorded:/data/masks/", "none"),
            ("none", "onnx:yolov8n-seg", "recorded:masks"),
        ),
        (("onnx:/a/best.onnx", "onnx:/b/best.onnx"), ("onnx:/a/best.onnx", "onnx:/b/best.onnx")),
    ],
)
def test_labels_name_files_without_their_folders_unless_two_would_be_alike(sources, named):
    rows = [row(tracker="mask-rcnn", variant={"segmentation.source": source}) for source in sources]
    assert sorted(make_labels(rows).values()) == [
        f"MASK-RCNN · segmentation.source={name}" for name in named
    ]


SEQUENCES = ("synthetic/walking_xyz", "synthetic/walking_static")


def made_by(**parts: object) -> dict[str, object]:
    return {"scheme": IDENTITY_SCHEME, **parts}


def sequences_by_row(board: Board, tracker: str) -> dict[str, list[str]]:
    """The sequences that each row of a tracker has runs on, by the row's name."""
    keys = [key for key in board.labels if board.first(key).tracker.id == tracker]
    return {board.labels[key]: sorted(board.cells[key]) for key in keys}


@pytest.mark.parametrize(
    ("before", "after", "name"),
    [
        ({"source": "1"}, {"source": "2"}, "code"),
        ({"tracker_version": "1"}, {"tracker_version": "2"}, "code"),
        ({"files": "1"}, {"files": "2"}, "code"),
        ({"libraries": {"torch": "2.1"}}, {"libraries": {"torch": "2.2"}}, "torch"),
        ({"weights": {"coco": "aaaa"}}, {"weights": {"coco": "bbbb"}}, "weights of coco"),
    ],
)
def test_runs_of_two_programs_are_two_rows_and_the_older_is_not_ranked(
    store: RunStore, before: dict[str, object], after: dict[str, object], name: str
) -> None:
    for sequence in SEQUENCES:
        add_run(store, "orb-slam2", sequence, error=0.02)
    add_run(
        store,
        "mine",
        SEQUENCES[0],
        error=0.01,
        identity=made_by(**before),
        started="2026-01-01T00:00:00+00:00",
    )
    add_run(
        store,
        "mine",
        SEQUENCES[1],
        error=0.50,
        identity=made_by(**after),
        started="2026-01-02T00:00:00+00:00",
    )
    board = load_board(store)
    rows = sequences_by_row(board, "mine")
    assert len(rows) == 2
    assert all(len(sequences) == 1 and f" {name} " in label for label, sequences in rows.items())
    current = {row.started[:10]: row.is_current for row in board.rows if row.tracker.id == "mine"}
    assert current == {"2026-01-01": False, "2026-01-02": True}
    assert not any(row.variant_key in board.ranked for row in board.rows if not row.is_current)


def test_a_program_that_ran_everything_again_supersedes_the_older_one(store: RunStore) -> None:
    for source, sequence in product("12", SEQUENCES):
        add_run(
            store,
            "mine",
            sequence,
            identity=made_by(source=source),
            started=f"2026-01-0{source}T00:00:00+00:00",
        )
    loaded = load_runs([store], PROTOCOL)
    assert loaded.superseded == 2
    assert {row.started[:10] for row in loaded.rows} == {"2026-01-02"}
    assert list(sequences_by_row(load_board(store), "mine")) == ["mine"]


def test_masks_of_two_networks_on_two_kinds_of_sequences_are_one_row(store: RunStore) -> None:
    add_run(store, "mine", SEQUENCES[0], identity=made_by(weights={"embedded": "aaaa"}))
    add_run(store, "mine", "bonn/crowd", identity=made_by(weights={"coco": "bbbb"}))
    assert list(sequences_by_row(load_board(store), "mine")) == ["mine"]


@pytest.mark.parametrize(
    ("made", "label"),
    [({"identity": {}}, "orb-slam2 · identity unverified"), ({"kind": "imported"}, "orb-slam2")],
)
def test_a_run_of_an_older_identity_scheme_and_an_import_are_never_the_reference(
    store: RunStore, made: dict[str, object], label: str
) -> None:
    add_run(store, "orb-slam2", SEQUENCES[0], **made)
    add_run(store, "mine", SEQUENCES[0])
    board = load_board(store)
    assert list(sequences_by_row(board, "orb-slam2")) == [label]
    assert board.reference is None


def test_a_verified_program_stays_ranked_beside_newer_runs_that_are_not_verified(
    store: RunStore,
) -> None:
    add_run(
        store,
        "mine",
        SEQUENCES[0],
        identity=made_by(source="1"),
        started="2026-01-01T00:00:00+00:00",
    )
    add_run(store, "mine", SEQUENCES[1], identity={}, started="2026-01-02T00:00:00+00:00")
    rows = load_runs([store], PROTOCOL).rows
    assert {row.started[:10]: row.is_current for row in rows} == {
        "2026-01-01": True,
        "2026-01-02": False,
    }


def test_two_results_under_one_id_are_said_on_the_page(tmp_path: Path) -> None:
    stores = [RunStore(tmp_path / name) for name in "ab"]
    for store, error in zip(stores, (0.01, 0.3), strict=True):
        add_run(store, "mine", SEQUENCES[0], error=error, run_id="0123456789abcdef")
    loaded = load_runs(stores, PROTOCOL)
    assert len(loaded.conflicts) == 1
    assert "0123456789abcdef" in loaded.conflicts[0]
    page = build_report([store.root for store in stores], tmp_path / "report").html.read_text()
    assert "0123456789abcdef" in page
    assert "must be equal" in page
    assert load_runs(stores[:1], PROTOCOL).conflicts == []


OLD = "synthetic/walking_xyz?scene=3"
NEW = "synthetic/walking_xyz?scene=103"


@pytest.fixture
def seen(store):
    """Four trackers, two with the network's masks, on a scene of the training set and on a held-out one."""
    masks = {"orb-slam2": ("", 0.05), "mask-rcnn": ("embedded", 0.01), "dynaslam": ("embedded", 0.03),
             "ds-slam": ("yolo", 0.02)}  # fmt: skip
    for sequence, (tracker, (source, error)) in product((OLD, NEW), masks.items()):
        add_run(store, tracker, sequence, error=error, masks=source)
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


def test_a_tracker_that_was_judged_only_where_its_network_was_trained_is_not_ranked(store):
    for tracker, masks in (("orb-slam2", ""), ("ds-slam", "yolo"), ("mask-rcnn", "embedded")):
        add_run(store, tracker, OLD, masks=masks, error=0.001 if masks == "embedded" else 0.03)
    board = load_board(store)
    assert {board.first(key).tracker.id for key in board.ranked} == {"orb-slam2", "ds-slam"}
    assert {board.first(key).tracker.id for key in board.trackers} == {
        "orb-slam2",
        "ds-slam",
        "mask-rcnn",
    }, "but shown"
    assert len(load_board(store, rank_seen=True).ranked) == 3


@pytest.mark.slow
@pytest.mark.parametrize("rank_seen", [False, True])
def test_every_format_carries_the_mark(seen, tmp_path, rank_seen):
    paths = build_report(seen, tmp_path / "report", rank_seen=rank_seen)
    markdown = paths.markdown.read_text()
    latex = paths.latex.read_text()
    page = "".join(
        (paths.html.parent / f"{name}.html").read_text()
        for name in ("index", "errors", "reproduce")
    )
    rule = "rank, since that was asked for" if rank_seen else "do not rank"
    assert "trained on this very scene (the embedded one, on rendered scenes 0-99)" in markdown
    assert rule in markdown
    table = markdown.split("## Absolute trajectory")[1].split("\n## ")[0]
    (line,) = [line for line in table.splitlines() if line.startswith("| mask-rcnn §")]
    held_out, trained, where = [cell.strip() for cell in line.split("|")[2:-1]]
    assert "§" not in held_out
    assert "**" in held_out
    assert "§" in trained
    assert ("**" in trained) is rank_seen
    assert where == "walking\\_xyz?scene=3"
    assert page.count("mask-rcnn §") > 3
    assert "mask-rcnn \\S{}" in latex
    assert "§" not in latex
    errors = pd.read_csv(paths.csv["per_sequence"], index_col="tracker")
    assert errors["§ trained on"]["mask-rcnn §"] == "walking_xyz?scene=3"
    marked = pd.read_csv(paths.csv["runs"]).query("seen_in_training")
    assert set(zip(marked["tracker"], marked["sequence"], strict=True)) == {
        ("mask-rcnn", OLD),
        ("dynaslam", OLD),
    }
    assert ("--rank-seen" in markdown + page) is rank_seen
    assert "§" in to_markdown(compare(seen, seen).table)


def test_a_recording_of_unknown_length_beside_published_numbers_is_named(store, tmp_path):
    for name in ("bonn/balloon", "tum/fr3/walking_rpy"):
        add_run(store, "orb-slam2", name, block=name, duration_s=30.6)
    markdown = build_report(store, tmp_path / "report").markdown.read_text()
    assert (
        "Published numbers stand beside bonn/balloon, whose full length is not known here"
        in markdown
    )
    assert least_length_s("bonn/balloon") is None, "no source, no claim"
    assert not is_excerpt("bonn/balloon", 1.0), "no source, no claim"


@pytest.mark.slow
def test_what_was_put_together_here_is_called_no_system_of_ours(store, tmp_path):
    """The back end in the manner of ORB-SLAM2 and masks by Mask R-CNN are others' systems in our composition."""
    for tracker in ("orb-slam2", "mask-rcnn", "emfoa-oft"):
        assert TRACKERS.get(tracker).provenance == "own"
        add_run(store, tracker, NEW, provenance="own")
    table = pd.read_csv(build_report(store, tmp_path / "report").csv["leaderboard"])
    assert table["provenance"].tolist() == ["our composition"] * 3
    meaning = "put together in this project: no one paper or program describes the whole"
    assert (tmp_path / "report" / "index.html").read_text().count(meaning) == 3
