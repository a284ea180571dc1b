"""The journal and the database of a study under kills, full disks and workers that begin at the same time."""

from __future__ import annotations

import errno
import multiprocessing
import os
import sqlite3
from pathlib import Path

import optuna
import pytest
from faults import survey

from dynslam_bench.core.errors import StudyError
from dynslam_bench.tuning import storage as database
from dynslam_bench.tuning.storage import JournalFile, open_database

LOSS = {"x": optuna.distributions.FloatDistribution(0, 1)}


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


def test_no_fault_spoils_a_journal(tmp_path: Path) -> None:
    path = tmp_path / "study" / "journal.log"
    found = survey(lambda: add(path, 3), path.parent, result=lambda: values(path), faults=("kill", "full", "read-only"))
    assert values(path) == [0, 1 / 8, 2 / 8] and path.read_bytes().endswith(b"\n")
    assert found.operations > 8 and found.ends["kill", -9] == found.operations and found.ends["full", 3] > 3


def test_a_torn_line_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "journal.log"
    add(path, 2)
    with path.open("ab") as file:
        file.write(b'{"op_code": 4, "half')
    assert values(path) == [0, 1 / 8]
    add(path, 3)
    assert values(path) == [0, 1 / 8, 2 / 8]


def test_a_full_disk_takes_back_what_did_not_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "journal.log"
    add(path, 2)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StudyError, match=r"cannot write .*journal\.log: No space left on device"):
        add(path, 3)
    assert path.read_bytes() == before


def begin(url: str, barrier, outcomes) -> None:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    barrier.wait()
    try:
        optuna.create_study(storage=open_database(url), study_name="s", load_if_exists=True)
        outcomes.put("")
    except Exception as error:
        outcomes.put(f"{type(error).__name__}: {error}")


def test_workers_that_begin_on_an_empty_database_at_the_same_time(tmp_path: Path) -> None:
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


def test_a_lost_connection_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = optuna.create_study(storage=open_database(f"sqlite:///{tmp_path}/study.db"), study_name="s")
    backend = study._storage._backend  # Optuna names it nowhere: the engine below its cache
    away = iter([True, True, False])
    connect = backend.engine.dialect.connect

    def restarting(*arguments, **named):
        if next(away, False):
            raise sqlite3.OperationalError("the database system is starting up")
        return connect(*arguments, **named)

    monkeypatch.setattr(backend.engine.dialect, "connect", restarting)
    monkeypatch.setattr(database.time, "sleep", lambda _: None)
    backend.engine.dispose()
    study.add_trial(optuna.trial.create_trial(value=1.0))
    assert [trial.value for trial in study.trials] == [1.0] and next(away, "none") == "none"
