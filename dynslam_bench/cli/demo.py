"""The whole way on rendered sequences: trackers through environments in processes of their own, then the report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from .output import note, progress
from .running import make_runs


@dataclass(frozen=True)
class DemoOutcome:
    """What the demo made.

    Attributes:
        leaderboard: The table as text.
        report: The HTML page.
        runs: How many runs there are.
        failed: How many of them failed.
    """

    leaderboard: str
    report: Path
    runs: int
    failed: int


def run_demo(results: Path | str = "results", *, frames: int = 150, jobs: int = 2) -> DemoOutcome:
    """Render walking and sitting people, run the suite ``demo`` on them, and report it.

    Args:
        results: Results folder; the report is ``report/index.html`` in it.
        frames: Frames of each sequence.
        jobs: Runs at a time.

    Raises:
        DynslamError: The results or the cache folder cannot be written.
    """
    from dynslam_bench.reports import build_report
    from dynslam_bench.runs import RunStore
    from dynslam_bench.suites import load_suite

    specs = [
        spec.model_copy(update={"sequence": f"{spec.sequence}?frames={frames}", "frames": None})
        for spec in load_suite("demo").specs()
    ]
    store = RunStore(results)
    store.prepare()  # before the rendering: an unwritable folder shows at once
    render({spec.sequence for spec in specs})
    records = make_runs(specs, store, jobs=jobs)
    note("making the report")
    paths = build_report(store, store.root / "report", title="Demo: walking and sitting people, rendered")
    return DemoOutcome(
        leaderboard_text(paths.csv["leaderboard"]), paths.html, len(records), sum(record.failed for record in records)
    )


def render(sequences: set[str]) -> None:
    """Render sequences ahead of the runs, so that no run waits for another's frames."""
    from dynslam_bench.sequences.roots import find_data_root
    from dynslam_bench.sequences.synthetic import render_synthetic

    for name in sorted(sequences):
        with progress(f"rendering {name}") as advance:
            render_synthetic(name, find_data_root(None), progress=advance)


def leaderboard_text(table: Path) -> str:
    """A CSV table as aligned text."""
    import csv

    with table.open(newline="") as file:
        rows = list(csv.reader(file))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )
