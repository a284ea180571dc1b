"""Recordings for rerun's viewer, opened by rerun's own reader."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from envs_toys import CAMERA, TARGET, write_folder

from dynslam_bench.contracts.tracker import MapOutputs
from dynslam_bench.core.errors import RunError
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import read_tum
from dynslam_bench.runs import RunSpec, RunStore, export_run, run_one
from dynslam_bench.runs.artifacts import read_snapshots
from dynslam_bench.runs.exchange.recording import RECORDING_FILE, check_rerun, write_recording
from dynslam_bench.slam.map_files import write_ply

try:
    from rerun import chunk
except ImportError:  # not installed, or without its reader of chunks
    chunk = None

needs_rerun = pytest.mark.skipif(chunk is None, reason="rerun-sdk with its reader rerun.chunk is not installed")
FRAMES = 100
IMAGE = "/world/camera/image"


class Opened:
    """A recording in rerun's own reader."""

    def __init__(self, path: Path) -> None:
        reader = chunk.RrdReader(str(path))
        (entry,) = reader.recordings()
        self._rows = [
            (str(each.entity_path), row)
            for each in reader.stream(store=entry)
            for row in each.to_record_batch().to_pylist()
        ]

    def __call__(self, entity: str, component: str) -> dict[int | None, Any]:
        """What was logged as a component of an entity, by frame; None for what holds always."""
        return {row.get("frame"): row[component] for name, row in self._rows if name == entity and row.get(component)}


def test_without_the_library_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(
        RunError,
        match=r"rerun-sdk, which is not installed \(pip install '\.\[rerun\]' in the checkout of dynslam-bench\)",
    ):
        check_rerun()


@needs_rerun
def test_a_recording_of_100_frames(store: RunStore, tmp_path: Path) -> None:
    folder = str(write_folder(tmp_path / "toy", FRAMES))
    record = run_one(RunSpec(tracker=TARGET, sequence=folder, rrd=True), store)
    assert record.status == "ok", record.reason
    own = store.folder(record.run_id)
    seen = Opened(own / RECORDING_FILE)
    shown = seen("/world/camera", "Transform3D:translation")
    assert list(shown) == list(range(FRAMES))
    online = read_tum(own / "trajectory_online.txt")
    assert np.abs(np.array([shown[i][0] for i in range(FRAMES)]) - online.positions).max() < 1e-6
    pictures = seen(IMAGE, "EncodedImage:blob")
    assert list(pictures) == list(range(FRAMES))
    image = cv2.imdecode(np.array(pictures[40][0], np.uint8), cv2.IMREAD_COLOR)
    mask = np.array(seen(f"{IMAGE}/mask", "SegmentationImage:buffer")[40][0], np.uint8).reshape(image.shape[:2])
    assert mask.sum() == 20 * 15 and mask[20:40, 25:40].all()  # the toy's, at half size
    for name, count in (("kept", 80), ("culled", 20)):
        points = seen(f"{IMAGE}/{name}", "Points2D:positions")
        assert [len(points[index]) for index in range(FRAMES)] == [count] * FRAMES
    errors = seen("/error/trans_m", "Scalars:scalars")
    assert len(errors) == FRAMES and 0 < max(row[0] for row in errors.values()) < 0.05
    (line,) = seen("/world/truth", "LineStrips3D:strips")[None]
    estimate = read_tum(own / "trajectory_final.txt").positions
    assert len(line) == FRAMES and np.linalg.norm(np.array(line) - estimate, axis=1).max() < 0.05

    exported = export_run(record, "rrd", results=store)
    assert (exported.folder / RECORDING_FILE).read_bytes() == (own / RECORDING_FILE).read_bytes()
    assert not exported.notes


@needs_rerun
def test_a_recording_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    nothing = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    with pytest.raises(RunError, match=r"cannot write .*missing/recording.rrd: "):
        write_recording(tmp_path / "missing" / RECORDING_FILE, CAMERA, "toy", [], (nothing, None))


@needs_rerun
def test_the_recording_of_a_stored_run(store: RunStore, tmp_path: Path) -> None:
    folder = str(write_folder(tmp_path / "toy", 40))
    record = run_one(RunSpec(tracker=TARGET, sequence=folder), store)
    rng = np.random.default_rng(0)
    colours = rng.integers(0, 255, (7, 3), np.uint8)
    outputs = MapOutputs((), np.arange(7), rng.normal(size=(7, 3)), colours, np.ones(7, np.int64))
    write_ply(store.folder(record.run_id) / "map.ply", outputs)
    exported = export_run(record, "rrd", results=store)
    known = [shot.index for shot in read_snapshots(store.folder(record.run_id))[1]]
    assert exported.notes == (f"features and masks are known of {len(known)} of 40 frames; `run --rrd` records all",)
    seen = Opened(exported.folder / RECORDING_FILE)
    assert list(seen("/world/camera", "Transform3D:translation")) == list(range(40)) and 0 < len(known) < 40
    assert list(seen("/features/kept", "Scalars:scalars")) == known
    cleared = sorted(frame or 0 for frame in seen(f"{IMAGE}/kept", "Clear:is_recursive"))
    assert cleared == [index + 1 for index in known if index + 1 < 40 and index + 1 not in known]
    cloud = np.array(seen("/world/map", "Points3D:positions")[None])
    assert np.abs(cloud - outputs.positions).max() < 1e-6
