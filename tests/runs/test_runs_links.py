"""Results folders that somebody else made: links that lead out of them, and pipes that nobody writes."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "reports"))

from reports_fake_store import add_run

from dynslam_bench.core.errors import DynslamError, RunError, StudyError
from dynslam_bench.core.files import claimed
from dynslam_bench.runs import RunStore
from dynslam_bench.runs.store import list_runs
from dynslam_bench.tuning.storage import JournalFile

SECRET = "the user's own words"


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    path = tmp_path / "secret.txt"
    path.write_text(SECRET)
    return path


@pytest.fixture
def filled(tmp_path: Path) -> tuple[RunStore, str]:
    store = RunStore(tmp_path / "results")
    return store, add_run(store, "a", "s/a", n=20)


@pytest.mark.parametrize("name", ["log.txt", "run.json", "trajectory_online.txt", "video.mp4"])
def test_a_run_with_a_link_to_elsewhere_is_one_unreadable_record(
    filled: tuple[RunStore, str], outside: Path, name: str
) -> None:
    store, run = filled
    (store.folder(run) / name).unlink(missing_ok=True)
    (store.folder(run) / name).symlink_to(outside)
    for found, (bad,) in (store.all(), list_runs(store)):
        assert found == [] and "is a link that leads out" in bad.reason and SECRET not in bad.reason
    assert store.get(run) is None


def test_links_within_the_store_are_followed(filled: tuple[RunStore, str]) -> None:
    store, run = filled
    kept = store.root / "kept.txt"
    (store.folder(run) / "log.txt").rename(kept)
    (store.folder(run) / "log.txt").symlink_to(kept)
    assert store.read_whole(run).run_id == run


def test_a_pipe_hangs_nothing(filled: tuple[RunStore, str]) -> None:
    store, run = filled
    record = store.folder(run) / "run.json"
    record.unlink()
    os.mkfifo(record)
    found, (bad,) = store.all()
    assert found == [] and bad.reason.endswith("run.json is no plain file")


@pytest.mark.parametrize("file", ["groundtruth.txt", "timestamps.txt"])
def test_the_truth_of_a_part_is_no_link_to_elsewhere(filled: tuple[RunStore, str], outside: Path, file: str) -> None:
    store, run = filled
    (part,) = (store.root / "sequences").iterdir()
    (part / file).unlink()
    (part / file).symlink_to(outside)
    metrics = store.score(store.read_whole(run))
    assert metrics.online is None and "leads out" in metrics.reasons["online"]
    with pytest.raises(RunError, match="leads out"):
        store.timestamps(part.name)


def test_nothing_is_written_through_links(filled: tuple[RunStore, str], outside: Path, tmp_path: Path) -> None:
    store, run = filled
    claim = store.runs / f".{run}.claim"
    claim.symlink_to(tmp_path / "new")
    with pytest.raises(DynslamError, match="cannot write"), claimed(claim):
        raise AssertionError("it is held")
    assert not (tmp_path / "new").exists()
    journal = tmp_path / "journal.log"
    journal.symlink_to(outside)
    with pytest.raises(StudyError, match="is a link"):
        JournalFile(journal)
    assert outside.read_text() == SECRET
