"""After the trials: the best are judged on unseen instances, the best of them on held-out ones and kept as a preset."""

import json
import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from optuna.trial import TrialState
from pydantic import Field

from dynslam_bench.core import StudyError, read_text, write_atomic
from dynslam_bench.core.records import Record
from dynslam_bench.tuning.objectives import (
    ACCURACY,
    FEWEST_SCENES,
    MATTER_LEVEL,
    SPEED,
    Configuration,
    InstanceFailedError,
    Objective,
    Outcomes,
    bounds,
    centre,
    combined_objective,
    hold_last_pose_protocol,
    scenes_needed,
    spread_test,
    violations,
)
from dynslam_bench.tuning.plan import held_settings, seen_note, splits_seen
from dynslam_bench.tuning.storage import (
    Importance,
    best_trials,
    count_states,
    importances,
    scene_ratios,
)
from dynslam_bench.tuning.study import StoredStudy, Study
from dynslam_bench.tuning.study_file import ProblemInstance, StudySpec

_LARGEST_LOG = 700.0
"""Larger logarithms overflow."""
NEGLIGIBLE = 0.05
"""A gain that is surely smaller than this share does not matter."""
ERROR = 0.05
"""Of an interval, half of it at either end: at most 2.5 % of the studies without anything better choose something."""


class Ratio(Record):
    """A ratio to the baseline, of the ATE or whatever a study is after, with its 95 % interval.

    Attributes:
        ratio: Geometric mean over the scenes, trimmed from ten on; below 1 is better than the
            baseline.
        low: Lower end of the interval over scenes (`objectives.bounds`); below three scenes over
            starts, which tells nothing of other scenes. None for a single run.
        high: Upper end.
        n: Paired runs.
        sequences: How many scenes they come from.
        bound: Upper end of an interval that is wide enough for all candidates compared; None for a
            single run.
        spread: Standard deviation of the logarithm over what the interval is over; None for a
            single run.
        what: What the ratio is one of.
    """

    ratio: float
    low: float | None = None
    high: float | None = None
    n: int
    sequences: int
    bound: float | None = None
    spread: float | None = None
    what: str = "ATE"

    @property
    def shows_gain(self) -> bool:
        """Whether the whole interval lies below 1, over enough scenes for an interval."""
        return self.high is not None and self.high < 1 and self.sequences >= FEWEST_SCENES

    @property
    def shows_loss(self) -> bool:
        """Whether the whole interval lies above 1, over enough scenes for an interval."""
        return self.low is not None and self.low > 1 and self.sequences >= FEWEST_SCENES

    @property
    def missing(self) -> int:
        """How many more scenes would show a gain as large as this one in four of five studies; at least one."""
        return max(1, scenes_needed(1 - self.ratio, self.spread or 0.0) - self.sequences)

    @property
    def interval(self) -> str:
        """The interval in brackets; empty without one."""
        return "" if self.low is None or self.high is None else f"[{self.low:.3f}, {self.high:.3f}]"

    def __str__(self) -> str:
        return f"{self.what} x {self.ratio:.3f} {self.interval or 'without an interval'}"


def compared(
    outcomes: Outcomes, baseline: Outcomes, *, objective: Objective = ACCURACY, candidates: int = 1
) -> Ratio:
    """A configuration beside the baseline on the same instances.

    Args:
        outcomes: Of the configuration.
        baseline: Of the baseline.
        objective: What is compared.
        candidates: How many configurations are compared for one choice; the bound allows for all of
            them (Bonferroni).
    """
    scenes = objective.ratios(outcomes, baseline)
    sample = (
        list(scenes.values())
        if len(scenes) >= FEWEST_SCENES
        else objective.by_start(outcomes, baseline)
    )
    sample = objective.counted(sample)
    ratio = Ratio(
        ratio=_ratio(centre(sample)), n=len(outcomes), sequences=len(scenes), what=objective.what
    )
    if len(sample) < 2:
        return ratio
    low, high = map(_ratio, bounds(sample))
    bound = _ratio(bounds(sample, 1 - ERROR / candidates)[1])
    return ratio.model_copy(
        update={"low": low, "high": high, "bound": bound, "spread": float(np.std(sample, ddof=1))}
    )


def _ratio(logarithm: float) -> float:
    return math.exp(min(logarithm, _LARGEST_LOG))


# The summary of a study and its verdict.


class Verdict(str, Enum):
    """What a study says of its best candidate."""

    PROVEN = "proven"
    PROMISING = "promising"
    NO_MATTER = "does not matter here"
    WORSE = "worse"
    NOT_JUDGED = "not judged"


class Candidate(Record):
    """One of the best configurations, judged again.

    Attributes:
        trial: Its number.
        params: The tuned settings.
        values: What its trial had been worth.
        confirm: On the instances for the choice, which no trial had seen.
        held_out: On the held-out split; None without one, or if it is not the best.
        recorded: ATE on recordings; None without any, or if it is not the best.
        on_confirm: ATE and processor time on the instances for the choice, by objective.
        on_held_out: The same on the held-out split.
        ate_margin: What it may lose of accuracy, as a share; None where its own ratio is one of
            errors.
        feasible: Whether the constraints hold in the new runs.
        failed: Why it could not be run again; empty if it could.
    """

    trial: int
    params: dict[str, Any]
    values: list[float]
    confirm: Ratio | None = None
    held_out: Ratio | None = None
    recorded: Ratio | None = None
    on_confirm: dict[str, Ratio] = Field(default_factory=dict)
    on_held_out: dict[str, Ratio] = Field(default_factory=dict)
    ate_margin: float | None = None
    feasible: bool = True
    failed: str = ""

    @property
    def bound(self) -> float:
        """Upper confidence bound of its ratio; infinite if it cannot be chosen."""
        return (
            _bound(self.confirm)
            if self.feasible and self.nothing_lost(self.on_confirm)
            else math.inf
        )

    @property
    def chosen(self) -> bool:
        """Whether it is surely better than the baseline on the instances of the choice."""
        return self.bound < 1

    @property
    def evidence(self) -> Ratio | None:
        """Its ratio on scenes that neither trials nor choice saw, or else on those of the choice; None without any."""
        held = self.held_out
        return held if held is not None and held.sequences >= FEWEST_SCENES else self.confirm

    def nothing_lost(self, ratios: Mapping[str, Ratio]) -> bool:
        """Whether the upper bound of the ATE ratio shows it (nearly) as accurate as the baseline, if that is asked."""
        return self.ate_margin is None or _bound(ratios.get("accuracy")) < 1 + self.ate_margin


class StudySummary(Record):
    """What came out of a study; `summary.json` in its folder.

    Attributes:
        name: The study.
        tracker: The tracker.
        baseline: What ratios are to, in words.
        protocol: Description of the protocol.
        trials: Trials by state.
        candidates: The best configurations, judged again; the best one, whose settings became the
            preset, first.
        verdict: What the study says of the best candidate.
        conclusion: A few short sentences, see `judge`.
        p_value: Of the test whether the settings matter at all (`objectives.spread_test`); None
            without a test.
        shipped: The default settings, where the baseline is something else, on ``confirm`` and
            ``held_out``.
        importances: Optuna's importances of the parameters, see `storage.importances`.
        tune: The instances that trials ran on.
        confirm: Those of the choice.
        held_out: Those that judged it.
        recorded: Recordings that it was checked on.
        seen: Splits with scenes that the network behind the masks was trained on, see
            `plan.seen_note`.
    """

    name: str
    tracker: str
    baseline: str
    protocol: str
    trials: dict[str, int]
    candidates: list[Candidate]
    verdict: Verdict
    conclusion: str
    p_value: float | None = None
    shipped: dict[str, Ratio] = Field(default_factory=dict)
    importances: dict[str, Importance] = Field(default_factory=dict)
    tune: list[str] = Field(default_factory=list)
    confirm: list[str] = Field(default_factory=list)
    held_out: list[str] = Field(default_factory=list)
    recorded: list[str] = Field(default_factory=list)
    seen: list[str] = Field(default_factory=list)

    @property
    def keeps_default(self) -> bool:
        """Whether the default settings, which are not the baseline, are as good as the best trial."""
        return beside_default(self.baseline, self.shipped, self.best).endswith("keep them.")

    @property
    def best(self) -> Candidate | None:
        """The best candidate; None if no trial with other settings came to its end."""
        return self.candidates[0] if self.candidates else None


def judge(
    candidates: Sequence[Candidate],
    p_value: float | None = None,
    failures: Sequence[str] = (),
) -> tuple[Verdict, str]:
    """The verdict on the first, best candidate, and a few short sentences with its numbers.

    *Proven*: it was chosen, the whole interval on held-out scenes lies below 1, nothing is lost of accuracy where that
    is asked, and recordings are not worse. *Worse*: an interval lies above 1, a constraint fails,
    or the settings matter and the estimate is not below 1. *Does not matter here*: the trials
    differ by no more than chance (`objectives.spread_test`), or the whole interval lies above 1 -
    `NEGLIGIBLE`, or the estimate does and nothing was chosen. *Promising* is what is left.

    Args:
        candidates: The best one first.
        p_value: Of `objectives.spread_test`.
        failures: Why trials failed, said where no trial did better.
    """
    verdict, text = _judged(candidates, p_value)
    if not candidates and failures:
        text += f"; {len(failures)} failed, the first one as {failures[0]}"
    return verdict, f"{verdict.value.capitalize()}: {text}."


def _judged(candidates: Sequence[Candidate], p_value: float | None) -> tuple[Verdict, str]:
    if not candidates:
        return Verdict.NOT_JUDGED, "no trial with other settings came to its end"
    best = candidates[0]
    name = f"trial {best.trial}"
    ratio = best.evidence
    if best.failed:
        return Verdict.NOT_JUDGED, f"{name} failed when it was run again: {best.failed}"
    if ratio is None or best.confirm is None:
        return Verdict.NOT_JUDGED, f"no frames are left to confirm {name} on; name some as confirm"
    if ratio.sequences < FEWEST_SCENES:
        return (
            Verdict.NOT_JUDGED,
            f"{name} has {ratio} on {_scenes(ratio)} only, and {FEWEST_SCENES} are the fewest",
        )
    numbers = f"{ratio} on {_scenes(ratio)} that no trial saw"
    numbers += (
        f" (where it was chosen {', '.join(map(str, best.on_confirm.values()))})"
        if best.ate_margin
        else ""
    )
    gain = f"{100 * (1 - ratio.ratio):.1f} % less {ratio.what}: {numbers}"
    no_better = f"the best, {name}, is not better than the baseline: {numbers}"
    unsettled = _unsettled(best)
    p = math.nan if p_value is None else p_value
    low = math.nan if ratio.low is None else ratio.low
    # over starts, if need be
    recorded_low = 0.0 if best.recorded is None else best.recorded.low or 0.0
    by_chance = p > MATTER_LEVEL and (not best.chosen or ratio.ratio >= 1) and not ratio.shows_gain
    small = ratio.ratio > 1 - NEGLIGIBLE and not best.chosen and not ratio.shows_gain
    verdicts = (
        (
            not best.feasible,
            Verdict.WORSE,
            f"{name} violates a constraint when it is run again ({numbers})",
        ),
        (recorded_low > 1, Verdict.WORSE, f"{name} has {best.recorded} on recordings ({numbers})"),
        (
            ratio.shows_loss,
            Verdict.WORSE,
            f"{name} has {100 * (ratio.ratio - 1):.1f} % more {ratio.what}: {numbers}",
        ),
        (not unsettled, Verdict.PROVEN, f"{name} has {gain}"),
        (
            by_chance,
            Verdict.NO_MATTER,
            f"the trials differ by no more than chance (F-test over trials and scenes, p = {p:.2f}, level "
            f"{MATTER_LEVEL}). The best, {name}, has {numbers}",
        ),
        (
            1 - NEGLIGIBLE < low and ratio.ratio < 1,
            Verdict.NO_MATTER,
            f"the best, {name}, gains at most {100 * (1 - low):.1f} %: {numbers}",
        ),
        (
            ratio.ratio >= 1 and p_value is None,
            Verdict.NOT_JUDGED,
            f"{no_better}. One trial or one scene cannot tell whether settings matter",
        ),
        (ratio.ratio >= 1, Verdict.WORSE, f"the settings matter, but {no_better}"),
        (small, Verdict.NO_MATTER, f"the best, {name}, has perhaps {gain}. {_NOT_WORTH}"),
        (
            True,
            Verdict.PROMISING,
            f"{name} has perhaps {gain}. It is not proven: {unsettled}. {_more_scenes(best, ratio)}",
        ),
    )
    return next((verdict, text) for holds, verdict, text in verdicts if holds)


_NOT_WORTH = f"A gain below {100 * NEGLIGIBLE:.0f} % is not worth more scenes"


def _more_scenes(best: Candidate, ratio: Ratio) -> str:
    """How many more scenes would settle a promising candidate."""
    if best.confirm is None or best.confirm.ratio >= 1:
        return f"As it has {best.confirm} where it was chosen, nobody can tell how many more scenes would settle it"
    if ratio.ratio > 1 - NEGLIGIBLE:
        return _NOT_WORTH
    missing = max(part.missing for part in ([ratio] if best.chosen else [ratio, best.confirm]))
    return f"About {missing} more scene{'s' * (missing != 1)} would settle it"


def beside_default(baseline: str, shipped: Mapping[str, Ratio], best: Candidate | None) -> str:
    """What the default settings reach where the baseline is something else; empty if it is not.

    Args:
        baseline: What ratios are to, in words.
        shipped: The default settings beside it, by split.
        best: The best candidate.
    """
    split = "held_out" if "held_out" in shipped else "confirm"
    default = shipped.get(split)
    mine = getattr(best, split, None)
    if default is None or mine is None:
        return ""
    keep = ", so keep them" if default.ratio <= mine.ratio else ""
    return f" Ratios are to {baseline}; the default settings have {default} there{keep}."


def _unsettled(best: Candidate) -> str:
    """Why the best candidate is not proven; empty if it is."""
    as_accurate = best.nothing_lost(best.on_confirm) and best.nothing_lost(
        best.on_held_out or best.on_confirm
    )
    held = best.held_out
    reasons = {
        f"it is not shown to be as accurate (the bound has to lie below {1 + (best.ate_margin or 0.0):.2f})": (
            not as_accurate
        ),
        f"its upper bound {_bound(best.confirm):.3f} where it was chosen is not below 1": not best.chosen,
        f"fewer than {FEWEST_SCENES} held-out scenes were given to prove it on": (
            held is None or held.sequences < FEWEST_SCENES
        ),
        "the interval is not below 1": held is not None and not held.shows_gain,
    }
    return next((reason for reason, holds in reasons.items() if holds), "")


def _scenes(ratio: Ratio) -> str:
    return f"{ratio.sequences} scene{'s' * (ratio.sequences != 1)}"


def _bound(ratio: Ratio | None) -> float:
    return math.inf if ratio is None or ratio.bound is None else ratio.bound


def finish(
    tuner: Study, on_note: Callable[[str], None] | None = None, *, jobs: int = 1
) -> StudySummary:
    """Judge the best trials on the `confirm` instances and the best of them on the others; write preset and summary.

    The best has the smallest upper confidence bound of its ratio to the baseline on `confirm`,
    allowing for the number of candidates; where that bound lies below 1 it is the choice. The
    held-out split and the recordings only judge.

    Args:
        tuner: A study with finished trials.
        on_note: Called with a line on every step.
        jobs: Runs at a time.

    Returns:
        The summary; `best.toml` and `summary.json` lie in the study's folder.

    Raises:
        StudyError: No trial has finished, or the baseline fails.
    """
    spec = tuner.spec
    design = tuner.design
    note = on_note or (lambda _: None)
    finished = best_trials(tuner.study, spec.top + 1)
    if not finished:
        raise StudyError(
            f"study '{spec.name}' has no finished trial",
            "run it first, or see why its trials failed",
        )
    # then trial 0, the default settings, is a candidate too
    is_rival = tuner.baseline.tracker != spec.tracker
    margin = spec.ate_margin if spec.at_equal_accuracy else None
    shipped = dict[str, Ratio]()
    candidates = [
        Candidate(
            trial=trial.number,
            params=trial.params,
            values=list(trial.values or ()),
            ate_margin=margin,
        )
        for trial in finished
        if trial.number > 0 or is_rival
    ][: spec.top]
    if candidates and design.confirm:
        note(
            f"the baseline and {len(candidates)} trials on {len(design.confirm)} instances that no trial has seen"
        )
    candidates = _judge(tuner, "confirm", candidates, jobs, shipped)
    candidates.sort(
        key=lambda candidate: (candidate.bound, bool(candidate.failed), not candidate.feasible)
    )
    if candidates and design.confirm and not candidates[0].failed:
        note(f"trial {candidates[0].trial} on the held-out instances")
        for split in ("held_out", "recorded"):
            candidates[:1] = _judge(tuner, split, candidates[:1], jobs, shipped)
    p_value = spread_test(list(scene_ratios(tuner.study).values()))
    reasons = [
        trial.user_attrs.get("reason", "")
        for trial in tuner.study.get_trials(states=(TrialState.FAIL,))
    ]
    verdict, conclusion = judge(candidates, p_value, reasons)
    conclusion += beside_default(spec.baseline, shipped, candidates[0] if candidates else None)
    summary = StudySummary(
        name=spec.name,
        tracker=spec.tracker,
        baseline=spec.baseline or "default settings",
        protocol=hold_last_pose_protocol(spec.protocol).describe(),
        trials=count_states(tuner.study),
        candidates=candidates,
        verdict=verdict,
        conclusion=conclusion,
        p_value=p_value,
        shipped=shipped,
        importances=importances(tuner.study),
        confirm=list(map(str, design.confirm)),
        held_out=list(map(str, design.held_out)),
        recorded=list(map(str, design.recorded)),
        tune=list(map(str, design.tune)),
        seen=splits_seen(tuner.defaults, design),
    )
    preset = preset_text(
        spec,
        summary.best.params if summary.best else {},
        " ".join(filter(None, (conclusion, seen_note(summary.seen)))),
        status=verdict.value,
        tuned_on=[*summary.tune, *summary.confirm],
        judged_on=[*summary.held_out, *summary.recorded],
    )
    write_atomic(tuner.folder / "best.toml", preset)
    write_atomic(tuner.folder / "summary.json", summary.to_json())
    return summary


def _judge(
    tuner: Study, split: str, candidates: Sequence[Candidate], jobs: int, shipped: dict[str, Ratio]
) -> list[Candidate]:
    """Candidates beside the baseline on the instances of a split; `shipped` gains the shipped default's ratio there.

    Raises:
        StudyError: The baseline fails.
    """
    instances: tuple[ProblemInstance, ...] = getattr(tuner.design, split)
    if not instances or not candidates:
        return list(candidates)
    objective = ACCURACY if split == "recorded" else combined_objective(tuner.objectives)
    tuned = [
        Configuration(tuner.spec.tracker, {**tuner.held, **candidate.params})
        for candidate in candidates
    ]
    default = [] if tuner.shipped is None else [tuner.shipped]
    baseline, runs = tuner.evaluate_beside([*tuned, *default], instances, jobs=jobs)
    if default and not isinstance(outcomes := runs.pop(), InstanceFailedError):
        shipped[split] = compared(outcomes, baseline, objective=objective)
    judged = []
    for candidate, outcomes in zip(candidates, runs, strict=True):
        update: dict[str, Any] = {"failed": str(outcomes), "feasible": False}
        if not isinstance(outcomes, InstanceFailedError):
            update = {
                split: compared(outcomes, baseline, objective=objective, candidates=len(candidates))
            }
            if split != "recorded":
                update[f"on_{split}"] = {
                    one.name: compared(outcomes, baseline, objective=one)
                    for one in (ACCURACY, SPEED)
                }
            if split == "confirm":
                update["feasible"] = all(
                    value <= 0 for value in violations(tuner.spec, outcomes).values()
                )
        judged.append(candidate.model_copy(update=update))
    return judged


def read_preset_text(
    spec: StudySpec, results: Path | str = "results", trial: int | None = None
) -> str:
    """The preset of a study, as text; of one that is not finished the best trial so far.

    Args:
        spec: The study.
        results: The results folder.
        trial: The number of a trial whose settings are asked for instead.

    Raises:
        StudyError: There is no such study or trial.
    """
    stored = StoredStudy(spec, results)
    preset = stored.folder / "best.toml"
    trials = best_trials(stored.study, 1)
    if trial is None and preset.is_file():
        return read_text(preset, kind=StudyError)
    if trial is not None:
        trials = [one for one in stored.study.get_trials(deepcopy=False) if one.number == trial]
    if not trials:
        absent = "finished trial" if trial is None else f"trial {trial}"
        raise StudyError(
            f"study '{spec.name}' has no {absent}", "dynslam-bench tune status STUDY.toml"
        )
    remark = f"Trial {trials[0].number}{', the best so far' * (trial is None)}; not judged on scenes that no trial saw."
    return preset_text(spec, trials[0].params, remark)


# The text of a preset.


def preset_text(
    spec: StudySpec,
    tuned: Mapping[str, Any],
    remark: str,
    *,
    status: str = Verdict.NOT_JUDGED.value,
    tuned_on: Sequence[str] = (),
    judged_on: Sequence[str] = (),
) -> str:
    """TOML text of tuned settings: their status, then a dotted name and its value a line under ``[settings]``.

    The settings of a baseline that is a preset are among them. What a study had fixed, for example
    the source of its masks, is only a comment, so that the preset runs wherever the tracker does.

    Args:
        spec: The study.
        tuned: The tuned settings; empty for the baseline's.
        remark: A line on what they are worth.
        status: The verdict on them.
        tuned_on: Instances that trials and choice saw.
        judged_on: Instances that judged.
    """
    fixed = spec.space.fixed
    remarks = {
        remark: True,
        f"Tuned on {_listed(tuned_on)}.": tuned_on,
        f"Judged on {_listed(judged_on)}.": judged_on,
        f"Fixed in that study, not part of these settings: {', '.join(_lines(fixed))}.": fixed,
    }
    shown = [
        f"# {line}" for text, holds in remarks.items() if holds for line in textwrap.wrap(text, 100)
    ]
    settings = {
        name: value for name, value in {**held_settings(spec), **tuned}.items() if name not in fixed
    }
    head = [
        f"# settings of {spec.tracker}",
        *shown,
        "",
        f"status = {json.dumps(status)}",
        "",
        "[settings]",
    ]
    return "\n".join([*head, *_lines(settings), ""])


def _lines(settings: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {json.dumps(value)}" for name, value in sorted(settings.items())]


def _listed(instances: Sequence[str]) -> str:
    """Instances by their sequences, with their number."""
    names = list(dict.fromkeys(re.sub(r"[?&](?!scene=)[^?&]*", "", text) for text in instances))
    shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return f"{len(instances)} instance{'s' * (len(instances) != 1)} of {shown}"
