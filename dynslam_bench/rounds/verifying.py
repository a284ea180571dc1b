"""`verify`: what others have run is checked, scored again, and a sample of it run again."""

import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from dynslam_bench.core import DynslamError
from dynslam_bench.geometry import format_tum
from dynslam_bench.rounds.bits import check_bits, scene_digest
from dynslam_bench.rounds.files import REVEAL_FILE, Entry, RoundFolder, Row, open_round
from dynslam_bench.rounds.programs import difference, program_of, working_in
from dynslam_bench.rounds.rows import Agreement, ScoredRow, agreement, record_of, scored
from dynslam_bench.rounds.running import (
    OnEvent,
    check_runner,
    make_rows,
    usable_entries,
)
from dynslam_bench.runs import bank
from dynslam_bench.runs.layout import TRUTH
from dynslam_bench.runs.store import RunStore
from dynslam_bench.sequences.synthetic import open_synthetic


@dataclass(frozen=True)
class RerunRow:
    """A row that was run again.

    Attributes:
        row: The row of another runner.
        agreement: Whether it came out as there.
        difference: Relative difference of the errors.
        ate_m: The error that was published, metres; None where it has none.
        ate_again_m: The error of the new run.
    """

    row: ScoredRow
    agreement: Agreement
    difference: float
    ate_m: float | None
    ate_again_m: float | None


@dataclass(frozen=True)
class Verification:
    """Outcome of the checks of a round.

    Attributes:
        faults: What is wrong, a line each.
        rows: All rows of the other runners that could be scored.
        rerun: The rows that were run again.
    """

    faults: list[str] = field(default_factory=list)
    rows: list[ScoredRow] = field(default_factory=list)
    rerun: list[RerunRow] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.faults


def verify(
    folder: str | Path,
    *,
    by: str,
    of: Iterable[str] = (),
    sample: int = 1,
    results: str | Path = "results/rounds",
    jobs: int = 1,
    on_step: Callable[[str], None] = lambda _: None,
    on_event: OnEvent | None = None,
) -> Verification:
    """Check the salt, the entries and the results of others, score all rows again, and run a sample again.

    Rows of the sample go into a bank of the verifier, so that a report can say who reproduced what.

    Args:
        folder: The round's folder.
        by: Name of the verifier.
        of: The runners whose results are checked; all others by default.
        sample: Rows of each entry and runner that are run again, drawn at random.
        results: See `running.run`, as for all that follow.
        jobs: Runs at a time.
        on_step: Called with each step in words.
        on_event: Called with every `RunEvent`.

    Raises:
        RunError: The round is not revealed, its salt is another one, this installation or this
            machine does not fit, or there are no results of a runner.
        DynslamError: Runs cannot be stored.
    """
    opened = open_round(folder)
    check_runner(opened, by)
    on_step("rendering a public scene")
    check_bits(opened.round)

    # the entries, as they were revealed
    with working_in(opened.root):
        usable, refused = usable_entries(opened)
    runners = list(of) or [runner for runner in opened.runners() if runner != by]
    verification = Verification(faults=list(refused.values()))

    # what each runner has published: checked without a run, then scored again
    for runner in runners:
        on_step(f"checking the results of {runner}")
        verification.faults.extend(faults_of(opened, runner, render=True))
        for row in opened.read_results(runner).rows:
            try:
                verification.rows.append(scored(opened, runner, row))
            except DynslamError as error:
                verification.faults.append(f"{runner}, {_named(opened, row)}: {error}")

    # a sample, run again here
    pairs = _sample(verification.rows, usable, sample)
    if not pairs:
        return verification
    chosen = list(dict.fromkeys((entry.name, row.row.sequence) for entry, row in pairs))
    by_name = {entry.name: entry for entry in usable}
    again = make_rows(
        opened,
        by,
        [(by_name[name], sequence) for name, sequence in chosen],
        results=results,
        jobs=jobs,
        on_step=on_step,
        on_event=on_event,
    )
    rows_again = {(row.entry, row.sequence): row for row in again.made}
    for _, published in pairs:
        made = rows_again.get(published.key)
        if made is None:
            verification.faults.append(f"{_named(opened, published.row)} could not be run again")
            continue
        verification.rerun.append(_compared(opened, published, scored(opened, by, made)))
    for rerun in verification.rerun:
        if rerun.agreement == "differs":
            verification.faults.append(
                f"{rerun.row.by}, {_named(opened, rerun.row.row)}: {_millimetres(rerun.ate_m)} was published, "
                f"run again it is {_millimetres(rerun.ate_again_m)}"
            )
    return verification


def _sample(
    rows: Iterable[ScoredRow], usable: Iterable[Entry], count: int
) -> list[tuple[Entry, ScoredRow]]:
    """Rows of each entry and runner, drawn at random: a runner must not know which."""
    draw = random.SystemRandom()
    every = list(rows)
    pairs = []
    for entry in usable:
        for runner in dict.fromkeys(row.by for row in every):
            own = [row for row in every if row.row.entry == entry.name and row.by == runner]
            pairs += [(entry, row) for row in draw.sample(own, min(count, len(own)))]
    return pairs


def _compared(opened: RoundFolder, row: ScoredRow, again: ScoredRow) -> RerunRow:
    """A row with the one that was run again."""
    word, share = agreement(opened, row, again)
    return RerunRow(row, word, share, row.ate_m, again.ate_m)


def faults_of(opened: RoundFolder, by: str, *, render: bool) -> list[str]:
    """Faults of a runner's results, a line each; nothing is run.

    Args:
        opened: The round.
        by: The runner.
        render: Whether the scenes are rendered to compare their bits.

    Raises:
        RunError: There are no results of this runner.
    """
    results = opened.read_results(by)
    try:
        faults = [f"{by}: {line}" for line in bank.verify(opened.bank(by))]
    except DynslamError as error:
        return [f"{by}: {error}"]
    sequences = set(opened.sequences)
    for row in results.rows:
        fault = _fault_of_row(opened, by, row, sequences)
        if fault:
            faults.append(f"{by}, {_named(opened, row)}: {fault}")

    # the bits of the scenes
    for sequence in sequences & results.scenes.keys() if render else ():
        here = scene_digest(sequence)
        if here != results.scenes[sequence]:
            faults.append(
                f"{by}: scene {opened.round.label_of(sequence, opened.salt)} had other bits there: "
                f"{results.scenes[sequence][:16]}, here {here[:16]}"
            )
    return faults


def _fault_of_row(opened: RoundFolder, by: str, row: Row, sequences: set[str]) -> str:
    """Fault of a row: of its entry, scene, program or ground truth; empty for none."""
    if row.entry not in opened.reveal.entries:
        return f"{REVEAL_FILE} does not list this entry"
    if row.sequence not in sequences:
        return "the scene is none of this round's"
    try:
        record = record_of(opened, by, row)
        entry = opened.received_entry(row.entry)
    except DynslamError as error:
        return str(error)
    if record.sequence.id != row.sequence:
        return f"its run is on {record.sequence.id}"
    if changed := difference(entry.program, program_of(entry.name, record.identity)):
        return f"it was run by another program than entered: {changed} was changed"

    # the ground truth needs no rendering
    truth = open_synthetic(row.sequence, None).ground_truth
    stored = RunStore(opened.bank(by)).sequences.folder(record.sequence.part) / TRUTH
    if not stored.is_file() or stored.read_text(encoding="utf-8") != format_tum(truth):
        return "the stored ground truth is not that of the scene"
    return ""


def _named(opened: RoundFolder, row: Row) -> str:
    """Entry and scene of a row in words."""
    return f"{row.entry} on {opened.round.label_of(row.sequence, opened.salt)}"


def _millimetres(error_m: float | None) -> str:
    """An error in words."""
    return "no error" if error_m is None else f"{1000 * error_m:.2f} mm"
