"""Result of a gate: verdict, guardrails, every sequence; as JSON, as a summary of ten lines, as an exit code."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field

from dynslam_bench.core.records import Record, schema
from dynslam_bench.evaluation.gate import GateVerdict
from dynslam_bench.gate.baseline import Origin

RESULT_SCHEMA = 1
"""Version of the fields of `GateResult`."""
PASSED = 0
RUNS_FAILED = 3
REGRESSED = 4
UNDECIDED = 5
_ROWS = 3
"""Sequences in the summary: those that changed most."""


class CaseResult(Record):
    """One sequence.

    Attributes:
        case: Its name.
        baseline_m: Median error of the baseline's rounds in metres; None where all were lost.
        candidate_m: Median error of the candidate's rounds in metres; None where all were lost.
        ratio: The candidate's typical error over the baseline's, lost runs counted as three times;
            None where both lost all.
        lost_baseline: Rounds that the baseline lost.
        lost: Rounds that the candidate lost.
        identical: Whether all trajectories are equal, bit by bit.
        reason: Why the candidate's first lost run was lost.
    """

    case: str
    baseline_m: float | None = None
    candidate_m: float | None = None
    ratio: float | None = None
    lost_baseline: int = 0
    lost: int = 0
    identical: bool = False
    reason: str = ""


class GuardrailResult(Record):
    """A guardrail beside the error.

    Attributes:
        name: Name of the guardrail.
        state: ``held``; ``broken``; ``open``: the scatter is too large to tell; ``not measured``.
        limit: What was allowed.
        measured: What was measured; None where it was not.
        text: One sentence without its full stop.
    """

    name: str
    state: Literal["held", "broken", "open", "not measured"]
    limit: float
    measured: float | None = None
    text: str = ""


class GateResult(Record):
    """Result of a gate: verdict, guardrails and every sequence.

    Attributes:
        schema_version: Version of this record's fields.
        verdict: Verdict on error and guardrails. *identical*, *improved* and *no difference* pass.
        exit_code: 0 passed, 3 runs failed, 4 regressed or a guardrail is broken, 5 undecided.
        sentence: The verdict in words.
        question: Digest of the question.
        changed_question: What of it is other than when the baseline was recorded, a line each.
        set: Which sequences were run.
        look: Which look at the confirmation set this is; 0 for the development set.
        protocol: Id of the protocol of the errors.
        margin: Differences below this share do not matter.
        baseline: Which program the baseline is.
        candidate: Which program the candidate is.
        reran_baseline: Whether the baseline was run again, in turns with the candidate.
        rounds: Rounds that were judged.
        runs: Runs of both sides in them.
        ratio: Mean ratio of the errors over the sequences; None where nothing could be compared.
        low: Lower end of its interval; None without one.
        high: Upper end.
        level: Two-sided error level (alpha) of the interval: 0.04 is a 96 % interval; None without one.
        lost: Runs that the candidate lost, and the baseline.
        cases: Every sequence.
        guardrails: The guardrails that were asked for.
        notes: What a reader should know, a line each.
        folder: Where the runs and the files of this result are.
        page: The page that shows every sequence; empty without one.
    """

    schema_version: int = schema(RESULT_SCHEMA)
    verdict: GateVerdict
    exit_code: int = 0
    sentence: str = ""
    question: str
    changed_question: list[str] = Field(default_factory=list)
    set: Literal["development", "confirmation"] = "development"
    look: int = 0
    protocol: str
    margin: float
    baseline: Origin
    candidate: Origin
    reran_baseline: bool = False
    rounds: int = 0
    runs: int = 0
    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    level: float | None = None
    lost: tuple[int, int] = (0, 0)
    cases: list[CaseResult] = Field(default_factory=list)
    guardrails: list[GuardrailResult] = Field(default_factory=list)
    notes: list[str] = Field(default_factory=list)
    folder: str = ""
    page: str = ""

    @property
    def passed(self) -> bool:
        """Whether the exit code is 0: identical, improved or no difference, and no guardrail broken."""
        return self.exit_code == PASSED

    @property
    def worst(self) -> CaseResult | None:
        """The sequence whose error grew most; None where none has a ratio."""
        compared = [case for case in self.cases if case.ratio is not None]
        return max(compared, key=lambda case: case.ratio or 0.0, default=None)

    def markdown(self) -> str:
        """The summary for people: verdict, the sequences that changed most in mm, the worst one, how sure it is."""
        lines = [f"**{self.verdict.value}**: {self.sentence}", ""]
        changed = sorted(self.cases, key=_change, reverse=True)
        lines += [
            "| sequence | baseline mm | candidate mm | ratio |",
            "| --- | ---: | ---: | ---: |",
        ]
        lines += [_row(case) for case in changed[:_ROWS]]
        lines += ["", f"{self._worst_words()} {self._sure_words()}"]
        lines.append(" ".join(f"{line[0].upper()}{line[1:]}." for line in self._remarks()))
        return "\n".join(lines).rstrip() + "\n"

    def _worst_words(self) -> str:
        worst = self.worst
        if worst is None or worst.ratio is None:
            return "No sequence could be compared."
        more = len(self.cases) - _ROWS
        unlisted = f" ({more} more in the JSON)" if more > 0 else ""
        return f"Worst of {len(self.cases)}{unlisted}: {worst.case}, x {worst.ratio:.3f}."

    def _sure_words(self) -> str:
        """How sure the verdict is: rounds, interval and its confidence, the share of false alarms."""
        words = f"{self.runs} runs in {self.rounds} round{'s' * (self.rounds != 1)}"
        if self.verdict is GateVerdict.IDENTICAL:
            return f"{words}, equal to the last bit."
        if self.low is None or self.high is None or self.level is None:
            return f"{words}: too few to tell scatter from change."
        # `LOOKS` of `evaluation.gate` share 4 %, as much as `ONE_LOOK`
        return (
            f"{words}; mean ratio [{self.low:.3f}, {self.high:.3f}] at {100 * (1 - self.level):.1f} %, "
            "false alarms 4 % in all looks."
        )

    def _remarks(self) -> list[str]:
        remarks = [guardrail.text for guardrail in self.guardrails if guardrail.text]
        if self.changed_question:
            changed = "; ".join(self.changed_question)
            remarks.append(f"the question changed since the baseline was recorded: {changed}")
        remarks.append(f"{self.candidate.describe()} against {self.baseline.describe()}")
        return [*remarks, *self.notes]


def _change(case: CaseResult) -> float:
    """How much a sequence changed to either side; lost on both sides is none."""
    return 0.0 if case.ratio is None else abs(math.log(case.ratio))


def _row(case: CaseResult) -> str:
    ratio = "" if case.ratio is None else f"{case.ratio:.3f}"
    if case.identical:
        ratio = "identical"
    before = _millimetres(case.baseline_m, case.lost_baseline)
    after = _millimetres(case.candidate_m, case.lost)
    return f"| {case.case.replace('|', '/')} | {before} | {after} | {ratio} |"


def _millimetres(error_m: float | None, lost: int) -> str:
    text = "lost" if error_m is None else f"{1000.0 * error_m:.2f}"
    return f"{text} ({lost} lost)" if lost and error_m is not None else text
