"""The field's records as data: the lowest published errors that were found, by sequence, with how each was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

from dynslam_bench.evaluation.protocol import PROTOCOLS, Protocol

from .published import ReportedCell, read_data

RECORD = "record"
KINDS = {
    "best": "lowest error found in print",
    "cpu": "lowest error found in print, real time on a CPU",
    "masks": "ORB-SLAM2 with person masks, in print",
}
HOW = {"R": "read in its source", "S": "second-hand: another paper's table or notes", "I": "inferred"}


@dataclass(frozen=True)
class Record:
    """One record.

    Attributes:
        sequence: Sequence id.
        kind: See `KINDS`.
        system: Who holds it.
        value: ATE, RMSE in metres.
        input: ``RGB``, ``RGB-D`` or ``not stated``.
        alignment: Alignment as far as stated.
        protocol: Id of the protocol here that scores alike, as far as that is known; empty where it is not. A table
            that states no alignment and takes depth is taken for TUM's.
        hardware: As far as stated.
        source: Where it was found.
        how: How it was read, see `HOW`.
    """

    sequence: str
    kind: str
    system: str
    value: float
    input: str
    alignment: str
    protocol: str
    hardware: str
    source: str
    how: str

    def describe(self) -> str:
        """Everything but the number, in one line."""
        parts = [self.system, self.input, self.alignment, self.hardware, self.source, HOW[self.how]]
        return "; ".join(parts)


@cache
def records() -> tuple[Record, ...]:
    """All records, in the order of the file."""
    return tuple(Record(**(line | {"value": float(line["value"])})) for line in read_data("records.csv"))  # type: ignore[arg-type]


def records_for(sequences: Sequence[str], protocol: Protocol) -> list[ReportedCell]:
    """The records of whole sequences that were scored as a protocol scores; no others stand beside measured errors.

    Args:
        sequences: Names of a report's whole sequences.
        protocol: The report's protocol.
    """
    wanted, digest = set(sequences), protocol.digest()
    return [
        ReportedCell(KINDS[each.kind], each.sequence, each.value, each.describe(), RECORD)
        for each in records()
        if each.sequence in wanted and each.protocol and PROTOCOLS[each.protocol].digest() == digest
    ]
