"""`bank check`: whether a submission to a bank is accepted.

The rules have a version, `CHECKER`: another rule is another version. A submission is a bank, with
the rows that are to be added.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from dynslam_bench.core import DynslamError, RunError
from dynslam_bench.runs.bank import Bank, verify
from dynslam_bench.runs.bank_files import BankDescription, read_description, read_marks
from dynslam_bench.runs.layout import FINAL, ONLINE, STAMPS, TRUTH, have_equal_files
from dynslam_bench.runs.record import RunRecord

CHECKER = "bank-check/1"
"""Name and version of the rules."""
_ERROR_TOLERANCE_M = 1e-9
"""Errors of a mark and of its row that differ by less are one: both come from the same trajectory."""


@dataclass(frozen=True)
class Checked:
    """Outcome of the checks of a submission.

    Attributes:
        checker: Name and version of the rules.
        protocol: Protocol under which its rows were scored.
        rows: Number of its rows.
        new: Ids of those that the bank does not hold.
        faults: Why it is refused, a line each; empty where it is accepted.
    """

    checker: str
    protocol: str
    rows: int
    new: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    @property
    def accepted(self) -> bool:
        """Whether it is accepted."""
        return not self.faults


def check_submission(submission: str | Path, bank: str | Path | None = None) -> Checked:
    """Check a submission: its files, its records, its errors, its marks, and whether it fits a bank.

    Args:
        submission: A bank with the rows that are to be added.
        bank: The bank that is to get them; None to check the submission alone.

    Raises:
        RunError: One of the two is no bank, or the bank itself has faults.
    """
    store = Bank(submission)
    faults = verify(submission)
    if faults:  # nothing of damaged files is scored
        return Checked(CHECKER, "", len(store.ids()), [], faults)
    description = read_description(store.root)
    accepted = None
    if bank is not None:
        accepted = Bank(bank)
        if of_bank := verify(bank):
            raise RunError(f"{bank} has faults itself, of {len(of_bank)} the first: {of_bank[0]}")
        if difference := description.difference(read_description(accepted.root)):
            faults.append(f"the submission and {bank} do not fit: {difference}")

    # every row, by itself and beside those of the bank
    records = [store.read_whole(run_id) for run_id in store.ids()]
    if not records:
        faults.append("it has no row")
    for record in records:
        row = f"row {record.run_id} ({record.tracker.id} on {record.sequence.id})"
        faults += [f"{row}: {fault}" for fault in _faults_of_row(store, record, description)]
        if accepted is not None and (fault := _contradiction(store, record, accepted)):
            faults.append(f"{row}: {fault}")
    new = [
        record.run_id
        for record in records
        if accepted is None or accepted.get(record.run_id) is None
    ]
    return Checked(CHECKER, description.protocol, len(records), new, faults)


def _faults_of_row(store: Bank, record: RunRecord, description: BankDescription) -> Iterator[str]:
    """Faults that keep a row from being accepted, a line each."""
    if record.trial_of:
        yield f"it is a trial of the study '{record.trial_of}', no result"
    if record.kind == "imported" and not record.provenance:
        yield "it does not say where the trajectory comes from"
    if not record.verified:
        yield "its id does not tell content, code, weights and libraries"
    if record.kind == "run" and not record.sequence.content:
        yield "it does not say what its sequence held"
    # a run that failed or was lost is a row, too; any other has an error
    if record.failed:
        return
    metrics = store.score(record, description.protocol, again=True)
    error = metrics.metrics.get("ate_rmse_m")
    if error is None and record.status == "ok":
        reason = metrics.reasons.get(metrics.trajectory, "no reason")
        yield f"it has no error under {description.protocol}: {reason}"
    marks, _ = read_marks(store.root)
    for mark in marks.get(record.run_id, ()):
        if error is not None and abs(mark.ate_m - error) > _ERROR_TOLERANCE_M:
            yield (
                f"the mark of {mark.by} says {1000 * mark.ate_m:.3f} mm, "
                f"the trajectory gives {1000 * error:.3f} mm"
            )


def _contradiction(store: Bank, record: RunRecord, accepted: Bank) -> str:
    """How a row differs from that of a bank with the same id, or its sequence from the bank's; empty for nothing."""
    part = record.sequence.part
    there = accepted.sequences.folder(part)
    if (there / STAMPS).is_file():
        here = store.sequences.folder(part)
        for name in (STAMPS, TRUTH):
            if not have_equal_files(here, there, name):
                return f"{name} of its sequence is another one in the bank"
    try:
        other = accepted.read_whole(record.run_id)
    except DynslamError:  # the bank does not have it
        return ""
    if other.status != record.status:
        return f"the bank has a row of this id that ended as {other.status}, not {record.status}"
    folders = (store.folder(record.run_id), accepted.folder(record.run_id))
    for name in (ONLINE, FINAL):
        if not have_equal_files(*folders, name):
            return f"the bank has a row of this id with another {name}"
    return ""
