"""What a glance at the report says is true: on uneven, failing, repeated, cached and confusable results."""

import numpy as np
import pandas as pd
import pytest
from reports_fake_store import add_frames, add_run
from reports_rows import PROTOCOL, cell_of, crashed, page_data, row, rows_of

from dynslam_bench.reports import build_report, load_frame
from dynslam_bench.reports.html.run_pages import RunPage, error_by_share, share_sums
from dynslam_bench.reports.model.board import make_board, missing_commands, missing_note
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.reports.model.published import is_excerpt
from dynslam_bench.reports.tables.leaderboard import leaderboard, per_sequence, relative_errors
from dynslam_bench.reports.tables.table import mm, percent
from dynslam_bench.runs.store import RunStore

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
    assert crashed().score_m == 0.3
    assert crashed(hold_last_pose_ate_m=0.7).score_m == 0.7
    assert crashed(hold_last_pose_ate_m=None, metrics={}).score_m == 0.3
    assert crashed(static_camera_ate_rmse_m=None).score_m is None


def test_a_tracker_that_never_succeeded_stands_below_all_and_is_never_emphasised():
    rows = [row("good", s, 0.1) for s in "st"] + [row("bad", s, 0.25) for s in "st"] + [crashed("c", s) for s in "st"]
    rows += [row("control", s, 0.4, provenance="control") for s in "st"]
    board = make_board(rows)
    assert [board.labels[k] for k in board.trackers] == ["GOOD", "BAD", "CONTROL", "C"]
    assert [board.labels[k] for k in board.ranked] == ["GOOD", "BAD"]
    table = leaderboard(board, PROTOCOL)
    assert table.separators == {2, 3}
    assert [cells[1].text for cells in table.rows] == ["2/2", "2/2", "2/2", "0/2"]
    assert [cell.text for cell in table.rows[3][:4]] == ["–", "0/2", "C", "nothing succeeded"]
    failed = cell_of(per_sequence(board, PROTOCOL), "C")
    assert (failed.text, failed.emphasis, failed.shade, failed.value) == ("crashed at 20/60", "failed", None, None)
    half = make_board([*rows, row("c", "u"), row("good", "u"), row("bad", "u")])
    for each, partly in zip(relative_errors(board, PROTOCOL), relative_errors(half, PROTOCOL), strict=True):
        assert [cells[0].text for cells in each.rows] == ["GOOD", "BAD", "CONTROL"]
        assert cell_of(each, "GOOD").emphasis == "best"
        assert [(cell_of(partly, "C", at).text, cell_of(partly, "C", at).emphasis) for at in (1, 2)] == [
            ("", "failed")
        ] * 2


def test_a_cell_with_one_failure_is_not_bold_and_not_green():
    rows = [row("good", error=0.2, seed=i) for i in range(3)] + [row("ref", error=0.25, seed=i) for i in range(3)]
    rows += [row("mixed", error=0.01, seed=0), row("mixed", error=0.02, seed=1), crashed("mixed", seed=2)]
    board = make_board(rows, reference="ref")
    cell = cell_of(per_sequence(board, PROTOCOL), "MIXED")
    assert cell.emphasis == ""
    assert cell.shade == 0.0
    assert "2/3 succeeded" in cell.small
    assert "crashed at 20/60" in cell.tip
    success = {cells[2].text: cells[1].text for cells in leaderboard(board, PROTOCOL).rows}
    assert success == {"GOOD": "3/3", "REF": "3/3", "MIXED": "2/3"}


def test_ways_to_fail_are_named():
    assert crashed(status="timeout").ending == "timeout at 20/60"
    assert crashed(status="lost", n_tracked=12).ending == "lost, 12/60 tracked"
    assert crashed(status="ok", not_evaluated=True).ending == "not evaluated"
    assert row().ending == ""
    board = make_board([crashed(seed=0), crashed(seed=1, n_processed=31), row("g")])
    assert cell_of(per_sequence(board, PROTOCOL), "C").text == "2 failed: crashed at 20/60; crashed at 31/60"


# -- on what it ranks


def uneven():
    """Three trackers on three sequences, one of them on a fourth, one more tracker on a single one."""
    rows = [row(name, s, error) for name, error in (("a", 0.1), ("b", 0.2), ("orb-slam2", 0.25)) for s in "stu"]
    return [*rows, row("a", "v", 0.1), row("new", "s", 0.05, frames=(0, 60))]


def test_one_more_sequence_takes_nobodys_rank():
    board = make_board(uneven())
    assert [board.labels[k] for k in board.ranked] == ["A", "B", "ORB-SLAM2"]
    assert board.common == ["s", "t", "u"]
    assert board.reference_name == "ORB-SLAM2"
    assert make_board(uneven(), on="all").ranked == []


def test_missing_cells_are_named_with_the_commands_that_fill_them():
    board = make_board(uneven())
    note = missing_note(board)
    assert note.startswith("The ranking stands on the 3 of 5 sequences that all ranked trackers have.")
    assert "others' sequences: NEW." in note and "B on s [0:60], v" in note
    wanted = {"b s --frames 0:60", "b v", "new s t u v"}
    assert {f"dynslam-bench run {words}" for words in wanted} <= set(missing_commands(board))
    assert missing_note(make_board([row("a"), row("b")])) == ""


def test_commands_carry_settings_and_repeats():
    variant = {"epipolar.threshold_px": 2.0, "device": "cpu", "threads": 4}
    rows = [row("a", "s", seed=i, offset=o, variant=variant) for i in (0, 1) for o in (0, 2)]
    rows += [row("b", s, place=f"/data/{s}") for s in "st"]
    (command,) = missing_commands(make_board(rows))
    expected = "dynslam-bench run a /data/t --seed 0 1 --offset 0 2 --set epipolar.threshold_px=2.0 --threads 4"
    assert command == expected


# -- what stands where


def test_parts_get_no_published_rows(store, tmp_path):
    add_run(store, "orb-slam2", "tum/fr3/walking_xyz", frames=(0, 200), block="part", duration_s=6.7)
    add_run(store, "orb-slam2", "bonn/crowd", block="excerpt", duration_s=6.7)
    add_run(store, "orb-slam2", "tum/fr3/walking_rpy", block="whole", duration_s=30.6)
    add_run(store, "orb-slam2", "synthetic/walking_xyz", block="rendered", frames=(0, 60))
    paths = build_report(store, tmp_path / "report")
    lines = rows_of(paths.csv["per_sequence"])
    published = [line for line in lines if "reported" in line["tracker"] or "claimed" in line["tracker"]]
    filled = {name for line in published for name, value in line.items() if value and name != "tracker"}
    assert published and filled == {"tum/fr3/walking_rpy"}
    parts = "bonn/crowd, tum/fr3/walking_xyz [0:200]."
    assert f"beside which no published number stands: {parts}" in paths.markdown.read_text()
    lengths = (("tum/fr3/walking_xyz", 20.0), ("tum/fr3/walking_xyz", 28.5), ("synthetic/walking_xyz", 2.0))
    assert [is_excerpt(*length) for length in lengths] == [True, False, False]


def test_a_final_trajectory_stands_in_no_online_table(tmp_path):
    store, only = RunStore(tmp_path / "r"), RunStore(tmp_path / "only")
    add_run(store, "orb-slam2", "s/a", error=0.05)
    for some in (store, only):
        add_run(some, "orb-slam3", "s/a", kind="imported", final_error=0.001, online=False)
    paths, alone = build_report(store, tmp_path / "report"), build_report(only, tmp_path / "alone")
    for name in ("leaderboard", "per_sequence", "rpe_1s_trans"):
        assert not any("orb-slam3" in line["tracker"] for line in rows_of(paths.csv[name])), name
    (final,) = rows_of(paths.csv["final_trajectory"])
    assert final["tracker"] == "orb-slam3" and float(final["s/a"]) < 0.005
    note = "Only in the table of final trajectories, as nothing else is known of them: orb-slam3."
    assert note in paths.markdown.read_text() and len(rows_of(alone.csv["final_trajectory"])) == 1


def test_imports_of_several_files_are_repeats_and_not_dropped(store):
    for day in (1, 2, 3):
        add_run(store, "orb-slam3", "s/a", kind="imported", started=f"2026-01-0{day}T00:00:00+00:00")
    loaded = load_runs([store], PROTOCOL)
    assert (len(loaded.rows), loaded.superseded) == (3, 0)


# -- repeats


def test_copies_are_no_repeats():
    rows = [row("copy", error=0.1, seed=i) for i in range(4)]
    board = make_board([*rows, *(row("real", error=0.1 + 0.01 * i, seed=i) for i in range(4))])
    table = per_sequence(board, PROTOCOL)
    assert [cell_of(table, name).small for name in ("COPY", "REAL")] == ["deterministic", "±7.5"]
    copies = board.cells[rows[0].variant_key]["s"]
    assert (len(copies.scores), len(copies.rows)) == (1, 4)


def test_offsets_and_noise_are_repeats_of_one_cell():
    rows = [row(error=0.1 + 0.01 * o, offset=o, seed=s, block="b") for o in (0, 1, 2) for s in (0, 1)]
    rows += [row(error=0.15, noise=5, block="b", sequence="s?noise=5")]
    board = make_board(rows)
    assert board.sequences == ["s"]
    (cell,) = (cells["s"] for cells in board.cells.values())
    assert len(cell.rows) == 7
    assert sorted(cell.scores) == pytest.approx([0.1, 0.11, 0.12, 0.15])
    assert [r.repeat for r in cell.rows][:3] == ["seed 0", "seed 1", "seed 0, noise 5"]
    assert not cell.deterministic


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
    column = [column.name for column in table.columns].index("× real time")
    times = {cells[2].text: cells[column].small for cells in table.rows}
    assert times == {"cached": "10.0 ms†", "both": "50.0 ms", "fresh": "20.0 ms", "real": "20.0 ms"}
    assert "†" in table.caption
    flags = {(r.tracker, r.sequence): r.cached for r in board.frame().itertuples()}
    assert {place for place, cached in flags.items() if cached} == {("cached", "s/a"), ("both", "s/a")}


def test_the_share_without_fundamental_matrix_stands_beside_the_error():
    board = make_board([row("ours", s, epipolar_skipped=0.98) for s in "st"] + [row("plain", s, 0.2) for s in "st"])
    table = leaderboard(board, PROTOCOL)
    column = [c.name for c in table.columns].index("F skipped")
    assert {cells[2].text: cells[column].text for cells in table.rows} == {"OURS": "98 %", "PLAIN": ""}
    errors = per_sequence(board, PROTOCOL)
    assert (cell_of(errors, "OURS").small, cell_of(errors, "PLAIN").small) == ("F skipped 98 %", "")
    assert "F skipped" not in [c.name for c in leaderboard(make_board([row()]), PROTOCOL).columns]


def test_the_page_of_a_run_stacks_stages_alone_and_claims_no_share_of_people_where_there_are_no_masks(store, tmp_path):
    shown = {}
    for name, known in {"exact": {}, "own": {"exact": False}, "none": {"exact": False, "masks": False}}.items():
        run_id = add_run(store, name, f"s/{name}", n=40)
        add_frames(store.folder(run_id), 40, **known)
        shown[name] = run_id
    folder = build_report(store, tmp_path / "report").html.parent
    runs = {name: page_data(folder, f"run-{run_id}") for name, run_id in shown.items()}
    stacked = {name: [trace["name"] for trace in run["figures"]["stages"]["data"]] for name, run in runs.items()}
    assert stacked == {name: ["features"] for name in shown}
    drawn = {name: [trace["name"] for trace in run["figures"]["time"]["data"]] for name, run in runs.items()}
    people = {"exact": "share of people: exact masks", "own": "share of people: the tracker's own masks"}
    assert {name: traces[-1] for name, traces in drawn.items() if traces[-1] in people.values()} == people


def test_numbers_have_three_digits_and_no_more():
    numbers = {0.2196: "220", 0.0142: "14.2", 0.009996: "10.0", 0.00123: "1.23", 2.5: "2500", 0.0: "0"}
    assert {value: mm(value) for value in numbers} == numbers and mm(float("nan")) == "–"
    shares = {0: "0 %", 0.5: "50 %", 1: "100 %", 0.999: "99.9 %", 0.0001: "< 0.1 %"}
    assert {value: percent(value) for value in shares} == shares


def test_little_data_claims_little():
    rows = [row("orb-slam2", "s", 0.2237), row("orb-slam2", "t", 0.02)]
    rows += [row("a", "s", 0.2196), row("a", "t", 0.01)]
    table = leaderboard(make_board(rows), PROTOCOL)
    names = [c.name for c in table.columns]
    assert "P(better)" not in names
    for cells in table.rows:
        assert (cells[0].text, cells[0].small) == ("1–2", "")
        assert cells[names.index("ATE ratio")].small == ""
        assert cells[names.index("ATE ratio")].emphasis == ""
        assert cells[names.index("better?")].text in ("", "reference")
    assert [cells[names.index("wins")].text for cells in table.rows] == ["2 of 2", ""]


def test_bold_is_not_given_to_most():
    """Eleven of twelve that may be first are not eleven bests."""
    names = "stuvwxyz"
    apart = [row(name, s, error * (1 + 0.02 * at)) for name, error in (("a", 0.01), ("b", 0.1), ("c", 1.0))
             for at, s in enumerate(names)]  # fmt: skip
    near = [row(f"n{k}", s, 0.1 * (1 + 0.4 * ((at * 7 + k * 5) % 4))) for k in range(3) for at, s in enumerate(names)]
    far = [row("far", s, 50.0 + at, static_camera_ate_rmse_m=99.0) for at, s in enumerate(names)]

    def bold(rows):
        table = leaderboard(make_board(rows, reference=rows[0].tracker.id), PROTOCOL)
        place = [column.name for column in table.columns].index("ATE ratio")
        return [cells[place].emphasis for cells in table.rows]

    assert bold(apart) == ["best", "", ""]
    assert bold(near + far) == [""] * 4


# -- frames


def test_the_frame_holds_all_runs_with_types_and_units(store, tmp_path):
    add_run(store, "a", "s/a", offset=2, block="b", skipped=0.5, overrides={"x.y": 3})
    add_run(store, "b", "s/a", status="crashed", reason="boom", block="b", noise=4)
    frame = load_frame(store)
    assert list(frame["tracker"]) == ["a", "b"] and frame["settings"][0].startswith("x.y=3")
    assert str(frame["noise"].dtype) == "Int64" and frame["noise"].isna().tolist() == [True, False]
    assert frame["failed"].tolist() == [False, True] and frame["ending"][1] == "crashed at 30/120"
    assert str(frame["score_m"].dtype) == "Float64" and frame["ate_rmse_m"][0] == frame["score_m"][0] > 0
    assert frame["epipolar_skipped"][1] is pd.NA
    assert list(rows_of(build_report(store, tmp_path / "report").csv["runs"])[0]) == list(frame.columns)


def test_who_follows_people_on_few_frames_is_not_shown_as_the_better_one():
    """The exploring page's error by the share of dynamic pixels; the follower is best on most frames."""
    share, errors_mm = np.full(100, 0.35), np.r_[np.full(90, 0.9), np.full(10, 40.0)]
    (rmse_mm,) = (mm for mm, _ in error_by_share([RunPage("", *share_sums(share, 1e-3 * errors_mm))]) if mm)
    assert rmse_mm == pytest.approx(np.sqrt(np.mean(errors_mm**2)), rel=1e-3)


def test_what_is_no_better_than_not_moving_is_named():
    rows = [row("good", s, 0.1) for s in "st"] + [row("frozen", "s", 0.3), row("frozen", "t", 0.2)]
    rows += [row("flaky", "s", 0.01), *(crashed("flaky", "s", seed=seed) for seed in (1, 2))]
    rows += [row("control", s, 0.3, provenance="control") for s in "st"]
    board = make_board(rows)
    assert "No better than a static camera, although their runs ended: FROZEN on 1 of 2 sequences." in (
        leaderboard(board, PROTOCOL).caption
    )
    small = {cells[0].text: [cell.small for cell in cells[1:]] for cells in per_sequence(board, PROTOCOL, []).rows}
    assert "no better than a static camera" in small["FROZEN"][0]
    worse = make_board([row("frozen", s, 0.3) for s in "st"] + [row("orb-slam2", s, 0.6) for s in "st"])
    cells = (
        cell_of(per_sequence(worse, PROTOCOL, []), "FROZEN"),
        cell_of(per_sequence(worse, PROTOCOL, []), "ORB-SLAM2"),
    )
    assert [(cell.emphasis, cell.shade) for cell in cells] == [("", 0.0)] * 2, "neither bold nor blue"
    assert not any("no better" in text for name in ("GOOD", "CONTROL", "FLAKY") for text in small[name])
