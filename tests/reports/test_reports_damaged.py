"""Damaged files of a store, and failures among repeats: the report is made, and says what it left out."""

import pytest
from reports_fake_store import add_frames, add_run
from reports_rows import PROTOCOL, crashed, page_data, row

from dynslam_bench.reports import build_report
from dynslam_bench.reports.figures import mask_figure
from dynslam_bench.reports.html.run_pages import exact_shares
from dynslam_bench.reports.model.board import make_board
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.reports.tables.leaderboard import repeatability
from dynslam_bench.runs.store import RunStore

HEAD = b"index,timestamp,state,frame_error_trans_m,dynamic_share\n"
DAMAGE = {
    "no text": b"\xff\xfe\x00\x01",
    "words": HEAD + b"0,1000.0,ok,much,0.1\n",
    "no stamp": HEAD + b"0,,ok,0.1,0.1\n",
    "no index": HEAD + b",1000.0,ok,0.1,0.1\n",
    "huge index": HEAD + b"9" * 40 + b",1000.0,ok,0.1,0.1\n",
    "another heading": b"a,b\n1,2\n",
    "heading alone": HEAD,
    "too many cells": HEAD + b"0,1000.0,ok,0.1,0.1,7,8,9\n",
    "null bytes": b"\x00" * 64,
}


@pytest.fixture
def store(tmp_path):
    store = RunStore(tmp_path / "results")
    for name, error in (("a", 0.01), ("b", 0.02)):
        for seed in (0, 1):
            add_frames(store.folder(add_run(store, name, "s/a", seed, error=error, n=40)), 40)
    return store


def test_a_damaged_table_of_frames_costs_only_its_own_figures(store, tmp_path):
    sound, hurt = store.ids(), {}
    for seed, damage in enumerate(DAMAGE, start=2):
        hurt[add_run(store, "a", "s/a", seed, n=40)] = damage
    for run_id, damage in hurt.items():
        (store.folder(run_id) / "frames.csv").write_bytes(DAMAGE[damage])
    folder = build_report(store, tmp_path / "report").html.parent
    pages = {run_id: page_data(folder, f"run-{run_id}") for run_id in store.ids()}
    for run_id, damage in hurt.items():
        assert any("frames.csv" in note for note in pages[run_id]["notes"]), damage
        assert "t" not in pages[run_id]["series"] and "track_x" in pages[run_id]["series"], damage
    assert all("t" in pages[run_id]["series"] for run_id in sound)


def test_what_is_left_out_is_named(store, tmp_path):
    for name, text in (("d" * 16, "{"), ("e" * 16, '{"schema_version": 99, "new": 1}')):
        (store.runs / name).mkdir()
        (store.runs / name / "run.json").write_text(text)
    paths = build_report(store, tmp_path / "report")
    assert "2 folders without a valid record" in paths.html.read_text()
    page = (paths.html.parent / "reproduce.html").read_text()
    assert all(f"runs/{name}" in page for name in ("d" * 16, "e" * 16))


def test_a_tracker_that_always_crashes_is_not_called_repeatable():
    rows = [row("good", s, 0.1 + 0.01 * seed, seed=seed) for s in "st" for seed in (0, 1)]
    rows += [crashed("c", s, seed=seed) for s in "st" for seed in (0, 1)]
    rows += [row("half", "s", 0.2), row("half", "s", 0.3, seed=1), row("half", "t", 0.2), crashed("half", "t", seed=1)]
    board = make_board(rows)
    assert {cells[0].text: cells[1].text for cells in repeatability(board).rows} == {"GOOD": "2", "HALF": "1"}


def test_figures_show_millimetres():
    figure = mask_figure(make_board([row("a", "s", 0.025, mask_iou=0.7), row("b", "s", 0.05, mask_iou=0.8)]))
    assert figure.layout.yaxis.title.text == "ATE (mm)"
    assert sorted(trace.y[0] for trace in figure.data) == [25, 50]


def test_a_run_that_crashed_hides_no_exact_share(tmp_path):
    """What the masks show of a frame is known if any run saw the frame, not only the first one of the sequence."""
    store = RunStore(tmp_path / "r")
    for name, count in (("crashed", 30), ("whole", 60)):
        add_frames(store.folder(add_run(store, name, "s/a", n=60)), count)
    runs = sorted(load_runs([store], PROTOCOL).rows, key=lambda row: row.tracker.id)
    assert [*exact_shares(runs)] == [*range(60)]


def test_a_final_trajectory_of_few_frames_is_no_success(tmp_path):
    """Under a protocol of the final trajectory, coverage and success are those of what is scored."""
    store = RunStore(tmp_path / "r")
    for name, kept in (("whole", None), ("thin", [0, 1, 2, 3])):
        add_run(store, name, "s/a", error=0.01, final_error=0.005, final_frames=kept)
    protocol = PROTOCOL.model_copy(update={"id": "x/v1", "trajectory": "final"})
    rows = {row.tracker.id: row for row in load_runs([store], protocol).rows}
    assert (rows["whole"].coverage, rows["whole"].failed) == (1.0, False)
    thin = rows["thin"]
    assert (thin.n_tracked, thin.failed, thin.status) == (4, True, "lost") and thin.coverage < 0.1
    assert "the final trajectory has poses of 4 of" in thin.reason and thin.ending.startswith("lost, 4/")
    assert {row.tracker.id: row.failed for row in load_runs([store], PROTOCOL).rows} == dict.fromkeys(rows, False)


def test_what_was_lost_as_it_came_and_found_in_the_end_is_a_success_of_the_final_trajectory(tmp_path):
    store, protocol = RunStore(tmp_path / "r"), PROTOCOL.model_copy(update={"id": "x/v1", "trajectory": "final"})
    add_run(store, "found", "s/a", error=0.01, status="lost", final_error=0.005, final_whole=True)
    add_run(store, "sparse", "s/a", error=0.01, kind="imported", lost=[at for at in range(120) if at % 5])
    rows = {row.tracker.id: row for row in load_runs([store], protocol).rows}
    assert (rows["found"].status, rows["found"].failed, rows["found"].coverage) == ("ok", False, 1.0)
    rows = {row.tracker.id: row for row in load_runs([store], PROTOCOL).rows}
    assert rows["found"].failed and rows["found"].status == "lost"
    assert not rows["sparse"].failed, "a file of keyframes says what it covers, and that no more was asked for"
