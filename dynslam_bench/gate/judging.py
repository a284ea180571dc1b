"""From the measurements of both sides to what a gate found."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.evaluation.gate import (
    CLIP,
    LOOKS,
    ONE_LOOK,
    GateEstimate,
    GateVerdict,
    decide,
    is_lost_more,
    log_ratios,
    mean_ratio,
)
from dynslam_bench.gate.baseline import Measurement, Side
from dynslam_bench.gate.config import GateConfig
from dynslam_bench.gate.result import (
    PASSED,
    REGRESSED,
    RUNS_FAILED,
    UNDECIDED,
    CaseResult,
    GuardrailResult,
)

Array = NDArray[np.float64]
SEQUENCE_FALL = 0.2
"""A sequence of which the candidate typically tracks so much less is no sequence that it still tracks."""
_ROUNDING = 1e-9
"""Shares that differ by less are equal."""


class Findings(NamedTuple):
    """Findings on both sides after some rounds.

    Attributes:
        verdict: Verdict on the error alone.
        estimate: Mean log ratio with its interval; None where nothing could be compared.
        level: Two-sided level of the interval.
        lost: Runs that the candidate lost, and the baseline.
        cases: Every sequence.
        guardrails: Every guardrail that the gate's file names.
        overruling: The guardrails that keep the gate from passing: broken ones, else those that cannot be judged.
        exit_code: See `GateResult`.
    """

    verdict: GateVerdict
    estimate: GateEstimate | None
    level: float
    lost: tuple[int, int]
    cases: list[CaseResult]
    guardrails: list[GuardrailResult]
    overruling: list[GuardrailResult]
    exit_code: int

    @property
    def overall(self) -> GateVerdict:
        """The verdict on error and guardrails: nothing that does not pass is called by the name of a pass."""
        by_code = {REGRESSED: GateVerdict.REGRESSED, UNDECIDED: GateVerdict.UNDECIDED}
        return by_code.get(self.exit_code, self.verdict)

    @property
    def is_settled(self) -> bool:
        """Whether another round would change nothing that is asked: verdict and guardrails are decided."""
        is_open = any(guardrail.state == "open" for guardrail in self.guardrails)
        return self.verdict is not GateVerdict.UNDECIDED and not is_open


def are_identical(baseline: Side, candidate: Side, cases: Iterable[str], rounds: int) -> bool:
    """Whether all trajectories of both sides are equal, and there is one of every run."""
    for case in cases:
        pairs = zip(baseline.of(case, rounds), candidate.of(case, rounds), strict=True)
        for before, after in pairs:
            is_same = before.trajectories == after.trajectories and before.status == after.status
            if not (is_same and after.trajectories):
                return False
    return True


def judge(
    baseline: Side,
    candidate: Side,
    config: GateConfig,
    rounds: int,
    *,
    one_look: bool = False,
    timed: bool = True,
    copies: bool = False,
) -> Findings:
    """Judge the first rounds of both sides.

    Args:
        baseline: The baseline's measurements.
        candidate: The candidate's, of the same cases.
        config: The question.
        rounds: How many rounds are judged.
        one_look: Whether the data are looked at this once, as with recorded runs.
        timed: Whether times and memory were measured on one machine, in turns.
        copies: Whether a side holds copies of one run in place of several: they show no scatter. Equality
            is asked of all rounds then, everything else of the first.
    """
    equal_rounds = rounds
    if copies:
        rounds = 1
    cases = list(candidate.by_case)
    level = ONE_LOOK if one_look else LOOKS.get(rounds, min(LOOKS.values()))

    # errors: a sequence that both always lost says nothing
    errors = candidate.errors(cases, rounds)
    errors_baseline = baseline.errors(cases, rounds)
    lost = np.isnan(errors)
    lost_baseline = np.isnan(errors_baseline)
    is_compared = ~(lost & lost_baseline).all(axis=1)
    counts = (int(lost.sum()), int(lost_baseline.sum()))
    ratios = log_ratios(errors, errors_baseline)
    estimate = mean_ratio(ratios[is_compared], level) if is_compared.any() else None

    # equal trajectories first, then the interval against the margin; more lost runs overrule both
    verdict = GateVerdict.UNDECIDED
    all_lost = lost.all() or lost_baseline.all()
    if are_identical(baseline, candidate, cases, equal_rounds) and not all_lost:
        verdict = GateVerdict.IDENTICAL
    elif estimate is not None and not all_lost and rounds > 1:
        verdict = decide(estimate, counts, config.margin)
    alone = int((lost & ~lost_baseline).sum())
    alone_baseline = int((lost_baseline & ~lost).sum())
    if is_lost_more(alone, alone_baseline, level):
        verdict = GateVerdict.REGRESSED

    rows = _case_results(baseline, candidate, cases, rounds, ratios)
    guardrails = _guardrails(baseline, candidate, config, rounds, level, timed=timed)
    # runs in turns that do not tell their times leave a limit on them open
    broken = [guardrail for guardrail in guardrails if guardrail.state == "broken"]
    unknown = ("open", "not measured") if timed else ("open",)
    unjudged = [guardrail for guardrail in guardrails if guardrail.state in unknown]
    code = _exit_code(
        verdict,
        counts,
        all_lost=bool(all_lost),
        is_broken=bool(broken),
        is_open=bool(unjudged),
    )
    overruling = {REGRESSED: broken, UNDECIDED: unjudged}.get(code, [])
    return Findings(verdict, estimate, level, counts, rows, guardrails, overruling, code)


def _exit_code(
    verdict: GateVerdict,
    lost: tuple[int, int],
    *,
    all_lost: bool,
    is_broken: bool,
    is_open: bool,
) -> int:
    if all_lost:
        return RUNS_FAILED
    if verdict is GateVerdict.REGRESSED or is_broken:
        return REGRESSED
    if verdict is GateVerdict.UNDECIDED and lost[0] > lost[1]:
        return RUNS_FAILED
    return UNDECIDED if verdict is GateVerdict.UNDECIDED or is_open else PASSED


def _case_results(
    baseline: Side, candidate: Side, cases: Sequence[str], rounds: int, ratios: Array
) -> list[CaseResult]:
    results = []
    for case, of_case in zip(cases, ratios, strict=True):
        before = baseline.of(case, rounds)
        after = candidate.of(case, rounds)
        errors_before = [run.ate_m for run in before if run.ate_m is not None]
        errors_after = [run.ate_m for run in after if run.ate_m is not None]
        is_compared = bool(errors_before or errors_after)
        results.append(
            CaseResult(
                case=case,
                baseline_m=float(np.median(errors_before)) if errors_before else None,
                candidate_m=float(np.median(errors_after)) if errors_after else None,
                ratio=math.exp(float(of_case.mean())) if is_compared else None,
                lost_baseline=len(before) - len(errors_before),
                lost=len(after) - len(errors_after),
                identical=are_identical(baseline, candidate, [case], rounds),
                reason=next((run.reason for run in after if run.is_lost), ""),
            )
        )
    return results


# -- guardrails ------------------------------------------------------------------------------------


def _guardrails(
    baseline: Side,
    candidate: Side,
    config: GateConfig,
    rounds: int,
    level: float,
    *,
    timed: bool,
) -> list[GuardrailResult]:
    asked = config.guardrails
    cases = list(candidate.by_case)
    results = []
    if asked.coverage is not None:
        results.append(_coverage(baseline, candidate, rounds, asked.coverage, level))
    if asked.failures is not None:
        results.append(_failures(baseline, candidate, rounds, asked.failures))
    if asked.sequence is not None:
        errors = (candidate.errors(cases, rounds), baseline.errors(cases, rounds))
        results.append(_worst_sequence(cases, *errors, asked.sequence))
    if asked.frame_time is not None:
        times = (candidate.frame_times(cases, rounds), baseline.frame_times(cases, rounds))
        name = "frame time"
        results.append(_paired(name, *times, asked.frame_time, level, timed=timed))
    if asked.memory is not None:
        memory = (candidate.memory(cases, rounds), baseline.memory(cases, rounds))
        results.append(_paired("memory", *memory, asked.memory, level, timed=timed))
    return results


def _coverage(
    baseline: Side, candidate: Side, rounds: int, limit: float, level: float
) -> GuardrailResult:
    """The mean coverage must not fall by more than a limit, nor that of one sequence by a fifth.

    Lost runs are counted elsewhere.

    Args:
        baseline: The baseline's measurements.
        candidate: The candidate's, of the same cases.
        rounds: How many rounds are judged.
        limit: Share of the frames by which the mean may fall.
        level: Two-sided level of the look.
    """
    by_case = {
        case: _coverage_pairs(baseline.of(case, rounds), candidate.of(case, rounds))
        for case in candidate.by_case
    }
    pairs = [pair for of_case in by_case.values() for pair in of_case]
    if not pairs:
        text = "coverage is not known"
        return GuardrailResult(name="coverage", state="not measured", limit=limit, text=text)

    # the mean
    share_before, share_after = np.mean(np.array(pairs, dtype=np.float64), axis=0).tolist()
    fall = share_before - share_after
    is_broken = fall > limit + _ROUNDING
    text = f"coverage {100 * share_before:.1f} % -> {100 * share_after:.1f} %"
    if is_broken:
        text += f": a fall of more than {100 * limit:g} points"
    state: Literal["broken", "held", "open"] = "broken" if is_broken else "held"

    # one sequence of many hardly moves the mean: it is asked by itself
    for case, of_case in by_case.items():
        falls = [before - after for before, after in of_case]
        if state == "broken" or not falls or float(np.median(falls)) <= SEQUENCE_FALL:
            continue
        fallen = sum(one > SEQUENCE_FALL for one in falls)
        risen = sum(-one > SEQUENCE_FALL for one in falls)
        state = "broken" if is_lost_more(fallen, risen, level) else "open"
        text += f", on {case} by {100 * float(np.median(falls)):.0f} points less"
    return GuardrailResult(name="coverage", state=state, limit=limit, measured=fall, text=text)


def _coverage_pairs(
    before: Iterable[Measurement], after: Iterable[Measurement]
) -> list[tuple[float, float]]:
    """Coverage of the baseline and the candidate in the rounds in which neither was lost."""
    pairs = []
    for run_before, run_after in zip(before, after, strict=True):
        if run_before.is_lost or run_after.is_lost:
            continue
        if run_before.coverage is not None and run_after.coverage is not None:
            pairs.append((run_before.coverage, run_after.coverage))
    return pairs


def _failures(baseline: Side, candidate: Side, rounds: int, limit: int) -> GuardrailResult:
    """The candidate must not lose more runs than the baseline by more than a limit."""
    before = sum(run.is_lost for run in baseline.all(rounds))
    after = sum(run.is_lost for run in candidate.all(rounds))
    state: Literal["broken", "held"] = "broken" if after - before > limit else "held"
    text = f"lost or failed runs {before} -> {after}"
    measured = after - before
    return GuardrailResult(name="failures", state=state, limit=limit, measured=measured, text=text)


def _worst_sequence(
    cases: Sequence[str], errors: Array, errors_baseline: Array, limit: float
) -> GuardrailResult:
    """Guardrail: no sequence's median error ratio (candidate over baseline) may exceed `limit`.

    Args:
        cases: Names ``[S]``.
        errors: The candidate's errors, metres ``[S, K]`` of sequences and rounds; nan is a lost run.
        errors_baseline: The baseline's errors ``[S, K]``.
        limit: Largest ratio that is allowed.
    """
    medians = np.median(log_ratios(errors, errors_baseline), axis=1)
    worst = int(medians.argmax())
    measured = math.exp(float(medians[worst]))
    is_broken = medians[worst] > math.log(limit)
    state: Literal["broken", "held"] = "broken" if is_broken else "held"
    text = f"{cases[worst]} has x {measured:.3f}, allowed are x {limit:g}"
    return GuardrailResult(
        name="sequence", state=state, limit=limit, measured=measured, text=text if is_broken else ""
    )


def _paired(
    name: str, values: Array, values_baseline: Array, limit: float, level: float, *, timed: bool
) -> GuardrailResult:
    """A ratio that was measured in turns must not be above a limit.

    Args:
        name: What was measured.
        values: The candidate's ``[S, K]``; nan where one is not known.
        values_baseline: The baseline's.
        limit: Most times the baseline's.
        level: Two-sided level of the interval.
        timed: Whether both were measured on one machine, in turns.
    """
    if not timed:
        text = f"{name} is not compared: it was not measured in turns on one machine"
        return GuardrailResult(name=name, state="not measured", limit=limit, text=text)
    ratios = np.log(values) - np.log(values_baseline)
    ratios = ratios[np.isfinite(ratios).all(axis=1)]
    if not len(ratios):
        text = f"{name} is not known: these runs do not tell it, so take the guardrail out"
        return GuardrailResult(name=name, state="not measured", limit=limit, text=text)
    estimate = mean_ratio(np.clip(ratios, -CLIP, CLIP), level)
    edge = math.log(limit)
    state: Literal["held", "broken", "open"] = "open"
    if estimate.low > edge:
        state = "broken"
    elif estimate.high <= edge:
        state = "held"
    measured = math.exp(estimate.centre)
    text = f"{name} x {measured:.3f}"
    if math.isfinite(estimate.low):
        text += f" [{math.exp(estimate.low):.3f}, {math.exp(estimate.high):.3f}]"
    words = {
        "held": "",
        "broken": f", above the allowed x {limit:g}",
        "open": f", too few rounds to hold it below x {limit:g}",
    }
    return GuardrailResult(
        name=name, state=state, limit=limit, measured=measured, text=text + words[state]
    )
