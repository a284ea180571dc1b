"""`report`: the board of a round says that it was sealed, who ran what, and who reproduced it."""

from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean, median

from dynslam_bench.core import DynslamError, ReportError, write_atomic
from dynslam_bench.reports import build_report
from dynslam_bench.rounds.files import REVEAL_FILE, RoundFolder, open_round
from dynslam_bench.rounds.rows import ScoredRow, agreement
from dynslam_bench.rounds.running import check_release
from dynslam_bench.rounds.verifying import checked_rows
from dynslam_bench.runs.record import coverage_text

BOARD_FILE = "round.md"
"""The board as Markdown."""
COLUMNS = (
    "entry",
    "median ATE (mm)",
    "coverage",
    "scenes",
    "not ok",
    "run by",
    "reproduced by",
)


@dataclass(frozen=True)
class BoardRow:
    """One entry.

    Attributes:
        entry: Its name.
        median_ate_m: Median over its scenes of the error, metres; None without one.
        coverage: Mean over its scenes of the share of the frames with a pose.
        scenes: Scenes on which it was run.
        of_scenes: Scenes of the round.
        not_ok: Scenes on which it was lost or did not come to its end.
        run_by: The runner whose rows are shown: the one with most scenes.
        reproduced: By name of each other runner: how many rows agree, how many of these to the last
            bit, and how many there are.
    """

    entry: str
    median_ate_m: float | None
    coverage: float
    scenes: int
    of_scenes: int
    not_ok: int
    run_by: str
    reproduced: dict[str, tuple[int, int, int]] = field(default_factory=dict)

    @property
    def rank(self) -> tuple[int, int, float]:
        """The order of the board: complete entries first, then fewer scenes not ok, then smaller errors."""
        missing = self.of_scenes - self.scenes
        error = float("inf") if self.median_ate_m is None else self.median_ate_m
        return missing, self.not_ok, error

    @property
    def cells(self) -> tuple[str, ...]:
        """The row as `COLUMNS` name it."""
        error = "" if self.median_ate_m is None else f"{1000 * self.median_ate_m:.2f}"
        words = [
            f"{by}: {agree} of {rows}" + (f", {same} identical" if same else "")
            for by, (agree, same, rows) in self.reproduced.items()
        ]
        counts = (f"{self.scenes} of {self.of_scenes}", str(self.not_ok))
        coverage = coverage_text(self.coverage)
        return self.entry, error, coverage, *counts, self.run_by, "; ".join(words) or "nobody"


@dataclass(frozen=True)
class RoundReport:
    """The board of a round.

    Attributes:
        remarks: Remarks on the whole board, a line each.
        rows: The entries, the best first.
        faults: What is wrong with the results, a line each; rows of such runners are shown all the
            same.
        markdown: The board as a file.
        html: The pages of the reference runner's bank.
    """

    remarks: list[str]
    rows: list[BoardRow]
    faults: list[str]
    markdown: Path
    html: Path


def report(folder: str | Path, output: str | Path | None = None) -> RoundReport:
    """Make the board of a round; everything is scored from the published trajectories.

    Args:
        folder: The round's folder.
        output: Folder of the report; ``report`` in the round's folder by default.

    Raises:
        ReportError: Nobody has published results, or none can be scored.
        RunError: The round is not revealed, its salt is another one, or this installation does not fit.
    """
    opened = open_round(folder)
    check_release(opened)
    runners = opened.runners()
    if not runners:
        raise ReportError(
            f"round {opened.round.name} has no results yet",
            "run it: dynslam-bench round run FOLDER --by NAME",
        )
    target = Path(output or opened.root / "report").expanduser().absolute()

    # all rows of all runners
    faults: list[str] = []
    rows: list[ScoredRow] = []
    for by in runners:
        scored_here, faults_here = checked_rows(opened, by, render=False)
        rows += scored_here
        faults += faults_here
    listed = [row for row in rows if row.row.entry in opened.reveal.entries]
    board = [
        _board_row(opened, entry, [row for row in listed if row.row.entry == entry])
        for entry in opened.reveal.entries
        if any(row.row.entry == entry for row in listed)
    ]
    board.sort(key=lambda row: row.rank)
    nobody = [name for name in opened.reveal.entries if name not in {row.entry for row in board}]
    faults += [f"entry '{name}' has no row" for name in nobody]

    # the board, and the pages of the runner with most rows
    remarks = _remarks(opened, runners)
    markdown = target / BOARD_FILE
    write_atomic(markdown, _markdown(opened, remarks, board, faults))
    readable = [by for by in runners if any(row.by == by for row in listed)]
    if not readable:
        raise ReportError(f"no row of round {opened.round.name} can be scored", faults[0])
    reference = max(readable, key=lambda by: sum(row.by == by for row in listed))
    paths = build_report(
        [opened.bank(reference)],
        target,
        protocol=opened.round.protocol,
        title=f"Sealed round {opened.round.name}, run by {reference}",
    )
    return RoundReport(remarks, board, faults, markdown, paths.html)


def _board_row(opened: RoundFolder, entry: str, rows: list[ScoredRow]) -> BoardRow:
    """The row of an entry: of the runner with most scenes; the rows of all others are compared with it."""
    by_runner: dict[str, dict[tuple[str, str], ScoredRow]] = {}
    for row in rows:
        by_runner.setdefault(row.by, {})[row.key] = row
    reference = max(by_runner, key=lambda by: len(by_runner[by]))
    shown = by_runner.pop(reference)

    reproduced = {}
    for by, others in by_runner.items():
        common = [key for key in others if key in shown]
        words = [agreement(opened, shown[key], others[key])[0] for key in common]
        agreeing = sum(word != "differs" for word in words)
        reproduced[by] = (agreeing, words.count("identical"), len(words))
    errors = [row.ate_m for row in shown.values() if row.ate_m is not None]
    return BoardRow(
        entry=entry,
        median_ate_m=median(errors) if errors else None,
        coverage=mean(row.coverage for row in shown.values()),
        scenes=len(shown),
        of_scenes=len(opened.sequences),
        not_ok=sum(row.status != "ok" for row in shown.values()),
        run_by=reference,
        reproduced=reproduced,
    )


def _remarks(opened: RoundFolder, runners: list[str]) -> list[str]:
    """Remarks that hold for all rows."""
    of = opened.round
    late = opened.late_entries()
    remarks = [
        f"Sealed: {of.scenes} scenes of each of {', '.join(of.families)}, {of.frames} frames; "
        f"the salt's SHA-256 {of.salt_sha256[:16]} was published before, the salt at {opened.reveal.revealed}.",
        f"Protocol {of.protocol}; rows agree where errors differ by at most {100 * of.tolerance:g} %.",
    ]
    if late:
        remarks.append(f"Not listed in {REVEAL_FILE}, not run: {', '.join(late)}.")
    for by in runners:
        try:
            results = opened.read_results(by)
        except DynslamError:
            continue  # it is among the faults
        machine = results.machine
        words = "no network" if results.network == "none" else "with the network open"
        remarks.append(
            f"{by}: {len(results.rows)} runs, {words}, on {machine.cpu}, {machine.system}, "
            f"numpy {results.versions.get('numpy', '')}, numba {results.versions.get('numba', '')}"
            + ("; earlier rows on others." if results.mixed else ".")
        )
    return remarks


def _markdown(
    opened: RoundFolder, remarks: list[str], rows: list[BoardRow], faults: list[str]
) -> str:
    """The board as a file."""
    lines = [f"# Sealed round {opened.round.name}", ""]
    lines += [f"- {remark}" for remark in remarks]
    lines += ["", f"| {' | '.join(COLUMNS)} |", f"|{' --- |' * len(COLUMNS)}"]
    lines += [f"| {' | '.join(cell.replace('|', '/') for cell in row.cells)} |" for row in rows]
    if faults:
        lines += ["", "## Faults", "", *(f"- {fault}" for fault in faults)]
    return "\n".join(lines) + "\n"
