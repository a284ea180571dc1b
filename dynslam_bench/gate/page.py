"""The page of a gate's result: both sides on every sequence, as ``report compare`` shows them."""

from __future__ import annotations

from pathlib import Path

from dynslam_bench.core import ReportError
from dynslam_bench.gate.result import GateResult
from dynslam_bench.reports import compare as compare_results


def write_page(result: GateResult, place: Path, baseline: Path, candidate: Path) -> Path | None:
    """Write the page of a result.

    Args:
        result: What was found.
        place: Where the folder ``page`` is made.
        baseline: Results folder of the baseline's runs.
        candidate: Results folder of the candidate's runs.

    Returns:
        The page; None where a side has no runs here, or nothing can be drawn.
    """
    if not (baseline.is_dir() and candidate.is_dir()):
        return None
    words = f"{result.verdict.value}: {result.sentence}."
    try:
        comparison = compare_results(
            baseline, candidate, protocol=result.protocol, output=place / "page", conclusion=words
        )
    except ReportError as error:
        result.notes.append(f"no page: {error.args[0]}")
        return None
    return comparison.page
