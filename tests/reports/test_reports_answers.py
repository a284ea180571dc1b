"""What a board answers in millimetres is true of its numbers, and nobody is left out of it."""

import re
from statistics import median

import pytest
from helpers.reports_fake_store import PROTOCOL, add_run, crashed, page_data, row

from dynslam_bench.reports import build_report
from dynslam_bench.reports.build_report import _board_notes
from dynslam_bench.reports.html.board_page import ranking_entries
from dynslam_bench.reports.model.answers import answers, error_columns, limits, typical_error
from dynslam_bench.reports.model.board import category_boards, make_board, more_sequences
from dynslam_bench.reports.model.load import LoadedRuns
from dynslam_bench.reports.model.statistics import FEWEST
from dynslam_bench.reports.tables.leaderboard import leaderboard
from dynslam_bench.reports.tables.quotes import bibtex, quotes

WALKS = [f"synthetic/walking_xyz?scene={scene}" for scene in range(100, 105)]
SITS = [f"synthetic/sitting_xyz?scene={scene}" for scene in range(100, 103)]


def tagged(tracker, name, error, **changes):
    tag = "high-dynamic" if "walking" in name else "low-dynamic"
    return row(tracker, name, error, tags=(tag,), **changes)


def final_only(tracker, name, error):
    """A run of a batch program: its final trajectory is all that is known."""
    changes = dict(metrics={}, final_metrics={"ate_rmse_m": error}, hold_last_pose_ate_m=None)
    return tagged(tracker, name, 0.0, kind="imported", trajectory="final", **changes)


def mixed():
    """Two categories, a crash, a tracker that lacks sequences, and one of which final trajectories are known."""
    rows = []
    for at, name in enumerate([*WALKS, *SITS]):
        rows.append(tagged("orb-slam2", name, 0.040 + 0.001 * at))
        rows.append(tagged("good", name, 0.010 + 0.001 * at))
        rows.append(final_only("batch", name, 0.006))
    rows += [tagged("fast", name, 0.020) for name in WALKS[1:]]
    rows.append(crashed("fast", WALKS[0], 0.001, tags=("high-dynamic",)))
    rows += [tagged("fast", name, 0.030) for name in SITS]
    rows.append(tagged("short", WALKS[0], 0.005))
    return rows


def numbers_of(sentence):
    """Name to the millimetres behind it, of one answer."""
    told = sentence.partition(": ")[2].rstrip(".")
    pairs = re.findall(r"([A-Z0-9a-z -]+?) ([0-9.]+) mm", told)
    return {name.strip(): float(value) for name, value in pairs}


def test_each_sentence_agrees_with_the_cells():
    for board in category_boards(make_board(mixed())).values():
        columns = error_columns(board)
        told = answers(board)
        assert len(told) == len(columns)
        for sentence, (meaning, names) in zip(told, columns.items(), strict=True):
            assert sentence.startswith(f"{meaning[0].upper()}{meaning[1:]} ({len(names)} sequences")
            values = numbers_of(sentence)
            assert values.pop("not moving") == pytest.approx(300.0)
            assert {"GOOD", "ORB-SLAM2"} <= values.keys()
            for label, value in values.items():
                key = next(key for key in board.trackers if board.names[key] == label)
                errors = [board.cells[key][name].median for name in names]
                assert value == pytest.approx(1000 * median(errors), rel=5e-3)


def test_lost_sequences_are_counted_beside_the_number():
    board = category_boards(make_board(mixed()))["high dynamic"]
    fast = next(key for key in board.trackers if board.first(key).tracker.id == "fast")
    assert typical_error(board, fast, WALKS).lost == 1
    (entry,) = [
        entry for entry in ranking_entries(board, board, {}) if entry["name"].text == "FAST"
    ]
    (cell,) = entry["errors"]
    assert cell.emphasis == "failed"
    assert cell.small == "lost 1"
    assert "1 of " in limits(board)


def test_everybody_has_a_row_with_a_number():
    board = make_board(mixed())
    entries = ranking_entries(board, board, category_boards(board))
    by_name = {entry["name"].text: entry for entry in entries}
    assert set(by_name) == {"GOOD", "FAST", "ORB-SLAM2", "SHORT", "BATCH"}
    batch = by_name["BATCH"]
    assert [cell.text for cell in batch["errors"]] == ["6.00", "6.00"]
    assert batch["verdict"].small == "final trajectory only"
    assert [cell.small for cell in by_name["SHORT"]["errors"]] == ["not run", "1 of 5"]

    # the terminal's table is the same
    table = leaderboard(board, PROTOCOL)
    assert {cells[2].text for cells in table.rows} == set(by_name)


def test_imports_alone_are_ranked_by_their_final_trajectories(store, tmp_path):
    for name in ("synthetic/walking_xyz", "synthetic/walking_rpy"):
        for tracker, error in (("theirs", 0.02), ("ours", 0.01)):
            add_run(
                store, tracker, name, error=error, kind="imported", online=False, final_error=error
            )
    paths = build_report(store, tmp_path / "report")
    text = paths.markdown.read_text()
    assert "tum-rgbd/v1-final" in text
    assert "they are scored under" in text
    assert "ours has the smallest error" in paths.headline
    assert "No tracker can be ranked" not in text


def test_monocular_trackers_keep_a_row_beside_others(store, tmp_path):
    for name in ("synthetic/walking_xyz", "synthetic/walking_rpy"):
        add_run(store, "steady", name, error=0.02)
        add_run(store, "mono", name, error=0.01, sensors="rgb")
    paths = build_report(store, tmp_path / "report")
    page = paths.html.read_text()
    (shown,) = re.findall(r'<tr class="group-3.*?</tr>', page, flags=re.S)
    assert ">mono</a>" in shown
    assert "monocular: its scale is that of the truth" in shown
    assert re.search(r"<td class=\"n[^>]*>[0-9.]+</td>", shown)
    assert "2 runs of monocular trackers are scored with the scale of the truth" in page
    assert "mono" not in {
        entry["label"] for entry in page_data(paths.html.parent, "board")["trackers"]
    }


def test_monocular_trackers_alone_make_a_board(store, tmp_path):
    for name in ("synthetic/walking_xyz", "synthetic/walking_rpy"):
        add_run(store, "mono", name, error=0.01, sensors="rgb")
    paths = build_report(store, tmp_path / "report")
    assert "tum-rgbd/v1-sim3" in paths.markdown.read_text()
    assert "mono alone is ranked" in paths.headline


def test_notes_of_a_tab_speak_of_its_trackers_only(store, tmp_path):
    for name in ("synthetic/walking_xyz", "synthetic/walking_rpy"):
        add_run(store, "steady", name, error=0.02, tags=("high-dynamic",))
        add_run(store, "other", name, error=0.03, tags=("high-dynamic",))
    add_run(store, "steady", "synthetic/sitting_xyz", error=0.02, tags=("low-dynamic",))
    paths = build_report(store, tmp_path / "report")
    page = paths.html.read_text()
    panels = dict(
        re.findall(
            r'data-panel="([^"]+)"(.*?)(?=data-panel=|<p class="caption">)', page, flags=re.S
        )
    )
    assert "Missing cells: other on synthetic/sitting_xyz" in panels["overall"]
    assert "Missing cells" not in panels["high dynamic"]
    # the tracker that was not run there has no row
    assert ">other</a>" not in panels["low dynamic"]


def test_notes_on_programs_speak_of_a_tab_s_trackers_only():
    boards = category_boards(make_board(mixed()))
    labels = boards["overall"].labels
    short = next(key for key, label in labels.items() if label.startswith("SHORT"))
    assert short not in boards["low dynamic"].labels
    loaded = LoadedRuns(not_installed={short: "other code"})
    assert any(
        f"{labels[short]} (other code)" in note for note in _board_notes(boards["overall"], loaded)
    )
    assert not any("other code" in note for note in _board_notes(boards["low dynamic"], loaded))


def test_failures_are_counted_by_tracker():
    board = make_board(mixed())
    assert f"1 of {len(board.rows)} runs failed (FAST 1) and counts as not moving" in limits(board)
    assert "failed" not in limits(make_board([run for run in mixed() if not run.failed]))


def test_an_import_of_a_part_says_how_much_of_the_time_it_covers():
    rows = [final_only("whole", name, 0.01) for name in WALKS]
    for name in WALKS:
        half = final_only("half", name, 0.005)
        rows.append(half.model_copy(update={"coverage": None, "truth_share": 0.6}))
    board = make_board(rows)
    (told,) = answers(board)
    assert "HALF 5.00 mm (final trajectory, 60 % of the time)" in told
    assert "WHOLE 10.0 mm (final trajectory)" in told
    (entry,) = [e for e in ranking_entries(board, board, {}) if e["name"].text == "HALF"]
    assert entry["coverage"].text == "60 % of the truth's time"


def test_quotes_hold_the_numbers_of_the_view():
    rows = [run.model_copy() for run in mixed()]
    board = make_board(rows)
    told = quotes(board, PROTOCOL, answers(board), error_columns(board))
    assert all(sentence in told["Sentence"] for sentence in answers(board))
    assert PROTOCOL.digest() in told["Sentence"]
    latex = told["LaTeX table"]
    assert latex.startswith(r"\begin{table}")
    good = next(line for line in latex.splitlines() if line.startswith("GOOD"))
    assert good.split("&")[1:3] == [" 16.0 ", " 12.0 "]


def test_each_citation_has_a_key_of_its_own():
    rows = mixed()
    for number, run in enumerate(rows):
        run.tracker.citation = f"Author {run.tracker.id} & others, 2017"
        run.sequence.citation = ["Data one, 2012", "Data two"][number % 2]
    text = bibtex(make_board(rows))
    keys = re.findall(r"^@\w+\{([^,]+),", text, flags=re.M)
    assert len(keys) == len(set(keys))
    assert "dynslam-bench" in keys
    assert r"Author good \& others, 2017" in text
    assert "year = {2012}" in text


def test_cannot_tell_says_how_many_sequences_would():
    rows = []
    for at, name in enumerate(WALKS + SITS):
        rows.append(tagged("orb-slam2", name, 0.04))
        rows.append(tagged("noisy", name, 0.04 * (0.6 if at % 2 else 1.4)))
    board = make_board(rows)
    noisy = next(key for key in board.trackers if board.first(key).tracker.id == "noisy")
    further = more_sequences(board, noisy)
    assert further is not None
    assert further > 0
    few = make_board([run for run in rows if run.sequence.id in WALKS[: FEWEST - 1]])
    assert more_sequences(few, noisy) is None
