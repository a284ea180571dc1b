"""A study's storage under kills, full disks and workers that begin together; it runs no code and keeps no password."""

from __future__ import annotations

import errno
import multiprocessing
import os
from pathlib import Path
from typing import Any

import optuna
import pytest
from faults import in_a_small_process, survey

from dynslam_bench.core.errors import StudyError
from dynslam_bench.tuning.storage import JournalFile, open_database, open_storage
from dynslam_bench.tuning.study_file import StudySpec

LOSS = {"x": optuna.distributions.FloatDistribution(0, 1)}
SPEC = StudySpec(name="trust", tune=("synthetic/walking_xyz?frames=10",))


def add(path: Path, upto: int) -> None:
    """Open the study and add finished trials until it has so many."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    path.parent.mkdir(exist_ok=True)
    storage = optuna.storages.JournalStorage(JournalFile(path))
    study = optuna.create_study(storage=storage, study_name="s", load_if_exists=True)
    for number in range(len(study.trials), upto):
        study.add_trial(optuna.trial.create_trial(value=number / 8, params={"x": number / 8}, distributions=LOSS))


def values(path: Path) -> list[float]:
    storage = optuna.storages.JournalStorage(JournalFile(path))
    return [trial.value for trial in optuna.load_study(storage=storage, study_name="s").trials]


@in_a_small_process
def test_no_fault_spoils_a_journal(tmp_path: Path) -> None:
    path = tmp_path / "study" / "journal.log"
    ends = survey(lambda: add(path, 3), path.parent, result=lambda: values(path), faults=("kill", "full", "read-only"))
    assert values(path) == [0, 1 / 8, 2 / 8] and path.read_bytes().endswith(b"\n")
    assert ends.operations > 8 and ends.ends["kill", -9] == ends.operations and ends.ends["full", 3] > 3


def test_an_unfinished_line_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "journal.log"
    add(path, 2)
    with path.open("ab") as file:
        file.write(b'{"op_code": 4, "half')
    assert values(path) == [0, 1 / 8]
    add(path, 3)
    assert values(path) == [0, 1 / 8, 2 / 8]


def test_a_full_disk_leaves_the_journal_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "journal.log"
    add(path, 2)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StudyError, match="No space left on device"):
        add(path, 3)
    assert path.read_bytes() == before


def begin(url: str, barrier: Any, outcomes: Any) -> None:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    barrier.wait()
    try:
        optuna.create_study(storage=open_database(url), study_name="s", load_if_exists=True)
        outcomes.put("")
    except Exception as error:
        outcomes.put(f"{type(error).__name__}: {error}")


def test_workers_may_begin_on_an_empty_database_at_the_same_time(tmp_path: Path) -> None:
    """SQLite, with as many errors as PostgreSQL gives: without repeats three of four workers fail."""
    context = multiprocessing.get_context("fork")
    barrier, outcomes = context.Barrier(4), context.Queue()
    url = f"sqlite:///{tmp_path}/study.db"
    workers = [context.Process(target=begin, args=(url, barrier, outcomes)) for _ in range(4)]
    for worker in workers:
        worker.start()
    assert [outcomes.get(timeout=120) for _ in workers] == [""] * 4
    for worker in workers:
        worker.join()


@pytest.mark.parametrize("storage", ["redis://host/0", "postgres", "file:///x", "s3://bucket"])
def test_storages_that_may_hold_code_are_refused(tmp_path: Path, storage: str) -> None:
    with pytest.raises(StudyError, match="is of no kind that is known"):
        open_storage(tmp_path, SPEC.model_copy(update={"storage": storage}))


@pytest.mark.parametrize(
    "address",
    ["postgresql://me:s3cret@127.0.0.1:9/x", "mysql+nothing://me:s3cret@host/x", "postgresql://me:s3%63ret@127.0.0.1:9/x",
     "grpc://me:s3cret@host"],
)  # fmt: skip
def test_the_password_is_in_no_error_and_no_record(tmp_path: Path, address: str) -> None:
    spec = SPEC.model_copy(update={"storage": address})
    with pytest.raises(StudyError, match="cannot open the storage") as caught:
        open_storage(tmp_path, spec)
    assert "s3" not in str(caught.value) and caught.value.__cause__ is None
    assert "s3" not in str(spec.for_others())
