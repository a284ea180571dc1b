"""Stored runs as files of other tools with ``provenance.json`` beside them, and their trajectories as stored runs."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timezone
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Sequence, timestamps_ns
from dynslam_bench.core import DynslamError, RunError, atomic_folder, did_you_mean, write_atomic
from dynslam_bench.core.fingerprint import versions
from dynslam_bench.core.records import Record, digest
from dynslam_bench.core.version import version
from dynslam_bench.envs.slam_env import Frames, open_frames
from dynslam_bench.evaluation.comparison import STAMP_TOLERANCE, clock_hint, share_of_time
from dynslam_bench.geometry import (
    Array,
    LoadedTrajectory,
    Trajectory,
    associate,
    nearest_gap,
    to_seconds,
    write_kitti,
    write_tum,
)
from dynslam_bench.runs.exchange.formats import (
    read_trajectory,
    write_bag,
    write_colmap,
    write_pose_table,
)
from dynslam_bench.runs.exchange.recording import RECORDING_FILE, write_stored
from dynslam_bench.runs.layout import TrajectoryKind
from dynslam_bench.runs.make_record import (
    judge_coverage,
    recording_notes,
    sequence_info,
    sequence_part_digest,
)
from dynslam_bench.runs.record import (
    LOST_COVERAGE,
    RunRecord,
    SequenceInfo,
    Status,
    TrackerInfo,
    run_id_of,
)
from dynslam_bench.runs.spec import place_of
from dynslam_bench.runs.store import RunStore, open_store
from dynslam_bench.sequences.catalogue import entry_of, parse_frames
from dynslam_bench.sequences.tags import motion_tags
from dynslam_bench.sequences.view import SequencePart, sequence_part_of
from dynslam_bench.slam.map_files import read_ply

_STAMP_TOLERANCE_S = 1e-5
"""Poses and images of one run whose stamps differ by less belong to each other."""
_IMPORT_TOLERANCE_S = 0.02
"""An imported pose covers a frame whose stamp differs by less."""
FORMATS = ("tum", "kitti", "euroc", "vslam-lab", "colmap", "mcap", "rrd")
"""Names of the formats."""
PROVENANCE_FILE = "provenance.json"
"""Lies beside an export, see `Provenance`."""


@dataclass(frozen=True)
class Exported:
    """Files that `export_run` wrote, with notes on what they lack.

    Attributes:
        folder: The folder of the export.
        files: Names of the files in it, ``provenance.json`` last.
        which: The trajectory that was written: ``online`` or ``final``.
        notes: What a user should know, one line each.
    """

    folder: Path
    files: tuple[str, ...]
    which: TrajectoryKind
    notes: tuple[str, ...]


def export_run(
    run: RunRecord | str,
    form: str,
    folder: str | Path | None = None,
    *,
    results: str | Path | RunStore = "results",
    which: TrajectoryKind | None = None,
    data_root: str | Path | None = None,
    camera: str | Path | None = None,
) -> Exported:
    """Write a stored run in a format of others, with its provenance beside it.

    Args:
        run: A record, or the run's id, its first digits or ``latest``.
        form: A name of `FORMATS`.
        folder: Folder of the export; what it held is replaced. By default
            ``exports/<run id>/<format>`` of the results folder.
        results: The results folder, an archive of one, or a store.
        which: The trajectory to write; by default the final one, else the online one.
        data_root: Folder of the recorded sequences, for formats that need images or the camera
            (COLMAP, rerun).
        camera: Camera of a folder that does not say its own, for these formats.

    Raises:
        RunError: There is no such run or format, or the run has no such trajectory.
        DynslamError: The sequence is not here although the format needs it, a library is missing,
            or the folder cannot be written.
    """
    # refuse what cannot be exported, and find the run
    if form not in FORMATS:
        raise RunError(f"there is no format '{form}'", did_you_mean(form, FORMATS))
    if folder is None and not isinstance(results, RunStore) and Path(results).is_file():
        raise RunError(f"{results} is an archive, which gets no exports", "name a folder, with -o")
    store = results if isinstance(results, RunStore) else open_store(results)
    record = store.read(run) if isinstance(run, str) else run

    # the trajectory, and the folder, which must be free or an earlier export
    chosen, trajectory = _trajectory(store, record, which)
    if folder is None:
        target = store.root / "exports" / record.run_id / form
    else:
        target = Path(folder).expanduser().absolute()
    if target.exists() and not _is_replaceable(target):
        raise RunError(
            f"{target} exists and is no export", "name a folder that does not exist, with -o"
        )

    # write the files, then their digests beside the run's record
    with atomic_folder(target) as work:
        notes = _write(
            form,
            work,
            store,
            record,
            chosen,
            trajectory,
            lambda: open_stored(record, data_root, camera),
        )
        digests = {path.name: digest_of(path) for path in sorted(work.iterdir()) if path.is_file()}
        provenance = Provenance(
            format=form, files=digests, which=chosen, run=record.public(), written_by=version()
        )
        write_atomic(work / PROVENANCE_FILE, provenance.to_json())
    return Exported(target, (*digests, PROVENANCE_FILE), chosen, tuple(notes))


def _is_replaceable(folder: Path) -> bool:
    """Whether an export may take the place of what is there: an empty folder, or one that an export made."""
    if not folder.is_dir():
        return False
    return not any(folder.iterdir()) or (folder / PROVENANCE_FILE).is_file()


def _trajectory(
    store: RunStore, record: RunRecord, which: TrajectoryKind | None
) -> tuple[TrajectoryKind, Trajectory]:
    """The trajectory of a run that is exported, and which it is; by default the final one, else the online one.

    Raises:
        RunError: The run has no such trajectory.
    """
    wanted: tuple[TrajectoryKind, ...] = ("final", "online") if which is None else (which,)
    for kind in wanted:
        if trajectory := store.trajectory(record.run_id, kind):
            return kind, trajectory
    raise RunError(
        f"run {record.run_id} has no {' and no '.join(wanted)} trajectory", record.describe()
    )


def _write(
    form: str,
    work: Path,
    store: RunStore,
    record: RunRecord,
    which: TrajectoryKind,
    trajectory: Trajectory,
    reopened: Callable[[], Sequence],
) -> list[str]:
    """Write the files of a format into a folder.

    Args:
        form: Name of the format.
        work: The folder.
        store: The run's.
        record: The run.
        which: Kind of the trajectory, ``online`` or ``final``.
        trajectory: The trajectory, camera-to-world poses.
        reopened: Opens the frames of the run, for formats that need images or the camera.

    Returns:
        What a user should know, one line each.
    """
    match form:
        case "tum":
            comment = f"{record.tracker.id} on {record.sequence.id}, {which}, run {record.run_id}"
            write_tum(work / "trajectory.txt", trajectory, comment=comment)
        case "kitti":
            write_kitti(work / "poses.txt", trajectory, work / "times.txt")
            if (missing := record.n_frames - len(trajectory)) > 0:
                return [
                    f"{missing} frames have no pose: line N of poses.txt is that of line N of times.txt"
                ]
        case "euroc":
            write_pose_table(work, form, trajectory)
            return ["the poses are the camera's, not a body's"]
        case "vslam-lab":
            write_pose_table(work, form, trajectory)
        case "mcap":
            truth = store.ground_truth(record.sequence.part)
            trajectories = {"estimate": trajectory}
            if truth is not None:
                trajectories["ground_truth"] = truth
            write_bag(work, trajectories)
            if truth is not None:
                return ["estimate and ground_truth are each in a world of their own, not aligned"]
        case "colmap":
            return _write_colmap(
                work, reopened(), trajectory, store.folder(record.run_id) / "map.ply"
            )
        case "rrd":
            recorded = store.folder(record.run_id) / RECORDING_FILE
            if not recorded.is_file():
                return write_stored(work / RECORDING_FILE, store, record, reopened(), trajectory)
            # `run --rrd` has seen every frame's features
            shutil.copyfile(recorded, work / RECORDING_FILE)
    return []


def _write_colmap(work: Path, sequence: Sequence, trajectory: Trajectory, cloud: Path) -> list[str]:
    """Write a reconstruction of the frames that have poses.

    Args:
        work: The folder.
        sequence: The frames of the run.
        trajectory: Its poses.
        cloud: Its map points, a PLY file that may be missing.

    Returns:
        What a user should know, one line each.
    """
    # only poses with an image: COLMAP has one pose for each image
    rows_of_frames, rows_of_poses = associate(
        sequence.timestamps, trajectory.timestamps, _STAMP_TOLERANCE_S
    )

    # names of these images; rendered ones get names as TUM gives them
    files: dict[float, str] = getattr(sequence, "colour_files", {})
    stamps = sequence.timestamps[rows_of_frames].tolist()
    names = [files.get(stamp, f"rgb/{stamp:.6f}.png") for stamp in stamps]

    # write the images with their poses, and the map's points
    points = read_ply(cloud) if cloud.is_file() else None
    poses = trajectory.select(np.asarray(rows_of_poses))
    write_colmap(work, poses, sequence.camera, names, points)

    notes = []
    if points is not None:
        notes.append(
            "the points have no tracks: a map of this package keeps positions, colours and counts"
        )
    n_without_image = len(trajectory) - len(rows_of_poses)
    if n_without_image > 0:
        notes.append(f"{n_without_image} poses carry stamps of no image and were left out")
    return notes


class Provenance(Record):
    """Origin of an export: its run and the digests of its files.

    Attributes:
        schema_version: Version of this record's fields.
        format: Name of the format.
        files: SHA-256 of every file by its name.
        which: The trajectory that was written: ``online`` or ``final``.
        run: The record of the run, without the command line and the folders of the machine that
            made it.
        written_by: Version of this package.
    """

    schema_version: int = 1
    format: str
    files: dict[str, str]
    which: TrajectoryKind
    run: RunRecord
    written_by: str = ""

    def describe(self) -> str:
        """One line, for the record of an import."""
        tracker = self.run.tracker
        origin = f", which came from {self.run.provenance}" if self.run.provenance else ""
        return (
            f"{self.which} trajectory of run {self.run.run_id} of {tracker.id} {tracker.version} on "
            f"{self.run.sequence.id}{origin}, exported as {self.format} by dynslam-bench {self.written_by}"
        )


def stated_provenance(file: Path) -> str:
    """Provenance stated in ``provenance.json`` beside a trajectory; empty where there is none, or the file has changed.

    Args:
        file: The trajectory, or the folder that holds it.
    """
    # ValueError: a name with a null byte
    with contextlib.suppress(DynslamError, OSError, ValueError):
        # what the export wrote, and the files that it means
        folder = file if file.is_dir() else file.parent
        provenance = Provenance.read(folder / PROVENANCE_FILE)
        if file.is_file():
            files = [file]
        else:  # names that lead out of the folder are left out
            files = [file / name for name in provenance.files if Path(name).name == name]
        # an edited file is no longer what the export wrote
        is_unchanged = all(provenance.files.get(path.name) == digest_of(path) for path in files)
        if files and is_unchanged:
            return provenance.describe()
    return ""


def digest_of(path: Path) -> str:
    """SHA-256 of a file, or of all files directly in a folder, in order of their names.

    Raises:
        OSError: One cannot be read.
    """
    files = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    return sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def open_stored(
    record: RunRecord, data_root: str | Path | None = None, camera: str | Path | None = None
) -> Sequence:
    """The frames of a run as its tracker saw them, before any preprocessing.

    Args:
        record: The run's.
        data_root: Folder of the recorded sequences; None for the default one.
        camera: Camera of a folder that does not say its own.

    Raises:
        DynslamError: It is not here, or not the one that was run on.
    """
    # without that a record could name any folder of images, and a page or a file show them
    if not record.sequence.content:
        raise RunError(f"the record does not say what {record.sequence.id} held")
    # the same frames, by their content and not by their name
    start, stop = record.frames or (0, None)
    place = record.place or record.sequence.id
    sequence = open_frames(place, data_root, camera, (start + record.offset, stop), record.stride)
    if sequence_part_of(sequence, record.offset).content != record.sequence.content:
        raise RunError(f"the content of {record.sequence.id} has changed since the run")
    return sequence


# -- trajectories from elsewhere -------------------------------------------------------------------


def import_trajectory(
    path: str | Path,
    tracker: str,
    sequence: str,
    *,
    results: str | Path | RunStore = "results",
    label: str = "",
    provenance: str = "",
    which: TrajectoryKind = "final",
    frames: Frames = None,
    stride: int = 1,
    data_root: str | Path | None = None,
    camera: str | Path | None = None,
    timestamps: str | Path | None = None,
    topic: str | None = None,
    truth: str | Path | None = None,
) -> RunRecord:
    """Store an external trajectory as a record of kind ``imported``.

    Args:
        path: A trajectory in any of the formats that `read_trajectory` knows.
        tracker: Name of the system that made it.
        sequence: The sequence that it was made on; its ground truth is needed to score it.
        results: The results folder, or a store.
        label: Name for tables; default is ``<tracker> (imported)``.
        provenance: Where it came from, e.g. a URL; by default what ``provenance.json`` beside it
            says, else its name.
        which: Whether its poses are the causal ones or those after the final optimisation.
        frames: Part of the sequence it covers; None for all.
        stride: Every so many frames.
        data_root: Folder of the recorded sequences.
        camera: Camera of a folder that does not say its own.
        timestamps: Stamps where the format has none: for KITTI a file whose lines begin with one
            each, in seconds, for COLMAP a list of stamps and images.
        topic: The topic to take of a bag that has several topics of poses.
        truth: Ground truth of a sequence whose images are not here, in a format of
            `read_trajectory`, with the same `timestamps` where it has none. Its frames are not
            known then; in place of the coverage stands the share of the truth's time that has poses.

    Returns:
        The record, ``lost`` by the rule of runs (`judge_coverage`); its notes count poses whose
        stamps are no frame's.

    Raises:
        DynslamError: The trajectory cannot be read.
        RunError: It shares no time with the sequence (with the measured gap), or the name is empty.
        DynslamError: The sequence cannot be opened, or the store not be written.
    """
    if not tracker.strip():
        raise RunError("an imported trajectory needs the name of its tracker")
    file = Path(path).expanduser()
    loaded = read_trajectory(file, timestamps, topic)
    trajectory = loaded.trajectory
    notes = loaded.notes.describe()

    # the sequence, by its images or by a ground truth alone
    if truth is None:
        reference = _reference_by_images(open_frames(sequence, data_root, camera, frames, stride))
    else:
        truth_file = read_trajectory(Path(truth).expanduser(), timestamps)
        phrases = truth_file.notes.describe(repeats=True)
        notes += [f"ground truth: {phrase}" for phrase in phrases]
        reference = _reference_by_truth(sequence, truth_file)

    # which of its frames the trajectory covers
    coverage = _coverage(trajectory, reference, file)
    notes += _coverage_notes(coverage, reference, trajectory)

    # its record, as that of a run: frames without a pose count as lost
    identity = _identity_of_import(file, tracker, which, reference.part, timestamps, topic)
    status, reason = judge_coverage(
        coverage.covered,
        coverage.total,
        coverage.total - 1 - coverage.last,
        coverage.total,
    )
    truth_share = None
    if not reference.knows_frames:
        true_stamps = to_seconds(reference.timestamps_ns)
        truth_share = share_of_time(trajectory.timestamps, true_stamps)
        status, reason = _judge_time(truth_share)
    record = RunRecord(
        kind="imported",
        run_id=run_id_of(identity),
        status=status,
        reason=reason,
        tracker=TrackerInfo(
            id=tracker, label=label or f"{tracker} (imported)", provenance="external"
        ),
        sequence=reference.info(sequence_part_digest(identity)),
        frames=None if frames is None else parse_frames(frames),
        stride=stride,
        n_frames=coverage.total,
        n_tracked=coverage.covered,
        n_lost=coverage.total - coverage.covered,
        coverage=coverage.covered / coverage.total if reference.knows_frames else None,
        truth_share=truth_share,
        started=datetime.now(timezone.utc).isoformat(timespec="milliseconds"),
        versions=versions(),
        identity=identity,
        provenance=provenance or stated_provenance(file) or str(file),
        place=place_of(sequence) if reference.knows_frames else "",
        stamps_match=reference.knows_frames and not coverage.n_without_frame,
        notes=[*notes, *reference.notes],
    ).normalised()

    # trajectory, stamps and ground truth into the store
    store = results if isinstance(results, RunStore) else RunStore(results)
    store.prepare()
    with store.work_folder(record.run_id) as work:
        comment = f"imported: {tracker} on {reference.part.id}"
        write_tum(work / f"trajectory_{which}.txt", trajectory, comment=comment)
        store.add_sequence(record.sequence.part, reference.timestamps_ns, reference.ground_truth)
        store.publish(work, record)
    return record


def _identity_of_import(
    file: Path,
    tracker: str,
    which: TrajectoryKind,
    part: SequencePart,
    timestamps: str | Path | None,
    topic: str | None,
) -> dict[str, Any]:
    """Identity of an imported trajectory: its file, and the frames that it belongs to.

    Args:
        file: The trajectory; its content counts, not its name.
        tracker: Name of the system that made it.
        which: Kind of the trajectory, ``online`` or ``final``.
        part: The part of the sequence that it was made on.
        timestamps: File of the stamps where the format has none; its content counts.
        topic: The topic that was taken of a bag.
    """
    identity = {
        "kind": "imported",
        "tracker": tracker,
        "which": which,
        "file": digest_of(file),
        "sequence": part.id,
        "content": part.content,
        "frames": [part.start, part.stop],
        "offset": 0,
        "stride": part.stride,
    }
    if timestamps is not None:
        identity["timestamps"] = digest_of(Path(timestamps).expanduser())
    if topic is not None:
        identity["topic"] = topic
    return identity


@dataclass(frozen=True, eq=False)
class _Reference:
    """Stamps and ground truth that an imported trajectory is compared with.

    Attributes:
        part: The part of the sequence.
        timestamps_ns: Stamps of its frames, or of its ground truth where the frames are not known.
        ground_truth: Its ground truth, with all poses of a repeated stamp; None if it has none.
        info: What the record keeps of the sequence, by the name of its part.
        knows_frames: Whether its images are here.
        notes: What of the recording was not used, or nobody could mean.
    """

    part: SequencePart
    timestamps_ns: NDArray[np.int64]
    ground_truth: Trajectory | None
    info: Callable[[str], SequenceInfo]
    knows_frames: bool
    notes: tuple[str, ...] = ()


def _reference_by_images(opened: Sequence) -> _Reference:
    """A sequence whose images are here."""
    part = sequence_part_of(opened)
    return _Reference(
        part=part,
        timestamps_ns=timestamps_ns(opened),
        ground_truth=opened.ground_truth,
        info=lambda name: sequence_info(opened, part.content, name),
        knows_frames=True,
        notes=tuple(recording_notes(opened)),
    )


def _reference_by_truth(sequence: str, truth: LoadedTrajectory) -> _Reference:
    """A sequence of which only the ground truth is here."""
    poses = truth.poses(repeats=True)
    part = _part_by_truth(sequence, poses)
    return _Reference(
        part=part,
        timestamps_ns=truth.trajectory.timestamps_ns,
        ground_truth=poses,
        info=lambda name: _info_by_truth(part, truth.trajectory, name),
        knows_frames=False,
    )


def _part_by_truth(sequence: str, truth: Trajectory) -> SequencePart:
    """The whole of a sequence of which only the ground truth is here."""
    entry = entry_of(sequence)
    content = digest([truth.timestamps_ns.tolist(), truth.T_world_cam.round(9).tolist()])
    return SequencePart(
        sequence if entry is None else entry.id, content, content, {}, 0, len(truth), 1, None
    )


def _info_by_truth(part: SequencePart, truth: Trajectory, name: str) -> SequenceInfo:
    """Describe a sequence without its images: the catalogue's entry and the camera's motion.

    Args:
        part: The whole sequence.
        truth: Its ground truth.
        name: The name of the part in a store.
    """
    entry = entry_of(part.id)
    return SequenceInfo(
        id=part.id,
        content=part.content,
        part=name,
        block=part.block,
        frames=len(truth),
        duration_s=float(truth.timestamps[-1] - truth.timestamps[0]),
        ground_truth=True,
        tags=sorted({*(entry.tags if entry else ()), *motion_tags(truth)}),
        fps=0.0 if entry is None else entry.fps,
        license="" if entry is None else entry.license,
        citation="" if entry is None else entry.citation,
        split="" if entry is None else entry.split,
    )


class _Coverage(NamedTuple):
    """Coverage of a sequence's frames by a trajectory.

    Attributes:
        total: Frames of the sequence.
        covered: Frames with a pose.
        n_without_frame: Poses that carry no frame's stamp.
        last: The last frame with a pose.
    """

    total: int
    covered: int
    n_without_frame: int
    last: int

    @classmethod
    def of_all(cls, poses: int, n_without_frame: int) -> _Coverage:
        """Each pose counts as a frame: the frames are not known."""
        return cls(poses, poses, n_without_frame, poses - 1)


def _coverage(trajectory: Trajectory, reference: _Reference, file: Path) -> _Coverage:
    """Coverage of the reference's frames by a trajectory; each pose is a frame where the frames are not known.

    Args:
        trajectory: The trajectory.
        reference: Stamps and ground truth of the sequence.
        file: Its file, for the error.

    Raises:
        RunError: Fewer than two poses are near a frame.
    """
    stamps_s = to_seconds(reference.timestamps_ns)
    coverage = _match_frames(trajectory, stamps_s, f"{file} shares", f"'{reference.part.id}'")
    if reference.knows_frames:
        return coverage
    return _Coverage.of_all(len(trajectory), coverage.n_without_frame)


def _judge_time(truth_share: float) -> tuple[Status, str]:
    """Whether a trajectory that covers this share of the ground truth's time is that of a lost camera, and why."""
    if truth_share >= LOST_COVERAGE:
        return "ok", ""
    return (
        "lost",
        f"poses for {100 * truth_share:.0f} % of the ground truth's time, below {100 * LOST_COVERAGE:.0f} %",
    )


def _coverage_notes(
    coverage: _Coverage, reference: _Reference, trajectory: Trajectory
) -> list[str]:
    """Notes for the record on what is not known of the coverage, and on poses beside the frames.

    Args:
        coverage: The coverage.
        reference: The sequence, by its images or by a ground truth alone.
        trajectory: The trajectory.
    """
    if not reference.knows_frames:
        return [
            "the images of the sequence were not here, so the number of its frames and the coverage are not known"
        ]
    if coverage.n_without_frame:
        return [
            f"{coverage.n_without_frame} of {len(trajectory)} poses carry stamps that are no input frame's"
        ]
    return []


def _match_frames(trajectory: Trajectory, stamps: Array, shares: str, name: str) -> _Coverage:
    """Match the poses of a trajectory with the frames of a sequence by their stamps.

    Args:
        trajectory: The trajectory.
        stamps: Stamps of the frames in seconds.
        shares: The beginning of an error: whose poses these are.
        name: The sequence as the error names it.

    Raises:
        RunError: Fewer than two poses are near a frame.
    """
    # poses with a frame's own stamp, and poses near a frame: others may have rounded the stamps
    exact, _ = associate(stamps, trajectory.timestamps, STAMP_TOLERANCE, strict=False)
    near, _ = associate(stamps, trajectory.timestamps, _IMPORT_TOLERANCE_S)
    if len(near) < 2:
        gap = float(np.min(nearest_gap(trajectory.timestamps, stamps)))
        raise RunError(
            f"{shares} {len(near)} stamps with {name}, at least 2 are needed: the nearest is {gap:.3f} s off; its own "
            f"last from {trajectory.timestamps[0]:.6f} to {trajectory.timestamps[-1]:.6f}, the frames from "
            f"{stamps[0]:.6f} to {stamps[-1]:.6f}",
            clock_hint(trajectory.timestamps, stamps),
        )
    # where all stamps are those of frames, poses of one stamp count once
    n_without_frame = len(trajectory) - len(exact)
    covered = len(near) if n_without_frame else len(exact)
    return _Coverage(len(stamps), covered, n_without_frame, int(near[-1]))
