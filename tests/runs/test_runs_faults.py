"""The run store under faults: no run is ever lost or half there, and going on gives what an undisturbed run gives."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import numpy as np
from faults import survey, tree

from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.runs import RunRecord, RunStore
from dynslam_bench.runs.store import RUN_FILE

RECORD = RunRecord.read(Path(__file__).parent / "data" / "run.json")
FAILED = RECORD.model_copy(update={"status": "crashed", "reason": "an earlier try"})
TRUTH = Trajectory(np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)))


def make(root: Path, record: RunRecord) -> None:
    """What a run writes into the store."""
    store = RunStore(root)
    store.prepare()
    with store.claim(record.run_id), store.work_folder(record.run_id) as work:
        store.add_sequence(record.sequence.part, TRUTH.timestamps_ns, TRUTH)
        store.publish(work, record)


def held(root: Path) -> dict[str, bytes | str]:
    """What is in the store once the next command has swept it, a minute later."""
    for new in root.rglob(".*.new"):
        os.utime(new, (0, 0))
    RunStore(root).prepare()
    return tree(root)


def test_a_new_run_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    root = tmp_path / "results"

    def whole_or_missing() -> None:
        records, unreadable = RunStore(root).all()
        assert records in ([], [RECORD]) and unreadable == []

    found = survey(lambda: make(root, RECORD), root, halfway=whole_or_missing, result=lambda: held(root))
    assert {name.split("/")[0] for name in tree(root)} == {"runs", "sequences", "latest"}
    assert found.operations > 20 and found.ends["kill", -9] == found.operations
    assert found.ends["full", 3] > 5 and found.ends["read-only", 3] > 5 and found.faults == 4 * found.operations


def test_a_run_that_is_made_again_is_never_lost(tmp_path: Path) -> None:
    root = tmp_path / "results"

    def old_or_new() -> None:
        store = RunStore(root)
        (record,) = store.all()[0]
        assert record in (FAILED, RECORD)

    found = survey(
        lambda: make(root, RECORD),
        root,
        begin=lambda: make(root, FAILED),
        halfway=old_or_new,
        result=lambda: held(root),
        faults=("kill",),
    )
    assert found.operations > 15 and found.ends["kill", -9] == found.operations


def test_a_run_is_removed_or_still_there(tmp_path: Path) -> None:
    root = tmp_path / "results"

    def remove() -> None:
        store = RunStore(root)
        if store.ids():
            store.remove(RECORD.run_id)

    found = survey(
        remove, root, begin=lambda: make(root, RECORD), result=lambda: held(root).keys(), faults=("kill", "full")
    )
    assert not RunStore(root).ids() and found.operations > 5 and found.ends["kill", -9] == found.operations


def test_four_publish_the_same_run(tmp_path: Path) -> None:
    """No false error, no missing file, nothing left over: an existing run is no failure."""
    store, errors = RunStore(tmp_path), []
    store.prepare()

    def publish() -> None:
        for _ in range(25):
            try:
                with store.work_folder(RECORD.run_id) as work:
                    (work / "trajectory_online.txt").write_text("0 0 0 0 0 0 0 1\n")
                    store.publish(work, RECORD)
            except Exception as error:
                errors.append(error)

    threads = [threading.Thread(target=publish) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert {path.name for path in store.runs.iterdir()} == {RECORD.run_id}
    assert {path.name for path in store.folder(RECORD.run_id).iterdir()} == {RUN_FILE, "trajectory_online.txt"}
