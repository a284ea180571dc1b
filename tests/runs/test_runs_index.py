"""The index of a store: what was computed once is taken from it while its files are the same, and never when not."""

from __future__ import annotations

import json
import os
import sqlite3
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "reports"))

from reports_fake_store import add_run

from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.runs import RunStore
from dynslam_bench.runs import store as store_module
from dynslam_bench.runs.store import FIELDS, list_runs, rescore, run_row

PROTOCOL = get_protocol("tum-rgbd/v1")


@pytest.fixture
def filled(tmp_path: Path) -> tuple[RunStore, list[str]]:
    store = RunStore(tmp_path / "results")
    ids = [add_run(store, "a", "s/a", seed, n=40, started=f"2026-01-0{3 - seed}T00:00:00+00:00") for seed in range(3)]
    return store, ids


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Ids of the records that are read whole."""
    ids: list[str] = []
    read_whole = RunStore.read_whole
    monkeypatch.setattr(RunStore, "read_whole", lambda self, run_id: ids.append(run_id) or read_whole(self, run_id))
    return ids


def shift(path: Path) -> None:
    """Move every second pose of a trajectory file by 0.2 m."""
    lines = path.read_text().splitlines()
    for number in range(1, len(lines), 2):
        words = lines[number].split()
        if words[0] != "#":
            lines[number] = " ".join([words[0], f"{float(words[1]) + 0.2:.6f}", *words[2:]])
    path.write_text("\n".join(lines) + "\n")


def test_rows_are_those_of_the_records_and_are_read_once(filled, reads: list[str]) -> None:
    store, ids = filled
    rows, unreadable = list_runs(store)
    assert [row["run_id"] for row in rows] == ids[::-1] and unreadable == []
    for row in rows:
        record = store.read(row["run_id"])
        assert row == run_row(record, store.score(record)) and tuple(row) == FIELDS
    reads.clear()
    assert list_runs(store) == (rows, []) and reads == []


def test_what_changed_is_read_again(filled, reads: list[str]) -> None:
    store, ids = filled
    list_runs(store)
    store.rewrite(store.read_whole(ids[0]), study="another")
    record = store.folder(ids[1]) / "run.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"reason": "edited by hand"}))
    store.remove(ids[2])
    new = add_run(store, "b", "s/a", n=40)
    reads.clear()
    rows = {row["run_id"]: row for row in list_runs(store)[0]}
    assert sorted(reads) == sorted(rows) == sorted([ids[0], ids[1], new])
    assert rows[ids[1]]["reason"] == "edited by hand"
    published = store.read_whole(new).model_copy(update={"status": "lost", "reason": "made again"})
    with store.work_folder(new) as work:
        store.publish(work, published)
    assert {row["reason"] for row in list_runs(store)[0]} >= {"edited by hand", "made again"}


@pytest.mark.parametrize("file", ["trajectory_online.txt", "groundtruth.txt"])
def test_an_edited_trajectory_or_truth_is_scored_again(filled, file: str) -> None:
    store, ids = filled
    record = store.read_whole(ids[0])
    before = store.score(record).metrics["ate_rmse_m"]
    list_runs(store)
    folder = store.folder(ids[0]) if "online" in file else store.root / "sequences" / record.sequence.part
    shift(folder / file)
    assert store.metrics(record, PROTOCOL) is None
    rows = {row["run_id"]: row for row in list_runs(store)[0]}
    assert rows[ids[0]]["ate_rmse_m"] == store.score(record).metrics["ate_rmse_m"] > before + 0.02
    assert store.metrics(record, PROTOCOL) is not None


def test_metrics_hold_for_one_version_of_the_code(filled, monkeypatch: pytest.MonkeyPatch) -> None:
    store, ids = filled
    record = store.read_whole(ids[0])
    scored = store.score(record)
    assert store.metrics(record, PROTOCOL) == scored
    monkeypatch.setattr(store_module, "evaluation_code", lambda: "newer")
    assert store.metrics(record, PROTOCOL) is None and store.score(record).code == "newer"
    monkeypatch.undo()
    rows, _ = list_runs(store)
    monkeypatch.setattr(store_module, "package_digest", lambda packages: "another")
    (store.folder(ids[1]) / "log.txt").write_text("no part of a row")
    assert list_runs(store) == (rows, [])


def test_rescoring_says_what_has_changed(filled) -> None:
    store, ids = filled
    for run_id in ids:
        store.score(store.read_whole(run_id))
    (same,) = rescore(store)
    assert (same.protocol, same.runs, same.changed) == ("tum-rgbd/v1", 3, ())
    record = store.read_whole(ids[0])
    scored = store.score(record)
    store.add_metrics(record, scored.model_copy(update={"online": None}))
    store.score(record, "evo-default")
    outcomes = {outcome.protocol: outcome.changed for outcome in rescore(store)}
    assert outcomes == {"tum-rgbd/v1": (ids[0],), "evo-default": ()} and store.metrics(record, PROTOCOL) == scored


def damaged(content: bytes):
    return lambda path: path.write_bytes(content)


def rewritten(command: str):
    def change(path: Path) -> None:
        with sqlite3.connect(path) as connection:
            connection.execute(command)
        connection.close()

    return change


DAMAGES = {
    "empty": damaged(b""),
    "no database": damaged(b"x" * 5000),
    "a torn database": lambda path: path.write_bytes(path.read_bytes()[:5000]),
    "no table": rewritten("DROP TABLE computed"),
    "another table": rewritten("ALTER TABLE computed RENAME COLUMN value TO other"),
    "values of other runs": rewritten("UPDATE computed SET value = (SELECT value FROM computed LIMIT 1)"),
    "values of other types": rewritten("UPDATE computed SET value = 3, run_id = x'00ff' || run_id"),
    "values that are no rows": rewritten("UPDATE computed SET value = '[1]'"),
    "values that lead out": rewritten("UPDATE computed SET state = '../../../etc ' || state"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_index_is_made_again(filled, damage: str) -> None:
    store, ids = filled
    rows, _ = list_runs(store)
    record = store.read_whole(ids[0])
    scored = store.score(record)
    DAMAGES[damage](store.index.path)
    assert list_runs(store) == (rows, []) and store.score(record) == scored
    assert list_runs(store) == (rows, []) and store.score(record) == scored


@pytest.mark.parametrize("place", ["folder", "pipe", "link"])
def test_what_is_no_database_is_neither_read_nor_written(filled, place: str, tmp_path: Path) -> None:
    store, ids = filled
    rows, _ = list_runs(store)
    store.index.path.unlink()
    outside = tmp_path / "outside"
    outside.write_bytes(b"")
    make = {"folder": Path.mkdir, "pipe": os.mkfifo, "link": lambda path: path.symlink_to(outside)}
    make[place](store.index.path)
    assert list_runs(store) == (rows, []) and store.score(store.read_whole(ids[0])).run_id == ids[0]
    assert outside.read_bytes() == b"" and store.index.names() == set()
    store.remove(ids[0])


def test_an_unreadable_record_is_named_every_time(filled) -> None:
    store, ids = filled
    (store.folder(ids[0]) / "run.json").write_text("{")
    for _ in range(2):
        rows, (bad,) = list_runs(store)
        assert len(rows) == 2 and bad.path == store.folder(ids[0])


def test_a_link_in_a_folder_is_seen_behind_its_back(filled, tmp_path: Path) -> None:
    store, ids = filled
    list_runs(store)
    name, version = f"list {PROTOCOL.digest()}", None
    with sqlite3.connect(store.index.path) as connection:
        ((version,),) = connection.execute("SELECT DISTINCT version FROM computed WHERE name = ?", (name,))
    (store.folder(ids[0]) / "video.webm").symlink_to(tmp_path)
    assert set(store.index.read(name, version, ids)) == set(ids)
    assert set(store.index.read(name, version, ids, check_links=True)) == set(ids[1:])
