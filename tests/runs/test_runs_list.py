"""The list of a store: read once, kept until a record changes, never wrong and never in the way."""

import json
import os
import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "reports"))

from reports_fake_store import add_run

from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.runs import RunStore, run_index
from dynslam_bench.runs import store as run_list
from dynslam_bench.runs.run_index import FIELDS, run_row
from dynslam_bench.runs.store import list_runs


@pytest.fixture
def filled(tmp_path):
    store = RunStore(tmp_path / "results")
    ids = [add_run(store, "a", "s/a", seed, n=40, started=f"2026-01-0{3 - seed}T00:00:00+00:00") for seed in range(3)]
    return store, ids


@pytest.fixture
def reads(monkeypatch):
    """Ids of the records that are read whole."""
    seen = []
    whole = RunStore.read_whole
    monkeypatch.setattr(RunStore, "read_whole", lambda self, run_id: seen.append(run_id) or whole(self, run_id))
    return seen


def test_rows_are_those_of_the_records_and_are_read_once(filled, reads):
    store, ids = filled
    rows, unreadable = list_runs(store)
    assert [row["run_id"] for row in rows] == ids[::-1] and unreadable == []
    for row in rows:
        record = store.read(row["run_id"])
        assert row == run_row(record, store.score(record)) and tuple(row) == FIELDS
    reads.clear()
    assert list_runs(store) == (rows, [])
    assert reads == []


def test_what_changed_is_read_again(filled, reads):
    store, ids = filled
    list_runs(store)
    reads.clear()
    store.relabel(store.read_whole(ids[0]), "another")
    record = store.folder(ids[1]) / "run.json"
    changed = json.loads(record.read_text()) | {"reason": "edited by hand"}
    record.write_text(json.dumps(changed))
    store.remove(ids[2])
    new = add_run(store, "b", "s/a", n=40)
    reads.clear()
    rows, _ = list_runs(store)
    assert sorted(reads) == sorted([ids[0], ids[1], new])
    assert {row["run_id"] for row in rows} == {ids[0], ids[1], new}
    assert next(row for row in rows if row["run_id"] == ids[1])["reason"] == "edited by hand"


@pytest.mark.parametrize("text", ["{", "[]", '{"head": 1}', '{"head": [], "rows": {}}', "\x00", '{"rows": [1]}'])
def test_a_damaged_index_is_made_again(filled, text):
    store, _ = filled
    rows, _ = list_runs(store)
    whole = lines_of(store)
    index_of(store).write_text(text)
    assert list_runs(store)[0] == rows
    assert lines_of(store) == whole and text not in index_of(store).read_text()


def test_an_unreadable_record_is_named_every_time(filled):
    store, ids = filled
    (store.folder(ids[0]) / "run.json").write_text("{")
    for _ in range(2):
        rows, (bad,) = list_runs(store)
        assert len(rows) == 2 and bad.path == store.folder(ids[0])


def test_a_store_that_cannot_be_written_is_listed(filled, monkeypatch):
    store, _ = filled
    rows, _ = list_runs(store)
    for path in (store.root / "index").iterdir():
        path.unlink()
    (store.root / "index").rmdir()
    (store.root / "index").write_text("a file in its place")
    assert list_runs(store) == (rows, [])


def index_of(store):
    (index,) = (store.root / "index").iterdir()
    return index


def lines_of(store):
    """Those of runs."""
    return [line for line in index_of(store).read_bytes().splitlines(keepends=True) if b"," in line]


def test_a_run_joins_the_index_when_it_is_scored(filled, reads):
    store, ids = filled
    for run_id in ids:
        store.score(store.read_whole(run_id))
    reads.clear()
    rows, _ = list_runs(store)
    assert reads == [] and [row["run_id"] for row in rows] == ids[::-1]
    assert rows == [run_row(record, store.score(record)) for record in store.all()[0]]
    store.score(store.read_whole(ids[0]), again=True)
    assert len(lines_of(store)) == 3


def test_a_run_that_is_made_again_is_listed_as_it_is_now(filled, reads):
    store, ids = filled
    list_runs(store)
    for reason in ("first", "second"):
        record = store.read_whole(ids[0]).model_copy(update={"status": "lost", "reason": reason})
        with store.work_folder(ids[0]) as work:
            store.publish(work, record)
        store.score(record)
    reads.clear()
    rows, _ = list_runs(store)
    assert reads == [] and next(row for row in rows if row["run_id"] == ids[0])["reason"] == "second"
    assert len(lines_of(store)) == 3


def test_a_torn_line_costs_no_other(filled, reads):
    store, ids = filled
    rows, _ = list_runs(store)
    index = index_of(store)
    lines = lines_of(store)
    index.write_bytes(lines[0] + lines[1][:40] + b"\n" + lines[2])
    reads.clear()
    assert list_runs(store) == (rows, []) and reads == [ids[1]]
    assert sorted(lines_of(store)) == sorted(lines)


def test_an_index_of_another_version_goes(filled, monkeypatch):
    store, _ = filled
    rows, _ = list_runs(store)
    first = index_of(store)
    monkeypatch.setattr("dynslam_bench.runs.run_index.package_digest", lambda packages: "another")
    assert list_runs(store) == (rows, [])
    assert index_of(store) != first


@pytest.fixture
def stats(monkeypatch):
    """Files whose times are asked for."""
    asked = []
    for module in (run_index, run_list):
        real = module.stamp_if_there
        monkeypatch.setattr(module, "stamp_if_there", lambda file, real=real: asked.append(str(file)) or real(file))
    return asked


def rescore(store, run, error):
    scored = store.score(store.read_whole(run))
    changed = scored.online.model_copy(update={"metrics": scored.online.metrics | {"ate_rmse_m": error}})
    store.add_metrics(scored.model_copy(update={"online": changed}))


def errors_of(store):
    return {row["run_id"]: row["ate_rmse_m"] for row in list_runs(store)[0]}


def made_long_ago(store, seconds=10):
    (folder,) = (store.root / "metrics").iterdir()
    then = time.time() - seconds
    os.utime(folder, (then, then))


def test_a_run_that_is_scored_again_is_listed_with_its_new_error(filled):
    store, ids = filled
    before = errors_of(store)
    made_long_ago(store)
    assert errors_of(store) == errors_of(store) == before
    rescore(store, ids[0], 0.125)
    assert errors_of(store) == before | {ids[0]: 0.125}
    rescore(store, ids[1], 0.25)
    assert errors_of(store) == errors_of(store) == before | {ids[0]: 0.125, ids[1]: 0.25}
    store.metric_file(ids[0], get_protocol("tum-rgbd/v1").digest()).unlink()
    assert errors_of(store) == before | {ids[1]: 0.25}


def test_errors_are_not_looked_at_while_their_folder_is_as_it_was(filled, stats):
    store, _ = filled
    list_runs(store)
    made_long_ago(store)
    list_runs(store)  # notes its time
    stats.clear()
    rows, _ = list_runs(store)
    assert len(rows) == 3 and [path for path in stats if path.endswith(".json")] == []


def test_errors_are_looked_at_while_their_folder_is_young(filled, stats):
    """It may change again within one tick of the file system's clock."""
    store, ids = filled
    for _ in range(3):
        list_runs(store)
    stats.clear()
    list_runs(store)
    assert len([path for path in stats if path.endswith(".json")]) == len(ids)


def test_notes_do_not_pile_up(filled):
    store, _ = filled
    list_runs(store)
    for seconds in range(5, 120):
        made_long_ago(store, seconds)
        list_runs(store)
    assert len(lines_of(store)) == 3 and len(index_of(store).read_bytes().splitlines()) < 3 + 110
