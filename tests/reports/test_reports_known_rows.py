"""Rows that a report has taken before: the same as if every run was read, whatever has changed since."""

import json
import os
import shutil

import pytest
from reports_fake_store import add_run, fill, truth_of

from dynslam_bench.core.errors import ReportError
from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import format_tum
from dynslam_bench.reports.model.load import RowCache, load_runs
from dynslam_bench.runs import RunStore

PROTOCOL = get_protocol("tum-rgbd/v1")


@pytest.fixture(scope="module")
def pattern(tmp_path_factory):
    """A store with runs of every kind, and the rows of a first report."""
    store = fill(tmp_path_factory.mktemp("rows") / "results", sequences=["s/a", "s/b"], seeds=(0, 1))
    add_run(store, "orb-slam2", "s/a", 7, lost=range(5), status="lost", n=60)
    add_run(store, "orb-slam2", "s/a", 8, status="stopped", n=60)
    add_run(store, "elsewhere", "s/b", kind="imported", n=60, online=False, final_error=0.02)
    add_run(store, "no-truth", "s/c", ground_truth=False, n=60)
    seen(store)
    return store


@pytest.fixture
def store(pattern, tmp_path):
    """A copy of it, times and all."""
    shutil.copytree(pattern.root, tmp_path / "results", symlinks=True)
    return RunStore(tmp_path / "results")


@pytest.fixture
def reads(monkeypatch):
    """Ids of the records that are read whole."""
    found = []
    whole = RunStore.read_whole
    monkeypatch.setattr(RunStore, "read_whole", lambda self, run_id: found.append(run_id) or whole(self, run_id))
    return found


def seen(store):
    """What a report knows of a store."""
    loaded = load_runs([store], PROTOCOL)
    rows = {run.row.run_id: (run.row.model_dump(), run.part) for run in loaded.runs}
    return rows, loaded.stopped, loaded.superseded, sorted(loaded.unreadable)


def seen_anew(store):
    """The same by reading everything."""
    shutil.rmtree(store.root / "index", ignore_errors=True)
    return seen(store)


def index_of(store):
    (index,) = (store.root / "index").glob("rows-*")
    return index


def test_unchanged_runs_are_not_read_and_rows_are_equal(store, reads):
    known = seen(store)
    assert reads == [] and known[1] == 1 and len(known[0]) == len(store.ids()) - 1
    assert known == seen_anew(store) and sorted(reads) == store.ids()
    assert seen(store) == known


def test_rows_name_the_folder_where_the_store_lies_now(store, tmp_path, reads):
    store.root.rename(tmp_path / "moved")
    moved = RunStore(tmp_path / "moved")
    rows = seen(moved)[0]
    assert reads == [] and {row["log"] for row, _ in rows.values()} == {
        str(moved.folder(run) / "log.txt") for run in rows
    }


def edited(store, run):
    path = store.folder(run) / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"coverage": 0.5}))


def rescored(store, run):
    record = store.read_whole(run)
    scored = store.score(record, PROTOCOL)
    better = scored.online.model_copy(update={"metrics": scored.online.metrics | {"ate_rmse_m": 0.125}})
    store.add_metrics(scored.model_copy(update={"online": better}))


def forgotten(store, run):
    store.metric_file(run, PROTOCOL.digest()).unlink()


def damaged(store, run):
    (store.folder(run) / "run.json").write_text("{")


def removed(store, run):
    store.remove(run)


def replaced(store, run):
    record = store.read_whole(run).model_copy(update={"status": "crashed", "reason": "RuntimeError: no map"})
    with store.work_folder(run) as work:
        store.publish(work, record)


def tracked_otherwise(store, run):
    lost = store.trajectory(run)
    (store.folder(run) / "trajectory_online.txt").write_text(
        format_tum(Trajectory(lost.timestamps[:9], lost.T_world_cam[:9]))
    )


def true_otherwise(store, run):
    truth = truth_of("another")
    (store.root / "sequences" / store.read_whole(run).sequence.part / "groundtruth.txt").write_text(format_tum(truth))


def linked(store, run):
    secret = store.root.parent / "secret.txt"
    secret.write_text("secret")
    (store.folder(run) / "frames.csv").unlink(missing_ok=True)
    (store.folder(run) / "frames.csv").symlink_to(secret)


def relabelled(store, run):
    store.relabel(store.read_whole(run), "Another name")


def added(store, run):
    add_run(store, "new", "s/a", n=60)


CHANGES = [
    edited,
    rescored,
    forgotten,
    damaged,
    removed,
    replaced,
    tracked_otherwise,
    true_otherwise,
    linked,
    relabelled,
    added,
]


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_what_changed_shows_at_once(store, reads, change):
    before = seen(store)
    run = next(run for run, (row, _) in before[0].items() if row["status"] == "lost")
    change(store, run)
    reads.clear()
    after = seen(store)
    assert len(set(reads)) <= len(store.ids()) // 2
    assert after == seen_anew(store)
    assert (after == before) == (change is forgotten)


@pytest.mark.parametrize("text", ["", "{", "[]\n[1]", "\x00", '["0"]\n', "null\n" * 3, '\udcff"\n'])
def test_a_damaged_index_is_made_again(store, reads, text):
    before, index = seen(store), index_of(store)
    index.write_text(text, errors="surrogateescape")
    assert seen(store) == before and sorted(reads) == store.ids()
    reads.clear()
    assert seen(store) == before and reads == []


def test_a_torn_line_costs_no_other(store, reads):
    before, index = seen(store), index_of(store)
    lines = index.read_bytes().splitlines(keepends=True)
    index.write_bytes(lines[0] + lines[1][:100] + b"\n" + b"".join(lines[2:]))
    assert seen(store) == before and reads == [json.loads(lines[1])[0]]


def test_an_index_that_somebody_made_gives_nothing_but_rows_of_their_runs(store, reads):
    before, index = seen(store), index_of(store)
    lines = [json.loads(line) for line in index.read_text().splitlines()]
    for line in lines:
        if line[-1] is not None:
            line[-1]["run_id"] = "../../secret"
    stranger = ["0" * 16, *lines[0][1:]]
    index.write_text("".join(json.dumps(line) + "\n" for line in [*lines, stranger]))
    assert seen(store) == before and len(reads) == len(before[0])


@pytest.mark.parametrize(
    "make", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("nowhere")], ids=["pipe", "folder", "link"]
)
def test_something_else_in_the_place_of_the_index_is_in_nobodys_way(store, make):
    before, index = seen(store), index_of(store)
    index.unlink()
    make(index)
    assert seen(store) == before


def test_a_store_that_cannot_be_written_is_reported(store, reads):
    before = seen(store)
    shutil.rmtree(store.root / "index")
    (store.root / "index").write_text("a file in its place")
    assert seen(store) == before and sorted(reads) == store.ids()


def test_outdated_lines_and_files_go(store):
    index = index_of(store)
    older = index.with_name(f"{index.name.rpartition('-')[0]}-of-another-version.jsonl")
    older.write_text("[]\n")
    count = len(index.read_text().splitlines())
    run = store.ids()[0]
    for label in "abcdefgh":
        store.relabel(store.read_whole(run), label)
        seen(store)
    assert count <= len(index.read_text().splitlines()) <= 1.3 * count and not older.exists()


def test_each_protocol_has_rows_of_its_own(store, reads):
    seen(store)
    other = {run.row.run_id: run.row for run in load_runs([store], get_protocol("evo-default")).runs}
    assert reads and {row.protocol_id for row in other.values()} == {"evo-default"}
    reads.clear()
    assert {run.row.protocol_id for run in load_runs([store], PROTOCOL).runs} == {"tum-rgbd/v1"} and reads == []


def test_a_reference_is_looked_for_among_known_and_new_rows(store, reads):
    assert load_runs([store], PROTOCOL, reference="orb-slam2").runs and reads == []
    new = add_run(store, "newcomer", "s/a", n=60)
    reads.clear()
    assert load_runs([store], PROTOCOL, reference="newcomer").runs and set(reads) == {new}
    with pytest.raises(ReportError, match="no run of the reference 'nobody'"):
        load_runs([store], PROTOCOL, reference="nobody")


def test_nothing_is_made_where_no_run_is(tmp_path):
    with pytest.raises(ReportError, match="no runs"):
        load_runs([RunStore(tmp_path / "nowhere")], PROTOCOL)
    assert RowCache(RunStore(tmp_path / "nowhere"), PROTOCOL).take_all([], print) == ([], [])
    assert list(tmp_path.iterdir()) == []
