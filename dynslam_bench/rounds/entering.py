"""`enter`: a tracker is frozen, checked and tried on public scenes."""

from collections.abc import Callable, Mapping
from contextlib import closing
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from dynslam_bench.core import DynslamError, RunError, TemporaryFolder, write_atomic
from dynslam_bench.core.fingerprint import this_machine, versions
from dynslam_bench.core.records import is_plain_name
from dynslam_bench.rounds.bits import check_bits
from dynslam_bench.rounds.files import (
    Entry,
    Program,
    RoundFolder,
    Trial,
    open_round,
    stamp,
)
from dynslam_bench.rounds.programs import folder_listing, foreign_read, program_of, working_in
from dynslam_bench.runs.identity import resolve
from dynslam_bench.runs.many import run_many
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.runs.store import RunStore
from dynslam_bench.testing.isolated import isolated_tracker_report

TRIAL_SCENE = 100
"""The public scene of the trial: the first held-out one."""
TRIAL_FRAMES = 60
"""Frames of the trial at most: two seconds."""
_PROGRAMS = ("subprocess", "batch")
"""Ids of trackers that are programs, whose files no package holds."""


def enter(
    folder: str | Path,
    tracker: str,
    *,
    name: str,
    settings: Mapping[str, Any] | None = None,
    on_step: Callable[[str], None] = lambda _: None,
    now: datetime | None = None,
) -> Entry:
    """Freeze a tracker, and write its entry.

    Args:
        folder: The round's folder, which is the working folder of the tracker.
        tracker: Id, ``id:value``, ``module:Attr`` or ``file.py:Attr``; paths count from the round's
            folder.
        name: Name of the entry.
        settings: Overrides of the tracker's settings by dotted name.
        on_step: Called with each step in words.
        now: The time; that of the clock by default.

    Raises:
        RunError: The round does not fit this installation or this machine, it is too late, the name
            is taken, or the tracker fails a check or its trial.
        DynslamError: The tracker is unknown, or the settings do not fit.
    """
    opened = open_round(folder)
    now = now or datetime.now(timezone.utc)
    _check_open(opened, name, now)
    opened.round.check_here()
    on_step("rendering a public scene")
    check_bits(opened.round)

    overrides = dict(settings or {})
    own = opened.root / "entries" / name
    before = folder_listing(own)
    with working_in(opened.root), closing(TemporaryFolder()) as folder_of_trial:
        _check_own_files(opened, tracker, overrides, own)
        on_step("checking the tracker's contract")
        checks = _checked(tracker, overrides)
        on_step("running it on a public scene")
        trial, record = _tried(opened, tracker, overrides, RunStore(folder_of_trial.path))

    # what it is made of: its folder, and what it has read
    if folder_listing(own) != before:
        raise RunError(
            f"the tracker writes into {own}, where its files are frozen",
            "let it write into a temporary folder",
        )
    if file := foreign_read(name, before, record.identity):
        raise RunError(
            f"the tracker has read {file} of the round's folder", f"put what it needs into {own}"
        )
    program = program_of(name, record.identity)
    check_is_new(opened, tracker, program, on_step)
    entry = Entry(
        name=name,
        round_sha256=opened.sha256,
        protocol=opened.round.protocol,
        tracker=tracker,
        overrides=overrides,
        program=program,
        folder=before,
        checks=checks,
        trial=trial,
        entered=stamp(now),
        machine=this_machine(),
        versions=versions(),
    )
    write_atomic(opened.entry_file(name), entry.to_json())
    return entry


def _check_open(opened: RoundFolder, name: str, now: datetime) -> None:
    """Check that an entry of this name can be received.

    Raises:
        RunError: The name is none or is taken, or the round is over.
    """
    if not is_plain_name(name):
        raise RunError(f"'{name}' is no name of an entry", "letters, digits, dots and dashes")
    if opened.is_revealed:
        raise RunError(
            f"round {opened.round.name} was revealed at {opened.reveal.revealed}: an entry would be late",
            "enter the next round",
        )
    deadline = opened.round.deadline
    if deadline and now >= datetime.fromisoformat(deadline):
        raise RunError(
            f"the deadline of round {opened.round.name} was {deadline}, it is {stamp(now)}: an entry would be late",
            "enter the next round",
        )
    if opened.entry_file(name).exists():
        raise RunError(
            f"there is an entry '{name}' already",
            f"remove {opened.entry_file(name)} to enter again, or name another",
        )


def _check_own_files(
    opened: RoundFolder, tracker: str, settings: dict[str, Any], own: Path
) -> None:
    """Check that a plug-in's file, or a file of a program, lies in the entry's folder.

    Raises:
        RunError: It lies elsewhere: nobody could tell whether it changes.
        DynslamError: The tracker is unknown, or the settings do not fit.
    """
    sequence = f"synthetic/{opened.round.families[0]}?scene={TRIAL_SCENE}&frames=2"
    resolved = resolve(RunSpec(tracker=tracker, sequence=sequence, settings=settings))
    plugin = resolved.base_folders.plugin
    is_elsewhere = plugin is not None and not is_below(plugin, own)
    if resolved.tracker.id in _PROGRAMS:
        is_elsewhere = not any(is_below(file, own) for file in resolved.files)
    if is_elsewhere:
        raise RunError(
            f"the files of '{tracker}' do not lie in entries/{own.name}: nobody could tell whether they change",
            f"put them into {own}, and name them from the round's folder",
        )


def is_below(path: Path, folder: Path) -> bool:
    """Whether a path leads to a folder or below it, links followed."""
    return path.resolve().is_relative_to(folder.resolve())


def check_is_new(
    opened: RoundFolder,
    tracker: str,
    program: Program,
    on_step: Callable[[str], None] = lambda _: None,
) -> None:
    """Check that no entry has the same program: the two would share their runs; damaged entries are named and skipped.

    Raises:
        RunError: There is such an entry.
    """
    for name in opened.entry_names():
        try:
            other = opened.read_entry(name)
        except DynslamError as error:
            on_step(f"entry '{name}' is not compared: {error.headline}")
            continue
        if other.tracker == tracker and other.program == program:
            raise RunError(
                f"entry '{name}' is the same tracker with the same settings", "enter it once"
            )


def _checked(tracker: str, settings: dict[str, Any]) -> list[str]:
    """The names of the conformance checks that a tracker passes.

    Raises:
        RunError: It fails one.
    """
    report = isolated_tracker_report(tracker, settings=settings)
    if report.failed:
        first = report.failed[0]
        raise RunError(
            f"{report.subject} fails {len(report.failed)} of {len(report.checks)} checks, the first: "
            f"{first.name}: {first.message}",
            f"dynslam-bench trackers test {tracker} shows all",
        )
    return [check.name for check in report.checks if check.status == "passed"]


def _tried(
    opened: RoundFolder, tracker: str, settings: dict[str, Any], store: RunStore
) -> tuple[Trial, RunRecord]:
    """Run a tracker on a public scene of the round's first family.

    Raises:
        RunError: It does not come to its end.
    """
    of = opened.round
    frames = min(of.frames, TRIAL_FRAMES)
    sequence = f"synthetic/{of.families[0]}?scene={TRIAL_SCENE}&frames={frames}"
    spec = RunSpec(tracker=tracker, sequence=sequence, settings=settings)
    (record,) = run_many([spec], results=store, protocol=of.protocol)
    if record.failed:
        raise RunError(
            f"the trial of '{tracker}' on {sequence} ended as {record.status}: {record.reason}",
            f"dynslam-bench run {tracker} '{sequence}' shows more",
        )
    trial = Trial(
        sequence=sequence,
        run_id=record.run_id,
        status=record.status,
        ate_m=store.score(record, of.protocol).metrics.get("ate_rmse_m"),
        coverage=record.coverage,
    )
    return trial, record
