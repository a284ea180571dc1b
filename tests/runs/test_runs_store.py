"""The store: identity, listing, damaged folders, what killed processes leave, and faults at every operation."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pandas as pd
import pytest
from helpers.envs_toys import TARGET
from helpers.reports_fake_store import add_run

from dynslam_bench.contracts import TrackResult
from dynslam_bench.core import DynslamError, ReportError, RunError, StudyError, try_lock
from dynslam_bench.envs import FrameOutcome
from dynslam_bench.evaluation import OnlineSample, get_protocol
from dynslam_bench.reports import build_report
from dynslam_bench.runs import (
    RunRecord,
    RunSpec,
    RunStore,
    list_runs,
    load_frames,
    make_run_row,
    open_store,
    rescore,
    resolve,
    score,
)
from dynslam_bench.runs import listing as listing_module
from dynslam_bench.runs import store as store_module
from dynslam_bench.runs.artifacts import (
    PICTURE,
    SNAPSHOTS_FILE,
    SPREAD,
    WORST,
    SnapshotWriter,
    read_snapshots,
    spread,
)
from dynslam_bench.runs.frames import FrameLog, FrameRow, read_csv, write_csv
from dynslam_bench.runs.rows import FIELDS
from dynslam_bench.tuning.storage import JournalFile


def test_run_id_depends_on_what_matters_and_on_nothing_else(
    toy_folder: str, tmp_path: Path
) -> None:
    base = {"tracker": TARGET, "sequence": toy_folder}
    first = resolve(RunSpec(**base)).run_id
    assert len(first) == 20
    assert resolve(RunSpec(**base)).run_id == first
    same = [
        {"settings": {"noise.clip": "2.0"}},
        {"settings": {"noise.clip": 2}},
        {"limits": {"time_s": 5}},
        {"video": True},
        {"sheet": True},
        {"degrade": {"blur": 0.0}},
        {"data_root": str(tmp_path)},
        {"frames": "0:60"},
        {"frames": (0, 900)},
        {"offset": 0},
    ]
    assert {resolve(RunSpec(**(base | change))).run_id for change in same} == {first}
    other = [
        {"seed": 1},
        {"settings": {"noise.clip": 2.5}},
        {"frames": (0, 30)},
        {"stride": 2},
        {"threads": 2},
        {"degrade": {"blur": 0.1}},
        {"drop_share": 0.1},
        {"realtime": True},
        {"offset": 3},
        {"frames": (3, None)},
        {"tracker": TARGET.replace(":SPEC", ":FIXED")},
    ]
    ids = [resolve(RunSpec(**(base | change))).run_id for change in other]
    assert len({first, *ids}) == len(ids) + 1


def test_a_part_has_one_run_id_however_it_is_written() -> None:
    def ids(sequence: str, **change) -> str:
        return resolve(
            RunSpec(tracker="never-move", sequence=f"synthetic/walking_xyz{sequence}", **change)
        ).run_id

    first = ids("", frames="0:60")
    assert ids("?frames=60") == ids("?scene=0&frames=60") == ids("?frames=90", frames=":60")
    assert ids("@0?frames=60") == ids("?scene=000", frames=(0, 60)) == first
    assert ids("?frames=60") == first != ids("?frames=61")
    assert (
        len(
            {
                first,
                ids("?frames=60&noise=1"),
                ids("?frames=60&noise=2"),
                ids("?frames=60", offset=1),
            }
        )
        == 4
    )


@pytest.mark.slow
def test_what_a_plug_in_that_a_setting_names_reads_is_recorded(
    toy_folder: str, tmp_path: Path
) -> None:
    specs = {
        "features.extractor": "from dynslam_bench.features.registry import FeatureSpec as Spec",
        "flow.plugin": "from dynslam_bench.flow.registry import FlowSpec as Spec",
        "segmentation.source": "from dynslam_bench.segmentation.build_segmenter import SegmenterSpec as Spec",
    }
    for name, text in specs.items():
        plugin = tmp_path / name / "mine.py"
        plugin.parent.mkdir()
        plugin.write_text(f'{text}\n\nSPEC = Spec("mine", f"{{__file__}}:build")\n')
        value = f"plugin:{plugin}:SPEC" if name == "segmentation.source" else f"{plugin}:SPEC"
        spec = RunSpec(
            tracker="emfoa-oft",
            sequence=toy_folder,
            settings={"segmentation.source": "embedded", name: value},
        )
        run = resolve(spec)
        assert run.has_plugins_or_programs, name
        assert "plugin:/mine.py:build" in run.identity["parts"], name
        assert run.base_folders.plugin == plugin.parent


def test_listing_finding_and_removing(store: RunStore) -> None:
    first, second = (
        add_run(store, "a", "s/a", seed, n=20, started=f"2026-01-0{seed + 1}") for seed in (0, 1)
    )
    records, unreadable = store.all()
    assert [record.run_id for record in records] == [first, second]
    assert not unreadable
    assert store.find(first[:10]) == first
    assert store.find("latest") == second
    assert store.read("latest") == store.read(second)
    for name, words in (("zzzz", "no run 'zzzz'"), ("", r"2 runs begin|no run ''")):
        with pytest.raises(RunError, match=words):
            store.find(name)
    store.remove(first[:12])
    assert store.ids() == [second]
    store.remove("latest")
    assert store.ids() == []
    assert not (store.root / "latest").is_symlink()
    with pytest.raises(RunError, match="there are no runs in"):
        store.read("latest")


def test_a_newer_record_is_refused_not_misread(tmp_path: Path) -> None:
    text = (Path(__file__).parent / "data" / "run.json").read_text()
    for old, new, words in (
        ('"coverage"', '"coverage_new"', "coverage_new"),
        ('schema_version": 1', 'schema_version": 99', "a newer dynslam-bench"),
    ):
        (tmp_path / "run.json").write_text(text.replace(old, new, 1))
        with pytest.raises(DynslamError, match=words):
            RunRecord.read(tmp_path / "run.json")


@pytest.mark.slow
def test_what_a_killed_process_left_is_swept_up_and_nothing_else(tmp_path: Path) -> None:
    root = tmp_path / "results"
    code = (
        f"import os, sys; sys.path[:0] = {sys.path!r}\n"
        "from dynslam_bench.runs import RunStore\n"
        f"store = RunStore({str(root)!r}); store.prepare()\n"
        f"with store.work_folder({'a' * 16!r}) as work, store.claim({'a' * 16!r}) as mine:\n"
        "    assert mine; os.kill(os.getpid(), 9)\n"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == -signal.SIGKILL
    runs = root / "runs"
    assert len(list(runs.iterdir())) == 2
    (runs / ".git").mkdir()
    store = RunStore(root)
    with store.work_folder("b" * 16) as alive, store.claim("b" * 16) as mine:
        assert mine
        RunStore(root).prepare()
        assert {path.name for path in runs.iterdir()} == {alive.name, f".{'b' * 16}.claim", ".git"}
    assert {path.name for path in runs.iterdir()} == {".git"}


# The index of a store, and runs and frames as lists and tables: never stale, and one vocabulary.


PROTOCOL = get_protocol("tum-rgbd/v1")


@pytest.fixture
def filled(tmp_path: Path) -> tuple[RunStore, list[str]]:
    store = RunStore(tmp_path / "results")
    ids = [
        add_run(store, "a", "s/a", seed, n=40, started=f"2026-01-0{3 - seed}T00:00:00+00:00")
        for seed in range(3)
    ]
    return store, ids


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
    assert [row["run_id"] for row in rows] == ids[::-1]
    assert unreadable == []
    for row in rows:
        record = store.read(row["run_id"])
        assert row == make_run_row(record, store.score(record))
        assert tuple(row) == FIELDS
    reads.clear()
    assert list_runs(store) == (rows, [])
    assert reads == []


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
def test_an_edited_trajectory_or_truth_is_not_scored_until_it_is_put_back(
    filled, file: str
) -> None:
    store, ids = filled
    record = store.read_whole(ids[0])
    before = store.score(record)
    list_runs(store)
    folder = (
        store.folder(ids[0])
        if "online" in file
        else store.root / "sequences" / record.sequence.part
    )
    text = (folder / file).read_text()
    shift(folder / file)
    assert f"{file} was changed since run {ids[0]}" in store.score(record).reasons["online"]
    assert {row["run_id"]: row["ate_rmse_m"] for row in list_runs(store)[0]}[ids[0]] is None
    (folder / file).write_text(text)
    assert store.score(record) == before


def test_metrics_hold_for_one_version_of_the_code(filled, monkeypatch: pytest.MonkeyPatch) -> None:
    store, ids = filled
    record = store.read_whole(ids[0])
    assert store.score(record) == store.metrics(record, PROTOCOL)
    monkeypatch.setattr(store_module, "evaluation_code", lambda: "newer")
    assert store.metrics(record, PROTOCOL) is None
    assert store.score(record).code == "newer"
    monkeypatch.undo()
    rows, _ = list_runs(store)
    for module in (listing_module, store_module):
        monkeypatch.setattr(module, "module_graph", lambda: Mock(digest=lambda *_: "another"))
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
    store.add_metrics(
        record, scored.model_copy(update={"online": None, "code": "older"}), "another state"
    )
    store.score(record, "evo-default")
    outcomes = {outcome.protocol: outcome.changed for outcome in rescore(store)}
    assert outcomes == {"tum-rgbd/v1": (ids[0],), "evo-default": ()}
    assert store.metrics(record, PROTOCOL) == scored


def rewritten(command: str):
    def change(path: Path) -> None:
        with sqlite3.connect(path) as connection:
            connection.execute(command)
        connection.close()

    return change


DAMAGES = {
    "empty": lambda path: path.write_bytes(b""),
    "no database": lambda path: path.write_bytes(b"x" * 5000),
    "a torn database": lambda path: path.write_bytes(path.read_bytes()[:5000]),
    "no table": rewritten("DROP TABLE computed"),
    "another table": rewritten("ALTER TABLE computed RENAME COLUMN value TO other"),
    "values of other runs": rewritten(
        "UPDATE computed SET value = (SELECT value FROM computed LIMIT 1)"
    ),
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
    assert list_runs(store) == (rows, [])
    assert store.score(record) == scored
    assert list_runs(store) == (rows, [])
    assert store.score(record) == scored


@pytest.mark.parametrize("place", ["folder", "pipe", "link"])
def test_what_is_no_database_is_neither_read_nor_written(
    filled, place: str, tmp_path: Path
) -> None:
    store, ids = filled
    rows, _ = list_runs(store)
    store.index.path.unlink()
    outside = tmp_path / "outside"
    outside.write_bytes(b"")
    make = {"folder": Path.mkdir, "pipe": os.mkfifo, "link": lambda path: path.symlink_to(outside)}
    make[place](store.index.path)
    assert list_runs(store) == (rows, [])
    assert store.score(store.read_whole(ids[0])).run_id == ids[0]
    assert outside.read_bytes() == b""
    assert store.index.names() == set()
    store.remove(ids[0])


def test_a_link_in_a_folder_is_seen_behind_its_back(filled, tmp_path: Path) -> None:
    store, ids = filled
    list_runs(store)
    name = f"list {PROTOCOL.digest()}"
    version = None
    with sqlite3.connect(store.index.path) as connection:
        ((version,),) = connection.execute(
            "SELECT DISTINCT version FROM computed WHERE name = ?", (name,)
        )
    (store.folder(ids[0]) / "video.webm").symlink_to(tmp_path)
    assert set(store.index.read(name, version, ids)) == set(ids)
    assert set(store.index.read(name, version, ids, check_links=True)) == set(ids[1:])


ROWS = [
    FrameRow(
        0,
        1.5,
        "ok",
        0.05,
        0.15,
        0.0,
        0.0,
        -0.0,
        0.25,
        {"total": 0.1},
        {"culled": 3.0},
        [0.0] * 6 + [1.0],
        0.5,
    ),
    FrameRow(1, 1.625, "dropped"),
    FrameRow(
        2,
        1.75,
        "lost",
        0.1,
        0.2,
        0.30000000000000004,
        0.4,
        -0.1,
        None,
        {"total": 1e-9, "flow": 2.0},
        {"f_s": 1.0},
    ),
]


@pytest.fixture
def two_runs(tmp_path: Path) -> RunStore:
    """Two sound runs in ``in/results``; nothing else lies in ``tmp_path``."""
    return RunStore(
        shutil.copytree(
            Path(__file__).parents[1] / "fixtures" / "results", tmp_path / "in" / "results"
        )
    )


def test_the_log_gives_back_every_row_and_leaves_out_an_unfinished_one(tmp_path: Path) -> None:
    (tmp_path / "log").write_text("".join(row.to_json() for row in ROWS) + ROWS[0].to_json()[:40])
    assert [FrameLog.read(tmp_path / name) for name in ("log", "none")] == [
        FrameLog(ROWS),
        FrameLog(),
    ]


def test_the_table_gives_back_all_but_the_poses(tmp_path: Path) -> None:
    write_csv(tmp_path / "without.csv", ROWS[1:])
    assert "dynamic_share" not in (tmp_path / "without.csv").read_text(), "no frame has exact masks"
    write_csv(tmp_path / "frames.csv", ROWS)
    head = (tmp_path / "frames.csv").read_text().splitlines()[0]
    assert head.split(",")[-4:] == ["total_s", "flow_s", "stat_culled", "stat_f_s"]
    rows = [(row.cells(), row.pose) for row in read_csv(tmp_path / "frames.csv")]
    assert rows == [(row.cells(), None) for row in ROWS]


def test_frames_of_a_run_by_record_id_and_path(two_runs: RunStore) -> None:
    record = two_runs.read("a7")
    frame = load_frames(record, two_runs)
    assert [str(kind) for kind in frame.dtypes[:4]] == ["int64", "float64", "string", "Float64"]
    assert {str(kind) for kind in frame.dtypes[8:]} == {"Float64"}
    assert frame["frame_error_trans_m"].isna().tolist() == [True] + [False] * 7
    assert frame["mask_iou"].isna().all()
    folder = two_runs.folder(record.run_id)
    for name in (
        load_frames("a7abe", two_runs),
        load_frames(folder),
        load_frames(str(folder / "frames.csv")),
    ):
        pd.testing.assert_frame_equal(name, frame)
    with pytest.raises(RunError, match="there is no run 'b'"):
        load_frames("b", two_runs)
    with pytest.raises(RunError, match="cannot read"):
        load_frames(two_runs.root)


def test_a_row_a_run(two_runs: RunStore) -> None:
    frame = two_runs.frame()
    records, _ = two_runs.all()
    assert frame["run_id"].tolist() == [record.run_id for record in records]
    assert frame["ate_rmse_m"].tolist() == [
        score(two_runs, record).metrics["ate_rmse_m"] for record in records
    ]
    assert frame["frame_ms"][1] == 1000 * records[1].frame_time_s
    assert frame["frames"].tolist() == ["0:8"] * 2
    kinds = {
        name: str(frame[name].dtype)
        for name in ("label", "seed", "keyframes", "ate_rmse_m", "mask_iou", "started")
    }
    assert list(kinds.values()) == [
        "string",
        "Int64",
        "Int64",
        "Float64",
        "Float64",
        "datetime64[us, UTC]",
    ]
    missing = frame[["keyframes", "mask_iou", "reason", "noise", "settings"]]
    assert missing.isna().all(axis=None)
    assert missing.notna().sum().sum() == 0
    other = two_runs.frame("evo-default")
    assert set(other["protocol_id"]) == {"evo-default"}
    assert set(frame["protocol_id"]) == {"tum-rgbd/v1"}


def test_trials_of_studies_are_left_out_unless_asked_for(two_runs: RunStore) -> None:
    records, _ = two_runs.all()
    trial = records[0].model_copy(update={"study": "thresholds", "overrides": {"frames": 3}})
    (two_runs.folder(trial.run_id) / "run.json").write_text(trial.to_json())
    assert two_runs.frame()["run_id"].tolist() == [records[1].run_id]
    everything = two_runs.frame(trials=True)
    assert everything["study"].tolist() == ["thresholds", pd.NA]
    assert everything["study"].dtype == "string"
    assert two_runs.frame()["study"].isna().all()


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
    assert len(even) == SPREAD
    assert {0, 199} <= set(even)
    assert [shot.index for shot in shots] == sorted(
        {*even, *[b for b in bad if b not in even][-WORST:]}
    )
    for shot, true in zip(shots, [result(shot.index) for shot in shots], strict=True):
        assert true.keypoints_xy is not None
        assert shot.points.tolist() == true.keypoints_xy.round().tolist()
        assert np.array_equal(shot.kept, np.asarray(true.keypoints_keep))
        assert (shot.mask is None) == (true.dynamic_mask is None)
        assert shot.mask is None or np.array_equal(shot.mask, np.asarray(true.dynamic_mask))
    assert any(shot.mask is None for shot in shots)
    assert any(shot.mask is not None for shot in shots)
    assert sorted(tmp_path.glob("*.webp")) == [
        tmp_path / PICTURE.format(shot.index) for shot in shots
    ]


def test_pictures_show_features_and_mask_and_the_frame_on_which_tracking_was_lost(
    tmp_path: Path,
) -> None:
    writer = SnapshotWriter(tmp_path, 300)
    seen = TrackResult(
        np.eye(4), "ok", dynamic_mask=np.arange(65) < np.full((48, 1), 30),
        keypoints_xy=np.array([[50, 20], [10, 20]], np.float32), keypoints_keep=np.array([True, False]),
    )  # fmt: skip
    for index in range(300):
        state = "lost" if 100 <= index < 110 else "ok"
        writer.add(
            replace(outcome(index, None if state == "lost" else 0.01), state=state), IMAGE, seen
        )
    assert (tmp_path / PICTURE.format(100)).is_file(), "written at once"
    assert not (tmp_path / PICTURE.format(101)).is_file()
    picture = np.asarray(cv2.imread(str(tmp_path / PICTURE.format(100))), dtype=float)[:, :, ::-1]
    yellow = picture[200, 60:120].mean(axis=0)
    plain = picture[250, 350:].mean(axis=0)
    assert yellow[:2].min() > yellow[2] + 30
    assert np.ptp(plain) < 10
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


GOOD = "e7f8d4df9db4bb16"
BAD = "a7abe04996a79cc4"


def edit(two_runs: RunStore, **changes: Any) -> None:
    path = two_runs.folder(BAD) / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def outside(tmp_path: Path) -> list[str]:
    return [
        str(path) for path in tmp_path.rglob("*") if path.relative_to(tmp_path).parts[0] != "in"
    ]


@pytest.mark.parametrize(
    "run_id", ["../../../out/x", "/tmp/out", "a7abe04996a79cc4\n", "A7ABE04996A79CC4", GOOD, ""]
)
def test_a_record_whose_id_is_not_its_folders_name_is_unreadable(
    two_runs: RunStore, tmp_path: Path, run_id: str
) -> None:
    edit(two_runs, run_id=run_id)
    records, unreadable = two_runs.all()
    assert [record.run_id for record in records] == [GOOD]
    assert [bad.path.name for bad in unreadable] == [BAD]
    assert two_runs.get(BAD) is None
    with pytest.raises(DynslamError, match=r"run_id|names itself"):
        two_runs.read(BAD)
    assert outside(tmp_path) == []


@pytest.mark.parametrize("part", ["../../../out", "/tmp/out", "x", ""])
def test_a_record_whose_part_is_a_path_is_unreadable(two_runs: RunStore, part: str) -> None:
    sequence = json.loads((two_runs.folder(BAD) / "run.json").read_text())["sequence"]
    for field in ("part", "block"):
        edit(two_runs, sequence=sequence | {field: part or "."})
        assert [bad.path.name for bad in two_runs.all()[1]] == [BAD]


@pytest.mark.parametrize("name", ["../../x", "/etc", "latest", ".", "", "a7abe04996a79cc"])
def test_no_folder_of_the_store_has_another_name_than_an_id(two_runs: RunStore, name: str) -> None:
    for ask in (
        two_runs.folder,
        two_runs.get,
        two_runs.trajectory,
        two_runs.ground_truth,
        two_runs.timestamps,
    ):
        with pytest.raises(RunError, match="expected 20 hexadecimal digits"):
            ask(name)


@pytest.mark.parametrize(
    "content", [b"\xff", b"", b"{}", b"[" * 10**5, b'{"reason": "\\ud800"}', b"null"]
)
def test_one_damaged_record_disables_nothing(two_runs: RunStore, content: bytes) -> None:
    (two_runs.folder(BAD) / "run.json").write_bytes(content)
    records, unreadable = two_runs.all()
    assert [record.run_id for record in records] == [GOOD]
    assert len(unreadable) == 1
    for _ in range(2):
        assert [bad.path for bad in list_runs(two_runs)[1]] == [two_runs.folder(BAD)]
    assert "\n" not in unreadable[0].reason
    assert str(two_runs.folder(BAD)) in unreadable[0].reason


def test_a_report_is_made_of_the_sound_records_alone(two_runs: RunStore, tmp_path: Path) -> None:
    edit(two_runs, run_id="../../../out/x")
    assert build_report(str(two_runs.root), tmp_path / "in" / "report").html.is_file()
    assert outside(tmp_path) == []
    (two_runs.folder(GOOD) / "run.json").write_bytes(b"")
    with pytest.raises(ReportError, match="there are no runs in"):
        build_report(str(two_runs.root), tmp_path / "in" / "none")


@pytest.mark.parametrize("file", ["trajectory_online.txt", "../../sequences/8a65f345d9b34895/groundtruth.txt",
                                  "../../sequences/8a65f345d9b34895/timestamps.txt"])  # fmt: skip
def test_a_damaged_trajectory_is_the_reason_why_there_is_no_error(
    two_runs: RunStore, file: str
) -> None:
    (two_runs.folder(BAD) / file).write_bytes(b"\xff\xfe")
    scored = score(two_runs, two_runs.read(BAD), again=True)
    assert scored.online is None
    assert "is not a text file" in scored.reasons["online"]
    # one line names the run and the fault; a shared truth is that of both runs
    (outcome,) = rescore(two_runs)
    assert outcome.runs == 2 - len(outcome.unreadable) == int("online" in file)
    assert f"{two_runs.folder(BAD)}: {scored.reasons['online']}" in outcome.unreadable


def test_faults_in_an_archive_name_the_archive(two_runs: RunStore, tmp_path: Path) -> None:
    (two_runs.folder(BAD) / "trajectory_online.txt").write_bytes(b"\xff\xfe")
    (two_runs.folder(GOOD) / "run.json").write_bytes(b"\xff\xfe")
    store = open_store(shutil.make_archive(str(tmp_path / "packed"), "zip", two_runs.root.parent))
    lines = [*rescore(store)[0].unreadable, store.score(store.read(BAD)).reasons["online"]]
    assert all("packed.zip" in line and "dynslam-private" not in line for line in lines), lines


def test_a_store_that_can_only_be_read_is_scored(
    two_runs: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusal = sqlite3.OperationalError("attempt to write a readonly database")
    monkeypatch.setattr("sqlite3.connect", Mock(side_effect=refusal))  # root may write anywhere
    assert score(two_runs, two_runs.read(BAD), "evo-default").metrics["ate_rmse_m"] > 0
    assert len(two_runs.frame("evo-default")) == 2


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
    # a line that is no UTF-8 may take those before it in the same block with it
    assert len(log.rows) in ((0, 1) if "\udcff" in line else (1,))
    assert "is damaged" in log.damage
    assert "\n" not in log.damage
    log.write(tmp_path, "comment")
    assert len(read_csv(tmp_path / "frames.csv")) == len(log.rows)


def test_stats_named_with_half_characters_are_stored(tmp_path: Path) -> None:
    path = tmp_path / "frames.jsonl"
    path.write_text(
        FrameRow.of(
            FrameOutcome(0, 1.0, "ok", np.eye(4), {"a\ud800": 1.0}, {}, None, 0.0)
        ).to_json()
    )
    FrameLog.read(path).write(tmp_path, "by \ud800")
    assert "stat_a\\ud800" in (tmp_path / "frames.csv").read_text()


SECRET = "the user's own words"


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "secret.txt"
    path.write_text(SECRET)
    return path


@pytest.fixture
def one_run(tmp_path: Path) -> tuple[RunStore, str]:
    store = RunStore(tmp_path / "results")
    return store, add_run(store, "a", "s/a", n=20)


@pytest.mark.parametrize("name", ["log.txt", "run.json", "trajectory_online.txt", "video.mp4"])
def test_a_run_with_a_link_to_elsewhere_is_one_unreadable_record(
    one_run: tuple[RunStore, str], secret: Path, name: str
) -> None:
    store, run = one_run
    (store.folder(run) / name).unlink(missing_ok=True)
    (store.folder(run) / name).symlink_to(secret)
    for found, (bad,) in (store.all(), list_runs(store)):
        assert not found
        assert "is a link that leads out" in bad.reason
        assert SECRET not in bad.reason
    assert store.get(run) is None


def test_links_within_the_store_are_followed(one_run: tuple[RunStore, str]) -> None:
    store, run = one_run
    kept = store.root / "kept.txt"
    (store.folder(run) / "log.txt").rename(kept)
    (store.folder(run) / "log.txt").symlink_to(kept)
    assert store.read_whole(run).run_id == run


def test_a_pipe_hangs_nothing(one_run: tuple[RunStore, str]) -> None:
    store, run = one_run
    record = store.folder(run) / "run.json"
    record.unlink()
    os.mkfifo(record)
    found, (bad,) = store.all()
    assert not found
    assert bad.reason.endswith("run.json is no plain file")


@pytest.mark.parametrize("file", ["groundtruth.txt", "timestamps.txt"])
def test_the_truth_of_a_part_is_no_link_to_elsewhere(
    one_run: tuple[RunStore, str], secret: Path, file: str
) -> None:
    store, run = one_run
    (part,) = (store.root / "sequences").iterdir()
    (part / file).unlink()
    (part / file).symlink_to(secret)
    metrics = store.score(store.read_whole(run))
    assert metrics.online is None
    assert "leads out" in metrics.reasons["online"]
    with pytest.raises(RunError, match="leads out"):
        store.timestamps(part.name)


def test_nothing_is_written_through_links(
    one_run: tuple[RunStore, str], secret: Path, tmp_path: Path
) -> None:
    store, run = one_run
    claim = store.runs / f".{run}.claim"
    claim.symlink_to(tmp_path / "new")
    with pytest.raises(DynslamError, match="cannot write"), try_lock(claim):
        raise AssertionError("it is held")
    assert not (tmp_path / "new").exists()
    journal = tmp_path / "journal.log"
    journal.symlink_to(secret)
    with pytest.raises(StudyError, match="is a link"):
        JournalFile(journal)
    assert secret.read_text() == SECRET
