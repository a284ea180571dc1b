"""What a glance at the report says is true: on uneven, failing, repeated, cached and confusable results."""

import json

import numpy as np
import pandas as pd
import pytest
from reports_fake_store import add_run
from reports_rows import PROTOCOL, cell_of, crashed, row, rows_of
from test_reports_browser import add_frames

from dynslam_bench.reports import build_report, load_frame
from dynslam_bench.reports.html.explore import Pages
from dynslam_bench.reports.model.board import make_board, missing_commands, missing_note
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.reports.model.published import is_excerpt
from dynslam_bench.reports.tables.leaderboard import leaderboard, per_sequence, relative_errors
from dynslam_bench.reports.tables.table import mm, percent
from dynslam_bench.runs.store import RunStore

# -- what ranks


def test_losing_frames_is_not_free(tmp_path):
    """The loser is better where it tracks, and far off once its lost frames count as not having moved."""
    store = RunStore(tmp_path / "r")
    for name in ("s/a", "s/b"):
        add_run(store, "steady", name, error=0.02)
        add_run(store, "loser", name, error=0.005, lost=range(40, 95))
    board = make_board(load_runs([store], PROTOCOL).rows)
    assert [board.labels[key] for key in board.trackers] == ["steady", "loser"]
    loser = next(r for r in board.rows if r.tracker.id == "loser")
    assert loser.score_m == loser.hold_last_pose_ate_m > 5 * loser.metrics["ate_rmse_m"]
    paths = build_report(store, tmp_path / "report")
    shown = {r["tracker"]: float(r["s/a"]) for r in rows_of(paths.csv["per_sequence"])}
    excluded = {r["tracker"]: float(r["s/a"]) for r in rows_of(paths.csv["lost_frames_excluded"])}
    assert shown["loser"] > shown["steady"]
    assert excluded["loser"] < excluded["steady"]
    rules = rows_of(paths.csv["failure_rules"])
    assert [r["tracker"] for r in rules] == ["steady", "loser"]
    assert float(rules[1]["lost frames held: ATE ratio"]) > float(rules[0]["lost frames held: ATE ratio"])
    assert float(rules[1]["lost frames left out: ATE ratio"]) < float(rules[0]["lost frames left out: ATE ratio"])


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
    assert [board.labels[k] for k in board.hopeless] == ["C"]
    table = leaderboard(board, PROTOCOL)
    assert table.separators == {2, 3}
    assert [cells[1].text for cells in table.rows] == ["2/2", "2/2", "2/2", "0/2"]
    assert [cell.text for cell in table.rows[3][:4]] == ["–", "0/2", "C", "nothing succeeded"]
    errors = per_sequence(board, PROTOCOL)
    failed = cell_of(errors, "C")
    assert (failed.text, failed.emphasis, failed.shade, failed.value) == ("crashed at 20/60", "failed", None, None)
    assert cell_of(errors, "GOOD").emphasis == "best"
    for each in relative_errors(board, PROTOCOL):
        assert [cells[0].text for cells in each.rows] == ["GOOD", "BAD", "CONTROL"]
        assert cell_of(each, "GOOD").emphasis == "best"
    half = make_board([*rows, row("c", "u"), row("good", "u"), row("bad", "u")])
    for each in relative_errors(half, PROTOCOL):
        assert [(cell.text, cell.emphasis) for cell in next(c for c in each.rows if c[0].text == "C")[1:3]] == [
            ("", "failed"),
            ("", "failed"),
        ]


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
    everything = make_board(uneven(), on="all")
    assert everything.ranked == []


def test_missing_cells_are_named_with_the_commands_that_fill_them():
    board = make_board(uneven())
    note = missing_note(board)
    assert note.startswith("The ranking stands on the 3 of 5 sequences that all ranked trackers have.")
    assert "Not ranked, since they lack too many of the others' sequences: NEW." in note
    assert "B on s [0:60], v" in note
    commands = missing_commands(board)
    assert "dynslam-bench run b s --frames 0:60" in commands
    assert "dynslam-bench run b v" in commands
    assert "dynslam-bench run new s t u v" in commands
    assert missing_note(make_board([row("a"), row("b")])) == ""


def test_commands_carry_settings_and_repeats():
    variant = {"epipolar.threshold_px": 2.0, "device": "cpu", "threads": 4}
    rows = [row("a", "s", seed=i, offset=o, variant=variant) for i in (0, 1) for o in (0, 2)]
    rows += [row("b", s, place=f"/data/{s}") for s in "st"]
    (command,) = missing_commands(make_board(rows))
    expected = "dynslam-bench run a /data/t --seed 0 1 --offset 0 2 --set epipolar.threshold_px=2.0 --threads 4"
    assert command == expected


# -- what stands where


def test_parts_get_no_published_rows(tmp_path):
    store = RunStore(tmp_path / "r")
    add_run(store, "orb-slam2", "tum/fr3/walking_xyz", frames=(0, 200), block="part", duration_s=6.7)
    add_run(store, "orb-slam2", "bonn/crowd", block="excerpt", duration_s=6.7)
    add_run(store, "orb-slam2", "tum/fr3/walking_rpy", block="whole", duration_s=30.6)
    add_run(store, "orb-slam2", "synthetic/walking_xyz", block="rendered", frames=(0, 60))
    paths = build_report(store, tmp_path / "report")
    table = rows_of(paths.csv["per_sequence"])
    published = [r for r in table if "reported" in r["tracker"] or "claimed" in r["tracker"]]
    assert published
    for line in published:
        assert line["tum/fr3/walking_xyz [0:200]"] == line["bonn/crowd"] == ""
        assert line["tum/fr3/walking_rpy"] != ""
    note = "Parts of recordings, beside which no published number stands: bonn/crowd, tum/fr3/walking_xyz [0:200]."
    assert note in paths.markdown.read_text()
    assert is_excerpt("tum/fr3/walking_xyz", 20.0)
    assert not is_excerpt("tum/fr3/walking_xyz", 28.5)
    assert not is_excerpt("synthetic/walking_xyz", 2.0)


def test_a_final_trajectory_stands_in_no_online_table(tmp_path):
    store = RunStore(tmp_path / "r")
    add_run(store, "orb-slam2", "s/a", error=0.05)
    add_run(store, "dynaslam", "s/a", error=0.04)
    add_run(store, "orb-slam3", "s/a", kind="imported", final_error=0.001, online=False)
    paths = build_report(store, tmp_path / "report")
    assert {r["tracker"] for r in rows_of(paths.csv["leaderboard"])} == {"orb-slam2", "dynaslam"}
    assert "orb-slam3 imported" not in {r["tracker"] for r in rows_of(paths.csv["per_sequence"])}
    assert not any("orb-slam3" in r["tracker"] for r in rows_of(paths.csv["rpe_1s_trans"]))
    (final,) = rows_of(paths.csv["final_trajectory"])
    assert final["tracker"] == "orb-slam3"
    assert float(final["s/a"]) < 0.005
    assert "Only in the table of final trajectories, as nothing else is known of them: orb-slam3." in (
        paths.markdown.read_text()
    )
    only = RunStore(tmp_path / "only")
    add_run(only, "orb-slam3", "s/a", kind="imported", final_error=0.001, online=False)
    alone = build_report(only, tmp_path / "alone")
    assert len(rows_of(alone.csv["final_trajectory"])) == 1


def test_imports_of_several_files_are_repeats_and_not_dropped(tmp_path):
    store = RunStore(tmp_path / "r")
    for day in (1, 2, 3):
        add_run(store, "orb-slam3", "s/a", kind="imported", started=f"2026-01-0{day}T00:00:00+00:00")
    loaded = load_runs([store], PROTOCOL)
    assert (len(loaded.rows), loaded.superseded) == (3, 0)


# -- repeats


def test_copies_are_no_repeats():
    rows = [row("copy", error=0.1, seed=i) for i in range(4)]
    rows += [row("real", error=0.1 + 0.01 * i, seed=i) for i in range(4)]
    board = make_board(rows)
    table = per_sequence(board, PROTOCOL)
    assert cell_of(table, "COPY").small == "deterministic"
    assert cell_of(table, "REAL").small == "±7.5"
    copies = (
        board.cells[rows[0].variant_key]["s"]
        if "s" in board.sequences
        else next(iter(board.cells[rows[0].variant_key].values()))
    )
    assert len(copies.scores) == 1
    assert len(copies.rows) == 4
    assert "±0.0000" not in str(table.rows)


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


def test_a_deterministic_trackers_offsets_keep_apart_in_the_store(tmp_path):
    store = RunStore(tmp_path / "r")
    for offset in (0, 2):
        for seed in (0, 1):
            add_run(store, "a", "s/a", seed, offset=offset, block="b", copy_of=offset)
    loaded = load_runs([store], PROTOCOL)
    assert (len(loaded.rows), loaded.superseded) == (4, 0)
    board = make_board(loaded.rows)
    (cells,) = board.cells.values()
    assert [(len(c.rows), len(c.scores)) for c in cells.values()] == [(4, 2)]


# -- what stands beside the numbers


def test_times_from_the_cache_are_marked(tmp_path):
    store = RunStore(tmp_path / "r")
    add_run(store, "cached", "s/a", cached=True, frame_s=0.01)
    add_run(store, "both", "s/a", cached=True, frame_s=0.01)
    add_run(store, "both", "s/b", frame_s=0.05)
    add_run(store, "fresh", "s/a", frame_s=0.02)
    paths = build_report(store, tmp_path / "report")
    markdown = paths.markdown.read_text()
    lines = {name: next(x for x in markdown.splitlines() if f"| {name} |" in x) for name in ("cached", "both", "fresh")}
    assert "10.0 ms†" in lines["cached"]
    assert "50.0 ms" in lines["both"]
    assert "†" not in lines["both"] + lines["fresh"]
    assert "† Times of features and masks come from the stage cache" in markdown
    flags = {(r["tracker"], r["sequence"]): r["cached"] for r in rows_of(paths.csv["runs"])}
    assert flags == {("cached", "s/a"): "True", ("both", "s/a"): "True", ("both", "s/b"): "False",
                     ("fresh", "s/a"): "False"}  # fmt: skip


def test_the_share_without_fundamental_matrix_stands_beside_every_number():
    rows = [row("ours", s, epipolar_skipped=0.98) for s in "st"] + [row("plain", s, 0.2) for s in "st"]
    board = make_board(rows)
    table = leaderboard(board, PROTOCOL)
    column = [c.name for c in table.columns].index("F skipped")
    assert {cells[2].text: cells[column].text for cells in table.rows} == {"OURS": "98 %", "PLAIN": ""}
    for each in (per_sequence(board, PROTOCOL), *relative_errors(board, PROTOCOL)):
        assert cell_of(each, "OURS").small == "F skipped 98 %"
        assert cell_of(each, "PLAIN").small == ""
    assert "F skipped" not in [c.name for c in leaderboard(make_board([row()]), PROTOCOL).columns]


def test_the_page_of_a_run_stacks_stages_alone_and_claims_no_share_of_people_where_there_are_no_masks(tmp_path):
    store = RunStore(tmp_path / "r")
    shown = {}
    for name, known in {"exact": {}, "own": {"exact": False}, "none": {"exact": False, "masks": False}}.items():
        run_id = add_run(store, name, f"s/{name}", n=40)
        add_frames(store.folder(run_id), 40, **known)
        shown[name] = run_id
    data = build_report(store, tmp_path / "report", picture_seconds=0).html.parent / "data"
    pages = {name: (data / f"run-{run_id}.js").read_text() for name, run_id in shown.items()}
    frames = {name: json.loads(text.partition(",")[2].removesuffix(");\n"))["frames"] for name, text in pages.items()}
    assert {name: set(found["stages"]) for name, found in frames.items()} == {name: {"features"} for name in shown}
    sources = {"exact": "exact masks", "own": "the tracker's own masks", "none": ""}
    assert {name: found["share_source"] for name, found in frames.items()} == sources
    assert {name for name, found in frames.items() if "share" in found} == {"exact", "own"}


def test_numbers_have_three_digits_and_no_more():
    assert [mm(v) for v in (0.2196, 0.0142, 0.009996, 0.00123, 2.5, 0.0)] == [
        "220",
        "14.2",
        "10.0",
        "1.23",
        "2500",
        "0",
    ]
    assert mm(float("nan")) == "–"
    assert [percent(v) for v in (0, 0.5, 1, 0.999, 0.0001)] == ["0 %", "50 %", "100 %", "99.9 %", "< 0.1 %"]


def test_little_data_claims_little():
    rows = [row("orb-slam2", "s", 0.2237), row("orb-slam2", "t", 0.02)]
    rows += [row("a", "s", 0.2196), row("a", "t", 0.01)]
    table = leaderboard(make_board(rows), PROTOCOL)
    names = [c.name for c in table.columns]
    assert "P(better)" not in names
    for cells in table.rows:
        assert (cells[0].text, cells[0].small) == ("1–2", "not separable")
        assert cells[names.index("ATE ratio")].small == ""
        assert cells[names.index("ATE ratio")].emphasis == ""
        assert cells[names.index("p")].text == ""
    assert [cells[names.index("wins")].text for cells in table.rows] == ["2 of 2", "reference"]


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


def test_the_frame_holds_all_runs_with_types_and_units(tmp_path):
    store = RunStore(tmp_path / "r")
    add_run(store, "a", "s/a", offset=2, block="b", skipped=0.5, overrides={"x.y": 3})
    add_run(store, "b", "s/a", status="crashed", reason="boom", block="b", noise=4)
    frame = load_frame(store)
    assert list(frame["tracker"]) == ["a", "b"]
    assert frame["settings"][0].startswith("x.y=3")
    assert str(frame["noise"].dtype) == "Int64"
    assert frame["noise"].isna().tolist() == [True, False]
    assert frame["failed"].tolist() == [False, True]
    assert frame["ending"][1] == "crashed at 30/120"
    assert frame["score_m"].dtype == "Float64"
    assert frame["ate_rmse_m"][0] == frame["score_m"][0] > 0
    assert frame["epipolar_skipped"][1] is pd.NA
    paths = build_report(store, tmp_path / "report")
    assert list(rows_of(paths.csv["runs"])[0]) == list(frame.columns)


def test_who_follows_people_on_few_frames_is_not_shown_as_the_better_one():
    """The exploring page's error by the share of dynamic pixels; the follower is best on most frames."""
    pages, share = Pages(), np.full(100, 0.35)
    for tracker, errors_mm in (("steady", np.full(100, 1.2)), ("follower", np.r_[np.full(90, 0.9), np.full(10, 40.0)])):
        pages.add_frames(row(tracker), 1e-3 * errors_mm, share, exact=True)
    steady, follower = (
        [mm for mm, _ in pages.by_share(row(name).variant_key) if mm] for name in ("steady", "follower")
    )
    assert steady == [1.2]
    assert follower == [pytest.approx(np.sqrt(0.9 * 0.9**2 + 0.1 * 40.0**2), rel=1e-3)]


def test_what_is_no_better_than_not_moving_is_named():
    rows = [row("good", s, 0.1) for s in "st"] + [row("frozen", "s", 0.3), row("frozen", "t", 0.2)]
    rows += [row("flaky", "s", 0.01), *(crashed("flaky", "s", seed=seed) for seed in (1, 2))]
    rows += [row("control", s, 0.3, provenance="control") for s in "st"]
    board = make_board(rows)
    assert "No better than a static camera, although their runs ended: FROZEN on 1 of 2 sequences." in (
        leaderboard(board, PROTOCOL).caption
    )
    table = per_sequence(board, PROTOCOL, [])
    small = {cells[0].text: [cell.small for cell in cells[1:]] for cells in table.rows}
    assert "no better than a static camera" in small["FROZEN"][0]
    assert not any("no better" in text for name in ("GOOD", "CONTROL", "FLAKY") for text in small[name])
