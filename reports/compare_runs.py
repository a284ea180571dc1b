"""Two sets of results against each other: before and after a change of the code, or of the settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dynslam_bench.core.errors import ReportError
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.runs.storage.store import RunStore

from .model.columns import name_columns
from .model.pairing import differences, label_pairs, make_side, pair_errors, pair_variants, unpaired
from .model.report_data import REPORT_FILE, ReportData
from .model.row import RunRow
from .model.rows import check_one_protocol, load_runs, open_stores
from .model.statistics import FEWEST, Interval, ratio_interval
from .tables.paired import paired_table
from .tables.table import Table, to_csv, to_markdown


@dataclass(frozen=True)
class Comparison:
    """What changed from A to B.

    Attributes:
        overall: Tracker and what differs to the geometric mean over sequences of B's median ATE over A's; with an
            interval from `FEWEST` sequences on.
        table: Every tracker and sequence with both medians.
        only_a: Runs that only A has.
        only_b: Runs that only B has.
        differences: Tracker, as in `overall`, to the settings that differ, e.g. ``epipolar.threshold_px: default in A,
            2 in B``; empty where the settings are the same.
    """

    overall: dict[str, Interval]
    table: Table
    only_a: int
    only_b: int
    differences: dict[str, list[str]]

    def to_markdown(self) -> str:
        """The comparison as Markdown."""
        return to_markdown(self.table)

    def to_csv(self) -> str:
        """The comparison as CSV."""
        return to_csv(self.table)


def compare(
    a: Path | str | RunStore, b: Path | str | RunStore, *, protocol: Protocol | str = "tum-rgbd/v1"
) -> Comparison:
    """Compare two results folders, or two reports, on the sequences that both have.

    A tracker with the same settings on both sides is compared with itself. Settings that only one side has are compared
    with those of the same tracker that only the other has and that differ in the fewest values.

    Args:
        a: Results folder, store, or folder of a report (``report.json``).
        b: Likewise.
        protocol: How results folders are evaluated; a report brings its own.

    Raises:
        ReportError: One holds no runs, nothing is in both, or their numbers stem from different protocols.
    """
    protocol = get_protocol(protocol)
    rows_a, rows_b = _rows(a, protocol), _rows(b, protocol)
    check_one_protocol([*rows_a, *rows_b])
    side_a, side_b = make_side(rows_a), make_side(rows_b)
    pairs = pair_variants(side_a, side_b)
    if not pairs:
        raise ReportError(
            f"{_name(a)} ({len(rows_a)} runs) and {_name(b)} ({len(rows_b)} runs) have no tracker and sequence in "
            "common",
            "compare results of the same suite",
        )
    columns = name_columns([*rows_a, *rows_b])
    found = []
    changed: dict[str, list[str]] = {}
    for (one, other), name in label_pairs(pairs, side_a, side_b).items():
        paired = pair_errors(side_a[one], side_b[other], columns)
        if paired:
            found.append((name, paired, ratio_interval(np.log([each.ratio for each in paired]))))
            changed[name] = differences(side_a, side_b, one, other)
    if not found:
        raise ReportError("none of the runs in common has ground truth", "nothing can be compared")
    caption = _caption(rows_a[0].protocol_id if _is_report(a) else protocol.describe(), changed)
    return Comparison(
        overall={name: ratio for name, _, ratio in found},
        table=paired_table(f"{_name(a)} (A) against {_name(b)} (B)", caption, found),
        only_a=unpaired(rows_a, side_a, side_b, pairs),
        only_b=unpaired(rows_b, side_b, side_a, [(other, one) for one, other in pairs]),
        differences=changed,
    )


def _caption(protocol: str, differences: Mapping[str, list[str]]) -> str:
    changed = [f"{name}: {', '.join(words)}" for name, words in differences.items() if words]
    return (
        f"{protocol}. Median ATE (millimetres), lost frames held, over the repeats that both have, or all where they "
        "share none; failures count as a static camera, or worse. B / A below 1: B is better. Brackets: "
        f"Student's 95 % interval over sequences, from {FEWEST} of them on."
    ) + (f" What differs: {'; '.join(changed)}." if changed else " The settings are the same.")


def _rows(source: Path | str | RunStore, protocol: Protocol) -> list[RunRow]:
    if not isinstance(source, RunStore) and _is_report(source):
        path = Path(source).expanduser()
        return ReportData.read(path if path.is_file() else path / REPORT_FILE).rows
    stores = open_stores(source if isinstance(source, RunStore) else [Path(source)])
    return [run.row for run in load_runs(stores, protocol, trials=True).runs]


def _is_report(source: Path | str | RunStore) -> bool:
    if isinstance(source, RunStore):
        return False
    path = Path(source).expanduser()
    return path.is_file() or (path / REPORT_FILE).is_file()


def _name(source: Path | str | RunStore) -> str:
    return str(source.root if isinstance(source, RunStore) else source)
