"""Two sets of results against each other: the same trackers, sequences and seeds before and after a change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from dynslam_bench.core.errors import ReportError
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.runs.store import RunStore

from .board import make_labels
from .build import ReportData
from .rows import RunRow, check_one_protocol, load_runs, open_stores
from .statistics import Interval, standings
from .table import Column, Table, TableCell, to_csv, to_markdown

REPORT_FILE = "report.json"


@dataclass(frozen=True)
class Comparison:
    """What changed from A to B.

    Attributes:
        overall: Tracker and variant to the geometric mean over sequences of B's median ATE over A's, with its interval.
        table: Every tracker and sequence with both medians.
        only_a: Runs that only A has.
        only_b: Runs that only B has.
    """

    overall: dict[str, Interval]
    table: Table
    only_a: int
    only_b: int

    def to_markdown(self) -> str:
        """The comparison as Markdown."""
        return to_markdown(self.table)

    def to_csv(self) -> str:
        """The comparison as CSV."""
        return to_csv(self.table)


def compare(
    a: Path | str | RunStore, b: Path | str | RunStore, *, protocol: Protocol | str = "tum-rgbd/v1"
) -> Comparison:
    """Compare two results folders, or two reports, on the runs that both have.

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
    by_a, by_b = _by_cell(rows_a), _by_cell(rows_b)
    shared = [key for key in by_a if key in by_b]
    if not shared:
        raise ReportError(
            f"{_name(a)} ({len(rows_a)} runs) and {_name(b)} ({len(rows_b)} runs) have no tracker, settings and "
            "sequence in common",
            "compare results of the same suite",
        )
    names = make_labels([row for key in shared for row in by_a[key].values()])
    overall: dict[str, Interval] = {}
    rows: list[list[TableCell]] = []
    separators = set()
    for variant, name in names.items():
        pairs = {sequence: _paired(by_a[v, sequence], by_b[v, sequence]) for v, sequence in shared if v == variant}
        scored = {sequence: pair for sequence, pair in pairs.items() if pair is not None}
        if not scored:
            continue
        before = {sequence: pair[0] for sequence, pair in scored.items()}
        after = {sequence: pair[1] for sequence, pair in scored.items()}
        overall[name] = standings({"b": after}, before, ["b"])[0].ratio
        if rows:
            separators.add(len(rows))
        for sequence in sorted(scored):
            rows.append(_row(name, sequence, by_a[variant, sequence], by_b[variant, sequence], *scored[sequence]))
        ratio = overall[name]
        rows.append(
            [
                TableCell(name),
                TableCell(f"all {len(scored)} sequences"),
                TableCell(),
                TableCell(),
                TableCell(f"{ratio.value:.3f}", f"[{ratio.low:.3f}, {ratio.high:.3f}]", ratio.value, emphasis="best"),
                TableCell(_verdict(ratio)),
                *[TableCell()] * 3,
            ]
        )
    if not overall:
        raise ReportError("none of the runs in common has ground truth", "nothing can be compared")
    columns = [
        Column("tracker", numeric=False), Column("sequence", numeric=False), Column("ATE A"), Column("ATE B"),
        Column("B / A"), Column("verdict", numeric=False), Column("coverage A"), Column("coverage B"), Column("runs"),
    ]  # fmt: skip
    caption = (
        f"{protocol.describe() if not _is_report(a) else rows_a[0].protocol_id}. Median ATE (metres) over the seeds "
        "that both have; failures count as a camera that never moves. B / A below 1: B is better. Brackets: 95 % "
        "bootstrap interval over runs and sequences."
    )
    table = Table("paired", f"{_name(a)} (A) against {_name(b)} (B)", caption, columns, rows, separators=separators)
    keys_a = {(key, seed) for key, found in by_a.items() for seed in found}
    keys_b = {(key, seed) for key, found in by_b.items() for seed in found}
    return Comparison(overall, table, len(keys_a - keys_b), len(keys_b - keys_a))


CellKey = tuple[str, str]


def _rows(source: Path | str | RunStore, protocol: Protocol) -> list[RunRow]:
    if not isinstance(source, RunStore) and _is_report(source):
        path = Path(source).expanduser()
        return ReportData.read(path if path.is_file() else path / REPORT_FILE).rows
    return [
        run.row
        for run in load_runs(open_stores(source if isinstance(source, RunStore) else [Path(source)]), protocol).runs
    ]


def _is_report(source: Path | str | RunStore) -> bool:
    if isinstance(source, RunStore):
        return False
    path = Path(source).expanduser()
    return path.is_file() or (path / REPORT_FILE).is_file()


def _by_cell(rows: list[RunRow]) -> dict[CellKey, dict[int, RunRow]]:
    found: dict[CellKey, dict[int, RunRow]] = {}
    for row in rows:
        found.setdefault((row.variant_key, row.sequence_key), {})[row.seed] = row
    return found


def _paired(a: Mapping[int, RunRow], b: Mapping[int, RunRow]) -> tuple[list[float], list[float]] | None:
    """Errors of the seeds that both have; of all seeds where they share none."""
    seeds = sorted(set(a) & set(b))
    pairs = ([a[s] for s in seeds], [b[s] for s in seeds]) if seeds else (list(a.values()), list(b.values()))
    scores = [[row.score_m for row in side if row.score_m is not None] for side in pairs]
    return (scores[0], scores[1]) if scores[0] and scores[1] else None


def _row(
    name: str, sequence: str, a: Mapping[int, RunRow], b: Mapping[int, RunRow], before: list[float], after: list[float]
) -> list[TableCell]:
    ratio = max(median(after), 1e-6) / max(median(before), 1e-6)
    return [
        TableCell(name),
        TableCell(sequence),
        TableCell(f"{median(before):.4f}", value=median(before)),
        TableCell(f"{median(after):.4f}", value=median(after)),
        TableCell(f"{ratio:.3f}", value=ratio),
        TableCell(),
        _coverage(a),
        _coverage(b),
        TableCell(f"{len(before)} + {len(after)}"),
    ]


def _coverage(rows: Mapping[int, RunRow]) -> TableCell:
    mean = sum(row.coverage for row in rows.values()) / len(rows)
    return TableCell(f"{100 * mean:.1f} %", value=mean)


def _verdict(ratio: Interval) -> str:
    if ratio.high < 1:
        return "better"
    if ratio.low > 1:
        return "worse"
    return "no difference shown"


def _name(source: Path | str | RunStore) -> str:
    return str(source.root if isinstance(source, RunStore) else source)
