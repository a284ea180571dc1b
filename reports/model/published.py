"""Published numbers as data: what papers report and the lowest errors in print, each with where it was read.

They are never mixed with runs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import pandas as pd

from dynslam_bench.evaluation import PROTOCOLS, Protocol

CLAIMED = "claimed by the paper"
"""Tag of what the implemented paper claims."""
_LEAST_FRAMES = {
    "tum/fr3/sitting_static": 680,
    "tum/fr3/sitting_xyz": 1219,
    "tum/fr3/sitting_halfsphere": 1074,
    "tum/fr3/sitting_rpy": 795,
    "tum/fr3/walking_static": 717,
    "tum/fr3/walking_xyz": 825,
    "tum/fr3/walking_halfsphere": 1021,
    "tum/fr3/walking_rpy": 866,
    "bonn/crowd": 425,
}
"""Least number of frames of a recording, at 30 Hz. TUM: the pairs of colour and depth in the association files that are
published with the code of DynaSLAM (walking_xyz: of DANI-SLAM). Bonn: the last frame of an excerpt
that is numbered as in the whole, counted from 0. Of others no source was read."""
METRICS = (
    "ate_rmse_m",
    "ate_mean_m",
    "ate_median_m",
    "ate_sd_m",
    "rpe_1s_trans_rmse_m",
    "rpe_1s_rot_rmse_deg",
    "coverage_percent",
)
"""Metrics of published numbers, the error that is always sought first."""
NOT_STATED = "not stated"
"""In place of what a source does not say."""
RECORD = "record"
"""Tag of the lowest published errors."""
KINDS = {
    "best": "lowest error found in print",
    "cpu": "lowest error found in print, real time on a CPU",
    "masks": "ORB-SLAM2 with person masks, in print",
}
"""Kind of a record to its words."""
HOW = {
    "R": "read in its source",
    "S": "second-hand: another paper's table or notes",
    "I": "inferred",
}
"""Words for the form in which a record is known, by its letter."""


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
def published() -> pd.DataFrame:
    """All published numbers, one a line.

    Columns: system (name collisions are told apart, e.g. ``DGS-SLAM (Kong 2024)``), sequence (its
    id), metric (as in `Evaluation.metrics`), value, unit, alignment (as far as stated), source
    (where it was read), by (``authors`` where that is the system's own publication, ``third party``
    where it is another one, which may have run the system or quote its authors; empty where both
    print the number), year (of the source), hardware (of the runs), remarks. Unknown hardware is
    empty.
    """
    frame = _read("published.csv")
    return frame.assign(year=frame["year"].replace("", pd.NA)).astype(
        {"value": float, "year": "Int64"}
    )


def published_for(sequences: Sequence[str], protocol: Protocol | None = None) -> pd.DataFrame:
    """Published numbers of whole sequences, a line a system and source, the lowest ATE of a sequence first.

    Args:
        sequences: Ids of the sequences.
        protocol: Only what is known to be scored alike (`scored_as`); None for everything.

    Returns:
        Columns: sequence, system, source, by, year, alignment, hardware and remarks as in
        `published`, then one for every metric (``Float64``).
    """
    frame = published()
    frame = frame[frame["sequence"].isin(sequences)]

    # one line for every sequence, system and source, with the facts of its first metric
    key = ["sequence", "system", "source"]
    first = frame.sort_values("metric").drop_duplicates(key)
    facts = first[[*key, "by", "year", "alignment", "hardware", "remarks"]]

    # a column for every metric
    values = frame.pivot(index=key, columns="metric", values="value").astype("Float64")
    lines = facts.join(values.reindex(columns=METRICS), on=key)
    lines = lines.sort_values(["sequence", METRICS[0], "system"])
    if protocol is None:
        return lines
    is_alike = [scored_as(line.alignment, line.sequence, protocol) for line in lines_of(lines)]
    return lines.loc[is_alike]


def spans(lines: pd.DataFrame) -> pd.DataFrame:
    """Between which values the published ATEs of one system under one alignment lie, the widest ratio first.

    Args:
        lines: Lines of `published_for`.

    Returns:
        One line where there are several. Columns: sequence, system, alignment, numbers, ratio,
        lowest_m, highest_m, authors_m (the lowest by its authors, missing where none was read).
    """
    # others call DynaSLAM by its short name
    systems = lines["system"].replace("DynaSLAM N+G", "DynaSLAM")
    by_authors = lines[METRICS[0]].where(lines["by"] == "authors")
    errors = lines.assign(system=systems, own=by_authors).dropna(subset=METRICS[0])

    # the lowest and the highest of each system, sequence and alignment
    groups = errors.groupby(["sequence", "system", "alignment"])
    frame = groups.agg(
        numbers=(METRICS[0], "size"),
        lowest_m=(METRICS[0], "min"),
        highest_m=(METRICS[0], "max"),
        authors_m=("own", "min"),
    )
    frame.insert(1, "ratio", frame["highest_m"] / frame["lowest_m"])
    return frame[frame["numbers"] > 1].sort_values("ratio", ascending=False).reset_index()


@cache
def claimed_results() -> pd.DataFrame:
    """Tables 1 to 3 of the paper that this project implements, as printed: claimed, not reproduced.

    Columns: table, system (as named there), sequence (its id), quantity (``ape_rmse``,
    ``rpe_mean``, ``accuracy_percent``, ``time_ms``, ...), kind (``value``, or
    ``improvement_percent``: the gain of the paper's method over the system), value, digits
    (decimals as printed).
    """
    frame = _read("claimed.csv")
    digits = frame["value"].str.partition(".")[2].str.len()
    return frame.astype({"table": int, "value": float}).assign(digits=digits)


@cache
def records() -> pd.DataFrame:
    """The lowest published errors that were found, by sequence and kind (see `KINDS`).

    Columns: sequence, kind, system, value (ATE, RMSE in metres), input (``RGB``, ``RGB-D`` or
    ``not stated``), alignment (as far as stated), protocol (id of the protocol here that scores
    alike, empty where that is not known; a table that states no alignment and takes depth is taken
    for TUM's), hardware, source, how (see `HOW`).
    """
    return _read("records.csv").astype({"value": float})


@cache
def static_camera_errors() -> dict[tuple[str, str], float]:
    """Errors of a static camera by sequence and metric, from the published ground truth."""
    frame = _read("never_move.csv").astype({"value": float})
    keys = zip(frame["sequence"], frame["metric"], strict=True)
    return dict(zip(keys, frame["value"], strict=True))


def least_length_s(sequence: str) -> float | None:
    """Least duration of a published recording, in seconds; None where that is not known."""
    frames = _LEAST_FRAMES.get(sequence)
    return None if frames is None else frames / 30.0


def is_excerpt(sequence: str, duration_s: float) -> bool:
    """Whether a recording under a published name is so short that it can only be a part of it.

    Of those whose length is not known (`least_length_s`) it is not said.
    """
    return duration_s < 0.9 * (least_length_s(sequence) or 0.0)


def reported_for(sequences: Sequence[str], protocol: Protocol) -> list[ReportedCell]:
    """The published ATEs of whole sequences.

    Args:
        sequences: Names of a report's whole sequences.
        protocol: The report's protocol; numbers known to be aligned or scored otherwise are left
            out.

    Returns:
        One cell for every system, source and sequence, and those that the implemented paper claims,
        tagged so.
    """
    # what systems' authors and others published
    cells = []
    for line in lines_of(published_for(sequences, protocol).dropna(subset=METRICS[0])):
        year = "" if pd.isna(line.year) else str(line.year)
        remarks = filter(None, (line.alignment, line.hardware, year, line.remarks))
        system = f"{line.system} ({line.by or NOT_STATED}: {line.source})"
        cells.append(ReportedCell(system, line.sequence, line.ate_rmse_m, "; ".join(remarks)))

    # what the implemented paper claims
    if scored_as("SE(3) or not stated", "", protocol):
        remark = "contradicts itself and what the systems' authors published; see the audit"
        frame = claimed_results().query(
            "kind == 'value' and quantity == 'ape_rmse' and sequence in @sequences"
        )
        for line in lines_of(frame):
            cells.append(ReportedCell(line.system, line.sequence, line.value, remark, CLAIMED))
    return cells


def scored_as(alignment: str, sequence: str, protocol: Protocol) -> bool:
    """Whether a published number was scored as a protocol scores, as far as is known.

    A table of a system with depth that states no alignment is taken for TUM's, SE(3). Numbers
    aligned by Sim(3) come from WildGS-SLAM's tables, which are scored against a corrected truth on
    Bonn. Nobody publishes numbers of a protocol that compares only some of the frames.
    """
    truth = "bonn-droid-w" if alignment == "Sim(3)" and sequence.startswith("bonn/") else "as-is"
    if protocol.thins or truth != protocol.truth:
        return False
    return protocol.alignment == {"Sim(3)": "sim3", "SE(3) or not stated": "se3"}.get(alignment)


def records_for(sequences: Sequence[str], protocol: Protocol) -> list[ReportedCell]:
    """The records of whole sequences that were scored as a protocol scores; no others stand beside measured errors.

    Args:
        sequences: Names of a report's whole sequences.
        protocol: The report's protocol.
    """
    # names of protocols that score as this one
    alike = [name for name, other in PROTOCOLS.items() if other.digest() == protocol.digest()]
    frame = records()
    frame = frame[frame["sequence"].isin(sequences) & frame["protocol"].isin(alike)]
    cells = []
    for line in lines_of(frame):
        facts = (line.system, line.input, line.alignment, line.hardware, line.source)
        source = "; ".join((*facts, HOW[line.how]))
        cells.append(ReportedCell(KINDS[line.kind], line.sequence, line.value, source, RECORD))
    return cells


def lines_of(frame: pd.DataFrame) -> Iterator[Any]:
    """The lines of a table; attributes are named as its columns."""
    return iter(frame.itertuples())


def _read(name: str) -> pd.DataFrame:
    """A table of this package's data, all of it as texts."""
    with (files("dynslam_bench.reports.model") / "data" / name).open(encoding="utf-8") as file:
        return pd.read_csv(file, dtype=str, keep_default_na=False)
