"""The four verbs of the gate: write the question, record a baseline, judge the working tree, compare revisions."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

from dynslam_bench.core import RunError, write_atomic
from dynslam_bench.core.fingerprint import Machine, this_machine, versions
from dynslam_bench.evaluation.gate import LOOKS, GateVerdict
from dynslam_bench.gate.baseline import (
    BASELINE_FILE,
    Baseline,
    Origin,
    Side,
    measurement_of,
    read_baseline,
)
from dynslam_bench.gate.config import (
    GATE_FILE,
    Cases,
    Gate,
    check_sequences,
    load_gate,
    spec_of_round,
)
from dynslam_bench.gate.judging import Findings, judge
from dynslam_bench.gate.page import write_page
from dynslam_bench.gate.result import GateResult
from dynslam_bench.gate.revisions import (
    Runner,
    build,
    checked_out,
    commit_of,
    untracked_files,
    working_tree,
)
from dynslam_bench.gate.trajectory_folder import import_folder
from dynslam_bench.runs.store import RunStore

RESULTS = "results/gate"
"""Where runs and results of gates are kept, a folder each."""
RECORDED_ROUNDS = 2
"""Rounds that `record` makes: with two of each side the files alone can tell scatter from change."""
_LISTED = 3
"""Names in a note."""
BASELINE = "baseline"
CANDIDATE = "candidate"
OnRun = Callable[[str, str, int], None]
"""Called before each run with the side, the case and the round, from 1."""


def _silent(side: str, case: str, number: int) -> None:
    """Report nothing."""


TEMPLATE = """\
# The question of a gate: did a change help? See docs/how-to/gate.md.
trackers = {trackers}
sequences = {sequences}
# confirm = []                # sequences for `gate check --confirm`: nobody looks at them before
frames = {frames}              # without this line all frames
protocol = "tum-rgbd/v1"
margin = 0.10                 # differences below 10 % do not matter
rounds = 10                   # at most; each runs every sequence once with the baseline and once with the candidate
# minutes = 30                # no round begins later
build = "{build}"             # run in every checkout, e.g. "cmake -B build && cmake --build build"

[guardrails]                  # what must not get worse beside the error
coverage = 0.02               # share of the frames by which the mean coverage may fall
# frame_time = 1.2            # most times the baseline's, measured in turns
# memory = 1.2
"""


def init(
    path: str | Path = GATE_FILE,
    *,
    trackers: Sequence[str] = ("orb-slam2",),
    sequences: Sequence[str] = (),
    frames: tuple[int, int] = (0, 60),
    build: str = "",
) -> Path:
    """Write a short ``gate.toml``.

    Args:
        path: The file.
        trackers: What is run, see `GateConfig`.
        sequences: Sequences that are run; without any eight rendered scenes.
        frames: Part of every sequence.
        build: Command that builds a checkout.

    Raises:
        RunError: The file exists.
    """
    file = Path(path).expanduser().absolute()
    if file.exists():
        raise RunError(f"{file} exists", "edit it, or remove it first")
    named = sequences or RENDERED
    text = TEMPLATE.format(
        trackers=_toml_list(trackers),
        sequences=_toml_list(named),
        frames=list(frames),
        build=build.replace("\\", "\\\\").replace('"', '\\"'),
    )
    write_atomic(file, text)
    return file


RENDERED = tuple(
    f"synthetic/{name}?scene={100 + number}"
    for number, name in enumerate(
        (
            "walking_xyz",
            "walking_static",
            "walking_halfsphere",
            "walking_rpy",
            "sitting_xyz",
            "sitting_static",
            "sitting_halfsphere",
            "sitting_rpy",
        )
    )
)
"""Rendered scenes, one of each kind: enough to find a change of 10 % in nine of ten gates."""


def _toml_list(values: Sequence[str]) -> str:
    lines = "".join(
        '  "' + value.replace("\\", "\\\\").replace('"', '\\"') + '",\n' for value in values
    )
    return f"[\n{lines}]"


# -- making runs -------------------------------------------------------------------------------------


@dataclass
class _Program:
    """One side: where its runs are made and stored, and what was measured of them.

    Attributes:
        runner: Makes its runs.
        store: Its results folder.
        side: Its measurements.
    """

    runner: Runner
    store: RunStore
    side: Side

    def measure(self, case: str, number: int, cases: Cases, gate: Gate) -> None:
        """Make and measure a case's run of a round."""
        run_id = self.runner.run(spec_of_round(cases[case], gate, number))
        record = self.store.read_whole(run_id)
        # a program's id names the checkout that it was built in: both sides get that of the question
        asked = cases[case].tracker
        prefix, colon, _ = asked.partition(":")
        if colon and record.tracker.id.startswith(prefix + colon) and record.tracker.id != asked:
            tracker = record.tracker.model_copy(update={"id": asked})
            record = self.store.rewrite(record, tracker=tracker)
        self.side.add(measurement_of(case, number, record, self.store, gate.protocol))


def _started(stack: ExitStack, name: str, folder: Path, gate: Gate, results: Path) -> _Program:
    """A side whose runs are made in a checkout, until the stack is closed."""
    place = results / name
    runner = stack.enter_context(Runner(folder, place, gate.config.environment))
    return _Program(runner, RunStore(place), Side(name))


@dataclass
class _Budget:
    """When no further round begins."""

    minutes: float | None
    began: float = field(default_factory=time.monotonic)

    def is_spent(self) -> bool:
        """Whether the minutes are over."""
        return self.minutes is not None and time.monotonic() - self.began > 60.0 * self.minutes


def _in_turns(
    baseline: _Program, candidate: _Program, cases: Cases, gate: Gate, on_run: OnRun
) -> tuple[Findings, int]:
    """Run both sides in turns until the question is decided or the budget is spent.

    Args:
        baseline: One side.
        candidate: The candidate's side.
        cases: What a round runs.
        gate: The question.
        on_run: Told of every run.

    Returns:
        What was found at the last look, and the rounds until it.
    """
    config = gate.config
    budget = _Budget(config.minutes)
    findings = None
    looked_at = 0
    for number in range(config.rounds):
        for position, case in enumerate(cases):
            # the one that begins changes from run to run: a machine that slows down favours none
            sides = [baseline, candidate]
            if (number + position) % 2:
                sides.reverse()
            for program in sides:
                on_run(program.side.name, case, number + 1)
                program.measure(case, number, cases, gate)
        made = number + 1
        # one round can show that all bits are equal, and nothing else
        if made == 1 or made in LOOKS:
            findings = judge(baseline.side, candidate.side, config, made)
            looked_at = made
            if findings.is_settled:
                break
        if budget.is_spent():
            break
    if findings is None:
        raise RunError("no round was run")
    return findings, looked_at


def _measured(program: _Program, cases: Cases, gate: Gate, rounds: int, on_run: OnRun) -> Side:
    """The measurements of one side alone in some rounds."""
    for number in range(rounds):
        for case in cases:
            on_run(program.side.name, case, number + 1)
            program.measure(case, number, cases, gate)
    return program.side


def _new_results(results: str | Path) -> Path:
    """A folder that no gate has used, named by the time."""
    now = datetime.now(timezone.utc)
    return Path(results).expanduser().absolute() / now.strftime("%Y%m%d-%H%M%S-%f")


# -- record --------------------------------------------------------------------------------------------


def record(
    path: str | Path = GATE_FILE,
    *,
    output: str | Path | None = None,
    rounds: int = RECORDED_ROUNDS,
    uncommitted: bool = False,
    trajectories: str | Path | None = None,
    results: str | Path = RESULTS,
    data_root: str | Path | None = None,
    on_run: OnRun = _silent,
) -> Baseline:
    """Run what the working tree holds, and write the baseline file.

    Args:
        path: The question.
        output: The baseline file; by default ``gate-baseline.json`` beside the question.
        rounds: Rounds that are recorded.
        uncommitted: Record although files have changes that no revision holds; the baseline cannot
            be run again then.
        trajectories: Folder of trajectory files of others, see `import_folder`: nothing is run.
        results: Folder of the runs.
        data_root: Folder of the recorded sequences.
        on_run: Told of every run.

    Raises:
        RunError: Sequences are missing, changes are not committed, the build fails, or all runs
            were lost.
        DynslamError: A run cannot be made.
    """
    gate = load_gate(path, data_root=data_root)
    file = _baseline_path(gate, output)
    cases = gate.cases()
    confirm = gate.cases(confirm=True) if gate.config.confirm else {}
    check_sequences(cases | confirm, gate, 1 if trajectories is not None else rounds)
    looks, notes = _looks_before(file, gate)
    place = _new_results(results)

    # measure development and confirmation set
    if trajectories is None:
        origin = working_tree(gate.folder, (gate.path, file))
        _refuse_uncommitted(origin, uncommitted=uncommitted)
        notes += _notes_on_untracked(gate, (gate.path, file, Path(results).expanduser()))
        notes += _built_here(gate, gate.config.build, origin, file)
        with ExitStack() as stack:
            program = _started(stack, BASELINE, gate.folder, gate, place)
            runs = _measured(program, cases, gate, rounds, on_run).all(rounds)
            program.side = Side(BASELINE)
            confirmed = _measured(program, confirm, gate, rounds, on_run).all(rounds)
    else:
        origin = Origin(name=f"the trajectories in {trajectories}")
        store = RunStore(place / BASELINE)
        folder = Path(trajectories)
        runs = import_folder(folder, cases, store, gate)
        confirmed = import_folder(folder, confirm, store, gate)
    if all(run.is_lost for run in runs):
        raise RunError(
            f"all {len(runs)} runs were lost or failed, the first: {runs[0].status} {runs[0].reason}".rstrip(),
            "a baseline that tracks nothing judges nothing: see dynslam-bench run",
        )

    if trajectories is None:
        origin.name = "the recorded baseline"
    baseline = Baseline(
        question=gate.config.question,
        asked=gate.config,
        protocol=gate.protocol.id,
        protocol_digest=gate.protocol.digest(),
        origin=origin,
        recorded=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        machine=this_machine(),
        versions=versions(),
        runs=runs,
        confirmation=confirmed,
        looks=looks,
        notes=notes,
    )
    write_atomic(file, baseline.to_json())
    return baseline


def _baseline_path(gate: Gate, path: str | Path | None) -> Path:
    return gate.folder / BASELINE_FILE if path is None else Path(path).expanduser().absolute()


def _refuse_uncommitted(origin: Origin, *, uncommitted: bool) -> None:
    """Refuse a working tree that no revision holds, unless that was asked for.

    Raises:
        RunError: Names the files.
    """
    if origin.uncommitted and not uncommitted:
        raise RunError(
            f"uncommitted changes in {', '.join(origin.uncommitted)}: the baseline could not be built again",
            "commit them, or record with --uncommitted, which is judged by its files alone",
        )


def _built_here(gate: Gate, command: str, origin: Origin, baseline: Path) -> list[str]:
    """Build the working tree.

    Returns:
        What it did to tracked files: those would count as changes of the next gate.

    Raises:
        RunError: The build fails.
    """
    build(command, gate.folder, origin.name, gate.config.build_minutes)
    if not command:
        return []
    after = working_tree(gate.folder, (gate.path, baseline))
    changed = [name for name in after.uncommitted if name not in origin.uncommitted]
    if not changed:
        return []
    return [f"the build changed tracked files: {', '.join(changed)}; put back: git checkout"]


def _notes_on_untracked(gate: Gate, own: tuple[Path, ...]) -> list[str]:
    """Files here that the recorded revision does not hold, although the runs may read them."""
    names = untracked_files(gate.folder, own)
    if not names:
        return []
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return [
        f"no revision holds {', '.join(names[:_LISTED])}{more}: commit what runs read, ignore what a build makes"
    ]


def _looks_before(file: Path, gate: Gate) -> tuple[list[str], list[str]]:
    """The looks at the same confirmation set that an older baseline file has counted, and what to know of them.

    Raises:
        RunError: A folder lies where the file is to be written.
    """
    if file.is_dir():
        raise RunError(f"{file} is a folder", "name a file with --baseline")
    if not file.is_file():
        return [], []
    try:
        older = read_baseline(file)
    except RunError as error:
        # a damaged file is replaced: its error tells to record again
        lost = (
            f"looks at the confirmation set in the older file are not counted on: {error.args[0]}"
        )
        return [], [lost]
    is_same = older.asked.confirm == gate.config.confirm
    return (older.looks if is_same else []), []


# -- check ---------------------------------------------------------------------------------------------


def check(
    path: str | Path = GATE_FILE,
    *,
    baseline: str | Path | None = None,
    files_only: bool = False,
    trajectories: str | Path | None = None,
    confirm: bool = False,
    results: str | Path = RESULTS,
    data_root: str | Path | None = None,
    on_run: OnRun = _silent,
) -> GateResult:
    """Judge what the working tree holds against the baseline file.

    If all bits of the first round are equal, the verdict is *identical*. Else the baseline is run
    again from its revision, in turns with the candidate. Where it has none, or with `files_only`, the
    recorded runs are judged, once; that takes two rounds of both sides.

    Args:
        path: The question.
        baseline: The baseline file; by default ``gate-baseline.json`` beside the question.
        files_only: Do not run the baseline again.
        trajectories: Folder of trajectory files of others, see `import_folder`: nothing is run.
        confirm: Judge on the confirmation set; the look is counted in the baseline file.
        results: Folder of the runs and of what was found.
        data_root: Folder of the recorded sequences.
        on_run: Told of every run.

    Raises:
        RunError: There is no baseline, it is of another protocol or lacks sequences, sequences are
            missing here, or a build fails.
        DynslamError: A run cannot be made.
    """
    gate = load_gate(path, data_root=data_root)
    file = _baseline_path(gate, baseline)
    recorded = read_baseline(file)
    _refuse_other_protocol(recorded, gate)
    cases = gate.cases(confirm=confirm)
    side = _recorded_side(recorded, cases, confirm=confirm)
    check_sequences(cases, gate, 1 if trajectories is not None else gate.config.rounds)
    place = _new_results(results)
    place.mkdir(parents=True)

    notes = _notes_on_machine(recorded.machine)
    if trajectories is not None:
        candidate = Side(
            CANDIDATE, import_folder(Path(trajectories), cases, RunStore(place / CANDIDATE), gate)
        )
        origin = Origin(name=f"the trajectories in {trajectories}")
        outcome = _judged_by_files(side, candidate, recorded, gate)
    else:
        origin = working_tree(gate.folder, (gate.path, file))
        notes += _built_here(gate, gate.config.build, origin, file)
        again = not files_only and _can_run_again(recorded.origin, gate)
        with ExitStack() as stack:
            outcome = _checked(stack, side, recorded, cases, gate, place, on_run, again=again)
    result = _result(outcome, gate, recorded.origin, origin, place, notes)
    result.changed_question = recorded.changed(gate.config)
    if confirm:
        _count_look(result, recorded, file)
    return _written(result, place)


@dataclass
class _GateOutcome:
    """Findings of a gate, and the rounds and runs that they took.

    Attributes:
        findings: What both sides show.
        rounds: Rounds that were judged.
        reran: Whether the baseline was run again.
        notes: What a reader should know.
    """

    findings: Findings
    rounds: int
    reran: bool = False
    notes: list[str] = field(default_factory=list)


def _checked(
    stack: ExitStack,
    recorded_side: Side,
    recorded: Baseline,
    cases: Cases,
    gate: Gate,
    place: Path,
    on_run: OnRun,
    *,
    again: bool,
) -> _GateOutcome:
    """Run the working tree: one round for equality, then in turns with the baseline, or as often as recorded."""
    guarded = gate.config.guardrails
    times_count = guarded.frame_time is not None or guarded.memory is not None

    # one round first: a change that keeps every trajectory to the bit needs no more
    first = _started(
        stack, "first" if again and times_count else CANDIDATE, gate.folder, gate, place
    )
    _measured(first, cases, gate, 1, on_run)
    findings = judge(recorded_side, first.side, gate.config, 1, timed=False)
    is_identical = findings.verdict is GateVerdict.IDENTICAL
    if is_identical and not (again and times_count):
        return _GateOutcome(findings, 1)

    # the recorded runs alone
    if not again:
        rounds = recorded_side.rounds()
        for number in range(1, rounds):
            for case in cases:
                on_run(first.side.name, case, number + 1)
                first.measure(case, number, cases, gate)
        return _judged_by_files(recorded_side, first.side, recorded, gate)

    # both in turns
    before = stack.enter_context(checked_out(gate.folder, recorded.origin.revision))
    revision = f"revision {recorded.origin.revision[:12]}"
    build(gate.config.build, before, revision, gate.config.build_minutes)
    baseline = _started(stack, BASELINE, before, gate, place)
    candidate = _started(stack, CANDIDATE, gate.folder, gate, place)
    findings, rounds = _in_turns(baseline, candidate, cases, gate, on_run)
    notes = _notes_on_program(recorded_side, baseline.side)
    notes += _notes_on_data(recorded_side, baseline.side)
    return _GateOutcome(findings, rounds, reran=True, notes=notes)


def _judged_by_files(side: Side, candidate: Side, recorded: Baseline, gate: Gate) -> _GateOutcome:
    """The verdict by recorded runs alone, which are looked at once.

    Raises:
        RunError: Both sides saw other data.
    """
    _refuse_other_data(side, candidate)
    rounds = min(side.rounds(), candidate.rounds())
    copies = {measured.name: measured.cases_of_copies(rounds) for measured in (side, candidate)}
    notes = [
        f"runs of the {name} are equal to the last bit on {', '.join(cases)}: they count as one run, so the scatter "
        "is not known"
        for name, cases in copies.items()
        if cases
    ]
    # their scatter of 0 would make the mean over all sequences look more certain than it is
    findings = judge(
        side, candidate, gate.config, rounds, one_look=True, timed=False, copies=bool(notes)
    )
    rounds = 1 if notes else rounds
    if rounds < 2 and findings.verdict is GateVerdict.UNDECIDED:
        notes.append(
            "one recorded run a sequence can show that all is identical, and nothing else: record two rounds or more"
        )
    if not recorded.origin.revision or recorded.origin.uncommitted:
        notes.append("the baseline has no revision to be run again: its recorded runs were judged")
    return _GateOutcome(findings, rounds, notes=notes)


def _cases_of_other_data(recorded: Side, measured: Side) -> list[str]:
    """Cases whose sequence has another content than when the baseline was recorded."""
    changed = []
    for case, runs in measured.by_case.items():
        before = recorded.by_case[case][0].data
        after = runs[0].data
        if before and after and before != after:
            changed.append(case)
    return changed


def _refuse_other_data(recorded: Side, candidate: Side) -> None:
    """Refuse to compare errors on sequences that have changed.

    Raises:
        RunError: Names them.
    """
    changed = _cases_of_other_data(recorded, candidate)
    if changed:
        raise RunError(
            f"the baseline was recorded on other data of {', '.join(changed)}: the content of the sequence differs",
            "put the data back, or record the baseline again on these: dynslam-bench gate record",
        )


def _notes_on_data(recorded: Side, again: Side) -> list[str]:
    """Sequences that have changed since the baseline was recorded; both sides ran on what they are now."""
    changed = _cases_of_other_data(recorded, again)
    if not changed:
        return []
    return [
        f"{', '.join(changed)} had other data when the baseline was recorded: both sides ran on what is here now"
    ]


def _can_run_again(origin: Origin, gate: Gate) -> bool:
    """Whether the baseline is a revision of this repository that holds all that was run."""
    if not origin.revision or origin.uncommitted:
        return False
    commit_of(gate.folder, origin.revision)
    return True


def _refuse_other_protocol(recorded: Baseline, gate: Gate) -> None:
    """Refuse a baseline whose errors are evaluated otherwise.

    Raises:
        RunError: Names both protocols.
    """
    if recorded.protocol_digest != gate.protocol.digest():
        raise RunError(
            f"the baseline was recorded under {recorded.protocol} ({recorded.protocol_digest}), "
            f"{gate.path.name} asks for {gate.protocol.id} ({gate.protocol.digest()})",
            "put the protocol back, or record the baseline again: dynslam-bench gate record",
        )


def _recorded_side(recorded: Baseline, cases: Cases, *, confirm: bool) -> Side:
    """The recorded runs of the cases that are asked for.

    Raises:
        RunError: The baseline lacks some.
    """
    side = Side(BASELINE)
    for run in recorded.confirmation if confirm else recorded.runs:
        if run.case in cases:
            side.add(run)
    missing = [case for case in cases if case not in side.by_case]
    if missing:
        raise RunError(
            f"the baseline lacks {len(missing)} of {len(cases)} sequences: {', '.join(missing)}",
            "record it again at the revision that is good: dynslam-bench gate record",
        )
    return side


def _notes_on_machine(machine: Machine) -> list[str]:
    """Notes on the differences between the baseline's machine and this one."""
    here = this_machine()
    if here == machine:
        return []
    return [
        f"the baseline was recorded on another machine ({machine.cpu}, {machine.cores} cores; here {here.cpu}, "
        f"{here.cores} cores): its errors are compared, its times are not"
    ]


def _notes_on_program(recorded: Side, again: Side) -> list[str]:
    """Libraries by which the baseline that was run again differs from the recorded one."""
    before = _libraries(recorded)
    now = _libraries(again)
    names = sorted(name for name in before.keys() & now.keys() if before[name] != now[name])
    if not names:
        return []
    words = ", ".join(f"{name} was {before[name]}, is {now[name]}" for name in names)
    return [f"the baseline was run again with other libraries than it was recorded with ({words})"]


def _libraries(side: Side) -> dict[str, str]:
    program = next(iter(side.by_case.values()))[0].program
    return {name: text for name, text in program.items() if name not in ("code", "identity")}


def _count_look(result: GateResult, recorded: Baseline, file: Path) -> None:
    """Count a look at the confirmation set, in the baseline file."""
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    recorded.looks.append(f"{now} {result.candidate.describe()}: {result.verdict.value}")
    write_atomic(file, recorded.to_json())
    result.set = "confirmation"
    result.look = len(recorded.looks)
    times = "look" if result.look == 1 else "looks"
    result.notes.append(
        f"{result.look} {times} at the confirmation set so far, counted in {file.name}: commit it"
    )


# -- compare -------------------------------------------------------------------------------------------


def compare(
    revision_a: str,
    revision_b: str = "",
    path: str | Path = GATE_FILE,
    *,
    build_command: str | None = None,
    baseline: str | Path | None = None,
    confirm: bool = False,
    results: str | Path = RESULTS,
    data_root: str | Path | None = None,
    on_run: OnRun = _silent,
) -> GateResult:
    """Check out, build and run two revisions in turns, and judge the second against the first.

    Args:
        revision_a: The baseline.
        revision_b: The candidate; empty for the working tree.
        path: The question; that of the working tree holds for both.
        build_command: In place of the question's.
        baseline: The baseline file, which counts looks at the confirmation set.
        confirm: Judge on the confirmation set.
        results: Folder of the runs and of what was found.
        data_root: Folder of the recorded sequences.
        on_run: Told of every run.

    Raises:
        RunError: A revision does not exist, a build fails, or sequences are missing here.
        DynslamError: A run cannot be made.
    """
    gate = load_gate(path, data_root=data_root)
    cases = gate.cases(confirm=confirm)
    check_sequences(cases, gate, gate.config.rounds)
    command = gate.config.build if build_command is None else build_command
    commit_a = commit_of(gate.folder, revision_a)
    origin_a = Origin(name=f"revision {revision_a}", revision=commit_a)
    place = _new_results(results)
    file = _baseline_path(gate, baseline)
    here = working_tree(gate.folder, (gate.path, file))

    with ExitStack() as stack:
        # both revisions are checked out and built before anything runs
        folder_a = stack.enter_context(checked_out(gate.folder, commit_a))
        minutes = gate.config.build_minutes
        build(command, folder_a, origin_a.name, minutes)
        notes = []
        if revision_b:
            commit_b = commit_of(gate.folder, revision_b)
            origin_b = Origin(name=f"revision {revision_b}", revision=commit_b)
            folder_b = stack.enter_context(checked_out(gate.folder, commit_b))
            build(command, folder_b, origin_b.name, minutes)
            if here.uncommitted:
                notes.append(f"uncommitted changes in {', '.join(here.uncommitted)} take no part")
        else:
            origin_b = here
            folder_b = gate.folder
            notes += _built_here(gate, command, origin_b, file)

        place.mkdir(parents=True)
        program_a = _started(stack, BASELINE, folder_a, gate, place)
        program_b = _started(stack, CANDIDATE, folder_b, gate, place)
        findings, rounds = _in_turns(program_a, program_b, cases, gate, on_run)
    outcome = _GateOutcome(findings, rounds, reran=True)
    result = _result(outcome, gate, origin_a, origin_b, place, notes)
    if confirm:
        if file.is_file():
            _count_look(result, read_baseline(file), file)
        else:
            result.set = "confirmation"
            result.notes.append(
                "the look at the confirmation set is not counted: there is no baseline file"
            )
    return _written(result, place)


# -- the result ----------------------------------------------------------------------------------------


def _result(
    outcome: _GateOutcome,
    gate: Gate,
    baseline: Origin,
    candidate: Origin,
    place: Path,
    notes: list[str],
) -> GateResult:
    """The findings as a `GateResult`, in words and numbers."""
    findings = outcome.findings
    estimate = findings.estimate
    result = GateResult(
        verdict=findings.overall,
        exit_code=findings.exit_code,
        question=gate.config.question,
        protocol=gate.protocol.id,
        margin=gate.config.margin,
        baseline=baseline,
        candidate=candidate,
        reran_baseline=outcome.reran,
        rounds=outcome.rounds,
        runs=2 * outcome.rounds * len(findings.cases),
        lost=findings.lost,
        cases=findings.cases,
        guardrails=findings.guardrails,
        notes=[*outcome.notes, *notes],
        folder=str(place),
    )
    if estimate is not None:
        result.ratio = math.exp(estimate.centre)
        if math.isfinite(estimate.low) and findings.verdict is not GateVerdict.IDENTICAL:
            result.low = math.exp(estimate.low)
            result.high = math.exp(estimate.high)
            result.level = findings.level
    result.sentence = _sentence(result, findings)
    return result


def _sentence(result: GateResult, findings: Findings) -> str:
    """The verdict in one sentence.

    Args:
        result: All but the sentence.
        findings: The verdict on the error alone, and the guardrails that overrule it.
    """
    lost, lost_baseline = result.lost
    number = len(result.cases)
    on = f"{number} sequence{'s' * (number != 1)}"
    if all(case.candidate_m is None for case in result.cases):
        reason = next((case.reason for case in result.cases if case.reason), "")
        return f"all runs of the candidate were lost or failed on {on}; the first: {reason}".rstrip(
            ": "
        )
    if all(case.baseline_m is None for case in result.cases):
        return f"all runs of the baseline were lost or failed on {on}, so nothing can be compared"
    overruling = "".join(
        f"guardrail {guardrail.state}: {guardrail.text}; " for guardrail in findings.overruling
    )
    more_lost = f"; lost runs {lost_baseline} -> {lost}" if lost != lost_baseline else ""
    if result.ratio is None:
        return f"{overruling}nothing could be compared on {on}{more_lost}"
    percent = 100.0 * (result.ratio - 1.0)
    measured = f"{abs(percent):.1f} % {'more' if percent > 0 else 'less'} error on {on}"
    words = {
        GateVerdict.IDENTICAL: f"every trajectory is equal to the last bit on {on}",
        GateVerdict.IMPROVED: measured,
        GateVerdict.REGRESSED: measured,
        GateVerdict.NO_DIFFERENCE: f"{measured}; differences above {100 * result.margin:g} % are excluded",
        GateVerdict.UNDECIDED: f"{measured} so far, within the scatter",
    }
    return overruling + words[findings.verdict] + more_lost


def _written(result: GateResult, place: Path) -> GateResult:
    """Write the page, the JSON and the summary."""
    page = write_page(result, place, place / BASELINE, place / CANDIDATE)
    result.page = "" if page is None else str(page)
    write_atomic(place / "gate.json", result.to_json())
    write_atomic(place / "summary.md", result.markdown())
    return result
