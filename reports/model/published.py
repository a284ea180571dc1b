"""Published numbers as data: what papers report, each with where it was read; never mixed with runs."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from ..tables.sequences import ReportedCell

CLAIMED = "claimed by the paper"
_TUM_S = {
    "tum/fr3/sitting_static": 23.63, "tum/fr3/sitting_xyz": 42.50, "tum/fr3/sitting_halfsphere": 37.15,
    "tum/fr3/sitting_rpy": 27.48, "tum/fr3/walking_static": 24.83, "tum/fr3/walking_xyz": 28.83,
    "tum/fr3/walking_halfsphere": 35.81, "tum/fr3/walking_rpy": 30.61,
}  # fmt: skip
_BONN_S = 10.0


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


@cache
def published() -> tuple[Published, ...]:
    """All published numbers."""
    return tuple(
        Published(
            system=line["system"], sequence=line["sequence"], metric=line["metric"], value=float(line["value"]),
            unit=line["unit"], alignment=line["alignment"], source=line["source"], remarks=line["remarks"],
        )
        for line in _lines("published.csv")
    )  # fmt: skip


@cache
def claimed() -> tuple[Claimed, ...]:
    """Tables 1 to 3 of the paper, as printed."""
    return tuple(
        Claimed(
            table=int(line["table"]), system=line["system"], sequence=line["sequence"], quantity=line["quantity"],
            kind=line["kind"], value=float(line["value"]), digits=len(line["value"].partition(".")[2]),
        )
        for line in _lines("claimed.csv")
    )  # fmt: skip


def is_excerpt(sequence: str, duration_s: float) -> bool:
    """Whether a recording under a published name is so short that it can only be a part of it.

    The recorded lengths are those of the TUM benchmark's page; every sequence of the Bonn data set lasts longer than
    `_BONN_S`. Of others nothing is known.
    """
    whole = _TUM_S.get(sequence, _BONN_S if sequence.startswith("bonn/") else 0.0)
    return duration_s < 0.9 * whole


def reported_for(sequences: Sequence[str], alignment: str = "se3") -> list[ReportedCell]:
    """The published ATEs of whole sequences.

    Args:
        sequences: Names of a report's whole sequences.
        alignment: Alignment of the report's protocol; numbers known to be aligned otherwise are left out.

    Returns:
        One cell for every system, source and sequence, and those that the implemented paper claims, tagged so.
    """
    if alignment not in ("se3", "sim3"):
        return []
    wanted = set(sequences)
    from_papers = [
        ReportedCell(f"{p.system} ({p.source})", p.sequence, p.value, "; ".join(filter(None, (p.alignment, p.remarks))))
        for p in published()
        if p.metric == "ate_rmse_m" and p.sequence in wanted and (p.alignment == "Sim(3)") == (alignment == "sim3")
    ]
    remark = "contradicts itself and what the systems' authors published; see the audit"
    claims = [
        ReportedCell(c.system, c.sequence, c.value, remark, CLAIMED)
        for c in claimed()
        if c.kind == "value" and c.quantity == "ape_rmse" and c.sequence in wanted and alignment == "se3"
    ]
    return from_papers + claims


def _lines(name: str) -> list[dict[str, str]]:
    text = (files("dynslam_bench.reports.model") / "data" / name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))
