"""Trajectories from elsewhere as records beside our own runs."""

from __future__ import annotations

from datetime import datetime, timezone
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dynslam_bench.core.errors import RunError
from dynslam_bench.core.machine import versions
from dynslam_bench.core.records import digest
from dynslam_bench.envs.source import Frames, open_frames
from dynslam_bench.evaluation.frames import STAMP_TOLERANCE
from dynslam_bench.geometry.association import associate, nearest_gap
from dynslam_bench.geometry.tum_file import load_tum, write_tum
from dynslam_bench.sequences.catalogue import parse_frames
from dynslam_bench.sequences.part import part_of

from ..one import part_digest, sequence_info
from ..spec import place_of
from .record import RunRecord, TrackerInfo
from .store import RunStore

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
) -> RunRecord:
    """Store an external trajectory as a record of kind ``imported``.

    Args:
        path: Trajectory file in TUM format.
        tracker: Name of the system that made it.
        sequence: The sequence that it was made on; its ground truth is needed to score it.
        results: The results folder, or a store.
        label: Name for tables; default is ``<tracker> (imported)``.
        provenance: Where it came from, e.g. a URL or "authors' repository".
        which: Whether its poses are the causal ones or those after the final optimisation.
        frames: Part of the sequence it covers; None for all.
        stride: Every so many frames.
        data_root: Folder of the recorded sequences.
        camera: Camera of a folder that does not say its own.

    Returns:
        The record. Poses whose stamps are no input frame's are kept, and said so in its notes.

    Raises:
        TrajectoryError: The file cannot be read.
        RunError: It shares no time with the sequence (with the measured gap), or the name is empty.
        DynslamError: The sequence cannot be opened, or the store not be written.
    """
    if not tracker.strip():
        raise RunError("an imported trajectory needs the name of its tracker")
    file = Path(path).expanduser()
    loaded = load_tum(file)
    trajectory = loaded.trajectory
    opened = open_frames(sequence, data_root, camera, frames, stride)
    store = results if isinstance(results, RunStore) else RunStore(results)
    stamps = opened.timestamps
    exact, _ = associate(stamps, trajectory.timestamps, STAMP_TOLERANCE, strict=False)
    near, _ = associate(stamps, trajectory.timestamps, _TOLERANCE_S)
    if len(near) < 2:
        gap = float(np.min(nearest_gap(trajectory.timestamps, stamps)))
        raise RunError(
            f"{file} shares {len(near)} stamps with '{opened.id}', at least 2 are needed",
            f"the nearest is {gap:.3f} s off; frames last from {stamps[0]:.6f} to {stamps[-1]:.6f}",
        )
    notes = loaded.notes.describe()
    matching = len(exact) == len(trajectory)
    if not matching:
        odd = len(trajectory) - len(exact)
        notes.append(f"{odd} of {len(trajectory)} poses carry stamps that are no input frame's")
    covered = len(exact) if matching else len(near)
    part = None if frames is None else parse_frames(frames if isinstance(frames, str) else (frames[0] or 0, frames[1]))
    seen = part_of(opened)
    identity: dict[str, Any] = {
        "kind": "imported", "tracker": tracker, "which": which, "file": sha256(file.read_bytes()).hexdigest(),
        "sequence": seen.id, "content": seen.content, "frames": [seen.start, seen.stop], "offset": 0,
        "stride": seen.stride,
    }  # fmt: skip
    record = RunRecord(
        kind="imported", run_id=digest(identity, 16), status="ok",
        tracker=TrackerInfo(id=tracker, label=label or f"{tracker} (imported)", provenance="external"),
        sequence=sequence_info(opened, seen.content, part_digest(identity)), frames=part, stride=stride,
        n_frames=len(opened), n_tracked=covered, n_lost=len(opened) - covered, coverage=covered / len(opened),
        stamps_match=matching, started=datetime.now(timezone.utc).isoformat(timespec="milliseconds"),
        versions=versions(), identity=identity, provenance=provenance or str(file), notes=notes,
        place=place_of(sequence),
    ).normalised()  # fmt: skip
    store.prepare()
    with store.work_folder(record.run_id) as work:
        write_tum(work / f"trajectory_{which}.txt", trajectory, comment=f"imported: {tracker} on {opened.id}")
        store.add_sequence(record.sequence.part, stamps, opened.ground_truth)
        store.publish(work, record)
    return record
