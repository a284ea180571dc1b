"""What of a results folder is locked, removed, full or killed in the middle: one line, and the same command goes on."""

import os
import shutil
import sqlite3
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from helpers.faults import in_a_small_process, survey, tree

from dynslam_bench.core import InfrastructureError, RunError
from dynslam_bench.geometry import Trajectory, write_tum
from dynslam_bench.runs import RunRecord, RunStore, bank, list_runs, rescore
from dynslam_bench.runs import index as index_module
from dynslam_bench.runs.copying import merge
from dynslam_bench.runs.exchange.transfer import import_trajectory

pytestmark = pytest.mark.slow


def walk(path: Path, drift: float) -> Path:
    """A trajectory of 30 poses, which drifts sideways by so many metres a pose."""
    motions = np.tile(np.eye(4), (30, 1, 1))
    motions[:, 0, 3] = 0.01 * np.arange(30)
    motions[:, 1, 3] = drift * np.arange(30)
    write_tum(path, Trajectory(np.arange(30) / 30.0, motions))
    return path


def make_runs(folder: Path, count: int) -> RunStore:
    """A store with so many runs of one sequence."""
    store = RunStore(folder)
    store.prepare()
    truth = walk(folder.parent / "truth.txt", 0.0)
    for number in range(count):
        file = walk(folder.parent / "theirs.txt", 0.001 * (number + 1))
        import_trajectory(file, f"tracker{number}", "mine", results=store, truth=truth)
    return store


@pytest.fixture
def three(tmp_path: Path) -> RunStore:
    return make_runs(tmp_path / "results", 3)


# -- kills and full disks


@in_a_small_process
def test_a_bank_is_added_to_again_after_any_fault(tmp_path: Path) -> None:
    """It gets, file by file, what it would have got; in between it says that it is not finished."""
    source = make_runs(tmp_path / "source", 2)
    target = tmp_path / "bank"

    def halfway() -> None:
        if (target / bank.UNFINISHED).exists():
            (fault,) = bank.verify(target)
            assert fault.startswith("runs were being added")
        elif (target / bank.SUMS).exists():
            assert bank.verify(target) == []
        else:
            assert RunStore(target).ids() == []

    found = survey(
        lambda: add(source, target), target, halfway=halfway, result=lambda: swept(target), every=2
    )
    assert bank.verify(target) == []
    assert RunStore(target).ids() == source.ids()
    assert found.ends["kill", -9] >= found.operations // 2 > 15
    assert found.ends["full", 3] > 5
    assert found.ends["read-only", 3] > 5


@in_a_small_process
def test_a_bank_that_holds_runs_is_added_to_again_after_any_kill(tmp_path: Path) -> None:
    source = make_runs(tmp_path / "source", 3)
    first = RunStore(tmp_path / "first")
    first.prepare()
    shutil.copytree(source.root / "sequences", first.root / "sequences")
    shutil.copytree(source.folder(source.ids()[0]), first.folder(source.ids()[0]))
    target = tmp_path / "bank"
    found = survey(
        lambda: add(source, target),
        target,
        begin=lambda: add(first, target),
        result=lambda: swept(target),
        faults=("kill", "full"),
        every=2,
    )
    assert bank.verify(target) == []
    assert RunStore(target).ids() == source.ids()
    assert found.ends["kill", -9] >= found.operations // 2


def add(source: RunStore, target: Path) -> None:
    bank.add([source.root], target)


@in_a_small_process
def test_results_are_merged_again_after_any_fault(tmp_path: Path) -> None:
    source = make_runs(tmp_path / "source", 2)
    target = tmp_path / "merged"

    def work() -> None:
        merge([source], RunStore(target))

    found = survey(work, target, result=lambda: swept(target), every=3)
    assert RunStore(target).ids() == source.ids()
    newest = max((source.read_whole(run_id).started, run_id) for run_id in source.ids())
    assert (target / "latest").resolve().name == newest[1]
    assert found.ends["kill", -9] >= found.operations // 3 > 10
    assert found.ends["full", 3] > 3
    assert found.ends["read-only", 3] > 3


def swept(root: Path) -> dict[str, bytes | str]:
    """What is there once the next command has swept up."""
    RunStore(root).prepare()
    return tree(root)


@pytest.mark.parametrize("name", ["run.json", "timestamps.txt", "x.txt"])
def test_what_was_changed_in_an_unfinished_bank_is_a_fault_all_the_same(
    three: RunStore, tmp_path: Path, name: str
) -> None:
    target = tmp_path / "bank"
    add(three, target)
    (target / bank.UNFINISHED).touch()
    if name == "x.txt":
        (target / "runs" / name).symlink_to("/etc/hostname")
    else:
        next(target.rglob(name)).write_text("changed")
    with pytest.raises(RunError, match=f"{name} is (not what SHA256SUMS says|a link)"):
        add(three, target)


@pytest.mark.parametrize("folder", ["runs", "runs/.y.0123456789ab.tmp", "sequences/b"])
def test_what_a_killed_process_left_is_no_part_of_a_bank(
    three: RunStore, tmp_path: Path, folder: str
) -> None:
    target = tmp_path / "bank"
    add(three, target)
    listed = (target / bank.SUMS).read_text()
    left = target / folder / ".x.0123456789ab.tmp"
    left.parent.mkdir(parents=True, exist_ok=True)
    left.write_text("half")
    assert bank.verify(target) == []
    assert bank.add([three.root], target).added == []
    assert (target / bank.SUMS).read_text() == listed


@pytest.mark.parametrize("name", [".x.txt", ".x.0123456789ab.old", "x.0123456789ab.tmp"])
def test_hidden_files_of_other_names_are_faults(three: RunStore, tmp_path: Path, name: str) -> None:
    target = tmp_path / "bank"
    add(three, target)
    (target / "runs" / name).write_text("")
    assert bank.verify(target) == [f"runs/{name} is not listed in SHA256SUMS"]


@pytest.mark.parametrize("verb", ["merge", "bank add"])
def test_a_full_disk_is_one_line_with_its_cause(
    three: RunStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    target = tmp_path / "target"

    def full(source: object, target: object, **_: object) -> None:
        raise OSError(28, "No space left on device", str(target))

    def work() -> None:
        if verb == "merge":
            merge([three], RunStore(target))
        else:
            add(three, target)

    with monkeypatch.context() as patch:
        patch.setattr("shutil.copyfile", full)
        patch.setattr("shutil.copy2", full)
        with pytest.raises(
            InfrastructureError, match=r"cannot write .*No space left on device"
        ) as raised:
            work()
    assert "[(" not in str(raised.value), "the first file alone is named"
    assert raised.value.hint == "check the free space"
    work()
    assert RunStore(target).ids() == three.ids()


def test_a_full_disk_is_no_fault_of_a_manifest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its trajectories are not left out for it."""
    truth = walk(tmp_path / "truth.txt", 0.0)
    file = walk(tmp_path / "theirs.txt", 0.001)
    checksum = sha256(file.read_bytes()).hexdigest()
    (tmp_path / "manifest.toml").write_text(
        f'[[trajectory]]\nfile = "{file.name}"\nsha256 = "{checksum}"\ntracker = "theirs"\nsequence = "mine"\n'
        f'truth = "{truth.name}"\n'
    )

    def full(path: Path, data: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        with pytest.raises(InfrastructureError, match="No space left on device"):
            bank.add([tmp_path / "manifest.toml"], tmp_path / "bank")
    assert len(bank.add([tmp_path / "manifest.toml"], tmp_path / "bank").added) == 1


# -- an index that another process has locked


@pytest.fixture
def locked(three: RunStore, monkeypatch: pytest.MonkeyPatch) -> Iterator[sqlite3.Connection]:
    """Another connection that keeps the index of the three runs locked."""
    list_runs(three)
    monkeypatch.setattr(index_module, "_LOCKED_S", 0.05)
    with closing(sqlite3.connect(three.index.path, isolation_level=None)) as connection:
        connection.execute("BEGIN EXCLUSIVE")
        yield connection


LOOKS: dict[str, Callable[[RunStore], object]] = {
    "list": list_runs,
    "frame": lambda store: store.frame().to_dict("records"),
    "score": lambda store: [store.score(store.read_whole(run_id)) for run_id in store.ids()],
    "rescore": rescore,
}


@pytest.mark.parametrize("what", LOOKS)
def test_a_locked_index_is_waited_for_once_and_then_left_alone(
    three: RunStore, locked: sqlite3.Connection, what: str
) -> None:
    with pytest.warns(RuntimeWarning) as warned:
        without = LOOKS[what](RunStore(three.root))
    (warning,) = warned
    assert "index.sqlite was locked by another process" in str(warning.message)
    locked.execute("ROLLBACK")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = LOOKS[what](RunStore(three.root))
    assert repr(again) == repr(without)


def test_an_index_that_others_may_read_is_read(three: RunStore, locked: sqlite3.Connection) -> None:
    locked.execute("ROLLBACK")
    locked.execute("BEGIN IMMEDIATE")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(list_runs(RunStore(three.root))[0]) == 3


# -- runs that vanish


@pytest.fixture
def vanishing(three: RunStore, monkeypatch: pytest.MonkeyPatch) -> str:
    """The second run, which is removed after all are listed, when the first one is read again."""
    first, second, _ = three.all()[0].run_ids
    read = RunStore.read_whole
    looked = list[str]()

    def then_removed(store: RunStore, run_id: str) -> RunRecord:
        record = read(store, run_id)
        looked.append(run_id)
        if looked.count(first) == 2:
            shutil.rmtree(three.folder(second), ignore_errors=True)
        return record

    monkeypatch.setattr(RunStore, "read_whole", then_removed)
    return second


def test_a_run_that_vanishes_is_left_out_of_a_frame(three: RunStore, vanishing: str) -> None:
    with pytest.warns(
        RuntimeWarning, match=f"1 runs cannot be read .*{vanishing}: run {vanishing} is not in"
    ):
        frame = three.frame()
    assert len(frame) == 2
    assert vanishing not in set(frame.run_id)


def test_a_run_that_vanishes_is_not_merged(three: RunStore, vanishing: str, tmp_path: Path) -> None:
    merged = merge([three], RunStore(tmp_path / "target"))
    assert len(merged.added) == 2
    (left_out,) = merged.left_out
    assert left_out.path.name == vanishing
    assert "is not in" in left_out.reason


def test_a_run_that_vanishes_is_listed_as_unreadable(
    three: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    ids = three.ids()
    monkeypatch.setattr(RunStore, "ids", lambda store: ids)
    shutil.rmtree(three.folder(ids[1]))
    rows, unreadable = list_runs(three)
    assert sorted(row["run_id"] for row in rows) == [ids[0], ids[2]]
    (gone,) = unreadable
    assert gone.path.name == ids[1]
    assert gone.reason.startswith(f"run {ids[1]} is not in {three.root}")


def test_a_record_that_vanishes_is_one_line(three: RunStore) -> None:
    records, _ = three.all()
    three.remove(records.run_ids[1])
    with pytest.raises(RunError, match="is not in") as raised:
        list(records)
    assert raised.value.hint == "if it was removed meanwhile, repeat the command"


def test_a_results_folder_that_vanishes_holds_no_runs(three: RunStore) -> None:
    shutil.rmtree(three.root)
    assert three.ids() == []
    assert list_runs(three) == ([], [])


@pytest.mark.parametrize(
    "file", ["trajectory_online.txt", "trajectory_final.txt", "groundtruth.txt"]
)
def test_a_file_that_vanishes_before_it_is_opened_is_one_line(
    three: RunStore, monkeypatch: pytest.MonkeyPatch, file: str
) -> None:
    record = three.all()[0][0]
    is_file = Path.is_file
    isfile = os.path.isfile
    for path in three.root.rglob(file):
        path.unlink()
    monkeypatch.setattr(Path, "is_file", lambda path: path.name == file or is_file(path))
    monkeypatch.setattr(os.path, "isfile", lambda path: Path(path).name == file or isfile(path))
    with pytest.raises(RunError, match=f"cannot read .*{file}"):
        three.changed(record)
    assert f"cannot read {three.root}" in three.score(record).reasons["final"]


@pytest.mark.parametrize("verb", ["merge", "bank add"])
@pytest.mark.parametrize("removed", ["folder", "trajectory_final.txt"])
def test_a_run_that_is_removed_while_it_is_copied_is_left_out(
    three: RunStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str, removed: str
) -> None:
    work_folder = RunStore.work_folder
    first = three.all()[0].run_ids[0]

    def then_removed(store: RunStore, run_id: str) -> AbstractContextManager[Path]:
        if removed == "folder":
            shutil.rmtree(three.folder(first), ignore_errors=True)
        else:
            (three.folder(first) / removed).unlink(missing_ok=True)
        return work_folder(store, run_id)

    monkeypatch.setattr(RunStore, "work_folder", then_removed)
    target = tmp_path / "target"
    merged = merge([three], RunStore(target)) if verb == "merge" else bank.add([three.root], target)
    assert len(merged.added) == 2
    (left_out,) = merged.left_out
    assert left_out.path.name == first
    assert "removed" in left_out.reason
    assert RunStore(target).ids() == sorted(merged.added)
    assert verb == "merge" or bank.verify(target) == []
