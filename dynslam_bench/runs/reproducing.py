"""`bank reproduce`: a row of a bank is run again, and gets a mark where it comes out as it did."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from dynslam_bench.core import DynslamError, RunError
from dynslam_bench.core.fingerprint import this_machine, versions
from dynslam_bench.core.settings import flatten
from dynslam_bench.runs.bank import Bank, add_mark, check_sound
from dynslam_bench.runs.bank_files import BankDescription, Mark, mark_file, read_description
from dynslam_bench.runs.identity import ResolvedRun, resolve
from dynslam_bench.runs.layout import FINAL, ONLINE, have_equal_files
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.running import run_one
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.runs.store import RunStore
from dynslam_bench.sequences.synthetic.ids import parse_synthetic_id, probe_id

REPEATS = 2
"""Further starts that are run where the new trajectory is not the row's to the last bit."""
_REPEATED = ("seed", "offset", "sequence", "content", "id_taken_by")
"""Entries of an identity in which repeats of one row differ; `sequence` by the noise alone."""

_COMMANDS = {"subprocess": "command", "batch": "program"}
"""Ids of trackers that run a program, and the setting that names it."""
_CODE = re.compile(r"[^:]*[\w\-]+(\.py)?:[A-Za-z_][\w.]*|.*\.py(:.*)?")
"""A module or a file of Python with the name of what is taken from it: ``module:Attr``, ``file.py:Attr``."""


@dataclass(frozen=True)
class Reproduction:
    """A row that was run again.

    Attributes:
        mark: The mark; it was added where `reproduced`.
        reproduced: Whether the row came out as it did, or within what its repeats differ by.
        record: The record of the new run.
        folder: Where the new run lies.
    """

    mark: Mark
    reproduced: bool
    record: RunRecord
    folder: Path

    def describe(self) -> str:
        """One line: both errors, their difference, and what the repeats differ by."""
        mark = self.mark
        errors = f"{1000 * mark.ate_m:.3f} mm in the bank, {1000 * mark.ate_again_m:.3f} mm here"
        if mark.identical:
            return f"{errors}: equal to the bit"
        words = f"{errors}: differs by {1000 * mark.difference_m:.3f} mm"
        if mark.repeats_differ_m is not None:
            words += f", {mark.repeats} repeats by {1000 * mark.repeats_differ_m:.3f} mm"
        return words


def reproduce(
    bank: str | Path,
    row: str,
    *,
    by: str,
    tracker: str = "",
    sequence: str = "",
    repeats: int = REPEATS,
    results: str | Path = "results/reproduced",
    data_root: str | Path | None = None,
    on_step: Callable[[str], None] = lambda _: None,
) -> Reproduction:
    """Run a row of a bank again with its tracker, settings and sequence, and add a mark where it comes out.

    A trajectory that is equal to the last bit is a mark. Any other has to have an error that
    differs from the row's by no more than repeats differ from each other: those that the bank
    holds, or further starts that are run here.

    Args:
        bank: The bank.
        row: Id of the row, or its first digits.
        by: Who runs it, as the mark shows it.
        tracker: Where the tracker is on this machine, if its id does not find it, e.g.
            ``own.py:Attr``. A program, a file or a module that a row names runs only if it is named
            here.
        sequence: Where the sequence is on this machine, if its id does not find it: a folder.
        repeats: Further starts that are run here at most.
        results: Results folder for the new runs.
        data_root: Folder of the recorded sequences.
        on_step: Called with each step in words.

    Raises:
        RunError: There is no such row, it is an import or has no error, the bank has faults, this
            machine renders other bits, the tracker is not here or is code that only the row names,
            or the row is another run here.
        DynslamError: The run cannot be made or stored.
    """
    store = Bank(bank)
    check_sound(bank)
    mark_file(store.root, "", by)  # refuses a name that is none
    description = read_description(store.root)
    record = store.read(row)
    ate_m = _error_of(store, record, description)

    # the same run here: bits of the renderer, tracker, settings, data
    on_step("checking this machine")
    _check_bits(record, description)
    resolved = _resolved(record, tracker, sequence, data_root)
    on_step(f"running {record.tracker.label} on {record.sequence.id}")
    place = RunStore(results)
    again = run_one(resolved, place, protocol=description.protocol)
    folder = place.folder(again.run_id)
    if again.status != record.status:
        raise RunError(
            f"row {record.run_id} ended as {record.status}, here as {again.status}: "
            f"{again.reason or 'no reason'}; no mark"
        )
    ate_again_m = _error_of(place, again, description)
    identical = have_equal_files(store.folder(record.run_id), folder, ONLINE, FINAL)

    # what repeats differ by, where it decides
    repeats_differ_m = None
    count = 0
    if not identical:
        errors_there = _errors_of_repeats(store, record, description)
        errors_here = [ate_again_m]
        if len(errors_there) < 2:
            on_step(f"running {repeats} repeats")
            errors_here += _more_errors(resolved, place, description, repeats)
        count = max(len(errors_there), len(errors_here))
        repeats_differ_m = max(_spread(errors_there), _spread(errors_here))

    mark = Mark(
        run_id=record.run_id,
        by=by,
        made=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        machine=this_machine(),
        versions=versions(),
        protocol=description.protocol,
        ate_m=ate_m,
        ate_again_m=ate_again_m,
        identical=identical,
        repeats_differ_m=repeats_differ_m,
        repeats=count,
        changed=_changed(record, again),
    )
    reproduced = not mark.fault(description, [record.run_id])
    if reproduced:
        add_mark(bank, mark)
    return Reproduction(mark, reproduced, again, folder)


def _error_of(store: RunStore, record: RunRecord, description: BankDescription) -> float:
    """The error of a run, computed from its trajectory, metres.

    Raises:
        RunError: It is an import, or has no error under the bank's protocol.
    """
    if record.kind == "imported":
        raise RunError(
            f"row {record.run_id} was imported from {record.provenance}: there is no run to repeat",
            "run its tracker, and add that run",
        )
    metrics = store.score(record, description.protocol, again=True)
    error = metrics.metrics.get("ate_rmse_m")
    if error is None:
        reason = metrics.reasons.get(metrics.trajectory, record.reason)
        raise RunError(f"run {record.run_id} has no error under {description.protocol}: {reason}")
    return error


def _check_bits(record: RunRecord, description: BankDescription) -> None:
    """Check that this machine renders what the bank's does.

    Raises:
        RunError: It renders other bits.
    """
    if not record.sequence.id.startswith("synthetic/"):
        return
    probe = probe_id(parse_synthetic_id(record.sequence.id).name)
    stated = description.probes.get(probe)
    if stated is None:  # a bank of an older release does not say it
        return
    from dynslam_bench.sequences.synthetic.digests import probe_digest

    here = probe_digest(probe)
    if here != stated:
        raise RunError(
            f"this machine renders other bits: {probe} has the digest {here[:16]}, in the bank {stated[:16]}",
            "errors would be those of other scenes; use another machine, and report this one",
        )


def _resolved(
    record: RunRecord, tracker: str, sequence: str, data_root: str | Path | None
) -> ResolvedRun:
    """The run of a row, looked up on this machine.

    Raises:
        RunError: The tracker is not here or is another one, or the settings or the sequence are
            others here.
        DynslamError: The sequence is not here.
    """
    info = record.tracker
    given = tracker or info.given or info.id
    _refuse_code_of_others(record, given, is_named=bool(tracker))
    settings = dict(record.overrides)
    if info.id in _COMMANDS and ":" in tracker:
        settings.pop(_COMMANDS[info.id], None)  # the one that the user has named
    spec = RunSpec(
        tracker=given,
        sequence=sequence or record.sequence.id,
        settings=settings,
        frames=record.frames,
        offset=record.offset,
        stride=record.stride,
        seed=record.seed,
        device=record.device,
        threads=record.threads,
        cache=bool(record.identity.get("cache", False)),
        realtime=record.realtime,
        drop_share=record.drop_share,
        degrade=record.degrade,
        data_root=None if data_root is None else str(data_root),
    )
    _check_tracker(record, given)
    resolved = resolve(spec)
    if resolved.tracker.id != info.id:
        raise RunError(
            f"row {record.run_id} is of tracker '{info.id}', not '{resolved.tracker.id}'"
        )

    # settings whose defaults another release has changed, and data that are not the row's
    here = resolved.identity.get("settings", flatten(resolved.settings))
    for name, value in record.identity.get("settings", {}).items():
        if here.get(name) != value:
            raise RunError(
                f"the setting {name} of row {record.run_id} was {value!r}, here it is {here.get(name)!r}",
                f"install dynslam-bench {record.versions.get('dynslam-bench', 'of the row')}",
            )
    content = str(resolved.identity["content"])
    if content != record.sequence.content:
        stated = record.sequence.content[:16]
        raise RunError(
            f"{record.sequence.id} has other content here: {content[:16]}, in the bank {stated}",
            "fetch the sequence again, or install the release of the row",
        )
    return resolved


def _refuse_code_of_others(record: RunRecord, given: str, *, is_named: bool) -> None:
    """Refuse to run a program, a file or a module that only the row names: its author chose it, not the user.

    Args:
        record: The row's.
        given: The tracker that would be run.
        is_named: Whether the user has named it.

    Raises:
        RunError: The row names one, and the user has not.
    """
    row = f"row {record.run_id}"
    info = record.tracker
    # a program, whose command is a setting
    if info.id in _COMMANDS and not (is_named and ":" in given):
        setting = _COMMANDS[info.id]
        command = record.settings.get(setting, record.overrides.get(setting, "none"))
        raise RunError(
            f"{row} runs a program of its author, which nobody has checked: {command!r}",
            f"look at it, and name it: --tracker '{info.id}:...'",
        )
    if is_named:
        return
    # a file or a module, as the tracker or in a setting
    if _CODE.fullmatch(given):
        raise RunError(
            f"tracker '{info.id}' of {row} is code that only the row names: {given!r}",
            "look at it, and say where it is with --tracker",
        )
    for name, value in record.overrides.items():
        if isinstance(value, str) and _CODE.fullmatch(value):
            raise RunError(
                f"the setting {name} of {row} is code that only the row names: {value!r}",
                f"look at it, and name the tracker: --tracker {given}",
            )


def _check_tracker(record: RunRecord, given: str) -> None:
    """Check that the tracker of a row is installed.

    Raises:
        RunError: It is not here.
    """
    from dynslam_bench.trackers.registry import TRACKERS

    info = record.tracker
    try:
        TRACKERS.get(given)
    except DynslamError as error:
        version = f" {info.version}" if info.version else ""
        origin = f" of {info.distribution}" if info.distribution else ""
        raise RunError(
            f"tracker '{info.id}'{version}{origin} of row {record.run_id} is not installed here: {error.headline}",
            "install it, or say where it is with --tracker",
        ) from error


def _errors_of_repeats(
    store: RunStore, record: RunRecord, description: BankDescription
) -> list[float]:
    """The errors of a row and of its repeats in the bank, metres: other seeds, starts and draws of the noise."""
    errors = []
    for other in store.all()[0]:
        if not _is_repeat(record, other):
            continue
        with suppress(RunError):  # a repeat without an error says nothing
            errors.append(_error_of(store, other, description))
    return errors


def _is_repeat(record: RunRecord, other: RunRecord) -> bool:
    """Whether two runs are repeats of one block by the same program."""
    if other.kind != "run" or other.sequence.block != record.sequence.block:
        return False
    return _without_repeat(record) == _without_repeat(other)


def _without_repeat(record: RunRecord) -> dict[str, object]:
    """The identity of a run without what its repeats differ in."""
    return {name: value for name, value in record.identity.items() if name not in _REPEATED}


def _more_errors(
    resolved: ResolvedRun, place: RunStore, description: BankDescription, repeats: int
) -> list[float]:
    """The errors of later starts of a run on this machine, metres."""
    errors = []
    for number in range(1, repeats + 1):
        offset = resolved.spec.offset + number
        later = run_one(
            resolved.spec.model_copy(update={"offset": offset}),
            place,
            protocol=description.protocol,
        )
        with suppress(RunError):  # a start that was lost says nothing
            errors.append(_error_of(place, later, description))
    return errors


def _spread(errors: Iterable[float]) -> float:
    """The largest difference between errors; 0 for one."""
    values = list(errors)
    return max(values) - min(values)


def _changed(record: RunRecord, again: RunRecord) -> list[str]:
    """Parts of the program that are others here, e.g. ``numpy 1.26.4, here 2.1.0``."""
    before = record.program
    now = again.program
    names = sorted(before.keys() | now.keys())
    return [
        f"{name} {before.get(name, 'none')}, here {now.get(name, 'none')}"
        for name in names
        if before.get(name) != now.get(name)
    ]
