"""Rows that a report keeps for the next one: the same as if every run was read, whatever has changed since."""

import json
import shutil
import sqlite3

import pytest
from reports_fake_store import add_run, fill, truth_of
from reports_rows import PROTOCOL

from dynslam_bench.core.errors import ReportError
from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.geometry.trajectory_files import format_tum
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.runs import RunStore


@pytest.fixture(scope="module")
def pattern(tmp_path_factory):
    """A store with runs of every kind, and the rows of a first report."""
    store = fill(tmp_path_factory.mktemp("rows") / "results", sequences=["s/a", "s/b"], seeds=(0, 1))
    add_run(store, "orb-slam2", "s/a", 7, lost=range(5), status="lost", n=60)
    add_run(store, "orb-slam2", "s/a", 8, status="stopped", n=60)
    add_run(store, "elsewhere", "s/b", kind="imported", n=60, online=False, final_error=0.02)
    add_run(store, "no-truth", "s/c", ground_truth=False, n=60)
    rows_of(store)
    return store


@pytest.fixture
def store(pattern, tmp_path):
    """A copy of it, and the rows of a first report on the copy."""
    shutil.copytree(pattern.root, tmp_path / "results", symlinks=True)
    copy = RunStore(tmp_path / "results")
    rows_of(copy)
    return copy


@pytest.fixture
def reads(monkeypatch):
    """Ids of the records that are read whole."""
    read_ids = []
    whole = RunStore.read_whole
    monkeypatch.setattr(RunStore, "read_whole", lambda self, run_id: read_ids.append(run_id) or whole(self, run_id))
    return read_ids


def rows_of(store):
    """What a report knows of a store."""
    loaded = load_runs([store], PROTOCOL)
    rows = {row.run_id: row.model_dump() for row in loaded.rows}
    return rows, loaded.stopped, loaded.superseded, sorted(loaded.unreadable)


def index_of(store):
    return store.root / "index.sqlite"


def test_unchanged_runs_are_not_read_and_rows_are_equal(store, tmp_path, reads):
    kept = rows_of(store)
    assert reads == [] and kept[1] == 1 and len(kept[0]) == len(store.ids()) - 1
    store.root.rename(tmp_path / "moved")
    moved = RunStore(tmp_path / "moved")
    rows = load_runs([moved], PROTOCOL).rows
    assert reads == [] and all(row.folder.is_dir() and row.estimate(row.trajectory) for row in rows)
    index_of(moved).unlink()
    assert rows_of(moved) == kept and sorted(reads) == moved.ids()


def edited(store, run):
    record = json.loads((store.folder(run) / "run.json").read_text())
    return store.folder(run) / "run.json", json.dumps(record | {"coverage": 0.5})


def damaged(store, run):
    return store.folder(run) / "run.json", "{"


def tracked_otherwise(store, run):
    return store.folder(run) / "trajectory_online.txt", format_tum(store.trajectory(run).select(slice(9)))


def true_otherwise(store, run):
    folder = store.root / "sequences" / store.read_whole(run).sequence.part
    return folder / "groundtruth.txt", format_tum(truth_of("another"))


def forgotten(store, run):
    store.index.forget(run)


def removed(store, run):
    store.remove(run)


def linked(store, run):
    (store.folder(run) / "frames.csv").symlink_to(store.root.parent)


def added(store, run):
    add_run(store, "new", "s/a", n=60)


CHANGES = [edited, forgotten, damaged, removed, tracked_otherwise, true_otherwise, linked, added]


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_what_changed_shows_at_once(store, reads, change):
    before = rows_of(store)
    written = change(store, next(run_id for run_id, row in before[0].items() if row["status"] == "lost"))
    if written:
        written[0].write_text(written[1])
    reads.clear()
    after = rows_of(store)
    assert len(set(reads)) <= len(store.ids()) // 2
    index_of(store).unlink()
    assert after == rows_of(store) and (after == before) == (change is forgotten)


@pytest.mark.parametrize("change", ["value = '{'", "value = x'ff'", "run_id = '0000000000000000'", "state = 'x'"])
def test_rows_that_somebody_made_count_as_missing(store, reads, change):
    before = rows_of(store)
    first, second, *_ = store.ids()
    report = f"name = 'report {PROTOCOL.digest()}'"
    with sqlite3.connect(index_of(store)) as index:
        index.execute(f"UPDATE computed SET {change} WHERE {report} AND run_id = ?", (first,))
        other = f"(SELECT max(value) FROM computed WHERE {report})"
        index.execute(f"UPDATE computed SET value = {other} WHERE {report} AND run_id = ?", (second,))
    assert rows_of(store) == before and first in reads


def test_each_protocol_has_rows_of_its_own(store, reads):
    other = {row.protocol_id for row in load_runs([store], get_protocol("evo-default")).rows}
    assert reads and other == {"evo-default"}
    reads.clear()
    assert {row.protocol_id for row in load_runs([store], PROTOCOL).rows} == {"tum-rgbd/v1"} and reads == []


def test_nothing_is_made_where_no_run_is(tmp_path):
    with pytest.raises(ReportError):
        load_runs([RunStore(tmp_path / "nowhere")], PROTOCOL)
    assert list(tmp_path.iterdir()) == []
