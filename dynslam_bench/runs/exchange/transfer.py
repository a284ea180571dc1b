"""Stored runs as files of other tools with ``provenance.json`` beside them, and their trajectories as stored runs."""

import contextlib
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timezone
from hashlib import sha256
from pathlib import Path

import numpy as np

from dynslam_bench.contracts import Sequence, timestamps_ns
from dynslam_bench.core import DynslamError, RunError, atomic_folder, did_you_mean, write_atomic
from dynslam_bench.core.fingerprint import versions
from dynslam_bench.core.records import Record, digest
from dynslam_bench.core.version import version
from dynslam_bench.envs.slam_env import Frames, open_frames
from dynslam_bench.evaluation.comparison import STAMP_TOLERANCE, clock_hint
from dynslam_bench.geometry import (
    Array,
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
from dynslam_bench.runs.layout import Which
from dynslam_bench.runs.make_record import judge_coverage, part_digest, sequence_info
from dynslam_bench.runs.record import RunRecord, SequenceInfo, TrackerInfo, run_id_of
from dynslam_bench.runs.spec import place_of
from dynslam_bench.runs.store import RunStore, open_store
from dynslam_bench.sequences.catalogue import entry_of, parse_frames
from dynslam_bench.sequences.tags import motion_tags
from dynslam_bench.sequences.view import Part, part_of
from dynslam_bench.slam.map_files import read_ply

_STAMP_TOLERANCE_S = 1e-5
_IMPORT_TOLERANCE_S = 0.02


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
        folder: Where; what it held is replaced. By default ``exports/<run id>/<format>`` of the
            results folder.
        results: The results folder, an archive of one, or a store.
        which: Which trajectory; by default the final one, else the online one.
        data_root: Folder of the recorded sequences, for formats that need images or the camera
            (COLMAP, rerun).
        camera: Camera of a folder that does not say its own, likewise.

    Raises:
        RunError: There is no such run or format, or the run has no such trajectory.
        DynslamError: The sequence is not here although the format needs it, a library is missing,
            or the folder cannot be written.
    """
    if form not in FORMATS:
        raise RunError(f"there is no format '{form}'", did_you_mean(form, FORMATS))
    if folder is None and not isinstance(results, RunStore) and Path(results).is_file():
        raise RunError(f"{results} is an archive, which gets no exports", "name a folder, with -o")
    store = results if isinstance(results, RunStore) else open_store(results)
    record = store.read(run) if isinstance(run, str) else run
    chosen, trajectory = _trajectory(store, record, which)
    target = (
        store.root / "exports" / record.run_id / form
        if folder is None
        else Path(folder).expanduser().absolute()
    )
    is_free = target.is_dir() and (
        not any(target.iterdir()) or (target / PROVENANCE_FILE).is_file()
    )
    # only a folder that an export made, or an empty one, is replaced
    if target.exists() and not is_free:
        raise RunError(
            f"{target} exists and is no export", "name a folder that does not exist, with -o"
        )
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


def _trajectory(
    store: RunStore, record: RunRecord, which: Which | None
) -> tuple[Which, Trajectory]:
    wanted: tuple[Which, ...] = ("final", "online") if which is None else (which,)
    for kind in wanted:
        if trajectory := store.trajectory(record.run_id, kind):
            return kind, trajectory
    raise RunError(
        f"run {record.run_id} has no {' and no '.join(wanted)} trajectory", record.describe()
    )


FORMATS = ("tum", "kitti", "euroc", "vslam-lab", "colmap", "mcap", "rrd")
"""Names of the formats."""


def _write(
    form: str,
    work: Path,
    store: RunStore,
    record: RunRecord,
    which: Which,
    trajectory: Trajectory,
    reopened: Callable[[], Sequence],
) -> list[str]:
    """Write the files of a format into a folder, and give notes; `reopened` gives the frames of the run."""
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
            write_bag(
                work, {"estimate": trajectory} | ({} if truth is None else {"ground_truth": truth})
            )
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
    at, poses = associate(sequence.timestamps, trajectory.timestamps, _STAMP_TOLERANCE_S)
    # without files they are named as TUM names them
    files: dict[float, str] = getattr(sequence, "colour_files", {})
    names = [files.get(stamp, f"rgb/{stamp:.6f}.png") for stamp in sequence.timestamps[at].tolist()]
    points = read_ply(cloud) if cloud.is_file() else None
    write_colmap(work, trajectory.select(np.asarray(poses)), sequence.camera, names, points)
    odd = len(trajectory) - len(poses)
    notes = [
        "the points have no tracks: a map of this package keeps positions, colours and counts"
    ] * cloud.is_file()
    return notes + [f"{odd} poses carry stamps of no image and were left out"] * (odd > 0)


PROVENANCE_FILE = "provenance.json"


class Provenance(Record):
    """What an export was made of.

    Attributes:
        schema_version: Of this record.
        format: Name of the format.
        files: SHA-256 of every file by its name.
        which: Which trajectory: ``online`` or ``final``.
        run: The record of the run, without the command line and the folders of the machine that
            made it.
        written_by: Version of this package.
    """

    schema_version: int = 1
    format: str
    files: dict[str, str]
    which: Which
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
    """What ``provenance.json`` beside a trajectory says of it; empty where there is none, or the file has changed.

    Args:
        file: The trajectory, or the folder that holds it.
    """
    # ValueError: a name with a null byte
    with contextlib.suppress(DynslamError, OSError, ValueError):
        provenance = Provenance.read((file if file.is_dir() else file.parent) / PROVENANCE_FILE)
        files = (
            [file]
            if file.is_file()
            else [file / name for name in provenance.files if Path(name).name == name]
        )
        if files and all(provenance.files.get(path.name) == digest_of(path) for path in files):
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
    # else a record could name any folder of images, and a page or a file show them
    if not record.sequence.content:
        raise RunError(f"the record does not say what {record.sequence.id} held")
    start, stop = record.frames or (0, None)
    place = record.place or record.sequence.id
    sequence = open_frames(place, data_root, camera, (start + record.offset, stop), record.stride)
    if part_of(sequence, record.offset).content != record.sequence.content:
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
    which: Which = "final",
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
        topic: Of a bag with several topics of poses, the one to take.
        truth: Ground truth of a sequence whose images are not here, in a format of
            `read_trajectory`, with the same `timestamps` where it has none. Its frames are not
            known then, and so is the coverage.

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
    notes = loaded.notes.describe()
    opened = None
    stated = None
    if truth is None:
        opened = open_frames(sequence, data_root, camera, frames, stride)
        part = part_of(opened)
        stamps = timestamps_ns(opened)
        poses = opened.ground_truth
    else:
        file_of_truth = read_trajectory(Path(truth).expanduser(), timestamps)
        notes += [
            f"ground truth: {phrase}" for phrase in file_of_truth.notes.describe(repeats=True)
        ]
        stated = file_of_truth.trajectory
        poses = file_of_truth.poses(repeats=True)
        part = _part_by_truth(sequence, poses)
        stamps = stated.timestamps_ns
    covered, odd, last = _join(
        loaded.trajectory, to_seconds(stamps), f"{file} shares", f"'{part.id}'"
    )
    total = len(stamps)
    if opened is None:
        covered = len(loaded.trajectory)
        total = len(loaded.trajectory)
        last = len(loaded.trajectory) - 1
        notes.append(
            "coverage is unknown: the images of the sequence were not here, and so its frames are not known"
        )
    elif odd:
        notes.append(
            f"{odd} of {len(loaded.trajectory)} poses carry stamps that are no input frame's"
        )
    status, reason = judge_coverage(covered, total, total - 1 - last, total)
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
        **({} if timestamps is None else {"timestamps": digest_of(Path(timestamps).expanduser())}),
        **({} if topic is None else {"topic": topic}),
    }
    named = part_digest(identity)
    info = (
        sequence_info(opened, part.content, named)
        if stated is None
        else _info_by_truth(part, stated, named)
    )
    record = RunRecord(
        kind="imported",
        run_id=run_id_of(identity),
        status=status,
        reason=reason,
        tracker=TrackerInfo(
            id=tracker, label=label or f"{tracker} (imported)", provenance="external"
        ),
        sequence=info,
        frames=None if frames is None else parse_frames(frames),
        stride=stride,
        n_frames=total,
        n_tracked=covered,
        n_lost=total - covered,
        coverage=None if opened is None else covered / total,
        started=datetime.now(timezone.utc).isoformat(timespec="milliseconds"),
        versions=versions(),
        identity=identity,
        provenance=provenance or stated_provenance(file) or str(file),
        place="" if opened is None else place_of(sequence),
        stamps_match=not odd and opened is not None,
        notes=notes,
    ).normalised()
    store = results if isinstance(results, RunStore) else RunStore(results)
    store.prepare()
    with store.work_folder(record.run_id) as work:
        write_tum(
            work / f"trajectory_{which}.txt",
            loaded.trajectory,
            comment=f"imported: {tracker} on {part.id}",
        )
        store.add_sequence(record.sequence.part, stamps, poses)
        store.publish(work, record)
    return record


def _part_by_truth(sequence: str, truth: Trajectory) -> Part:
    """The whole of a sequence of which only the ground truth is here."""
    entry = entry_of(sequence)
    content = digest([truth.timestamps_ns.tolist(), truth.T_world_cam.round(9).tolist()])
    return Part(
        sequence if entry is None else entry.id, content, content, {}, 0, len(truth), 1, None
    )


def _info_by_truth(part: Part, truth: Trajectory, named: str) -> SequenceInfo:
    """What is known of it: the catalogue's entry and the camera's motion."""
    entry = entry_of(part.id)
    stated = (
        {}
        if entry is None
        else {name: getattr(entry, name) for name in ("fps", "license", "citation", "split")}
    )
    return SequenceInfo(
        id=part.id,
        content=part.content,
        part=named,
        block=part.block,
        frames=len(truth),
        duration_s=float(truth.timestamps[-1] - truth.timestamps[0]),
        ground_truth=True,
        tags=sorted({*(entry.tags if entry else ()), *motion_tags(truth)}),
        **({"fps": 0.0} | stated),
    )


def _join(trajectory: Trajectory, stamps: Array, shares: str, name: str) -> tuple[int, int, int]:
    """How many frames a trajectory covers, how many of its poses carry no frame's stamp, and the last frame it covers.

    Raises:
        RunError: Fewer than two of them are near a frame; `shares` and `name` say whose they are.
    """
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
    odd = len(trajectory) - len(exact)
    return (len(near) if odd else len(exact)), odd, int(near[-1])
