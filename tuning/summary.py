"""The result of a study: ratios to the default with their intervals, the choice, the conclusion, the picks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

from pydantic import Field

from dynslam_bench.core.records import Record
from dynslam_bench.tuning.objectives import ACCURACY, FEWEST_SCENES, Objective, Outcomes, bounds, centre, upper

_LARGEST_LOG = 700.0
"""Larger logarithms overflow."""
FALSE_CHOICES = 0.05
"""At most this share of the studies in which nothing is better may choose something."""


class Ratio(Record):
    """A ratio to the default settings, of the ATE or whatever a study is after, with its 95 % interval.

    Attributes:
        ratio: Geometric mean over the scenes, trimmed from ten on; below 1 is better than the default.
        low: Lower end of the interval over scenes (`objectives.bounds`); below three scenes over starts, which tells
            nothing of other scenes. None for a single run.
        high: Upper end.
        n: Paired runs.
        sequences: How many scenes they come from.
        bound: One-sided upper bound, wide enough for the number of candidates compared; None for a single run.
        what: What the ratio is one of.
    """

    ratio: float
    low: float | None
    high: float | None
    n: int
    sequences: int
    bound: float | None = None
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
    def interval(self) -> str:
        """The interval in brackets; empty without one."""
        return "" if self.low is None or self.high is None else f"[{self.low:.3f}, {self.high:.3f}]"

    def __str__(self) -> str:
        return f"{self.what} x {self.ratio:.3f} {self.interval or 'without an interval'}"


def compared(outcomes: Outcomes, default: Outcomes, *, objective: Objective = ACCURACY, candidates: int = 1) -> Ratio:
    """A configuration beside the default on the same instances.

    Args:
        outcomes: Of the configuration.
        default: Of the default settings.
        objective: What is compared.
        candidates: How many configurations are compared for one choice; the bound allows for all of them (Bonferroni).
    """
    scenes = objective.ratios(outcomes, default)
    sample = list(scenes.values()) if len(scenes) >= FEWEST_SCENES else objective.by_start(outcomes, default)
    sample = objective.counted(sample)
    interval = bounds(sample)
    return Ratio(
        ratio=_ratio(centre(sample)),
        low=None if interval is None else _ratio(interval[0]),
        high=None if interval is None else _ratio(interval[1]),
        bound=None if interval is None else _ratio(upper(sample, 1 - FALSE_CHOICES / candidates)),
        n=len(outcomes),
        sequences=len(scenes),
        what=objective.what,
    )


def _ratio(logarithm: float) -> float:
    return math.exp(min(logarithm, _LARGEST_LOG))


# The summary of a study and its conclusion.


class Candidate(Record):
    """One of the best configurations, judged again.

    Attributes:
        trial: Its number.
        params: The tuned settings.
        values: What its trial had been worth.
        confirm: On the instances for the choice, which no trial had seen.
        held_out: On the held-out split; None without one, or if it was not chosen.
        recorded: ATE on recordings; None without any, or if it was not chosen.
        on_confirm: ATE and processor time on the instances for the choice, by objective.
        on_held_out: The same on the held-out split.
        ate_margin: What it may lose of accuracy, as a share; None where its own ratio is one of errors.
        frame_ms: Mean milliseconds a frame, timed without the stage cache.
        default_frame_ms: The same of the default settings.
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
    frame_ms: float | None = None
    default_frame_ms: float | None = None
    feasible: bool = True
    failed: str = ""

    @property
    def bound(self) -> float:
        """Upper confidence bound of its ratio; infinite if it cannot be chosen."""
        return _bound(self.confirm) if self.feasible and self.nothing_lost(self.on_confirm) else math.inf

    def nothing_lost(self, ratios: Mapping[str, Ratio]) -> bool:
        """Whether the upper bound of the ATE ratio shows it (nearly) as accurate as the default, if that is asked."""
        return self.ate_margin is None or _bound(ratios.get("accuracy")) < 1 + self.ate_margin

    @property
    def worse_on_recordings(self) -> bool:
        """Whether the whole interval on the recordings, over starts if need be, lies above 1."""
        return self.recorded is not None and self.recorded.low is not None and self.recorded.low > 1

    @property
    def is_confirmed(self) -> bool:
        """Whether it beats the default on the held-out split and is not worse on recordings."""
        gain = self.held_out is not None and self.held_out.shows_gain
        return self.feasible and gain and self.nothing_lost(self.on_held_out) and not self.worse_on_recordings


class StudySummary(Record):
    """What came out of a study; `summary.json` in its folder.

    Attributes:
        name: The study.
        tracker: The tracker.
        protocol: Description of the protocol.
        trials: Trials by state.
        candidates: The best configurations, judged again; the chosen one first.
        chosen: Number of the trial whose settings became the preset; None if the default was chosen.
        improves: Whether the chosen settings beat the default on the held-out split (the whole interval below 1), are
            not worse on recordings, and the splits are apart.
        conclusion: One sentence, see `conclude`.
        importances: Optuna's importances of the parameters, see `trials.importances`.
        tune: The instances that trials ran on.
        confirm: Those of the choice.
        held_out: Those that judged it.
        recorded: Recordings that it was checked on.
        picks: Presets of the study by name, and the trial of each; None where the default is the pick.
        split_notes: How the splits are not apart, where the study accepts that; to be shown beside every number.
        seen: Splits with scenes that the network behind the masks was trained on, see `splits.seen_note`.
    """

    name: str
    tracker: str
    protocol: str
    trials: dict[str, int]
    candidates: list[Candidate]
    chosen: int | None
    improves: bool
    conclusion: str
    importances: dict[str, float] = Field(default_factory=dict)
    tune: list[str] = Field(default_factory=list)
    confirm: list[str] = Field(default_factory=list)
    held_out: list[str] = Field(default_factory=list)
    recorded: list[str] = Field(default_factory=list)
    picks: dict[str, int | None] = Field(default_factory=dict)
    split_notes: list[str] = Field(default_factory=list)
    seen: list[str] = Field(default_factory=list)


def choose(candidates: Sequence[Candidate]) -> Candidate | None:
    """The candidate with the smallest upper bound of its ratio; None, the default, where no bound lies below 1."""
    best = min(candidates, key=lambda candidate: candidate.bound, default=None)
    return best if best is not None and best.bound < 1 else None


def conclude(candidates: Sequence[Candidate], chosen: int | None, split_notes: Sequence[str]) -> str:
    """One sentence: better or not on the held-out split, by how much, how sure, and whether to keep the default."""
    candidate = next((candidate for candidate in candidates if candidate.trial == chosen), None)
    text = _nothing_chosen(candidates) if candidate is None else _judged(candidate, bool(split_notes))
    return text + _apart(split_notes)


def _nothing_chosen(candidates: Sequence[Candidate]) -> str:
    """Why the default was chosen."""
    if not candidates:
        return "Keep the default: no trial with other settings came to its end."
    judged = [candidate for candidate in candidates if candidate.confirm is not None]
    feasible = [candidate for candidate in judged if candidate.feasible]
    if not judged:
        return f"Keep the default: trial {candidates[0].trial} failed when run again: {candidates[0].failed}."
    if not feasible:
        return f"Keep the default: trial {judged[0].trial} violates a constraint when run again, as do all that were."
    if not any(candidate.nothing_lost(candidate.on_confirm) for candidate in feasible):
        best = min(feasible, key=lambda candidate: _bound(candidate.on_confirm["accuracy"]))
        ate = best.on_confirm["accuracy"]
        return (
            f"Keep the default: no trial is shown to be as accurate on {ate.n} runs that none had seen (trial "
            f"{best.trial}: {best.confirm}, but {ate}, upper bound {_bound(ate):.3f}, which has to lie below "
            f"{1 + (best.ate_margin or 0.0):.2f})."
        )
    best = min(feasible, key=lambda candidate: candidate.bound)
    assert best.confirm is not None
    many = f"none of the {len(judged)} best trials is" if len(judged) > 1 else "the best trial is not"
    return (
        f"Keep the default: {many} confirmed on {best.confirm.n} runs that no trial had seen (trial {best.trial}: "
        f"{best.confirm}, upper bound {_bound(best.confirm):.3f})."
    )


def _judged(chosen: Candidate, overlapping: bool) -> str:
    """What the held-out split and the recordings say of the choice."""
    if chosen.failed:
        return f"Keep the default: trial {chosen.trial} was chosen, but failed when it was judged: {chosen.failed}."
    held, confirm = chosen.held_out, chosen.confirm
    if held is None:
        return (
            f"Not judged, keep the default: no held-out split was given, and what trial {chosen.trial} reaches on the "
            f"instances that it was chosen on ({confirm}) says nothing about others."
        )
    on = f"on {held.sequences} held-out scene{'s' * (held.sequences != 1)}"
    details = f"where it was chosen: {confirm}"
    if held.sequences < FEWEST_SCENES:
        return f"Not judged, keep the default: {held} {on} only, from which nothing follows for others ({details})."
    sure = "95 % interval over scenes" + (", rough below five" if held.sequences < 5 else "")
    if chosen.worse_on_recordings:
        return f"Worse on recordings, keep the default: {chosen.recorded} there ({on}: {held}, {sure})."
    if held.shows_loss and chosen.nothing_lost(chosen.on_held_out):
        more = f"{100 * (held.ratio - 1):.1f} % more {held.what}"
        return f"Worse, keep the default: {more} {on} ({held}, {sure}; {details})."
    if chosen.ate_margin is not None and "accuracy" in chosen.on_held_out:
        details += f"; {chosen.on_held_out['accuracy']}"
    if chosen.recorded is not None:
        details += f"; recorded: {chosen.recorded}"
    if not chosen.nothing_lost(chosen.on_held_out):
        limit = 1 + (chosen.ate_margin or 0)
        return (
            f"Not better, keep the default: {held} {on}, but not shown to be as accurate: the upper bound has to lie "
            f"below {limit:.2f} ({details})."
        )
    if held.shows_gain and not overlapping:
        return (
            f"Better: trial {chosen.trial} has {100 * (1 - held.ratio):.1f} % less {held.what} {on} ({held}, {sure}; "
            f"{details}), so its settings may replace the default there."
        )
    return f"Not better, keep the default: {held} {on} shows no gain ({sure}; {details})."


def worth(name: str, candidate: Candidate | None, split_notes: Sequence[str]) -> str:
    """The value of a preset, in one sentence.

    Args:
        name: Of the preset.
        candidate: Whose settings it holds, judged; None for the default's.
        split_notes: How the splits are not apart, where the study accepts that.
    """
    if candidate is None:
        return f"The '{name}' pick is the default: no trial was surely better than it."
    parts = [
        f"{split}: {ratios['accuracy']}, {ratios['speed']}"
        for split, ratios in (("where it was chosen", candidate.on_confirm), ("held out", candidate.on_held_out))
        if ratios
    ]
    if candidate.recorded is not None:
        parts.append(f"recorded: {candidate.recorded}")
    if candidate.failed:
        parts.append(f"failed when it was judged: {candidate.failed}")
    return f"The '{name}' pick is trial {candidate.trial} ({'; '.join(parts)}).{_apart(split_notes)}"


def _apart(split_notes: Sequence[str]) -> str:
    return f" THE SPLITS ARE NOT APART: {'; '.join(split_notes)}." if split_notes else ""


# Picks: the fast, the balanced and the accurate one of a study's best trials.

PickName = Literal["fast", "balanced", "accurate"]
PICKS: tuple[PickName, ...] = get_args(PickName)


def pick(name: PickName, candidates: Sequence[Candidate], margin: float) -> Candidate | None:
    """A study's pick; None stands for the default.

    Args:
        name: ``fast``: the least processor time at (nearly) the default's accuracy; ``accurate``: the least ATE;
            ``balanced``: the least of the study's objectives together, at (nearly) the default's accuracy.
        candidates: The trials to choose from, feasible ones.
        margin: What may be lost of accuracy, as a share.
    """
    asked = 1 + margin if name != "accurate" else math.inf
    accurate = [candidate for candidate in candidates if _bound(candidate.on_confirm["accuracy"]) < asked]
    objective = {"fast": "speed", "accurate": "accuracy"}.get(name)

    def bound(candidate: Candidate) -> float:
        return _bound(candidate.confirm if objective is None else candidate.on_confirm[objective])

    best = min(accurate, key=bound, default=None)
    return best if best is not None and bound(best) < 1 else None


def _bound(ratio: Ratio | None) -> float:
    return math.inf if ratio is None or ratio.bound is None else ratio.bound
