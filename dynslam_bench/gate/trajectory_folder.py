"""Trajectory files of others as the runs of a gate: nothing is run here."""

from __future__ import annotations

import re
from pathlib import Path

from dynslam_bench.core import RunError
from dynslam_bench.gate.baseline import Measurement, measurement_of
from dynslam_bench.gate.config import TRAJECTORIES, Cases, Gate
from dynslam_bench.runs.exchange.transfer import import_trajectory
from dynslam_bench.runs.store import RunStore


def file_name(case: str) -> str:
    """How the file or folder of a case is called: what is no letter, digit, dot or hyphen becomes ``_``.

    Example:
        >>> file_name("synthetic/walking_xyz?scene=100")
        'synthetic_walking_xyz_scene_100'
    """
    return re.sub(r"[^A-Za-z0-9.-]+", "_", case).strip("_")


def import_folder(folder: Path, cases: Cases, store: RunStore, gate: Gate) -> list[Measurement]:
    """Score the trajectory files of a folder.

    A file with the name of a case and any ending is its one run. A folder of that name holds several,
    in order of their names. `file_name` says how a case is called. Any format of `read_trajectory` is read.

    Args:
        folder: The folder.
        cases: What the gate runs.
        store: Takes the trajectories as imported runs.
        gate: The question.

    Raises:
        RunError: Cases have no file; names the first one's.
        DynslamError: A file cannot be read, or does not belong to the sequence.
    """
    files = {case: _files_of(folder.expanduser(), case) for case in cases}
    missing = [case for case, of_case in files.items() if not of_case]
    if missing:
        raise RunError(
            f"{folder} has no trajectory of {len(missing)} of {len(cases)} sequences: {', '.join(missing)}",
            f"put the first one's there as {file_name(missing[0])}.txt, or several runs into the folder "
            f"{file_name(missing[0])}",
        )
    measurements = []
    for case, of_case in files.items():
        spec = cases[case]
        for number, file in enumerate(of_case):
            record = import_trajectory(
                file,
                TRAJECTORIES,
                spec.sequence,
                results=store,
                frames=spec.frames,
                stride=spec.stride,
                data_root=spec.data_root,
                camera=spec.camera,
            )
            measurements.append(measurement_of(case, number, record, store, gate.protocol))
    return measurements


def _files_of(folder: Path, case: str) -> list[Path]:
    """The files of a case, one a run."""
    several = folder / file_name(case)
    if several.is_dir():
        return sorted(file for file in several.iterdir() if file.is_file())
    return sorted(file for file in folder.glob(f"{file_name(case)}.*") if file.is_file())[:1]
