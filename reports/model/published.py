"""Published numbers as data: what papers report, each with where it was read; never mixed with runs."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from dynslam_bench.evaluation.protocol import PROTOCOLS, Protocol

CLAIMED = "claimed by the paper"
_FPS = 30.0
_SITTING = {"static": 680, "xyz": 1219, "halfsphere": 1074, "rpy": 795}
_WALKING = {"static": 717, "xyz": 825, "halfsphere": 1021, "rpy": 866}
_LEAST_FRAMES = {f"tum/fr3/sitting_{name}": frames for name, frames in _SITTING.items()}
_LEAST_FRAMES |= {f"tum/fr3/walking_{name}": frames for name, frames in _WALKING.items()}
_LEAST_FRAMES |= {"bonn/crowd": 425}
"""So many frames a recording has at least. TUM: the pairs of colour and depth in the association files that are
published with the code of DynaSLAM (walking_xyz: of DANI-SLAM). Bonn: the last frame of an excerpt that is numbered as
in the whole, counted from 0. Of others no source was read."""


@dataclass(frozen=True)
class Published:
    """One published number.

    Attributes:
        system: Its name; name collisions are told apart, e.g. ``DGS-SLAM (Kong 2024)``.
        sequence: Sequence id.
        metric: Metric name as in `Evaluation.metrics`.
        value: The number.
        unit: Its unit.
        alignment: Alignment of the trajectory as far as stated.
        source: Where it was read; this need not be the system's own paper.
        remarks: What a reader should know.
    """

    system: str
    sequence: str
    metric: str
    value: float
    unit: str
    alignment: str
    source: str
    remarks: str = ""

    def scored_as(self, protocol: Protocol) -> bool:
        """Whether it was scored as a protocol scores, as far as is known.

        What is aligned by Sim(3) is from tables of WildGS-SLAM's evaluation, which corrects Bonn's truth.
        """
        scaled = self.alignment == "Sim(3)"
        truth = "bonn-droid-w" if scaled and self.sequence.startswith("bonn/") else "as-is"
        return scaled == (protocol.alignment == "sim3") and truth == protocol.truth


@dataclass(frozen=True)
class Claimed:
    """One number of the paper that this project implements: claimed by the paper, not reproduced.

    Attributes:
        table: Table of the paper.
        system: System as named there.
        sequence: Sequence id.
        quantity: ``ape_rmse``, ``rpe_mean``, ``accuracy_percent``, ``time_ms``, ...
        kind: ``value``, or ``improvement_percent``: the gain of the paper's method over the system.
        value: The number.
        digits: Decimals as printed.
    """

    table: int
    system: str
    sequence: str
    quantity: str
    kind: str
    value: float
    digits: int


@dataclass(frozen=True)
class ReportedCell:
    """A published number.

    Attributes:
        system: Its name.
        sequence: Sequence of the board.
        value: ATE in metres.
        source: Where it was read.
        tag: What kind of number it is.
    """

    system: str
    sequence: str
    value: float
    source: str
    tag: str = "reported"


@cache
def published() -> tuple[Published, ...]:
    """All published numbers."""
    return tuple(Published(**(line | {"value": float(line["value"])})) for line in read_data("published.csv"))  # type: ignore[arg-type]


@cache
def claimed() -> tuple[Claimed, ...]:
    """Tables 1 to 3 of the paper, as printed."""
    return tuple(_claimed(**line) for line in read_data("claimed.csv"))


def _claimed(*, table: str, value: str, **words: str) -> Claimed:
    return Claimed(table=int(table), value=float(value), digits=len(value.partition(".")[2]), **words)


def least_length_s(sequence: str) -> float | None:
    """How long a published recording lasts at least, in seconds; None where that is not known."""
    frames = _LEAST_FRAMES.get(sequence)
    return None if frames is None else frames / _FPS


def is_excerpt(sequence: str, duration_s: float) -> bool:
    """Whether a recording under a published name is so short that it can only be a part of it.

    Of those whose length is not known (`least_length_s`) it is not said.
    """
    return duration_s < 0.9 * (least_length_s(sequence) or 0.0)


def reported_for(sequences: Sequence[str], protocol: Protocol) -> list[ReportedCell]:
    """The published ATEs of whole sequences.

    Args:
        sequences: Names of a report's whole sequences.
        protocol: The report's protocol; numbers known to be aligned or scored otherwise are left out.

    Returns:
        One cell for every system, source and sequence, and those that the implemented paper claims, tagged so.
    """
    alignment = protocol.alignment
    if alignment not in ("se3", "sim3") or protocol.thins:
        return []
    wanted = set(sequences)
    from_papers = [
        ReportedCell(f"{p.system} ({p.source})", p.sequence, p.value, "; ".join(filter(None, (p.alignment, p.remarks))))
        for p in published()
        if p.metric == "ate_rmse_m" and p.sequence in wanted and p.scored_as(protocol)
    ]
    remark = "contradicts itself and what the systems' authors published; see the audit"
    claims = [
        ReportedCell(c.system, c.sequence, c.value, remark, CLAIMED)
        for c in claimed()
        if c.kind == "value" and c.quantity == "ape_rmse" and c.sequence in wanted
        if alignment == "se3" and protocol.truth == "as-is"
    ]
    return from_papers + claims


def read_data(name: str) -> list[dict[str, str]]:
    """The rows of a table of this package's data."""
    text = (files("dynslam_bench.reports.model") / "data" / name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


# The field's records as data: the lowest published errors that were found, by sequence, with how each was read.

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
