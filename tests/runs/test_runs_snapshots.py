"""Snapshots of a run: which frames are kept, that they come back as they were, and what a damaged file says."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from dynslam_bench.contracts.tracker import TrackResult
from dynslam_bench.core.errors import RunError
from dynslam_bench.envs.episode import FrameOutcome
from dynslam_bench.evaluation.online import OnlineSample
from dynslam_bench.runs.artifacts import SNAPSHOTS_FILE, SPREAD, WORST, SnapshotWriter, read_snapshots, spread
from dynslam_bench.runs.frames import FIXED, FrameLog, FrameRow, read_csv, write_csv

SHAPE = (48, 65, 3)


def outcome(index: int, error_m: float) -> FrameOutcome:
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
        writer.add(outcome(index, 1.0 + index if index in bad else 0.01), SHAPE, result(index))
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


def test_trackers_that_show_nothing_leave_no_file(tmp_path: Path) -> None:
    writer = SnapshotWriter(tmp_path, 2)
    for index in range(2):
        writer.add(outcome(index, 0.1), SHAPE, TrackResult(np.eye(4), "ok"))
    writer.write()
    assert not (tmp_path / SNAPSHOTS_FILE).exists()
    assert read_snapshots(tmp_path) == ((0, 0), [])


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 half of one"])
def test_a_damaged_file_is_one_clear_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / SNAPSHOTS_FILE).write_bytes(content)
    with pytest.raises(RunError, match=r"holds no (snapshots|arrays)"):
        read_snapshots(tmp_path)


def test_the_dynamic_share_is_a_column_where_it_is_known(tmp_path: Path) -> None:
    known = [FrameRow(0, 1.0, "ok", dynamic_share=0.25), FrameRow(1, 2.0, "ok", dynamic_share=0.0)]
    write_csv(tmp_path / "known.csv", known)
    assert [row.dynamic_share for row in read_csv(tmp_path / "known.csv")] == [0.25, 0.0]
    write_csv(tmp_path / "unknown.csv", [FrameRow(0, 1.0, "ok")])
    assert "dynamic_share" not in (tmp_path / "unknown.csv").read_text()


def test_a_row_comes_back_whole_from_the_log_of_a_run(tmp_path: Path) -> None:
    numbers = {name: 0.25 + at for at, name in enumerate((*FIXED[3:], "dynamic_share"))}
    row = FrameRow(3, 1.5, "ok", **numbers, timings={"read": 0.1}, stats={"culled": 7}, pose=[0.0] * 6 + [1.0])
    assert None not in [getattr(row, each.name) for each in fields(row)]
    (tmp_path / "log").write_text(row.to_json())
    assert FrameLog.read(tmp_path / "log") == FrameLog([row])
