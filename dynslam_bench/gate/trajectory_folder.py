"""Trajectory files of others as the runs of a gate: nothing is run here."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from dynslam_bench.core import RunError
from dynslam_bench.gate.baseline import Measurement, measurement_of
from dynslam_bench.gate.config import TRAJECTORIES, Cases, Gate
from dynslam_bench.runs.exchange.transfer import import_trajectory
from dynslam_bench.runs.store import RunStore

_LISTED = 5
"""Names of a folder that an error shows."""


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
    in order of their names; hidden files are left out. `file_name` says how a case is called. Any
    format of `read_trajectory` is read.

    Args:
        folder: The folder.
        cases: What the gate runs.
        store: Takes the trajectories as imported runs.
        gate: The question.

    Raises:
        RunError: Cases have no file, or several could be meant; names the first one's.
        DynslamError: A file cannot be read, or does not belong to the sequence.
    """
    place = folder.expanduser()
    _refuse_equal_names(cases)
    files = {case: _files_of(place, case) for case in cases}
    missing = [case for case, of_case in files.items() if not of_case]
    if missing:
        first = file_name(missing[0])
        raise RunError(
            f"{folder} has no trajectory of {len(missing)} of {len(cases)} sequences: {', '.join(missing)}"
            f"; it holds {_listed(place)}",
            f"put the first one's there as {first}.txt, or several runs into the folder {first}",
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
    """The files of a case, one a run; hidden ones are none.

    Raises:
        RunError: Two files could be its one run.
    """
    name = file_name(case)
    several = folder / name
    if several.is_dir():
        return _visible_files(several.iterdir())
    files = _visible_files(folder.glob(f"{name}.*"))
    if len(files) > 1:
        raise RunError(
            f"{folder} has {len(files)} files for {case}: {', '.join(file.name for file in files)}",
            f"keep one, or put the files of several runs into the folder {name}",
        )
    return files


def _visible_files(paths: Iterable[Path]) -> list[Path]:
    return sorted(path for path in paths if path.is_file() and not path.name.startswith("."))


def _refuse_equal_names(cases: Iterable[str]) -> None:
    """Refuse cases whose files would be the same.

    Raises:
        RunError: Names two.
    """
    by_name: dict[str, str] = {}
    for case in cases:
        name = file_name(case)
        if name in by_name:
            raise RunError(
                f"the files of {by_name[name]} and of {case} would have the same name, {name}",
                "judge them in two gates, or rename the folder of one sequence",
            )
        by_name[name] = case


def _listed(folder: Path) -> str:
    """The first names in a folder, in words."""
    if not folder.is_dir():
        return "nothing: there is no such folder"
    names = sorted(path.name for path in folder.iterdir())
    if not names:
        return "nothing"
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more
