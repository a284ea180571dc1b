"""A row of a table is one program: code, weights and library versions are never mixed without a word."""

from __future__ import annotations

from pathlib import Path

import pytest
from reports_fake_store import add_run
from reports_rows import PROTOCOL

from dynslam_bench.reports import build_report, load_board
from dynslam_bench.reports.model.board import Board
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.runs.record import IDENTITY_SCHEME
from dynslam_bench.runs.store import RunStore

SEQUENCES = ("synthetic/walking_xyz", "synthetic/walking_static")


def made_by(**parts: object) -> dict[str, object]:
    return {"scheme": IDENTITY_SCHEME, **parts}


def rows_of(board: Board, tracker: str) -> dict[str, list[str]]:
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
    add_run(store, "mine", SEQUENCES[0], error=0.01, identity=made_by(**before), started="2026-01-01T00:00:00+00:00")
    add_run(store, "mine", SEQUENCES[1], error=0.50, identity=made_by(**after), started="2026-01-02T00:00:00+00:00")
    board = load_board(store)
    rows = rows_of(board, "mine")
    assert len(rows) == 2 and all(len(sequences) == 1 and f" {name} " in label for label, sequences in rows.items())
    newer = {board.first(key).started[:10] for key in board.ranked if board.first(key).tracker.id == "mine"}
    older = [board.first(key).is_current for key, label in board.labels.items() if label in rows]
    assert newer <= {"2026-01-02"} and sorted(older) == [False, True]


def test_a_program_that_ran_everything_again_supersedes_the_older_one(store: RunStore) -> None:
    for day, source in enumerate("12", start=1):
        for sequence in SEQUENCES:
            started = f"2026-01-0{day}T00:00:00+00:00"
            add_run(store, "mine", sequence, identity=made_by(source=source), started=started)
    loaded = load_runs([store], PROTOCOL)
    assert loaded.superseded == 2 and {row.started[:10] for row in loaded.rows} == {"2026-01-02"}
    assert list(rows_of(load_board(store), "mine")) == ["mine"]


def test_masks_of_two_networks_on_two_kinds_of_sequences_are_one_row(store: RunStore) -> None:
    add_run(store, "mine", SEQUENCES[0], identity=made_by(weights={"embedded": "aaaa"}))
    add_run(store, "mine", "bonn/crowd", identity=made_by(weights={"coco": "bbbb"}))
    assert list(rows_of(load_board(store), "mine")) == ["mine"]


@pytest.mark.parametrize(
    ("made", "label"), [({"identity": {}}, "orb-slam2 · identity unverified"), ({"kind": "imported"}, "orb-slam2")]
)
def test_a_run_of_an_older_identity_scheme_and_an_import_are_never_the_reference(
    store: RunStore, made: dict[str, object], label: str
) -> None:
    add_run(store, "orb-slam2", SEQUENCES[0], **made)
    add_run(store, "mine", SEQUENCES[0])
    board = load_board(store)
    assert list(rows_of(board, "orb-slam2")) == [label] and board.reference is None


def test_a_verified_program_stays_ranked_beside_newer_runs_that_are_not_verified(store: RunStore) -> None:
    add_run(store, "mine", SEQUENCES[0], identity=made_by(source="1"), started="2026-01-01T00:00:00+00:00")
    add_run(store, "mine", SEQUENCES[1], identity={}, started="2026-01-02T00:00:00+00:00")
    rows = load_runs([store], PROTOCOL).rows
    assert {row.started[:10]: row.is_current for row in rows} == {"2026-01-01": True, "2026-01-02": False}


def test_two_results_under_one_id_are_said_on_the_page(tmp_path: Path) -> None:
    stores = [RunStore(tmp_path / name) for name in "ab"]
    for store, error in zip(stores, (0.01, 0.3), strict=True):
        add_run(store, "mine", SEQUENCES[0], error=error, run_id="0123456789abcdef")
    loaded = load_runs(stores, PROTOCOL)
    assert len(loaded.conflicts) == 1 and "0123456789abcdef" in loaded.conflicts[0]
    page = build_report([store.root for store in stores], tmp_path / "report").html.read_text()
    assert "0123456789abcdef" in page and "must be equal" in page
    assert load_runs(stores[:1], PROTOCOL).conflicts == []
