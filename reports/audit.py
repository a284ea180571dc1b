"""An audit of the paper's own Tables 1 to 3: what can be true of them by arithmetic alone.

Nothing is run. The printed numbers are held against identities that every such table obeys, against the numbers that
the compared systems' authors published, and against a static camera.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from dynslam_bench.evaluation.ape import static_camera
from dynslam_bench.evaluation.protocol import RPESpec
from dynslam_bench.evaluation.rpe import select_pairs
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.reports.model.published import Claimed, claimed, published
from dynslam_bench.reports.tables.table import Column, Table, TableCell, to_markdown

OURS = "EMFOA-OFT-SLAM"
_HALF_DIGIT = 0.5
_PERCENT_TOLERANCE = 0.001
_ERROR_TOLERANCE = 0.25
_MASK_RCNN_MS = 195.0


@dataclass(frozen=True)
class Finding:
    """One printed number held against what it has to be.

    Attributes:
        check: Which check, see `CHECKS`.
        table: Table of the paper.
        system: System as named there.
        sequence: Sequence id.
        quantity: What was printed.
        printed: The printed number.
        expected: What it is held against.
        holds: Whether it passes.
        remark: Why, in a few words.
    """

    check: str
    table: int
    system: str
    sequence: str
    quantity: str
    printed: float
    expected: float
    holds: bool
    remark: str = ""


CHECKS = {
    "rmse-identity": "RMSE² = mean² + StD² (population standard deviation), within rounding",
    "rmse-at-least-mean": "RMSE >= mean: the opposite is impossible",
    "improvement": "improvement rows are 100 (baseline - ours) / baseline",
    "better-than-not-moving": "the error is smaller than that of a static camera",
    "published": "within a factor of two of what the system's authors and others published",
    "accuracy": "accuracy is 100 - error, and error is something else than 100 times the APE's StD in metres",
    "time": "a method with Mask R-CNN takes at least the published time of Mask R-CNN",
}


@dataclass(frozen=True)
class AuditReport:
    """All findings.

    Attributes:
        findings: One for every number that a check applies to.
    """

    findings: tuple[Finding, ...]

    def of(self, check: str) -> list[Finding]:
        """The findings of one check."""
        return [finding for finding in self.findings if finding.check == check]

    def failed(self, check: str) -> list[Finding]:
        """The findings of one check that do not hold."""
        return [finding for finding in self.of(check) if not finding.holds]

    def summary(self) -> Table:
        """How many numbers pass each check."""
        rows = [
            [
                TableCell(check),
                TableCell(meaning),
                TableCell(str(len(self.of(check))), value=len(self.of(check))),
                TableCell(str(len(self.failed(check))), value=len(self.failed(check))),
            ]
            for check, meaning in CHECKS.items()
        ]
        columns = [Column("check", numeric=False), Column("what has to hold", numeric=False), Column("numbers"),
                   Column("fail")]  # fmt: skip
        caption = (
            "Claimed by the paper, audited by arithmetic; no system was run for it. "
            f"{sum(not f.holds for f in self.findings)} of {len(self.findings)} findings do not hold, so none of the "
            "printed numbers is a target that a re-implementation could be held to."
        )
        return Table("audit_summary", "Audit of the paper's tables", caption, columns, rows)

    def details(self, *, failed_only: bool = True) -> Table:
        """Every finding, or only those that do not hold."""
        shown = [finding for finding in self.findings if not (failed_only and finding.holds)]
        rows = [
            [
                TableCell(finding.check),
                TableCell(str(finding.table), value=finding.table),
                TableCell(finding.system),
                TableCell(finding.sequence),
                TableCell(finding.quantity),
                TableCell(f"{finding.printed:.4f}", value=finding.printed),
                TableCell(f"{finding.expected:.4f}", value=finding.expected),
                TableCell(finding.remark),
            ]
            for finding in shown
        ]
        columns = [
            Column("check", numeric=False), Column("table"), Column("system", numeric=False),
            Column("sequence", numeric=False), Column("quantity", numeric=False), Column("printed"),
            Column("held against"), Column("remark", numeric=False),
        ]  # fmt: skip
        what = "Numbers that do not hold" if failed_only else "All findings"
        return Table("audit_findings", what, "Metres, percent or milliseconds, as printed.", columns, rows)

    def to_markdown(self) -> str:
        """Summary and failures as Markdown."""
        return to_markdown(self.summary()) + "\n" + to_markdown(self.details())


def audit_paper(ground_truth: Mapping[str, Trajectory] | None = None) -> AuditReport:
    """Audit Tables 1 to 3 of the paper.

    Args:
        ground_truth: Sequence id to ground truth, to recompute the error of not moving there; without it the stored
            values are used (from the published ground truth of sitting_xyz and a surrogate for walking_xyz).

    Returns:
        One finding for every number that a check applies to.
    """
    values = {(c.table, c.system, c.sequence, c.quantity): c for c in claimed() if c.kind == "value"}
    findings: list[Finding] = []
    for (table, system, sequence, quantity), rmse in values.items():
        if quantity.endswith("_rmse"):
            findings += _statistics(values, table, system, sequence, quantity, rmse)
    findings += [_improvement(values, printed) for printed in claimed() if printed.kind == "improvement_percent"]
    still = _stored_never_move() | _computed_never_move(ground_truth or {})
    for key, rmse in values.items():
        findings += _against_not_moving(still, *key, rmse)
        findings += _against_published(*key, rmse)
        findings += _accuracy(values, *key, rmse)
        findings += _time(*key, rmse)
    order = list(CHECKS)
    return AuditReport(tuple(sorted(findings, key=lambda finding: (order.index(finding.check), finding.table))))


Values = Mapping[tuple[int, str, str, str], Claimed]


def _statistics(values: Values, table: int, system: str, sequence: str, quantity: str, rmse: Claimed) -> list[Finding]:
    metric = quantity.removesuffix("_rmse")
    mean = values[table, system, sequence, f"{metric}_mean"].value
    std = values[table, system, sequence, f"{metric}_std"].value
    expected = math.hypot(mean, std)
    rounding = _HALF_DIGIT * 10.0**-rmse.digits
    tolerance = rounding * (1 + (mean + std) / expected)  # of the printed RMSE, and of what follows from the others
    off = rmse.value - expected
    possible = rmse.value >= mean - 2 * rounding
    return [
        Finding(
            "rmse-identity", table, system, sequence, quantity, rmse.value, expected, abs(off) <= tolerance,
            f"off by {1000 * off:+.1f} mm",
        ),
        Finding(
            "rmse-at-least-mean", table, system, sequence, quantity, rmse.value, mean, possible,
            "" if possible else "below the mean",
        ),
    ]  # fmt: skip


def _improvement(values: Values, printed: Claimed) -> Finding:
    baseline = values[printed.table, printed.system, printed.sequence, printed.quantity].value
    ours = values[printed.table, OURS, printed.sequence, printed.quantity].value
    expected = 100 * (baseline - ours) / baseline
    holds = abs(printed.value - expected) <= _PERCENT_TOLERANCE
    remark = ""
    if not holds:
        repeated = [
            other
            for other in claimed()
            if other.kind == printed.kind
            and (other.table, other.system, other.quantity) == (printed.table, printed.system, printed.quantity)
            and other.sequence != printed.sequence
            and abs(other.value - printed.value) <= _PERCENT_TOLERANCE
        ]
        remark = f"repeats the column of {repeated[0].sequence}" if repeated else "does not follow from the table"
    return Finding(
        "improvement", printed.table, printed.system, printed.sequence, printed.quantity, printed.value, expected,
        holds, remark,
    )  # fmt: skip


def _against_not_moving(
    still: Mapping[tuple[str, str], float], table: int, system: str, sequence: str, quantity: str, printed: Claimed
) -> list[Finding]:
    reference = {"ape_rmse": "ape_rmse", "rpe_rmse": "rpe_1s"}.get(quantity)
    if reference is None or (sequence, reference) not in still:
        return []
    expected = still[sequence, reference]
    remark = "" if quantity == "ape_rmse" else "held against 1 s; the paper states no delta"
    if quantity == "rpe_rmse" and (sequence, "rpe_1f") in still:
        remark += f" (over 1 frame not moving scores {still[sequence, 'rpe_1f']:.4f})"
    return [
        Finding(
            "better-than-not-moving", table, system, sequence, quantity, printed.value, expected,
            printed.value < expected, remark,
        )
    ]  # fmt: skip


def _against_published(table: int, system: str, sequence: str, quantity: str, printed: Claimed) -> list[Finding]:
    if quantity != "ape_rmse":
        return []
    known = [p for p in published() if p.system == system and p.sequence == sequence and p.metric == "ate_rmse_m"]
    if not known:
        return []
    low, high = min(p.value for p in known), max(p.value for p in known)
    nearest = min(max(printed.value, low), high)
    factor = printed.value / nearest
    span = f"{low:g}" if low == high else f"{low:g} to {high:g}"
    return [
        Finding(
            "published", table, system, sequence, quantity, printed.value, nearest, 0.5 <= factor <= 2,
            f"{factor:.1f} times what is published ({span} m in {len(known)} tables)",
        )
    ]  # fmt: skip


def _accuracy(values: Values, table: int, system: str, sequence: str, quantity: str, printed: Claimed) -> list[Finding]:
    if quantity == "accuracy_percent":
        expected = 100 - values[table, system, sequence, "error_percent"].value
        holds = abs(printed.value - expected) < 0.006
        return [Finding("accuracy", table, system, sequence, quantity, printed.value, expected, holds, "100 - error")]
    if quantity == "error_percent":
        expected = 100 * values[1, system, sequence, "ape_std"].value
        same = abs(printed.value - expected) <= _ERROR_TOLERANCE
        remark = "it is 100 times the StD of Table 1 in metres, which is no accuracy" if same else ""
        return [Finding("accuracy", table, system, sequence, quantity, printed.value, expected, not same, remark)]
    return []


def _time(table: int, system: str, sequence: str, quantity: str, printed: Claimed) -> list[Finding]:
    if quantity != "time_ms" or system != OURS:
        return []
    return [
        Finding(
            "time", table, system, sequence, quantity, printed.value, _MASK_RCNN_MS, printed.value >= _MASK_RCNN_MS,
            "less than the published time of its Mask R-CNN alone (DynaSLAM's: 195 ms)",
        )
    ]  # fmt: skip


@cache
def _stored_never_move() -> dict[tuple[str, str], float]:
    text = (files("dynslam_bench.reports.model") / "data" / "never_move.csv").read_text(encoding="utf-8")
    return {(line["sequence"], line["metric"]): float(line["value"]) for line in csv.DictReader(text.splitlines())}


def _computed_never_move(ground_truth: Mapping[str, Trajectory]) -> dict[tuple[str, str], float]:
    found: dict[tuple[str, str], float] = {}
    for sequence, truth in ground_truth.items():
        found[sequence, "ape_rmse"] = static_camera(truth)["constant_rmse_m"]
        pairs = select_pairs(truth.timestamps, truth.T_world_cam, RPESpec(delta=1, unit="s", max_pairs=0))
        if len(pairs):
            moved = truth.positions[pairs[:, 1]] - truth.positions[pairs[:, 0]]
            found[sequence, "rpe_1s"] = float(math.sqrt((moved**2).sum(axis=1).mean()))
    return found
