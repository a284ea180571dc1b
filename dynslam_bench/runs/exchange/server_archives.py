"""Archives of stored runs for the servers of ETH3D and KITTI, which hide the ground truth of their test sequences.

ETH3D SLAM (https://www.eth3d.net/slam_documentation): a file in TUM's format for each sequence,
named by it. KITTI odometry (its development kit's readme): ``11.txt`` to ``21.txt``, for each frame
the first three rows of the pose, camera to first camera, in the root of a zip archive.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np

from dynslam_bench.core import RunError, did_you_mean, write_atomic
from dynslam_bench.geometry import Trajectory, associate, format_tum, se3
from dynslam_bench.runs.layout import TrajectoryKind
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.store import RunStore, open_store

Server = Literal["eth3d", "kitti"]
SERVERS: tuple[Server, ...] = ("eth3d", "kitti")
"""Servers for which archives are written."""
KITTI_SEQUENCES = tuple(f"{number:02d}" for number in range(11, 22))
"""KITTI's test sequences: its server takes all of them together."""
_STAMP_TOLERANCE_S = 1e-5
"""A pose belongs to a frame whose stamp differs by less."""
_ARCHIVE_DATE = (1980, 1, 1, 0, 0, 0)
"""Date of the files in an archive: two of the same runs have the same bytes."""


@dataclass(frozen=True)
class ServerArchive:
    """An archive that was written.

    Attributes:
        file: The archive.
        runs: Id of the run of each file in it, by the file's name.
        notes: What a user should know, one line each.
    """

    file: Path
    runs: dict[str, str]
    notes: list[str]


def write_server_archive(
    server: str,
    file: str | Path,
    tracker: str,
    *,
    results: str | Path | RunStore = "results",
    which: TrajectoryKind | None = None,
) -> ServerArchive:
    """Write the runs of a tracker as an archive for a server.

    Args:
        server: ``eth3d`` or ``kitti``.
        file: The archive, a ``.zip``.
        tracker: Id or label of the tracker.
        results: The results folder, or a store.
        which: The trajectory to write; by default the final one, else the online one.

    Raises:
        RunError: There is no such server, the tracker has no run on a sequence of the server, two
            runs differ in more than their repeat, or KITTI's sequences are not complete.
        DynslamError: A run cannot be read, or the archive not be written.
    """
    if server not in SERVERS:
        raise RunError(f"there is no server '{server}'", did_you_mean(server, SERVERS))
    path = Path(file)
    if path.suffix.lower() != ".zip":
        raise RunError(f"an archive is not written as '{path.name}'", "name a .zip file")
    store = results if isinstance(results, RunStore) else open_store(results)
    chosen, notes = _runs(store, server, tracker)

    texts = {}
    for name, record in sorted(chosen.items()):
        trajectory = _trajectory(store, record, which)
        if server == "eth3d":
            texts[f"{name}.txt"] = _eth3d_text(trajectory)
        else:
            poses, filled = _pose_of_each_frame(store, record, trajectory)
            texts[f"{name}.txt"] = _kitti_text(poses)
            if filled:
                notes.append(
                    f"{name}: {filled} of {len(poses)} frames have no pose; they got that before"
                )
        if record.tracker.sensors == "rgb":
            notes.append(f"{name}: the tracker has no depth, its scale is its own")
    write_atomic(path, _zipped(texts))
    notes.append("the server's own check of the archive was not tried")
    return ServerArchive(path, {f"{name}.txt": run.run_id for name, run in chosen.items()}, notes)


def _runs(store: RunStore, server: str, tracker: str) -> tuple[dict[str, RunRecord], list[str]]:
    """The run of a tracker on each sequence of a server, by the server's name of the sequence, and remarks.

    Raises:
        RunError: There is none, a sequence of KITTI is missing, or runs have different settings.
    """
    chosen: dict[str, RunRecord] = {}
    equal: dict[str, list[str]] = {}
    for record in store.all()[0]:
        name = _name_at(server, record)
        is_of_tracker = tracker in (record.tracker.id, record.tracker.label)
        if not name or not is_of_tracker or record.failed or record.trial_of:
            continue
        is_whole = record.frames is None and not record.offset and record.stride == 1
        if not is_whole:
            continue
        earlier = chosen.get(name)
        if earlier is not None and earlier.requested_settings != record.requested_settings:
            raise RunError(
                f"'{tracker}' has runs with different settings on {record.sequence.id}: "
                f"{earlier.run_id} and {record.run_id}",
                "give each a label of its own (run --label), and name that",
            )
        # of repeats the first one: nobody chooses the best of them
        if earlier is None or record.seed < earlier.seed:
            chosen[name] = record
            equal[name] = []
        elif record.seed == earlier.seed:
            # of runs with one seed, e.g. by two releases, the newest whose id tells its code
            is_newer = _validity_and_time(record) > _validity_and_time(earlier)
            equal[name].append(earlier.run_id if is_newer else record.run_id)
            chosen[name] = record if is_newer else earlier
    if not chosen:
        raise RunError(
            f"'{tracker}' has no whole run on a sequence of {server} in {store.source}",
            f"dynslam-bench runs list --tracker {tracker}",
        )
    missing = [name for name in KITTI_SEQUENCES if name not in chosen]
    if server == "kitti" and missing:
        raise RunError(f"KITTI takes all of 11 to 21 together: {', '.join(missing)} have no run")
    notes = [
        f"{name}: run {chosen[name].run_id} of {chosen[name].started or 'no date'} is the newest with its seed; "
        f"not taken: {', '.join(others)}"
        for name, others in sorted(equal.items())
        if others
    ]
    return chosen, notes


def _validity_and_time(record: RunRecord) -> tuple[bool, str]:
    """Whether a run's id tells what made it, and when it began: the larger of two is taken."""
    return record.verified, record.started


def _name_at(server: str, record: RunRecord) -> str:
    """The name that a server has for the sequence of a run; empty if it is none of the server's.

    Test sequences are folders, ``folder/NAME``: the catalogue lists sequences with a ground truth.
    """
    data_set, _, name = record.sequence.id.rpartition("/")
    if server == "kitti":
        return name if name in KITTI_SEQUENCES and data_set in ("folder", "kitti") else ""
    return name if data_set in ("folder", "eth3d") else ""


def _trajectory(store: RunStore, record: RunRecord, which: TrajectoryKind | None) -> Trajectory:
    """The trajectory of a run that is sent.

    Raises:
        RunError: The run has none.
    """
    wanted: Iterable[TrajectoryKind] = ("final", "online") if which is None else (which,)
    for kind in wanted:
        if trajectory := store.trajectory(record.run_id, kind):
            return trajectory
    raise RunError(f"run {record.run_id} has no such trajectory", record.describe())


def _eth3d_text(trajectory: Trajectory) -> str:
    """A trajectory in TUM's format, without comments."""
    lines = format_tum(trajectory).splitlines()
    return "".join(f"{line}\n" for line in lines if not line.startswith("#"))


def _pose_of_each_frame(
    store: RunStore, record: RunRecord, trajectory: Trajectory
) -> tuple[np.ndarray, int]:
    """Poses ``[N, 4, 4]``, one a frame and relative to the first, and how many frames had none.

    A frame without a pose gets that of the frame before; those before the first pose get the first.
    """
    stamps = store.timestamps(record.sequence.part)
    rows, of_pose = associate(stamps, trajectory.timestamps, _STAMP_TOLERANCE_S)
    if not len(rows):
        raise RunError(f"run {record.run_id} has no pose at a frame of {record.sequence.id}")
    # the index of the pose of each frame, or of the last one before it
    index = np.full(len(stamps), -1)
    index[rows] = np.asarray(of_pose)
    held = np.maximum.accumulate(np.where(index >= 0, np.arange(len(stamps)), -1))
    held[held < 0] = rows[0]
    poses = trajectory.T_world_cam[index[held]]
    return se3.inverse(poses[0]) @ poses, len(stamps) - len(rows)


def _kitti_text(poses: np.ndarray) -> str:
    """The first three rows of each pose in a line of twelve numbers."""
    rows = poses[:, :3].reshape(-1, 12).tolist()
    return "".join(" ".join(f"{value:.9e}" for value in row) + "\n" for row in rows)


def _zipped(texts: dict[str, str]) -> bytes:
    """A zip archive with text files in its root."""
    content = BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(zipfile.ZipInfo(name, _ARCHIVE_DATE), text, zipfile.ZIP_DEFLATED)
    return content.getvalue()
