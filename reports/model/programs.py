"""Programs that made the runs of a tracker: which of them ranks, and which have equal results and share a row.

A program is code, libraries and weights. The runs of one tracker with the same settings have a row
for each program that made some of them. The row of the program that is installed here ranks.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from statistics import geometric_mean
from typing import Any, Literal, NamedTuple

from dynslam_bench.core.records import digest
from dynslam_bench.evaluation.verdicts import FLOOR_M
from dynslam_bench.reports.model.row import RunRow, grouped
from dynslam_bench.runs.layout import FINAL, ONLINE
from dynslam_bench.runs.record import PROGRAM
from dynslam_bench.runs.validity import Installation

FEWEST_EQUAL = 5
"""Results that two programs must have in common, and all equal, to share a row."""
CLOCKS_DIFFER = timedelta(minutes=10)
"""Largest difference between the clocks of two machines. A run that started later than that lies in the future."""
CODE = "code"
LIBRARIES = "libraries"
WEIGHTS = "weights"

ProgramComponent = tuple[str, str]
"""`CODE`, `LIBRARIES` or `WEIGHTS`, and the name of one part of a program."""
Repeat = tuple[str, tuple[int, int, int, str]]
"""A column and the repeat in it, see `RunRow.sequence_key` and `RunRow.repeat_key`."""
Result = tuple[str, tuple[tuple[str, str], ...]]
"""Status of a run that ended, and the checksums of its trajectories."""
Preference = tuple[bool, bool, bool, float, str]


@dataclass(eq=False)
class Program:
    """Runs that one program made, as far as their records tell.

    Attributes:
        rows: The runs.
        parts: Digest or version of every part of the program that the records name.
        changed: What of it is another one here, see `Installation.what_changed`.
    """

    rows: list[RunRow]
    parts: dict[ProgramComponent, str]
    changed: str

    @property
    def is_verified(self) -> bool:
        """Whether the ids of its runs tell what it is."""
        return self.rows[0].verified

    def fits(self, other: "Program") -> bool:
        """Whether the two may be one program: equal in all parts that both name, both installed here or neither."""
        if self.is_verified != other.is_verified or bool(self.changed) != bool(other.changed):
            return False
        return all(other.parts.get(part, value) == value for part, value in self.parts.items())


@dataclass(eq=False)
class ProgramRow:
    """Programs that share a row of a table, since their results are equal.

    Attributes:
        programs: The programs, the preferred one first.
        is_deterministic: Whether equal requests have equal results.
    """

    programs: list[Program] = field(default_factory=list)
    is_deterministic: bool = True
    _results: dict[Repeat, dict[Result, RunRow]] = field(default_factory=dict)

    def add(self, programs: Iterable[Program]) -> None:
        """Take in further programs."""
        for program in programs:
            self.programs.append(program)
            for row in program.rows:
                self.is_deterministic &= row.tracker.deterministic and not row.realtime
                results = self._results.setdefault((row.sequence_key, row.repeat_key), {})
                results.setdefault(_result_of(row), row)

    @property
    def is_verified(self) -> bool:
        """Whether the ids of its runs tell what it is."""
        return self.programs[0].is_verified

    def values(self) -> dict[ProgramComponent, list[str]]:
        """Digests or versions of every part of its programs, sorted."""
        of_part: dict[ProgramComponent, set[str]] = {}
        for program in self.programs:
            for part, value in program.parts.items():
                of_part.setdefault(part, set()).add(value)
        return {part: sorted(values) for part, values in sorted(of_part.items())}

    def outcomes(self, other: "ProgramRow") -> Iterator["RunAgreement"]:
        """Agreement of each run with that of another row, of all runs that both have; copies are left out.

        Copies are runs that differ in their seed only and have one result: they count once, as in a
        cell of a table.
        """
        compared = set()
        for repeat, results in self._results.items():
            other_results = other._results.get(repeat)
            if other_results is None:
                continue
            column, (offset, noise, _, _) = repeat
            pair = (column, offset, noise, frozenset(results), frozenset(other_results))
            if pair not in compared:
                compared.add(pair)
                yield _compare_results(results, other_results)

    def compare(self, other: "ProgramRow") -> "RowAgreement":
        """Count the outcomes of all runs that both rows have."""
        outcomes = list(self.outcomes(other))
        equal = sum(outcome.verdict == "equal" for outcome in outcomes)
        different = sum(outcome.verdict == "different" for outcome in outcomes)
        return RowAgreement(
            equal, different, [outcome.ratio for outcome in outcomes if outcome.ratio is not None]
        )

    def is_equal_to(self, other: "ProgramRow") -> bool:
        """Whether both have equal results on all runs that both have, and enough of these."""
        if not (
            self.is_verified
            and other.is_verified
            and self.is_deterministic
            and other.is_deterministic
        ):
            return False
        equal = 0
        for outcome in self.outcomes(other):
            if outcome.verdict == "different":
                return False
            equal += outcome.verdict == "equal"
        return equal >= FEWEST_EQUAL

    def shared_results(self) -> int:
        """Number of different good results of runs that several of the row's programs have made.

        A deterministic tracker gives one result for all seeds: it counts once.
        """
        # the programs that made each run
        makers: dict[Repeat, set[int]] = {}
        for at, program in enumerate(self.programs):
            for row in program.rows:
                makers.setdefault((row.sequence_key, row.repeat_key), set()).add(at)

        # different results, whatever the seed
        shared = set()
        for repeat, programs in makers.items():
            column, (offset, noise, _, _) = repeat
            for result in self._results[repeat]:
                if len(programs) > 1 and result[0] == "ok":
                    shared.add((column, offset, noise, result))
        return len(shared)


class RunAgreement(NamedTuple):
    """One run of two programs.

    Attributes:
        verdict: ``equal``: both ended well with equal trajectories; ``different``: other
            trajectories, or one of them failed; empty: both failed alike, which says little.
        ratio: Error of the first program's run over that of the second's; None where one has none.
    """

    verdict: Literal["equal", "different", ""]
    ratio: float | None


def _compare_results(
    first: Mapping[Result, RunRow], second: Mapping[Result, RunRow]
) -> RunAgreement:
    """Compare what two programs made of one request; each may have several results."""
    # the ratio of their errors; errors below the floor count as equal to it
    error_m = next(iter(first.values())).score_m
    other_error_m = next(iter(second.values())).score_m
    ratio = None
    if error_m is not None and other_error_m is not None:
        ratio = max(error_m, FLOOR_M) / max(other_error_m, FLOOR_M)

    status, checksums = next(iter(first))
    # several results of one request: it is not deterministic
    if len(first) > 1 or first.keys() != second.keys():
        return RunAgreement("different", ratio)
    if status != "ok":
        return RunAgreement("", ratio)
    # without checksums nothing shows that they are equal
    return RunAgreement("equal" if checksums else "different", ratio)


class RowAgreement(NamedTuple):
    """Agreement of the results of two rows, on the runs that both have; see `RunAgreement`.

    Attributes:
        equal: Runs with equal results.
        different: Runs with different results.
        ratios: Error of the first row's run over that of the second's, of those that have errors.
    """

    equal: int
    different: int
    ratios: list[float]

    @property
    def ratio_words(self) -> str:
        """The geometric mean of the ratios, with the smallest and the largest; empty without any."""
        if not self.ratios:
            return ""
        return f"ATE × {geometric_mean(self.ratios):.2f} ({min(self.ratios):.2f} to {max(self.ratios):.2f})"


@dataclass
class ChosenRuns:
    """The rows of a report.

    Attributes:
        rows: One run of every program row, column and repeat.
        in_future: Runs that started in the future by their records.
        not_installed: What of the ranked program is another one here, by its variant key, where
            several programs made runs and none of them is the one that is installed.
    """

    rows: list[RunRow] = field(default_factory=list)
    in_future: list[RunRow] = field(default_factory=list)
    not_installed: dict[str, str] = field(default_factory=dict)


def choose_runs(rows: Iterable[RunRow]) -> ChosenRuns:
    """Choose one run of every column and repeat, and say which program's runs stand in which row.

    Of several programs the one that is installed here ranks; where none is, the one of the newest
    run. In a cell the ranked program's run is taken where it has one, then the newest. Starts in
    the future count as the oldest.

    Args:
        rows: All runs. `split_by`, `is_current` and `program_remark` of those that are chosen are
            set.
    """
    # what is installed here, and the time
    installation = Installation()
    now = datetime.now(timezone.utc)
    chosen = ChosenRuns()
    for group in grouped(rows, lambda row: row.settings_key).values():
        # runs by one program, then programs with equal results, then one run of each repeat
        programs = _find_programs(group, installation, now)
        program_rows = _merge_equal(programs)
        kept = _choose_of_each_repeat(program_rows, now)
        _mark(program_rows, kept)
        ranked = program_rows[0].programs[0]
        chosen.rows += [row for some in kept for row in some]
        chosen.in_future += [row for row in group if starts_in_future(row, now)]
        if len(program_rows) > 1 and ranked.is_verified and ranked.changed:
            chosen.not_installed[kept[0][0].variant_key] = ranked.changed
    chosen.rows.sort(key=lambda row: (row.started, row.run_id))
    return chosen


# -- programs --------------------------------------------------------------------------------------


def _find_programs(
    rows: Sequence[RunRow], installation: Installation, now: datetime
) -> list[Program]:
    """The programs that made runs of one tracker with the same settings, the preferred one first.

    Runs on sequences of two kinds name different readers, and may be by one program: those that no
    part tells apart are. Each program joins the first that it fits.
    """
    # runs whose records say the same, split by what of it has changed here
    by_identity = grouped(rows, _program_text)
    described = []
    for some in by_identity.values():
        by_change = grouped(some, installation.what_changed) if len(by_identity) > 1 else {"": some}
        described += [
            Program(runs, _parts_of(runs[0]), changed) for changed, runs in by_change.items()
        ]
    described.sort(
        key=lambda program: max(_preference(row, program.changed, now) for row in program.rows),
        reverse=True,
    )

    programs: list[Program] = []
    # each joins the first program that no part tells it from
    for program in described:
        fitting = next((earlier for earlier in programs if earlier.fits(program)), None)
        if fitting is None:
            programs.append(program)
        else:
            fitting.rows += program.rows
            fitting.parts |= program.parts
    return programs


def _merge_equal(programs: Iterable[Program]) -> list[ProgramRow]:
    """The rows of programs: those whose results are equal share one; the row of the first is the first."""
    program_rows = []
    for program in programs:
        program_row = ProgramRow()
        program_row.add([program])
        program_rows.append(program_row)

    # a row that has grown may have enough in common with one that had too little before
    before = len(program_rows) + 1
    while len(program_rows) < before:
        before = len(program_rows)
        waiting = program_rows
        program_rows = []
        while waiting:
            first, *others = waiting
            waiting = []
            for other in others:
                if first.is_equal_to(other):
                    first.add(other.programs)
                else:
                    waiting.append(other)
            program_rows.append(first)
    return program_rows


def _program_text(row: RunRow) -> str:
    """Text of a run's program, as its record states it; empty for imports."""
    if row.imported:
        return ""
    named = {name: row.identity[name] for name in ("scheme", *PROGRAM) if name in row.identity}
    return json.dumps(named, sort_keys=True, default=str)


def _parts_of(row: RunRow) -> dict[ProgramComponent, str]:
    """Digest or version of every part of the program that a run's record names."""
    if row.imported:
        return {}
    parts: dict[ProgramComponent, str] = {}
    for name in PROGRAM:
        kind = name if name in (LIBRARIES, WEIGHTS) else CODE
        if name != "parts":  # they name what the digests of `source` are of
            parts |= {(kind, leaf): value for leaf, value in _leaves(name, row.identity.get(name))}
    return parts


def _leaves(name: str, value: Any) -> Iterator[tuple[str, str]]:
    """The values in an entry of an identity, which may be nested, by the names that lead to them."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(f"{name} {key}", inner)
    elif value is not None:
        yield name, str(value)


# -- which run of each repeat ----------------------------------------------------------------------


def starts_in_future(row: RunRow, now: datetime) -> bool:
    """Whether a run's record says that it starts later than now."""
    return _start_of(row) > now + CLOCKS_DIFFER


def _start_of(row: RunRow) -> datetime:
    """Time when a run started; the earliest date where its record does not tell."""
    try:
        start = datetime.fromisoformat(row.started)
    except ValueError:
        return datetime.min.replace(tzinfo=timezone.utc)
    return start if start.tzinfo is not None else start.replace(tzinfo=timezone.utc)


def _preference(row: RunRow, changed: str, now: datetime) -> Preference:
    """The largest is the run to take: with a verified id, by the program installed here, not in the future, newest."""
    in_past = not starts_in_future(row, now)
    age = (now - _start_of(row)).total_seconds()
    return row.verified, not changed, in_past, -age, row.run_id


def _choose_of_each_repeat(program_rows: Sequence[ProgramRow], now: datetime) -> list[list[RunRow]]:
    """The runs that stand in each row: one of each column and repeat, in the ranked row where it has one."""
    # the ranked row's run wins, then the preferred one
    best: dict[tuple[object, ...], tuple[tuple[bool, Preference], int, RunRow]] = {}
    for at, program_row in enumerate(program_rows):
        for program in program_row.programs:
            for row in program.rows:
                place = (row.sequence_key, row.repeat_key, row.trajectory)
                preference = (at == 0, _preference(row, program.changed, now))
                if place not in best or preference > best[place][0]:
                    best[place] = (preference, at, row)
    # by the row in which each stands
    kept: list[list[RunRow]] = [[] for _ in program_rows]
    for _, at, row in best.values():
        kept[at].append(row)
    return kept


# -- what the rows say -----------------------------------------------------------------------------


def _mark(program_rows: Sequence[ProgramRow], kept: Sequence[Sequence[RunRow]]) -> None:
    """Say in the runs that are kept which row they stand in, whether it ranks, and how it compares with the ranked one.

    Args:
        program_rows: The rows of one tracker with the same settings, the first to be ranked first.
        kept: The runs that stand in each; none where all are made again by other programs.
    """
    # rows with runs are shown; of the others all was run again
    shown = [at for at, rows in enumerate(kept) if rows]
    superseded = [program_rows[at] for at, rows in enumerate(kept) if not rows]
    names = _names_of([program_rows[at] for at in shown])
    ranked = program_rows[0]
    for at, name in zip(shown, names, strict=True):
        program_row = program_rows[at]
        # what the row is, and how it compares with the ranked one
        remarks = []
        if len(program_row.programs) > 1:
            count = len(program_row.programs)
            remarks.append(f"{count} programs, equal on {_runs(program_row.shared_results())}")
        if at == 0:
            remarks += _superseded_words(ranked, superseded)
        elif ranked.is_verified:
            remarks.append(
                f"other {_what_differs(program_row, ranked)}: {_comparison_words(program_row, ranked)}"
            )
        for row in kept[at]:
            row.split_by = name
            row.is_current = at == 0 and ranked.is_verified
            row.program_remark = "; ".join(remarks)


def _names_of(program_rows: Sequence[ProgramRow]) -> list[dict[str, str]]:
    """The parts by which rows are told apart, by name as short texts; none for a single row with verified ids."""
    texts = [_short_texts(program_row) for program_row in program_rows]
    # only what differs tells rows apart
    values: dict[str, set[str]] = {}
    for text in texts:
        for name, value in text.items():
            values.setdefault(name, set()).add(value)
    varying = {name for name, some in values.items() if len(some) > 1 or name == "identity"}
    names: list[dict[str, str]] = []
    for text in texts:
        parts = {name: value for name, value in text.items() if name in varying}
        if parts in names:  # each row needs a name of its own
            parts["program"] = str(len(names) + 1)
        names.append(parts)
    return names


def _short_texts(program_row: ProgramRow) -> dict[str, str]:
    """Code, libraries and weights of a row's programs, by name as short texts."""
    values = program_row.values()
    texts = {
        "code": digest([[*part, *some] for part, some in values.items() if part[0] == CODE], 8)
    }
    for (kind, name), some in values.items():
        short_name = name.removeprefix(f"{kind} ")
        if kind == LIBRARIES:
            texts[short_name] = " + ".join(some)
        elif kind == WEIGHTS:
            texts[f"weights of {short_name}"] = " + ".join(value[:8] for value in some)
    return texts if program_row.is_verified else texts | {"identity": "unverified"}


def _what_differs(one: ProgramRow, other: ProgramRow) -> str:
    """In which kinds of parts two rows differ, in words."""
    values = one.values()
    other_values = other.values()
    differing = {
        kind
        for (kind, name), some in values.items()
        if other_values.get((kind, name), some) != some
    }
    kinds = [kind for kind in (CODE, LIBRARIES, WEIGHTS) if kind in differing]
    if len(kinds) > 1:
        return f"{', '.join(kinds[:-1])} and {kinds[-1]}"
    return kinds[0] if kinds else "program"


def _comparison_words(program_row: ProgramRow, ranked: ProgramRow) -> str:
    """Words on how the results of a row compare with those of the ranked one."""
    agreement = program_row.compare(ranked)
    # an honest comparison needs common runs, and trackers that repeat their results
    total = agreement.equal + agreement.different
    if not total:
        return "no run in common"
    if not (program_row.is_deterministic and ranked.is_deterministic):
        words = [f"not deterministic, {_runs(total)} in common"]
    elif agreement.different:
        words = [
            f"{agreement.different} of {_runs(total)} differ{'s' * (agreement.different == 1)}"
        ]
    else:
        return f"equal on {_runs(total)}, fewer than {FEWEST_EQUAL}"
    return ", ".join(filter(None, [*words, agreement.ratio_words]))


def _superseded_words(ranked: ProgramRow, superseded: Sequence[ProgramRow]) -> list[str]:
    """Words on how the ranked row's results differ from those of the newest program of which all was run again."""
    if not (ranked.is_verified and ranked.is_deterministic):
        return []
    for program_row in superseded:
        is_comparable = program_row.is_verified and program_row.is_deterministic
        if is_comparable and program_row.compare(ranked).different:
            return [
                f"superseded {_what_differs(program_row, ranked)}: {_comparison_words(program_row, ranked)}"
            ]
    return []


def _runs(count: int) -> str:
    return f"{count} run{'s' * (count != 1)}"


def _result_of(row: RunRow) -> Result:
    """Status of a run that ended, and the checksums of its trajectories."""
    checksums = tuple((name, row.files[name]) for name in (FINAL, ONLINE) if name in row.files)
    return row.status, checksums
