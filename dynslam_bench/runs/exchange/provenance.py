"""Where an exported trajectory came from: ``provenance.json`` beside it, which an import takes up again."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

import dynslam_bench
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.records import Digest, Record

from ..storage.record import RunRecord

PROVENANCE_FILE = "provenance.json"
PROVENANCE_SCHEMA = 1


class Provenance(Record):
    """What an export was made of.

    Attributes:
        schema_version: Of this record.
        format: Name of the format.
        files: SHA-256 of every file by its name.
        run_id: The run.
        tracker: Its tracker's id.
        tracker_version: And version.
        tracker_provenance: ``own``, ``faithful-code``, ... or ``external`` for a trajectory that had been imported.
        sequence: Id of the sequence.
        frames: Part of it; None for all.
        offset: So many leading frames of that part were left out.
        stride: Every so many frames.
        seed: Seed.
        which: Which trajectory: ``online`` or ``final``.
        overrides: The settings that were asked for.
        origin: For a run that was imported: where its trajectory had come from.
        written_by: Version of this package.
    """

    schema_version: int = PROVENANCE_SCHEMA
    format: str
    files: dict[str, str]
    run_id: Digest
    tracker: str
    tracker_version: str = ""
    tracker_provenance: str = ""
    sequence: str
    frames: tuple[int, int | None] | None = None
    offset: int = 0
    stride: int = 1
    seed: int = 0
    which: Literal["online", "final"]
    overrides: dict[str, Any] = Field(default_factory=dict)
    origin: str = ""
    written_by: str = ""

    def describe(self) -> str:
        """One line, for the record of an import."""
        origin = f", which came from {self.origin}" if self.origin else ""
        return (
            f"{self.which} trajectory of run {self.run_id} of {self.tracker} {self.tracker_version} on {self.sequence}"
            f"{origin}, exported as {self.format} by dynslam-bench {self.written_by}"
        )


def provenance_of(record: RunRecord, form: str, which: Literal["online", "final"], folder: Path) -> Provenance:
    """The provenance of the files of an export that lie in a folder."""
    files = sorted(path for path in folder.iterdir() if path.is_file())
    same = ("run_id", "frames", "offset", "stride", "seed", "overrides")
    return Provenance(
        format=form,
        files={path.name: digest_of(path) for path in files},
        tracker=record.tracker.id,
        tracker_version=record.tracker.version,
        tracker_provenance=record.tracker.provenance,
        sequence=record.sequence.id,
        which=which,
        origin=record.provenance,
        written_by=dynslam_bench.__version__,
        **{name: getattr(record, name) for name in same},
    )


def stated_provenance(file: Path) -> str:
    """What ``provenance.json`` beside a trajectory says of it; empty where there is none, or the file has changed.

    Args:
        file: The trajectory, or the folder that holds it.
    """
    beside = (file if file.is_dir() else file.parent) / PROVENANCE_FILE
    if not beside.is_file():
        return ""
    try:
        found = Provenance.read(beside)
        files = [file] if file.is_file() else [file / name for name in found.files if Path(name).name == name]
        intact = bool(files) and all(found.files.get(path.name) == digest_of(path) for path in files)
    except (DynslamError, OSError, ValueError):  # ValueError: a name with a null byte
        return ""
    return found.describe() if intact else ""


def digest_of(path: Path) -> str:
    """SHA-256 of a file, or of all files directly in a folder, in order of their names.

    Raises:
        OSError: One cannot be read.
    """
    found = sha256()
    for each in sorted(part for part in path.iterdir() if part.is_file()) if path.is_dir() else [path]:
        with each.open("rb") as file:
            while block := file.read(1 << 20):
                found.update(block)
    return found.hexdigest()
