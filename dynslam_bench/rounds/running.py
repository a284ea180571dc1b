"""`run`: the sealed scenes are rendered, the entries run on them, and the runs go into a bank."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Literal

import psutil

from dynslam_bench.core import DynslamError, RunError, write_atomic
from dynslam_bench.core.fingerprint import this_machine, versions
from dynslam_bench.core.records import is_plain_name
from dynslam_bench.rounds.bits import check_bits, scene_digest
from dynslam_bench.rounds.files import (
    RESULTS_FILE,
    Entry,
    Results,
    RoundFolder,
    Row,
    open_round,
    stamp,
)
from dynslam_bench.rounds.programs import other_folder, what_changed, working_in
from dynslam_bench.runs import bank
from dynslam_bench.runs.many import OnFault, RunEvent, run_many
from dynslam_bench.runs.spec import RunSpec
from dynslam_bench.runs.store import RunStore

OnEvent = Callable[[RunEvent], None]


@dataclass(frozen=True)
class RoundRuns:
    """Runs that a runner has made of a round.

    Attributes:
        results: The description of the bank.
        folder: The bank.
        made: Rows of this call.
        failed: Rows of this call that did not come to their end or were lost, with reasons.
        refused: Why entries were not run, by name.
    """

    results: Results
    folder: Path
    made: list[Row]
    failed: list[str] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)


def run(
    folder: str | Path,
    *,
    by: str,
    entries: Iterable[str] = (),
    results: str | Path = "results/rounds",
    jobs: int = 1,
    on_step: Callable[[str], None] = lambda _: None,
    on_event: OnEvent | None = None,
) -> RoundRuns:
    """Render the round's scenes and run entries on them.

    Args:
        folder: The round's folder.
        by: Name of the runner, also that of the bank below ``results/``.
        entries: Names of the entries; by default all that the reveal lists.
        results: Results folder for the runs themselves; the bank gets what scores are computed from.
        jobs: Runs at a time.
        on_step: Called with each step in words.
        on_event: Called with every `RunEvent`.

    Raises:
        RunError: The round is not revealed, its salt is another one, this installation or this
            machine does not fit, or a named entry is not listed or was changed.
        DynslamError: Runs cannot be stored.
    """
    opened = open_round(folder)
    check_runner(opened, by)
    on_step("rendering a public scene")
    check_bits(opened.round)

    # entries that are named have to be right; of all, the wrong ones are left out with a reason
    chosen = list(entries)
    with working_in(opened.root):
        if chosen:
            usable = [usable_entry(opened, name) for name in chosen]
            refused: dict[str, str] = {}
        else:
            usable, refused = usable_entries(opened)
            for name in opened.late_entries():
                refused[name] = opened.late_words(name)
    pairs = [(entry, sequence) for sequence in opened.sequences for entry in usable]
    made = make_rows(
        opened, by, pairs, results=results, jobs=jobs, on_step=on_step, on_event=on_event
    )
    made.refused.update(refused)
    return made


def check_runner(opened: RoundFolder, by: str) -> None:
    """Check that a runner's name is one, and that the round is revealed and fits this installation.

    Raises:
        RunError: One does not hold.
    """
    if not is_plain_name(by):
        raise RunError(f"'{by}' is no name of a runner", "letters, digits, dots and dashes")
    check_release(opened)


def check_release(opened: RoundFolder) -> None:
    """Check that a round is revealed and fits this installation.

    Raises:
        RunError: One does not hold.
    """
    _ = opened.reveal
    opened.round.check_here()


def usable_entries(opened: RoundFolder) -> tuple[list[Entry], dict[str, str]]:
    """The listed entries whose trackers are here and unchanged; and why the others are not used, by name."""
    usable = []
    refused = {}
    for name in opened.reveal.entries:
        try:
            usable.append(usable_entry(opened, name))
        except DynslamError as error:
            refused[name] = str(error)
    return usable, refused


def usable_entry(opened: RoundFolder, name: str) -> Entry:
    """A listed entry whose tracker is here and unchanged; the working folder is the round's.

    Raises:
        RunError: It is not listed, was changed, or its tracker was.
        DynslamError: Its tracker is not here.
    """
    entry = opened.received_entry(name)
    if fault := other_folder(entry, opened.root):
        raise RunError(
            f"the tracker of entry '{name}' is not the frozen one: {fault}",
            f"restore {opened.root / 'entries' / name} as it was entered",
        )
    if changed := what_changed(entry, opened.root, entry.trial.sequence):
        raise RunError(
            f"the tracker of entry '{name}' is not the frozen one: {changed} was changed since it was entered",
            "restore what was entered, or install the release with which it was",
        )
    return entry


def make_rows(
    opened: RoundFolder,
    by: str,
    pairs: Sequence[tuple[Entry, str]],
    *,
    results: str | Path,
    jobs: int,
    on_step: Callable[[str], None],
    on_event: OnEvent | None,
    sample: bool = False,
) -> RoundRuns:
    """Run entries on scenes, add the runs to the runner's bank, and describe the bank.

    Args:
        opened: The round.
        by: The runner.
        pairs: The entries with the scenes on which they run.
        results: See `run`, as for all that follow.
        jobs: Runs at a time.
        on_step: Called with each step in words.
        on_event: Called with every `RunEvent`.
        sample: Whether the pairs are a sample of a verifier.

    Raises:
        DynslamError: The round's bank cannot be written, or has faults.
    """
    # a store of this round and runner alone, so that a verifier never takes the runs of another
    place = Path(results).expanduser().absolute() / opened.sha256[:16] / by
    store = RunStore(place)

    # the scenes, rendered before the trackers that run on them
    digests = {}
    sequences = list(dict.fromkeys(sequence for _, sequence in pairs))
    for number, sequence in enumerate(sequences, 1):
        on_step(f"rendering scene {number} of {len(sequences)}")
        digests[sequence] = scene_digest(sequence)

    # the runs, in the round's folder
    faults: dict[tuple[str, str], str] = {}

    def on_fault(spec: RunSpec, error: DynslamError) -> None:
        faults[spec.label, spec.sequence] = str(error)

    on_step("running")
    specs = [entry.spec(sequence) for entry, sequence in pairs]
    with working_in(opened.root):
        made = _made(specs, store, opened, jobs, on_event, on_fault)
    rows = [
        Row(entry=label, sequence=sequence, run_id=id) for (label, sequence), id in made.items()
    ]
    failed = [f"{label} on {sequence}: {reason}" for (label, sequence), reason in faults.items()]
    for row in rows:
        record = store.read_whole(row.run_id)
        if record.status != "ok":
            failed.append(f"{row.entry} on {row.sequence}: {record.status}, {record.reason}")

    # the bank, and which rows it holds: those of earlier calls, too
    folder = opened.bank(by)
    results_here = _described(opened, by, digests, rows, sample=sample)
    if rows:
        left_out = bank.add([store.root], folder, protocol=opened.round.protocol).left_out
        failed += [f"left out of the bank: {entry.path}: {entry.reason}" for entry in left_out]
        write_atomic(folder / RESULTS_FILE, results_here.to_json())
    return RoundRuns(results_here, folder, rows, failed)


def _made(
    specs: Sequence[RunSpec],
    store: RunStore,
    opened: RoundFolder,
    jobs: int,
    on_event: OnEvent | None,
    on_fault: OnFault,
) -> dict[tuple[str, str], str]:
    """Make runs; the id of each by the entry's name and the sequence."""
    made: dict[tuple[str, str], str] = {}

    def note(event: RunEvent) -> None:
        if event.record is not None:
            made[event.spec.label, event.spec.sequence] = event.record.run_id
        if on_event is not None:
            on_event(event)

    run_many(
        specs,
        results=store,
        protocol=opened.round.protocol,
        jobs=jobs,
        on_event=note,
        on_fault=on_fault,
    )
    return made


def _described(
    opened: RoundFolder, by: str, digests: dict[str, str], rows: Sequence[Row], *, sample: bool
) -> Results:
    """The description of a runner's bank after new rows."""
    machine = this_machine()
    packages = versions()
    reached = network()
    mixed = False
    scenes: dict[str, str] = {}
    every: dict[tuple[str, str], Row] = {}
    if (opened.bank(by) / RESULTS_FILE).is_file():
        earlier = opened.read_results(by)
        sample = sample and earlier.sample
        # an entry that reached a network once may have taken what it keeps
        reached = "open" if earlier.network == "open" else reached
        mixed = earlier.mixed or (earlier.machine, earlier.versions) != (machine, packages)
        scenes |= earlier.scenes
        every |= {(row.entry, row.sequence): row for row in earlier.rows}
    every |= {(row.entry, row.sequence): row for row in rows}
    return Results(
        by=by,
        round_sha256=opened.sha256,
        reveal_sha256=opened.reveal_sha256,
        scenes=scenes | digests,
        rows=list(every.values()),
        sample=sample,
        network=reached,
        made=stamp(datetime.now(timezone.utc)),
        machine=machine,
        versions=packages,
        mixed=mixed,
    )


def network() -> Literal["none", "open"]:
    """``none`` where no interface of this process, and what it starts, is up but the loopback; else ``open``."""
    up = {name for name, state in psutil.net_if_stats().items() if state.isup}
    return "open" if up - {"lo", "lo0"} else "none"
