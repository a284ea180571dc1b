"""Trajectories from elsewhere as records beside our own runs."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import timestamps_ns
from dynslam_bench.core.errors import RunError
from dynslam_bench.core.fingerprint import versions
from dynslam_bench.core.records import digest
from dynslam_bench.envs.arguments import Frames, open_frames
from dynslam_bench.evaluation.comparison import STAMP_TOLERANCE
from dynslam_bench.geometry.association import associate, nearest_gap
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.geometry.trajectory_files import write_tum
from dynslam_bench.runs.exchange.export import digest_of, stated_provenance
from dynslam_bench.runs.exchange.formats import read_trajectory
from dynslam_bench.runs.record import RunRecord, TrackerInfo
from dynslam_bench.runs.running import judge_coverage, part_digest, sequence_info
from dynslam_bench.runs.spec import place_of
from dynslam_bench.runs.store import RunStore
from dynslam_bench.sequences.catalogue import parse_frames
from dynslam_bench.sequences.view import part_of

_TOLERANCE_S = 0.02


def import_trajectory(
    path: str | Path,
    tracker: str,
    sequence: str,
    *,
    results: str | Path | RunStore = "results",
    label: str = "",
    provenance: str = "",
    which: Literal["online", "final"] = "final",
    frames: Frames = None,
    stride: int = 1,
    data_root: str | Path | None = None,
    camera: str | Path | None = None,
    timestamps: str | Path | None = None,
    topic: str | None = None,
) -> RunRecord:
    """Store an external trajectory as a record of kind ``imported``.

    Args:
        path: A trajectory in any of the formats that `read_trajectory` knows.
        tracker: Name of the system that made it.
        sequence: The sequence that it was made on; its ground truth is needed to score it.
        results: The results folder, or a store.
        label: Name for tables; default is ``<tracker> (imported)``.
        provenance: Where it came from, e.g. a URL; by default what ``provenance.json`` beside it says, else its name.
        which: Whether its poses are the causal ones or those after the final optimisation.
        frames: Part of the sequence it covers; None for all.
        stride: Every so many frames.
        data_root: Folder of the recorded sequences.
        camera: Camera of a folder that does not say its own.
        timestamps: Stamps where the format has none: for KITTI a file whose lines begin with one each, in seconds, for
            COLMAP a list of stamps and images.
        topic: Of a bag with several topics of poses, the one to take.

    Returns:
        The record, ``lost`` by the rule of runs (`judge_coverage`); its notes count poses whose stamps are no frame's.

    Raises:
        DynslamError: The trajectory cannot be read.
        RunError: It shares no time with the sequence (with the measured gap), or the name is empty.
        DynslamError: The sequence cannot be opened, or the store not be written.
    """
    if not tracker.strip():
        raise RunError("an imported trajectory needs the name of its tracker")
    file = Path(path).expanduser()
    loaded = read_trajectory(file, timestamps, topic)
    opened = open_frames(sequence, data_root, camera, frames, stride)
    covered, odd, last = _join(loaded.trajectory, opened.timestamps, f"{file} shares", f"'{opened.id}'")
    notes, total = loaded.notes.describe(), len(opened)
    if odd:
        notes.append(f"{odd} of {len(loaded.trajectory)} poses carry stamps that are no input frame's")
    status, reason = judge_coverage(covered, total, total - 1 - last, total)
    part = part_of(opened)
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
    record = RunRecord(
        kind="imported",
        run_id=digest(identity, 16),
        status=status,
        reason=reason,
        tracker=TrackerInfo(id=tracker, label=label or f"{tracker} (imported)", provenance="external"),
        sequence=sequence_info(opened, part.content, part_digest(identity)),
        frames=None if frames is None else parse_frames(frames),
        stride=stride,
        n_frames=total,
        n_tracked=covered,
        n_lost=total - covered,
        coverage=covered / total,
        started=datetime.now(timezone.utc).isoformat(timespec="milliseconds"),
        versions=versions(),
        identity=identity,
        provenance=provenance or stated_provenance(file) or str(file),
        place=place_of(sequence),
        stamps_match=not odd,
        notes=notes,
    ).normalised()
    store = results if isinstance(results, RunStore) else RunStore(results)
    store.prepare()
    with store.work_folder(record.run_id) as work:
        write_tum(work / f"trajectory_{which}.txt", loaded.trajectory, comment=f"imported: {tracker} on {opened.id}")
        store.add_sequence(record.sequence.part, timestamps_ns(opened), opened.ground_truth)
        store.publish(work, record)
    return record


def _join(trajectory: Trajectory, stamps: NDArray[np.float64], shares: str, name: str) -> tuple[int, int, int]:
    """How many frames a trajectory covers, how many of its poses carry no frame's stamp, and the last frame it covers.

    Raises:
        RunError: Fewer than two of them are near a frame; `shares` and `name` say whose they are.
    """
    exact, _ = associate(stamps, trajectory.timestamps, STAMP_TOLERANCE, strict=False)
    near, _ = associate(stamps, trajectory.timestamps, _TOLERANCE_S)
    if len(near) < 2:
        gap = float(np.min(nearest_gap(trajectory.timestamps, stamps)))
        raise RunError(
            f"{shares} {len(near)} stamps with {name}, at least 2 are needed",
            f"the nearest is {gap:.3f} s off; frames last from {stamps[0]:.6f} to {stamps[-1]:.6f}",
        )
    odd = len(trajectory) - len(exact)
    return (len(near) if odd else len(exact)), odd, int(near[-1])
