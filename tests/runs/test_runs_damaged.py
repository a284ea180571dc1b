"""A results folder of somebody else's: whatever a record says, nothing is written outside, and the rest is read."""

import json
import os
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reports_fake_store import add_run

from dynslam_bench.core.errors import DynslamError, ReportError, RunError, StudyError
from dynslam_bench.core.files import claimed
from dynslam_bench.envs.episode import FrameOutcome
from dynslam_bench.reports import build_report
from dynslam_bench.runs import RunStore, score
from dynslam_bench.runs.frames import FrameLog, FrameRow, read_csv
from dynslam_bench.runs.store import list_runs
from dynslam_bench.tuning.storage import JournalFile

FIXTURE = Path(__file__).resolve().parents[1] / "fixtures" / "results"
GOOD, BAD = "e7f8d4df9db4bb16", "a7abe04996a79cc4"


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    """Two sound runs in ``in/results``; nothing else lies in ``tmp_path``."""
    return RunStore(shutil.copytree(FIXTURE, tmp_path / "in" / "results"))


def edit(store: RunStore, **changes: Any) -> None:
    path = store.folder(BAD) / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def outside(tmp_path: Path) -> list[str]:
    return [str(path) for path in tmp_path.rglob("*") if path.relative_to(tmp_path).parts[0] != "in"]


@pytest.mark.parametrize("run_id", ["../../../out/x", "/tmp/out", "a7abe04996a79cc4\n", "A7ABE04996A79CC4", GOOD, ""])
def test_a_record_whose_id_is_not_its_folders_name_is_unreadable(store: RunStore, tmp_path: Path, run_id: str) -> None:
    edit(store, run_id=run_id)
    records, unreadable = store.all()
    assert [record.run_id for record in records] == [GOOD] and [bad.path.name for bad in unreadable] == [BAD]
    assert store.get(BAD) is None
    with pytest.raises(DynslamError, match=r"run_id|names itself"):
        store.read(BAD)
    build_report(str(store.root), tmp_path / "in" / "report")
    assert outside(tmp_path) == []


@pytest.mark.parametrize("part", ["../../../out", "/tmp/out", "x", ""])
def test_a_record_whose_part_is_a_path_is_unreadable(store: RunStore, part: str) -> None:
    sequence = json.loads((store.folder(BAD) / "run.json").read_text())["sequence"]
    for field in ("part", "block"):
        edit(store, sequence=sequence | {field: part or "."})
        assert [bad.path.name for bad in store.all()[1]] == [BAD]


@pytest.mark.parametrize("name", ["../../x", "/etc", "latest", ".", "", "a7abe04996a79cc"])
def test_no_folder_of_the_store_has_another_name_than_an_id(store: RunStore, name: str) -> None:
    asked: list[Callable[[str], object]] = [store.folder, store.get, store.trajectory]
    asked += [store.ground_truth, store.timestamps]
    for ask in asked:
        with pytest.raises(RunError, match="expected 16 hexadecimal digits"):
            ask(name)


@pytest.mark.parametrize("content", [b"\xff", b"", b"{}", b"[" * 10**5, b'{"reason": "\\ud800"}', b"null"])
def test_one_damaged_record_disables_nothing(store: RunStore, tmp_path: Path, content: bytes) -> None:
    (store.folder(BAD) / "run.json").write_bytes(content)
    records, unreadable = store.all()
    assert [record.run_id for record in records] == [GOOD] and len(unreadable) == 1
    assert "\n" not in unreadable[0].reason and str(store.folder(BAD)) in unreadable[0].reason
    assert build_report(str(store.root), tmp_path / "report").html.is_file()
    (store.folder(GOOD) / "run.json").write_bytes(content)
    with pytest.raises(ReportError, match="there are no runs in"):
        build_report(str(store.root), tmp_path / "none")


@pytest.mark.parametrize("file", ["trajectory_online.txt", "../../sequences/8a65f345d9b34895/groundtruth.txt",
                                  "../../sequences/8a65f345d9b34895/timestamps.txt"])  # fmt: skip
def test_a_damaged_trajectory_is_the_reason_why_there_is_no_error(store: RunStore, tmp_path: Path, file: str) -> None:
    (store.folder(BAD) / file).write_bytes(b"\xff\xfe")
    scored = score(store, store.read(BAD), again=True)
    assert scored.online is None and "is not a text file" in scored.reasons["online"]
    assert build_report(str(store.root), tmp_path / "report").html.is_file()


def test_a_store_that_can_only_be_read_is_scored(store: RunStore, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise sqlite3.OperationalError("attempt to write a readonly database")

    monkeypatch.setattr("sqlite3.connect", refuse)  # root may write anywhere
    assert score(store, store.read(BAD), "evo-default").metrics["ate_rmse_m"] > 0
    assert len(store.frame("evo-default")) == 2


@pytest.mark.parametrize(
    "line",
    ['{"index": 1}', "[]", "null", "\udcff", '{"index": 1, "timestamp": 1e400, "state": "ok"}', "[" * 9999,
     '{"index": 1, "timestamp": 2, "state": "ok", "pose": [0, 0, 0, 0, 0, 0, 0]}',
     '{"index": 1, "timestamp": 2, "state": "ok", "stats": {"a": "x"}}',
     '{"index": 1, "timestamp": 2, "state": "flying"}', '{"index": 1, "timestamp": 0.5, "state": "ok"}',
     '{"index": 1, "timestamp": 2, "state": "ok", "extra": 1}', '{"index": -1, "timestamp": 2, "state": "ok"}',
     '{"index": 99999999999999999999, "timestamp": 2, "state": "ok"}'],
)  # fmt: skip
def test_a_damaged_log_of_frames_is_taken_up_to_the_damage(tmp_path: Path, line: str) -> None:
    good = '{"index": 0, "timestamp": 1.0, "state": "ok", "pose": [0, 0, 0, 0, 0, 0, 1], "stats": {"a": 1}}'
    path = tmp_path / "frames.jsonl"
    path.write_bytes(f"{good}\n{line}\n{good}\n".encode(errors="surrogateescape"))
    log = FrameLog.read(path)
    rows, damage = log.rows, log.damage
    # a line that is no UTF-8 may take those before it in the same block with it
    assert len(rows) in ((0, 1) if "\udcff" in line else (1,)) and "is damaged" in damage and "\n" not in damage
    log.write(tmp_path, "comment")
    assert len(read_csv(tmp_path / "frames.csv")) == len(rows)


def test_stats_named_with_half_characters_are_stored(tmp_path: Path) -> None:
    path = tmp_path / "frames.jsonl"
    path.write_text(FrameRow.of(FrameOutcome(0, 1.0, "ok", np.eye(4), {"a\ud800": 1.0}, {}, None, 0.0)).to_json())
    FrameLog.read(path).write(tmp_path, "by \ud800")
    assert "stat_a\\ud800" in (tmp_path / "frames.csv").read_text()


@pytest.mark.parametrize(
    "table",
    ["index,timestamp,state,reward_m\n0,1.0,ok,0\n1,2.0\n", "a\n1\n",
     "index,timestamp,state,reward_m\n0,1.0,asleep,0\n", "\xff", "index\n" + "x" * 200_000,
     "index,timestamp,state,reward_m\n99999999999999999999,1.0,ok,0\n"],
)  # fmt: skip
def test_a_damaged_table_of_frames_is_one_clear_line(tmp_path: Path, table: str) -> None:
    path = tmp_path / "frames.csv"
    path.write_bytes(table.encode("latin-1"))
    with pytest.raises(RunError, match=r"row \d+ is damaged|is not a text file"):
        read_csv(path)


SECRET = "the user's own words"


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "secret.txt"
    path.write_text(SECRET)
    return path


@pytest.fixture
def filled(tmp_path: Path) -> tuple[RunStore, str]:
    store = RunStore(tmp_path / "results")
    return store, add_run(store, "a", "s/a", n=20)


@pytest.mark.parametrize("name", ["log.txt", "run.json", "trajectory_online.txt", "video.mp4"])
def test_a_run_with_a_link_to_elsewhere_is_one_unreadable_record(
    filled: tuple[RunStore, str], secret: Path, name: str
) -> None:
    store, run = filled
    (store.folder(run) / name).unlink(missing_ok=True)
    (store.folder(run) / name).symlink_to(secret)
    for found, (bad,) in (store.all(), list_runs(store)):
        assert not found and "is a link that leads out" in bad.reason and SECRET not in bad.reason
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
    assert not found and bad.reason.endswith("run.json is no plain file")


@pytest.mark.parametrize("file", ["groundtruth.txt", "timestamps.txt"])
def test_the_truth_of_a_part_is_no_link_to_elsewhere(filled: tuple[RunStore, str], secret: Path, file: str) -> None:
    store, run = filled
    (part,) = (store.root / "sequences").iterdir()
    (part / file).unlink()
    (part / file).symlink_to(secret)
    metrics = store.score(store.read_whole(run))
    assert metrics.online is None and "leads out" in metrics.reasons["online"]
    with pytest.raises(RunError, match="leads out"):
        store.timestamps(part.name)


def test_nothing_is_written_through_links(filled: tuple[RunStore, str], secret: Path, tmp_path: Path) -> None:
    store, run = filled
    claim = store.runs / f".{run}.claim"
    claim.symlink_to(tmp_path / "new")
    with pytest.raises(DynslamError, match="cannot write"), claimed(claim):
        raise AssertionError("it is held")
    assert not (tmp_path / "new").exists()
    journal = tmp_path / "journal.log"
    journal.symlink_to(secret)
    with pytest.raises(StudyError, match="is a link"):
        JournalFile(journal)
    assert secret.read_text() == SECRET
