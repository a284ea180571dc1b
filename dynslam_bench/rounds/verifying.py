"""`verify`: what others have run is checked, scored again, and a sample of it run again."""

import random
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dynslam_bench.contracts import timestamps_ns
from dynslam_bench.core import DynslamError
from dynslam_bench.geometry import format_ns, format_tum
from dynslam_bench.rounds.bits import check_bits, scene_digest
from dynslam_bench.rounds.files import (
    RESULTS_FILE,
    REVEAL_FILE,
    Entry,
    Results,
    RoundFolder,
    Row,
    open_round,
)
from dynslam_bench.rounds.programs import difference, foreign_read, program_of, working_in
from dynslam_bench.rounds.rows import Agreement, ScoredRow, agreement, record_of, scored
from dynslam_bench.rounds.running import (
    OnEvent,
    check_runner,
    make_rows,
    usable_entries,
)
from dynslam_bench.runs import bank
from dynslam_bench.runs.identity import Resolver
from dynslam_bench.runs.layout import STAMPS, TRUTH, content_of
from dynslam_bench.runs.record import ASKED, RunRecord, coverage_text
from dynslam_bench.runs.store import RunStore
from dynslam_bench.sequences.synthetic import open_synthetic

_OF_MACHINE = ("settings", "device")
"""Entries of a request that differ by machine: paths in settings, which `program_of` compares, and the device."""


@dataclass(frozen=True)
class RerunRow:
    """A row that was run again.

    Attributes:
        row: The row of another runner.
        agreement: Whether it came out as there.
        difference: Relative difference of the errors.
        ate_m: The error that was published, metres; None where it has none.
        ate_again_m: The error of the new run.
        again: The new row.
    """

    row: ScoredRow
    agreement: Agreement
    difference: float
    ate_m: float | None
    ate_again_m: float | None
    again: ScoredRow


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
        published, faults = checked_rows(opened, runner, render=True)
        verification.rows.extend(published)
        verification.faults.extend(faults)

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
        sample=True,
    )
    rows_again = {(row.entry, row.sequence): row for row in again.made}
    for _, published in pairs:
        made = rows_again.get(published.key)
        if made is None:
            name = f"{published.row.entry} on {published.row.sequence}: "
            reasons = [line for line in again.failed if line.startswith(name)]
            reason = reasons[0].removeprefix(name) if reasons else "no reason"
            verification.faults.append(
                f"{_named(opened, published.row)} could not be run again: {reason}"
            )
            continue
        verification.rerun.append(_compared(opened, published, scored(opened, by, made)))
    for rerun in verification.rerun:
        if rerun.agreement == "differs":
            verification.faults.append(
                f"{rerun.row.by}, {_named(opened, rerun.row.row)}: {_outcome(rerun.row)} was published, "
                f"run again it is {_outcome(rerun.again)}"
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
    return RerunRow(row, word, share, row.ate_m, again.ate_m, again)


def checked_rows(
    opened: RoundFolder, by: str, *, render: bool
) -> tuple[list[ScoredRow], list[str]]:
    """A runner's rows that could be scored, and the faults of the results, a line each; nothing is run.

    Args:
        opened: The round.
        by: The runner.
        render: Whether the scenes are rendered to compare their bits.
    """
    # a damaged file of one runner is a fault of that runner, and of nobody else
    try:
        results = opened.read_results(by)
        faults = faults_of(opened, results, render=render)
    except DynslamError as error:
        return [], [f"{by}: {error}"]
    rows = []
    for row in results.rows:
        try:
            rows.append(scored(opened, by, row))
        except DynslamError as error:
            faults.append(f"{by}, {_named(opened, row)}: {error}")
    return rows, faults


def faults_of(opened: RoundFolder, results: Results, *, render: bool) -> list[str]:
    """Faults of a runner's results, a line each; nothing is run.

    Args:
        opened: The round.
        results: The description of the runner's bank.
        render: Whether the scenes are rendered to compare their bits.

    Raises:
        DynslamError: The bank is none.
    """
    by = results.by
    faults = [f"{by}: {line}" for line in bank.verify(opened.bank(by))]
    faults += [f"{by}: {line}" for line in _faults_of_pairs(opened, results)]
    sequences = set(opened.sequences)
    resolver = Resolver()
    with working_in(opened.root):
        for row in results.rows:
            fault = _fault_of_row(opened, by, row, sequences, resolver)
            if fault:
                faults.append(f"{by}, {_named(opened, row)}: {fault}")

    # the bits of the scenes
    without = sorted({row.sequence for row in results.rows} - results.scenes.keys())
    for sequence in without:
        label = opened.round.label_of(sequence, opened.salt)
        faults.append(f"{by}: scene {label} has no digest in {RESULTS_FILE}")
    for sequence in sorted(sequences & results.scenes.keys()) if render else ():
        here = scene_digest(sequence)
        if here != results.scenes[sequence]:
            faults.append(
                f"{by}: scene {opened.round.label_of(sequence, opened.salt)} had other bits there: "
                f"{results.scenes[sequence][:16]}, here {here[:16]}"
            )
    return faults


def _faults_of_pairs(opened: RoundFolder, results: Results) -> list[str]:
    """Scenes that a runner has left out of an entry, or has twice; a verifier's sample may leave out scenes."""
    faults = []
    counts = Counter((row.entry, row.sequence) for row in results.rows)
    for (entry, sequence), count in counts.items():
        if count > 1:
            label = opened.round.label_of(sequence, opened.salt)
            faults.append(f"{entry} on {label} has {count} rows")
    if results.sample:
        return faults
    for entry in dict.fromkeys(row.entry for row in results.rows):
        missing = [name for name in opened.sequences if (entry, name) not in counts]
        if missing:
            labels = ", ".join(opened.round.label_of(name, opened.salt) for name in missing)
            faults.append(
                f"{entry} lacks {len(missing)} of {len(opened.sequences)} scenes: {labels}"
            )
    return faults


def _fault_of_row(
    opened: RoundFolder, by: str, row: Row, sequences: set[str], resolver: Resolver
) -> str:
    """Fault of a row: of its entry, scene, request, program, stamps or ground truth; empty for none."""
    if row.entry not in opened.reveal.entries:
        return f"{REVEAL_FILE} does not list this entry"
    if row.sequence not in sequences:
        return "the scene is none of this round's"
    try:
        record = record_of(opened, by, row)
        entry = opened.received_entry(row.entry)
        asked = resolver(entry.spec(row.sequence)).identity
    except DynslamError as error:
        return str(error)
    if record.sequence.id != row.sequence:
        return f"its run is on {record.sequence.id}"
    if fault := _other_request(record, asked):
        return fault
    if changed := difference(entry.program, program_of(entry.name, record.identity)):
        return f"it was run by another program than entered: {changed} was changed"

    if file := foreign_read(entry.name, entry.folder, record.identity):
        return f"it has read {file} of the round's folder, which is no frozen file of the entry"

    # stamps and ground truth need no rendering
    scene = open_synthetic(row.sequence, None)
    folder = RunStore(opened.bank(by)).sequences.folder(record.sequence.part)
    stamps = "".join(f"{format_ns(ns)}\n" for ns in timestamps_ns(scene).tolist())
    if content_of(folder / STAMPS) != stamps.encode():
        return "the stored stamps are not those of the scene"
    if content_of(folder / TRUTH) != format_tum(scene.ground_truth).encode():
        return "the stored ground truth is not that of the scene"
    return ""


def _other_request(record: RunRecord, asked: Mapping[str, Any]) -> str:
    """Fault of a run that was made otherwise than the round asks; empty for none.

    Args:
        record: The run's.
        asked: The identity of the run that the round asks for.
    """
    if record.kind != "run":
        return f"it is no run, but {record.kind}"
    for name in ASKED:
        made = record.identity.get(name)
        if name not in _OF_MACHINE and made != asked.get(name):
            return f"it was run with {name} {made!r}, the round asks for {asked.get(name)!r}"
    return ""


def _named(opened: RoundFolder, row: Row) -> str:
    """Entry and scene of a row in words."""
    return f"{row.entry} on {opened.round.label_of(row.sequence, opened.salt)}"


def _outcome(row: ScoredRow) -> str:
    """Error, status and coverage of a row in words."""
    error = "no error" if row.ate_m is None else f"{1000 * row.ate_m:.2f} mm"
    if row.status == "ok" and row.coverage == 1:
        return error
    return f"{error}, {row.status}, {coverage_text(row.coverage)} of the frames"
