"""Stored runs as files of other tools."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from dynslam_bench.core.errors import RunError, did_you_mean
from dynslam_bench.core.files import atomic_folder, write_atomic
from dynslam_bench.geometry.association import associate
from dynslam_bench.geometry.kitti_file import write_kitti
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.tum_file import write_tum
from dynslam_bench.slam.outputs.map_files import read_ply

from ..storage.record import RunRecord
from ..storage.store import RunStore
from .colmap import write_colmap
from .pose_tables import write_euroc, write_vslam_lab
from .provenance import PROVENANCE_FILE, provenance_of
from .recording import RECORDING_FILE
from .ros_bag import write_bag
from .stored_recording import write_stored
from .stored_sequence import image_names, open_stored

Which = Literal["online", "final"]
_STAMP_TOLERANCE_S = 1e-5


@dataclass(frozen=True)
class Exported:
    """What `export_run` wrote.

    Attributes:
        folder: Where.
        files: Names of the files in it, ``provenance.json`` last.
        which: Which trajectory.
        notes: What a user should know, one line each.
    """

    folder: Path
    files: tuple[str, ...]
    which: Which
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Job:
    """One run on its way out."""

    store: RunStore
    record: RunRecord
    which: Which
    trajectory: Trajectory
    data_root: str | Path | None
    camera: str | Path | None


def export_run(
    run: RunRecord | str,
    form: str,
    folder: str | Path | None = None,
    *,
    results: str | Path | RunStore = "results",
    which: Which | None = None,
    data_root: str | Path | None = None,
    camera: str | Path | None = None,
) -> Exported:
    """Write a stored run in a format of others, with its provenance beside it.

    Args:
        run: A record, or the run's id, its first digits or ``latest``.
        form: A name of `FORMATS`.
        folder: Where; what it held is replaced. By default ``exports/<run id>/<format>`` of the results folder.
        results: The results folder, or a store.
        which: Which trajectory; by default the final one, else the online one.
        data_root: Folder of the recorded sequences, for formats that need images or the camera (COLMAP, rerun).
        camera: Camera of a folder that does not say its own, likewise.

    Raises:
        RunError: There is no such run or format, or the run has no such trajectory.
        DynslamError: The sequence is not here although the format needs it, a library is missing, or the folder
            cannot be written.
    """
    if form not in FORMATS:
        raise RunError(f"there is no format '{form}'", did_you_mean(form, FORMATS))
    store = results if isinstance(results, RunStore) else RunStore(results)
    record = store.read(run) if isinstance(run, str) else run
    chosen, trajectory = _trajectory(store, record, which)
    target = store.root / "exports" / record.run_id / form if folder is None else Path(folder).expanduser().absolute()
    _check_target(target)
    with atomic_folder(target) as work:
        notes = FORMATS[form](_Job(store, record, chosen, trajectory, data_root, camera), work)
        provenance = provenance_of(record, form, chosen, work)
        write_atomic(work / PROVENANCE_FILE, provenance.to_json())
    return Exported(target, (*provenance.files, PROVENANCE_FILE), chosen, tuple(notes))


def _check_target(target: Path) -> None:
    """Only a folder that an export made, or an empty one, is replaced.

    Raises:
        RunError: It holds something else, or is a file.
    """
    if target.is_dir() and (not any(target.iterdir()) or (target / PROVENANCE_FILE).is_file()):
        return
    if target.exists():
        raise RunError(f"{target} exists and is no export", "name a folder that does not exist, with -o")


def _trajectory(store: RunStore, record: RunRecord, which: Which | None) -> tuple[Which, Trajectory]:
    wanted: tuple[Which, ...] = ("final", "online") if which is None else (which,)
    for each in wanted:
        found = store.trajectory(record.run_id, each)
        if found is not None:
            return each, found
    raise RunError(f"run {record.run_id} has no {' and no '.join(wanted)} trajectory", record.describe())


def _tum(job: _Job, work: Path) -> list[str]:
    comment = f"{job.record.tracker.id} on {job.record.sequence.id}, {job.which}, run {job.record.run_id}"
    write_tum(work / "trajectory.txt", job.trajectory, comment=comment)
    return []


def _kitti(job: _Job, work: Path) -> list[str]:
    write_kitti(work / "poses.txt", job.trajectory, work / "times.txt")
    missing = job.record.n_frames - len(job.trajectory)
    return [f"{missing} frames have no pose: line N of poses.txt is that of line N of times.txt"] * (missing > 0)


def _euroc(job: _Job, work: Path) -> list[str]:
    write_euroc(work / "data.csv", job.trajectory)
    return ["the poses are the camera's, not a body's"]


def _vslam_lab(job: _Job, work: Path) -> list[str]:
    write_vslam_lab(work / "00000_KeyFrameTrajectory.csv", job.trajectory)
    return []


def _mcap(job: _Job, work: Path) -> list[str]:
    trajectories = {"estimate": job.trajectory}
    truth = job.store.ground_truth(job.record.sequence.part)
    if truth is not None:
        trajectories["ground_truth"] = truth
    write_bag(work, trajectories)
    return ["estimate and ground_truth are each in a world of their own, not aligned"] * (truth is not None)


def _colmap(job: _Job, work: Path) -> list[str]:
    sequence = open_stored(job.record, job.data_root, job.camera)
    at, poses = associate(sequence.timestamps, job.trajectory.timestamps, _STAMP_TOLERANCE_S)
    names = image_names(sequence)
    cloud = job.store.folder(job.record.run_id) / "map.ply"
    write_colmap(
        work,
        job.trajectory.select(np.asarray(poses)),
        sequence.camera,
        [names[index] for index in at],
        read_ply(cloud) if cloud.is_file() else None,
    )
    odd = len(job.trajectory) - len(poses)
    notes = ["the points have no tracks: a map of this package keeps positions, colours and counts"] * cloud.is_file()
    return notes + [f"{odd} poses carry stamps of no image and were left out"] * (odd > 0)


def _rrd(job: _Job, work: Path) -> list[str]:
    recorded = job.store.folder(job.record.run_id) / RECORDING_FILE
    if recorded.is_file():  # `run --rrd` has seen every frame's features
        shutil.copyfile(recorded, work / RECORDING_FILE)
        return []
    sequence = open_stored(job.record, job.data_root, job.camera)
    return write_stored(work / RECORDING_FILE, job.store, job.record, sequence, job.trajectory)


FORMATS: dict[str, Callable[[_Job, Path], list[str]]] = {
    "tum": _tum,
    "kitti": _kitti,
    "euroc": _euroc,
    "vslam-lab": _vslam_lab,
    "colmap": _colmap,
    "mcap": _mcap,
    "rrd": _rrd,
}
"""Formats by name; each writes its files into a folder and gives notes."""
