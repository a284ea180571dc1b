"""Files of a bank beside its runs: its description, and marks of who has run a row again."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import Field

from dynslam_bench.core import DynslamError, RunError
from dynslam_bench.core.fingerprint import Machine
from dynslam_bench.core.records import Name, Record, RunId, is_plain_name, schema
from dynslam_bench.evaluation import get_protocol
from dynslam_bench.runs.layout import Unreadable
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.store import DEFAULT_PROTOCOL

DESCRIPTION_FILE = "bank.json"
"""Holds the description of a bank; older banks have none."""
MARKS_FOLDER = "marks"
"""Holds the marks, one file for each row and name: ``marks/<run_id>/<name>.json``."""


class BankDescription(Record):
    """Facts that hold for a whole bank.

    Attributes:
        schema_version: Version of this record's fields.
        protocol: Id of the protocol under which rows are compared.
        protocol_digest: Digest of that protocol.
        probes: For each rendered family the digest of two frames of a public scene, as the machine
            rendered them that added the family; by the scene's id.
    """

    schema_version: int = schema(1)
    protocol: str = DEFAULT_PROTOCOL
    protocol_digest: str = ""
    probes: dict[str, str] = Field(default_factory=dict)

    def difference(self, other: BankDescription) -> str:
        """The first thing that keeps rows of two banks from being compared; empty for none."""
        if self.protocol != other.protocol:
            return f"one has the protocol {self.protocol}, the other {other.protocol}"
        if self.protocol_digest and other.protocol_digest:
            if self.protocol_digest != other.protocol_digest:
                digests = f"{self.protocol_digest} and {other.protocol_digest}"
                return f"their protocols {self.protocol} have the digests {digests}"
        for scene in sorted(self.probes.keys() & other.probes.keys()):
            if self.probes[scene] != other.probes[scene]:
                digests = f"{self.probes[scene][:16]} and {other.probes[scene][:16]}"
                return f"their machines render other bits: {scene} has the digests {digests}"
        return ""


def new_description(protocol: str) -> BankDescription:
    """The description of a bank without rows.

    Raises:
        DynslamError: There is no such protocol.
    """
    return BankDescription(protocol=protocol, protocol_digest=get_protocol(protocol).digest())


def read_description(bank: Path) -> BankDescription:
    """The description of a bank; that of the default protocol where it has none.

    Raises:
        DynslamError: It is damaged.
    """
    file = bank / DESCRIPTION_FILE
    return BankDescription.read(file) if file.is_file() else new_description(DEFAULT_PROTOCOL)


class Mark(Record):
    """Statement that a person or machine has run a row again, and by how much the error differed.

    Attributes:
        schema_version: Version of this record's fields.
        run_id: The row.
        by: Who has run it again.
        made: When, UTC, ISO 8601.
        machine: Where.
        versions: Versions of Python and the packages that matter.
        protocol: Protocol of the errors.
        ate_m: The row's error, metres.
        ate_again_m: Error of the new run, metres.
        identical: Whether all trajectories are equal to the last bit that the files hold.
        repeats_differ_m: Largest difference between repeats, metres; None where none was needed.
        repeats: Number of repeats that were compared for it.
        changed: Parts of the program that were other ones than the row's, e.g. a library's version.
    """

    schema_version: int = schema(1)
    run_id: RunId
    by: Name
    made: str
    machine: Machine
    versions: dict[str, str] = Field(default_factory=dict)
    protocol: str
    ate_m: float = Field(ge=0)
    ate_again_m: float = Field(ge=0)
    identical: bool = False
    repeats_differ_m: float | None = Field(default=None, ge=0)
    repeats: int = Field(default=0, ge=0)
    changed: list[str] = Field(default_factory=list)

    @property
    def difference_m(self) -> float:
        """How far the two errors differ, metres."""
        return abs(self.ate_again_m - self.ate_m)

    def describe(self) -> str:
        """One line: who, how far, where."""
        difference = f"differs by {1000 * self.difference_m:.3f} mm"
        if self.identical:
            difference = "equal to the bit"
        elif self.repeats_differ_m is not None:
            difference += f", repeats by {1000 * self.repeats_differ_m:.3f} mm"
        return f"{self.by}: {difference}, {self.machine.cpu}"

    def fault(self, description: BankDescription, rows: Iterable[str]) -> str:
        """Fault of the mark in a bank of these rows; empty for none."""
        if self.run_id not in rows:
            return f"there is no row {self.run_id}"
        if self.protocol != description.protocol:
            return f"it is under {self.protocol}, the bank under {description.protocol}"
        if self.identical:
            return (
                "" if not self.difference_m else "it says equal to the bit, and its errors differ"
            )
        if self.repeats_differ_m is None or self.difference_m > self.repeats_differ_m:
            return f"it differs by {1000 * self.difference_m:.3f} mm, beyond what its repeats differ by"
        return ""


def mark_file(bank: Path, run_id: str, by: str) -> Path:
    """The file of a mark.

    Raises:
        RunError: The name is none.
    """
    if not is_plain_name(by):
        raise RunError(f"'{by}' is no name for a mark", "letters, digits, dots and dashes")
    return bank / MARKS_FOLDER / run_id / f"{by}.json"


def read_marks(bank: Path) -> tuple[dict[str, list[Mark]], list[Unreadable]]:
    """The marks of a bank by row, in order of their dates, and the files that hold none, with reasons."""
    marks: dict[str, list[Mark]] = {}
    unreadable = []
    for file in sorted((bank / MARKS_FOLDER).glob("*/*.json")):
        try:
            mark = Mark.read(file)
        except DynslamError as error:
            unreadable.append(Unreadable(file, str(error)))
            continue
        if (file.parent.name, file.stem) != (mark.run_id, mark.by):
            names = f"{mark.run_id} by {mark.by}"
            unreadable.append(Unreadable(file, f"it is the mark of {names}, not of its name"))
            continue
        marks.setdefault(mark.run_id, []).append(mark)
    for of_row in marks.values():
        of_row.sort(key=lambda mark: mark.made)
    return marks, unreadable


def standing(record: RunRecord, marks: Mapping[str, list[Mark]]) -> str:
    """Whether a row is its owner's alone, imported, or was reproduced, and by how many."""
    if record.kind == "imported":
        return "imported"
    count = len(marks.get(record.run_id, ()))
    return f"reproduced by {count}" if count else "own"
