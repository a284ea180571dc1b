"""The index of a store, and runs and frames as lists and tables: never stale, and one vocabulary."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from reports_fake_store import add_run

from dynslam_bench.contracts.tracker import TrackResult
from dynslam_bench.core.errors import RunError
from dynslam_bench.envs.slam_env import FrameOutcome
from dynslam_bench.evaluation.online import OnlineSample
from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.runs import RunStore, load_frames, score
from dynslam_bench.runs import store as store_module
from dynslam_bench.runs.artifacts import PICTURE, SNAPSHOTS_FILE, SPREAD, WORST, SnapshotWriter, read_snapshots, spread
from dynslam_bench.runs.frames import FrameLog, FrameRow, read_csv, write_csv
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


ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "tests" / "fixtures" / "results"
ROWS = [
    FrameRow(0, 1.5, "ok", 0.05, 0.15, 0.0, 0.0, -0.0, 0.25, {"total": 0.1}, {"culled": 3.0}, [0.0] * 6 + [1.0], 0.5),
    FrameRow(1, 1.625, "dropped"),
    FrameRow(
        2, 1.75, "lost", 0.1, 0.2, 0.30000000000000004, 0.4, -0.1, None, {"total": 1e-9, "flow": 2.0}, {"f_s": 1.0}
    ),
]


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    return RunStore(shutil.copytree(RESULTS, tmp_path / "results"))


def test_the_log_gives_back_every_row_and_leaves_out_an_unfinished_one(tmp_path: Path) -> None:
    (tmp_path / "log").write_text("".join(row.to_json() for row in ROWS) + ROWS[0].to_json()[:40])
    assert FrameLog.read(tmp_path / "log") == FrameLog(ROWS)
    assert FrameLog.read(tmp_path / "none") == FrameLog()


def test_the_table_gives_back_all_but_the_poses(tmp_path: Path) -> None:
    write_csv(tmp_path / "without.csv", ROWS[1:])
    assert "dynamic_share" not in (tmp_path / "without.csv").read_text(), "no frame has exact masks"
    write_csv(tmp_path / "frames.csv", ROWS)
    head = (tmp_path / "frames.csv").read_text().splitlines()[0]
    assert head.split(",")[-4:] == ["total_s", "flow_s", "stat_culled", "stat_f_s"]
    found = read_csv(tmp_path / "frames.csv")
    assert [row.cells() for row in found] == [row.cells() for row in ROWS]
    assert [row.pose for row in found] == [None] * 3


def test_frames_of_a_run_by_record_id_and_path(store: RunStore) -> None:
    record = store.read("a7")
    frame = load_frames(record, store)
    assert [str(kind) for kind in frame.dtypes[:4]] == ["int64", "float64", "string", "Float64"]
    assert {str(kind) for kind in frame.dtypes[8:]} == {"Float64"}
    assert frame["frame_error_trans_m"].isna().tolist() == [True] + [False] * 7 and frame["mask_iou"].isna().all()
    folder = store.folder(record.run_id)
    for name in (load_frames("a7abe", store), load_frames(folder), load_frames(str(folder / "frames.csv"))):
        pd.testing.assert_frame_equal(name, frame)
    with pytest.raises(RunError, match="there is no run 'b'"):
        load_frames("b", store)
    with pytest.raises(RunError, match="cannot read"):
        load_frames(store.root)


def test_a_row_a_run(store: RunStore) -> None:
    frame = store.frame()
    records, _ = store.all()
    assert frame["run_id"].tolist() == [record.run_id for record in records]
    assert frame["ate_rmse_m"].tolist() == [score(store, record).metrics["ate_rmse_m"] for record in records]
    assert frame["frame_ms"][1] == 1000 * records[1].frame_time_s and frame["frames"].tolist() == ["0:8"] * 2
    kinds = {
        name: str(frame[name].dtype) for name in ("label", "seed", "keyframes", "ate_rmse_m", "mask_iou", "started")
    }
    assert list(kinds.values()) == ["string", "Int64", "Int64", "Float64", "Float64", "datetime64[us, UTC]"]
    missing = frame[["keyframes", "mask_iou", "reason", "noise", "settings"]]
    assert missing.isna().all(axis=None) and missing.notna().sum().sum() == 0
    other = store.frame("evo-default")
    assert set(other["protocol_id"]) == {"evo-default"} and set(frame["protocol_id"]) == {"tum-rgbd/v1"}


def test_trials_of_studies_are_left_out_unless_asked_for(store: RunStore) -> None:
    records, _ = store.all()
    trial = records[0].model_copy(update={"study": "thresholds", "overrides": {"frames": 3}})
    (store.folder(trial.run_id) / "run.json").write_text(trial.to_json())
    assert store.frame()["run_id"].tolist() == [records[1].run_id]
    everything = store.frame(trials=True)
    assert everything["study"].tolist() == ["thresholds", pd.NA] and everything["study"].dtype == "string"
    assert store.frame()["study"].isna().all()


SHAPE = (48, 65, 3)
IMAGE = np.full(SHAPE, 90, np.uint8)


def outcome(index: int, error_m: float | None) -> FrameOutcome:
    sample = OnlineSample(trans_m=0.0, rot_deg=0.0, frame_trans_m=error_m, frame_rot_deg=0.0)
    return FrameOutcome(index, float(index), "ok", np.eye(4), {}, {}, sample, 0.0)


def result(index: int) -> TrackResult:
    rng = np.random.default_rng(index)
    points = rng.uniform(0, 48, (index % 7, 2)).astype(np.float32)
    mask = None if index % 2 else rng.random(SHAPE[:2]) > 0.5
    kept = np.asarray(rng.random(len(points)) > 0.5)
    return TrackResult(np.eye(4), "ok", dynamic_mask=mask, keypoints_xy=points, keypoints_keep=kept)


def test_the_spread_and_the_worst_frames_come_back_as_they_were(tmp_path: Path) -> None:
    bad = [11, 50, 51, 99, 150, 151, 152, 198]
    writer = SnapshotWriter(tmp_path, 200)
    for index in range(200):
        writer.add(outcome(index, 1.0 + index if index in bad else 0.01), IMAGE, result(index))
    writer.write()
    size, shots = read_snapshots(tmp_path)
    assert size == SHAPE[:2]
    even = spread(200)
    assert len(even) == SPREAD and {0, 199} <= set(even)
    assert [shot.index for shot in shots] == sorted({*even, *[b for b in bad if b not in even][-WORST:]})
    for shot, true in zip(shots, [result(shot.index) for shot in shots], strict=True):
        assert true.keypoints_xy is not None and shot.points.tolist() == true.keypoints_xy.round().tolist()
        assert np.array_equal(shot.kept, np.asarray(true.keypoints_keep))
        assert (shot.mask is None) == (true.dynamic_mask is None)
        assert shot.mask is None or np.array_equal(shot.mask, np.asarray(true.dynamic_mask))
    assert any(shot.mask is None for shot in shots) and any(shot.mask is not None for shot in shots)
    assert sorted(tmp_path.glob("*.webp")) == [tmp_path / PICTURE.format(shot.index) for shot in shots]


def test_pictures_show_features_and_mask_and_the_frame_on_which_tracking_was_lost(tmp_path: Path) -> None:
    writer = SnapshotWriter(tmp_path, 300)
    seen = TrackResult(
        np.eye(4), "ok", dynamic_mask=np.arange(65) < np.full((48, 1), 30),
        keypoints_xy=np.array([[50, 20], [10, 20]], np.float32), keypoints_keep=np.array([True, False]),
    )  # fmt: skip
    for index in range(300):
        state = "lost" if 100 <= index < 110 else "ok"
        writer.add(replace(outcome(index, None if state == "lost" else 0.01), state=state), IMAGE, seen)
    assert (tmp_path / PICTURE.format(100)).is_file(), "written at once"
    assert not (tmp_path / PICTURE.format(101)).is_file()
    picture = np.asarray(cv2.imread(str(tmp_path / PICTURE.format(100))), dtype=float)[:, :, ::-1]
    yellow, plain = picture[200, 60:120].mean(axis=0), picture[250, 350:].mean(axis=0)
    assert yellow[:2].min() > yellow[2] + 30 and np.ptp(plain) < 10
    static, dynamic = (picture[115:131, x - 8 : x + 8].reshape(-1, 3) for x in (308, 62))
    assert (static[:, 2] - static[:, 0]).max() > 40, "blue"
    assert (dynamic[:, 0] - dynamic[:, 1]).max() > 40, "red"


def test_trackers_that_show_nothing_leave_no_file(tmp_path: Path) -> None:
    writer = SnapshotWriter(tmp_path, 2)
    for index in range(2):
        writer.add(outcome(index, 0.1), IMAGE, TrackResult(np.eye(4), "ok"))
    writer.write()
    assert not (tmp_path / SNAPSHOTS_FILE).exists()
    assert read_snapshots(tmp_path) == ((0, 0), [])


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 half of one"])
def test_a_damaged_file_is_one_clear_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / SNAPSHOTS_FILE).write_bytes(content)
    with pytest.raises(RunError, match=r"holds no (snapshots|arrays)"):
        read_snapshots(tmp_path)
