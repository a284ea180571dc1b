"""After the trials: the best is judged on scenes that it was not chosen on; what is proven becomes a preset."""

import json
import math
import re
import shlex
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean, geometric_mean
from typing import Any

from optuna.trial import FrozenTrial, TrialState
from pydantic import Field

from dynslam_bench.core import StudyError, read_text, write_atomic
from dynslam_bench.core.records import Record
from dynslam_bench.evaluation.verdicts import (
    FEWEST,
    LOOKS,
    ONE_SIDED,
    ComparisonVerdict,
    PairedRatio,
    findings,
    paired_ratio,
    scenes_to_settle,
    verdict_of,
)
from dynslam_bench.runs.layout import is_id
from dynslam_bench.sequences.families import family_of
from dynslam_bench.tuning.objectives import (
    ACCURACY,
    SPEED,
    Configuration,
    InstanceFailedError,
    Outcomes,
    combined_objective,
    compare,
    hold_last_pose_protocol,
    improvement_bound,
    lost_scenes,
    scene_errors_m,
)
from dynslam_bench.tuning.plan import (
    Design,
    held_settings,
    known_settings,
    seen_note,
    splits_seen,
)
from dynslam_bench.tuning.storage import (
    EARLIER,
    Importance,
    best_trials,
    count_states,
    importances,
    scene_ratios,
)
from dynslam_bench.tuning.study import SUMMARY_FILE, StoredStudy, Study
from dynslam_bench.tuning.study_file import TRACKER, ProblemInstance, StudySpec, scenes

NOT_JUDGED = "not judged"
"""Status of settings that no scenes have judged."""
OFFERED = (ComparisonVerdict.PROVEN, ComparisonVerdict.BUT_LOST, ComparisonVerdict.PROMISING)
"""Verdicts with which `best.toml` sets the best trial's settings; with others it keeps the baseline's."""


class SceneErrors(Record):
    """ATE of the baseline and of a candidate in one scene, lost frames held, see `scene_errors_m`.

    Attributes:
        scene: The scene.
        baseline_m: ATE of the baseline, metres.
        candidate_m: ATE of the candidate, metres.
        lost_by_baseline: Whether the baseline lost at least half of its runs there.
        lost: Whether the candidate did.
    """

    scene: str
    baseline_m: float
    candidate_m: float
    lost_by_baseline: bool = False
    lost: bool = False


class Candidate(Record):
    """One of the best configurations, judged again.

    Attributes:
        trial: Its number.
        params: The tuned settings.
        values: What its trial had been worth.
        choice: Mean log ratio on the instances of the choice, which ranks the candidates; None
            without such instances.
        confirm: Comparison with the baseline on the instances of the choice; where nothing is held
            out they judge.
        held_out: Comparison with the baseline on the held-out instances; None without any, or if it
            is not the best.
        recorded: ATE on recordings, which is said and decides nothing; None without any, or if it is not the best.
        scene_errors: Its ATE and the baseline's in each scene that judges; empty where none judged.
        beyond: Comparison by the means of the judging families that no trial saw; None for fewer
            than `FEWEST` of them.
        on_confirm: ATE and processor time on the instances of the choice, by objective.
        on_held_out: ATE and processor time on the held-out instances, by objective.
        ate_margin: What it may lose of accuracy, as a share; None where its own ratio is one of
            errors.
        feasible: Whether the constraints hold in the new runs.
        failed: Why it could not be run again; empty if it could.
        crashes: Why some of its runs and of the baseline's crashed on the scenes that judge; they are lost.
        scene_s: Seconds of runs that a judging scene took, the baseline's included.
    """

    trial: int
    params: dict[str, Any]
    values: list[float]
    choice: float | None = None
    confirm: PairedRatio | None = None
    held_out: PairedRatio | None = None
    recorded: PairedRatio | None = None
    scene_errors: list[SceneErrors] = Field(default_factory=list)
    beyond: PairedRatio | None = None
    on_confirm: dict[str, PairedRatio] = Field(default_factory=dict)
    on_held_out: dict[str, PairedRatio] = Field(default_factory=dict)
    ate_margin: float | None = None
    feasible: bool = True
    failed: str = ""
    crashes: list[str] = Field(default_factory=list)
    scene_s: float = 0.0

    @property
    def evidence(self) -> PairedRatio | None:
        """Ratio on the scenes that judge: the held-out ones, or else those of `confirm`; None without any."""
        return self.confirm if self.held_out is None else self.held_out

    @property
    def errors_sentence(self) -> str:
        """The errors of the baseline and of this candidate over the judging scenes in millimetres; or empty."""
        if not self.scene_errors:
            return ""
        # geometric means, whose quotient is the mean ratio of the scenes
        baseline_mm = 1000 * geometric_mean(scene.baseline_m for scene in self.scene_errors)
        candidate_mm = 1000 * geometric_mean(scene.candidate_m for scene in self.scene_errors)
        count = len(self.scene_errors)
        return (
            f"Geometric mean of the ATE over {count} {'scene' if count == 1 else 'scenes'}: baseline "
            f"{baseline_mm:#.3g} mm, trial {self.trial} {candidate_mm:#.3g} mm."
        )

    @property
    def as_accurate(self) -> bool:
        """Whether the judging scenes show it (nearly) as accurate as the baseline, if that is asked."""
        if self.ate_margin is None:
            return True
        accuracy = (self.on_held_out or self.on_confirm).get("accuracy")
        return (
            accuracy is not None
            and accuracy.high is not None
            and accuracy.high < 1 + self.ate_margin
            and len(accuracy.losses) <= len(accuracy.losses_baseline)
        )


class StudySummary(Record):
    """Result of a study; `summary.json` in its folder.

    Attributes:
        name: The study.
        tracker: The tracker.
        baseline: What ratios are to, in words.
        protocol: Description of the protocol.
        trials: Trials by state.
        candidates: The best configurations, the best one first.
        verdict: What the study says of the best candidate.
        conclusion: A few short sentences, see `conclude`.
        shipped: The default settings, where the baseline is something else, on ``confirm`` and
            ``held_out``.
        importances: Optuna's importances of the parameters, see `storage.importances`.
        tune: The instances that trials ran on.
        confirm: The instances of the choice; where nothing is held out they judged it.
        held_out: The held-out instances, which judged it.
        recorded: Recordings that the best one was run on at the end.
        seen: Splits with scenes that the network behind the masks was trained on, see
            `plan.seen_note`.
    """

    name: str
    tracker: str
    baseline: str
    protocol: str
    trials: dict[str, int]
    candidates: list[Candidate]
    verdict: ComparisonVerdict
    conclusion: str
    shipped: dict[str, PairedRatio] = Field(default_factory=dict)
    importances: dict[str, Importance] = Field(default_factory=dict)
    tune: list[str] = Field(default_factory=list)
    confirm: list[str] = Field(default_factory=list)
    held_out: list[str] = Field(default_factory=list)
    recorded: list[str] = Field(default_factory=list)
    seen: list[str] = Field(default_factory=list)

    @property
    def best(self) -> Candidate | None:
        """The best candidate; None if no trial with other settings came to its end."""
        return self.candidates[0] if self.candidates else None

    @property
    def keeps_default(self) -> bool:
        """Whether the default settings, which are not the baseline, are as good as the best trial."""
        default = self.shipped.get("held_out" if self.held_out else "confirm")
        best = None if self.best is None else self.best.evidence
        return _is_as_good(default, best)

    @property
    def is_to_use(self) -> bool:
        """Whether the best trial's settings are a result to use."""
        return self.verdict is ComparisonVerdict.PROVEN and not self.keeps_default

    @property
    def offered(self) -> dict[str, Any]:
        """The settings that `best.toml` sets: the best trial's, or none where the verdict offers none."""
        if self.best is None or self.verdict not in OFFERED or self.keeps_default:
            return {}
        return self.best.params


def _is_as_good(default: PairedRatio | None, best: PairedRatio | None) -> bool:
    """Whether the default settings have no larger typical ratio than the best trial, and lose no more."""
    if default is None or best is None or default.ratio is None or best.ratio is None:
        return False
    loses_no_more = len(default.losses) <= len(best.losses)
    return default.scenes >= FEWEST and loses_no_more and default.ratio <= best.ratio


# The verdict on the best candidate, and the sentences that say it.


def judge(best: Candidate | None) -> tuple[ComparisonVerdict, list[str]]:
    """The verdict on the best candidate, and short sentences with its numbers, without their full stops.

    `evaluation.verdicts.verdict_of` decides on the judging scenes. Beside that a candidate that violates
    a constraint when it is run again, or is not shown to be as accurate where a study is after something
    else, is not *proven*.
    """
    if best is None:
        return ComparisonVerdict.CANNOT_TELL, ["no trial with other settings came to its end"]
    name = f"trial {best.trial}"
    if best.failed:
        return ComparisonVerdict.CANNOT_TELL, [
            f"{name} failed when it was run again: {best.failed}"
        ]
    evidence = best.evidence
    if evidence is None:
        no_frames = f"no frames are left to judge {name} on; name some as held_out"
        return ComparisonVerdict.CANNOT_TELL, [no_frames]
    verdict = verdict_of(evidence)
    sentences = findings(evidence, name)
    if best.crashes:
        count = f"{len(best.crashes)} run{'s' * (len(best.crashes) != 1)}"
        sentences.append(f"{count} crashed and counts as lost, the first one as {best.crashes[0]}")
    if not best.feasible:
        if verdict in OFFERED:
            verdict = ComparisonVerdict.CANNOT_TELL
        return verdict, [f"{name} violates a constraint when it is run again", *sentences]
    if verdict in OFFERED and not best.as_accurate:
        accuracy = (best.on_held_out or best.on_confirm).get("accuracy")
        limit = 1 + (best.ate_margin or 0.0)
        sentences.append(
            f"It is not shown to be as accurate: {accuracy}, whose upper end has to lie below {limit:.2f}"
        )
        is_worse = accuracy is None or verdict_of(accuracy) is ComparisonVerdict.WORSE
        verdict = ComparisonVerdict.CANNOT_TELL if is_worse else ComparisonVerdict.PROMISING
    if best.recorded is not None:
        sentences += findings(best.recorded, f"{name} on recordings")
    return verdict, sentences


def conclude(
    spec: StudySpec,
    candidates: Sequence[Candidate],
    trials: Sequence[Mapping[str, float]] = (),
    *,
    shipped: PairedRatio | None = None,
    failures: Sequence[str] = (),
    families: str = "",
    inert: int = 0,
) -> tuple[ComparisonVerdict, str]:
    """The verdict of a study and its conclusion: a few short sentences.

    Args:
        spec: The study.
        candidates: The best one first.
        trials: Log ratio by scene of each trial beside the baseline's.
        shipped: The default settings on the judging scenes, where the baseline is something else.
        failures: Why trials failed.
        families: A sentence on the families that judged; empty for none.
        inert: See `without_effect`.
    """
    if inert:
        verdict = ComparisonVerdict.NO_DIFFERENCE
        return verdict, (
            f"{verdict.value.capitalize()}: nothing that the study set has an effect. All {inert} trials "
            f"with other settings have the baseline's trajectories to the last bit. Does the tracker read its settings?"
        )
    best = candidates[0] if candidates else None
    verdict, sentences = judge(best)
    if failures:
        which = f"{len(failures)} trials failed, the first one as"
        if len(failures) == 1:
            which = "1 trial failed:"
        sentences.append(f"{which} {failures[0]}")
    if families and best is not None and best.evidence is not None:
        sentences.append(families)
        if best.beyond is not None:
            beyond = verdict_of(best.beyond).value
            number = best.beyond.all_scenes
            sentences.append(
                f"Beyond them, by the means of the {number} families that no trial saw: {beyond}, {best.beyond}"
            )

    # where nothing is claimed: what the trials exclude, and what would settle it
    if verdict not in (ComparisonVerdict.PROVEN, ComparisonVerdict.BUT_LOST) and (
        bound := improvement_bound(trials)
    ):
        gain, n_trials = bound
        sentences.append(
            f"On the scenes that trials ran on none of the {n_trials} trials with {FEWEST} or more is better by "
            f"more than {math.ceil(100 * gain)} % (95 %)"
        )
    if verdict in (ComparisonVerdict.PROMISING, ComparisonVerdict.CANNOT_TELL) and best is not None:
        sentences += _settling(spec, best)

    # beside another baseline, what the default settings reach
    if shipped is not None and best is not None and best.evidence is not None:
        keep = ", so keep them" if _is_as_good(shipped, best.evidence) else ""
        baseline = spec.baseline
        sentences.append(
            f"Ratios are to {baseline}; the default settings have {shipped} there{keep}"
        )
    text = ". ".join([sentences[0], *(line[0].upper() + line[1:] for line in sentences[1:])])
    return verdict, f"{verdict.value.capitalize()}: {text}."


_TOO_MANY = 1000
"""Scenes above which nobody would settle a question."""


def _settling(spec: StudySpec, best: Candidate) -> list[str]:
    """Number of scenes that would settle it, the command, and how long that runs; empty where nobody can tell."""
    evidence = best.evidence
    if evidence is None or best.failed or not best.feasible:
        return []
    needed = scenes_to_settle(evidence)
    if needed is None and evidence.all_scenes >= FEWEST:
        return [
            "More scenes of this kind would not settle it: judge on scenes that both sides track"
        ]
    if needed is None:
        return [f"Name {FEWEST} held-out scenes at least to learn more"]
    if needed > _TOO_MANY:
        return [f"More than {_TOO_MANY} scenes would be needed to settle it"]
    # an extendable study goes on to its next look
    if step := _further_scenes(spec, best):
        minutes = max(1, math.ceil(step * best.scene_s / 60))
        return [
            f"About {needed} scenes would settle it",
            f"The next look takes {minutes} min of runs: {_extend_command(step)}",
        ]
    minutes = max(1, math.ceil(needed * best.scene_s / 60))
    return [
        f"About {needed} held-out scenes in a new study would settle it, {minutes} min of runs to judge"
    ]


def _further_scenes(spec: StudySpec, best: Candidate) -> int:
    """Number of scenes that the next look of an extendable study adds; 0 where no look would settle it."""
    evidence = best.evidence
    needed = None if evidence is None else scenes_to_settle(evidence)
    if evidence is None or needed is None or needed > max(LOOKS) or not spec.extendable:
        return 0
    further = [count for count in LOOKS if count > evidence.all_scenes]
    return further[0] - evidence.all_scenes if further else 0


def _extend_command(scenes_more: int) -> str:
    """The command that judges on further scenes."""
    return f"dynslam-bench tune extend STUDY.toml --scenes {scenes_more}"


def next_step(
    spec: StudySpec, summary: StudySummary, baseline: Configuration, best: Configuration
) -> tuple[str, str]:
    """The next step after a study: a sentence, and the command that does it.

    Args:
        spec: The study.
        summary: What came out of it.
        baseline: What ratios are to.
        best: The best trial's tracker and settings; the baseline's where there is none.
    """
    # paths are those in the study's folder
    run_best = f"dynslam-bench run {shlex.quote(best.tracker)} SEQUENCE --settings best.toml"
    candidate = summary.best
    if summary.keeps_default:
        command = f"dynslam-bench run {shlex.quote(spec.tracker)} SEQUENCE"
        return "Keep the default settings: they are as good as the best trial.", command
    if summary.is_to_use and candidate is not None:
        return f"Use the settings of trial {candidate.trial}.", run_best

    evidence = None if candidate is None else candidate.evidence
    if (
        summary.verdict is ComparisonVerdict.BUT_LOST
        and candidate is not None
        and evidence is not None
    ):
        scene = shlex.quote(evidence.losses[0]) if evidence.losses else "SEQUENCE"
        return (
            f"See where trial {candidate.trial} fails before you use it.",
            f"dynslam-bench run {shlex.quote(best.tracker)} {scene} --settings best.toml --snapshots",
        )
    if summary.verdict in (ComparisonVerdict.PROMISING, ComparisonVerdict.CANNOT_TELL):
        is_usable = candidate is not None and not candidate.failed and candidate.feasible
        step = _further_scenes(spec, candidate) if candidate is not None and is_usable else 0
        if step:
            return "Keep the baseline for now, and judge on more scenes.", _extend_command(step)
        return (
            "Keep the baseline for now. To learn more, name more held_out scenes in a new study.",
            "dynslam-bench tune run NEW_STUDY.toml",
        )
    preset = f" --settings {shlex.quote(spec.baseline)}" if spec.baseline.endswith(".toml") else ""
    command = f"dynslam-bench run {shlex.quote(baseline.tracker)} SEQUENCE{preset}"
    return "Keep the baseline.", command


def families_sentence(design: Design) -> str:
    """A sentence on the families that a study judges on, and on whether its trials saw other scenes of them."""
    judging = _families(design.judging)
    tuned = _tuned_families(design)
    names = f"{len(judging)} famil{'y' if len(judging) == 1 else 'ies'} ({', '.join(judging[:8])})"
    if set(judging) <= set(tuned):
        return f"It was judged on {names}, of which trials saw other scenes, and says nothing of others"
    # with enough families that no trial saw their means speak of others
    unseen = len(set(judging) - set(tuned))
    nothing = "" if unseen >= FEWEST else ", and says nothing of others"
    if unseen == len(judging):
        return f"It was judged on {names} that no trial saw{nothing}"
    return f"It was judged on {names}, of some of which trials saw other scenes{nothing}"


def beyond_families(
    comparison: PairedRatio, ratios: Mapping[str, float], design: Design
) -> PairedRatio | None:
    """Comparison by the judging families that no trial saw: each counts once, by the mean of its scenes.

    Scenes that a side lost take no part in the means; a family of which one side alone lost half of the scenes or
    more is lost by it.

    Args:
        comparison: The comparison over all judging scenes.
        ratios: Natural log of the error ratio by scene.
        design: The study's design: which instances it runs on, and what for.

    Returns:
        None for fewer than `FEWEST` such families.
    """
    # the scenes of each family that no trial saw
    tuned = _tuned_families(design)
    members: dict[str, list[str]] = {}
    for scene, instances in scenes(design.judging).items():
        family = family_of(instances[0].sequence)
        if family not in tuned and scene in ratios:
            members.setdefault(family, []).append(scene)
    if len(members) < FEWEST:
        return None

    # its mean where both succeed, and whether a side lost it
    by_candidate = {*comparison.lost, *comparison.lost_both}
    by_baseline = {*comparison.lost_baseline, *comparison.lost_both}
    means = {}
    lost = []
    lost_by_baseline = []
    for family, names in members.items():
        # ratios of the scenes that both have tracked
        of_both = [ratios[name] for name in names if name not in by_candidate | by_baseline]
        means[family] = fmean(of_both) if of_both else 0.0
        lost += [family] * (2 * len(by_candidate.intersection(names)) >= len(names))
        lost_by_baseline += [family] * (2 * len(by_baseline.intersection(names)) >= len(names))
    return paired_ratio(
        means, lost, lost_by_baseline, one_sided=comparison.one_sided, what=comparison.what
    )


def _tuned_families(design: Design) -> list[str]:
    return _families([*design.tune, *(design.confirm if design.held_out else ())])


def _families(instances: Sequence[ProblemInstance]) -> list[str]:
    return list(dict.fromkeys(family_of(instance.sequence) for instance in instances))


# Running the best trials again.


def finish(
    tuner: Study,
    on_note: Callable[[str], None] | None = None,
    *,
    jobs: int = 1,
    trial: int | None = None,
) -> StudySummary:
    """Judge the best trial on scenes that it was not chosen on; write preset and summary.

    Where a study has both `confirm` and held-out instances, the best `top` trials are ranked on `confirm`
    by their mean log ratio, those that fulfil the constraints first. Else the trials' own values rank
    them, and the instances there are judge. Ranking needs no significance: a wrong choice costs power,
    never a false claim, since other scenes judge.

    Args:
        tuner: A study with finished trials.
        on_note: Called with a line on every step.
        jobs: Runs at a time.
        trial: The number of a trial to be judged in place of the best, e.g. one of the front.

    Returns:
        The summary; `best.toml` and `summary.json` lie in the study's folder.

    Raises:
        StudyError: No trial has finished, or the baseline fails.
    """
    spec = tuner.spec
    design = tuner.design
    note = on_note or (lambda _: None)
    shipped = dict[str, PairedRatio]()

    # candidates, ranked; there is nothing to choose or judge where no setting changes anything
    candidates = _best_trials(tuner) if trial is None else [_named_trial(tuner, trial)]
    inert = without_effect(tuner)
    chooses = bool(design.confirm and design.held_out)
    if candidates and chooses and not inert:
        note(
            f"the baseline and {len(candidates)} trials on {len(design.confirm)} instances to choose on"
        )
        candidates = _run_again(tuner, "confirm", candidates, jobs, shipped)
        candidates.sort(key=_rank_by_choice)
    else:
        candidates = candidates[:1]

    # the best one is judged, once on the same scenes
    _check_same_look(tuner, candidates)
    if candidates and design.judging and not candidates[0].failed and not inert:
        split = "held_out" if design.held_out else "confirm"
        note(f"trial {candidates[0].trial} on {len(design.judging)} instances that judge it")
        candidates[:1] = _run_again(tuner, split, candidates[:1], jobs, shipped)
        if not candidates[0].failed:
            candidates[:1] = _run_again(tuner, "recorded", candidates[:1], jobs, shipped)

    # what that says
    trials = [ratios for number, ratios in scene_ratios(tuner.study).items() if number > 0]
    failed = tuner.study.get_trials(states=(TrialState.FAIL,))
    verdict, conclusion = conclude(
        spec,
        candidates,
        trials,
        shipped=shipped.get("held_out" if design.held_out else "confirm"),
        failures=[trial.user_attrs.get("reason", "") for trial in failed],
        families=families_sentence(design) if design.judging else "",
        inert=inert,
    )
    summary = StudySummary(
        name=spec.name,
        tracker=spec.tracker,
        baseline=spec.baseline or "default settings",
        protocol=hold_last_pose_protocol(spec.protocol).describe(),
        trials=count_states(tuner.study),
        candidates=candidates,
        verdict=verdict,
        conclusion=conclusion,
        shipped=shipped,
        importances=importances(tuner.study),
        confirm=list(map(str, design.confirm)),
        held_out=list(map(str, design.held_out)),
        recorded=list(map(str, design.recorded)),
        tune=list(map(str, design.tune)),
        seen=splits_seen(tuner.defaults, design),
    )
    _write(tuner, summary)
    return summary


def _best_trials(tuner: Study) -> list[Candidate]:
    """The best trials with other settings than the baseline's, as far as the study asks for them.

    Raises:
        StudyError: No trial has finished.
    """
    spec = tuner.spec
    finished = best_trials(tuner.study, spec.top + 1)
    if not finished:
        raise StudyError(
            f"study '{spec.name}' has no finished trial",
            "run it first, or see why its trials failed",
        )
    # beside another tracker trial 0, the default settings, is a candidate too
    is_rival = tuner.baseline.tracker != spec.tracker
    candidates = [_candidate(tuner, trial) for trial in finished if trial.number > 0 or is_rival]
    return candidates[: spec.top]


def without_effect(tuner: Study) -> int:
    """Number of trials with other settings than trial 0, where all of them gave its trajectories to the last bit.

    Such settings change nothing: a program may ignore them. 0 where a trial gave another trajectory,
    or there is none to compare.
    """
    finished = tuner.study.get_trials(
        deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED)
    )
    first = next((trial for trial in finished if trial.number == 0), None)
    if first is None:
        return 0
    baseline = _runs_of(first)
    compared = 0
    for trial in finished:
        if trial.params == first.params:
            continue
        runs = {name: run for name, run in _runs_of(trial).items() if name in baseline}
        for name, run in runs.items():
            if not (run and baseline[name]):
                return 0
            tracks = _tracks(tuner, run)
            # a run that is no longer stored has nothing to compare
            if not tracks or tracks != _tracks(tuner, baseline[name]):
                return 0
        compared += bool(runs)
    return compared


def _runs_of(trial: FrozenTrial) -> dict[str, str]:
    """The id of a trial's run on each instance."""
    return {str(row[0]): str(row[1]) for row in trial.user_attrs.get("instances", ())}


def _tracks(tuner: Study, run: str) -> list[bytes]:
    """The files of a run's trajectories; none for a run that is not stored."""
    if not is_id(run):
        return []
    folder = tuner.store.folder(run)
    return [file.read_bytes() for file in sorted(folder.glob("trajectory_*.txt"))]


def _named_trial(tuner: Study, number: int) -> Candidate:
    """The candidate that a user has chosen.

    Raises:
        StudyError: There is no complete trial of that number, or it has the baseline's settings.
    """
    complete = {
        trial.number: trial for trial in tuner.study.get_trials(states=(TrialState.COMPLETE,))
    }
    if number not in complete or EARLIER in complete[number].user_attrs:
        raise StudyError(
            f"study '{tuner.spec.name}' has no complete trial {number}", "see tune status"
        )
    if number == 0 and tuner.baseline.tracker == tuner.spec.tracker:
        raise StudyError("trial 0 has the baseline's settings", "choose another one")
    return _candidate(tuner, complete[number])


def _candidate(tuner: Study, trial: FrozenTrial) -> Candidate:
    """A trial as a candidate that nothing has judged yet."""
    spec = tuner.spec
    return Candidate(
        trial=trial.number,
        params=trial.params,
        values=list(trial.values or ()),
        ate_margin=spec.ate_margin if spec.at_equal_accuracy else None,
    )


def _check_same_look(tuner: Study, candidates: Sequence[Candidate]) -> None:
    """Refuse to judge another trial on scenes that have judged one: the best of several looks claims too often.

    Raises:
        StudyError: The study has a verdict on another trial.
    """
    file = tuner.folder / SUMMARY_FILE
    earlier = StudySummary.read(file).best if file.is_file() else None
    if earlier is None or earlier.evidence is None or not candidates:
        return
    has_judged = earlier.evidence.all_scenes >= FEWEST
    if has_judged and earlier.trial != candidates[0].trial:
        raise StudyError(
            f"study '{tuner.spec.name}' has its verdict on trial {earlier.trial}; trial {candidates[0].trial} would be "
            "judged on the same scenes",
            f'begin a new study with other held-out scenes and start = ["{tuner.folder}"]',
        )


def _rank_by_choice(candidate: Candidate) -> tuple[bool, bool, float]:
    """Sort key: candidates that ran and fulfil the constraints first, then by value on the instances of the choice."""
    value = math.inf if candidate.choice is None else candidate.choice
    return bool(candidate.failed), not candidate.feasible, value


def _run_again(
    tuner: Study,
    split: str,
    candidates: Sequence[Candidate],
    jobs: int,
    shipped: dict[str, PairedRatio],
) -> list[Candidate]:
    """Candidates beside the baseline on the instances of a split; `shipped` gains the shipped default's ratio there.

    Raises:
        StudyError: The baseline fails.
    """
    instances: tuple[ProblemInstance, ...] = getattr(tuner.design, split)
    if not instances or not candidates:
        return list(candidates)
    objective = ACCURACY if split == "recorded" else combined_objective(tuner.objectives)
    level = (
        tuner.spec.level(len(scenes(tuner.design.judging))) if split != "recorded" else ONE_SIDED
    )
    tuned = [tuner.configuration(candidate.params) for candidate in candidates]
    default = [] if tuner.default_configuration is None else [tuner.default_configuration]
    baseline, runs = tuner.evaluate_beside([*tuned, *default], instances, jobs=jobs)
    if default and not isinstance(outcomes := runs.pop(), InstanceFailedError):
        shipped[split] = compare(outcomes, baseline, objective=objective, one_sided=level)
    return [
        _judged_on(tuner, split, candidate, outcomes, baseline, level)
        for candidate, outcomes in zip(candidates, runs, strict=True)
    ]


def _judged_on(
    tuner: Study,
    split: str,
    candidate: Candidate,
    outcomes: Outcomes | InstanceFailedError,
    baseline: Outcomes,
    level: float,
) -> Candidate:
    """A candidate with what its runs on a split came to."""
    if isinstance(outcomes, InstanceFailedError):
        return candidate.model_copy(update={"failed": str(outcomes), "feasible": False})
    objective = ACCURACY if split == "recorded" else combined_objective(tuner.objectives)
    update: dict[str, Any] = {
        split: compare(outcomes, baseline, objective=objective, one_sided=level)
    }
    if split == "recorded":
        return candidate.model_copy(update=update)
    update[f"on_{split}"] = {
        single.name: compare(outcomes, baseline, objective=single, one_sided=level)
        for single in (ACCURACY, SPEED)
    }
    violated = tuner.violations(outcomes)
    update["feasible"] = candidate.feasible and max(violated.values(), default=0.0) <= 0.0
    if tuner.design.judging == getattr(tuner.design, split):
        ratios = objective.ratios(outcomes, baseline)
        update["beyond"] = beyond_families(update[split], ratios, tuner.design)
        update["scene_errors"] = _scene_errors(outcomes, baseline)
    if split == "confirm":
        update["choice"] = objective.value(outcomes, baseline)
    both = (*outcomes.values(), *baseline.values())
    update["crashes"] = [run.crash for run in both if run.crash]
    wall_s = sum(run.wall_s for run in both)
    update["scene_s"] = wall_s / len(scenes(outcomes))
    return candidate.model_copy(update=update)


def _scene_errors(outcomes: Outcomes, baseline: Outcomes) -> list[SceneErrors]:
    """The errors of a candidate beside the baseline's, scene by scene."""
    errors_m = scene_errors_m(outcomes)
    baseline_m = scene_errors_m(baseline)
    lost = lost_scenes(outcomes)
    lost_by_baseline = lost_scenes(baseline)
    return [
        SceneErrors(
            scene=scene,
            baseline_m=baseline_m[scene],
            candidate_m=error_m,
            lost_by_baseline=scene in lost_by_baseline,
            lost=scene in lost,
        )
        for scene, error_m in errors_m.items()
        if scene in baseline_m
    ]


def _write(tuner: Study, summary: StudySummary) -> None:
    """Write `best.toml` and `summary.json` into the study's folder."""
    params = summary.best.params if summary.best else {}
    preset = preset_text(
        tuner.spec,
        summary.offered,
        " ".join(filter(None, (summary.conclusion, seen_note(summary.seen)))),
        status=summary.verdict.value,
        tuned_on=[*summary.tune, *(summary.confirm if summary.held_out else [])],
        judged_on=[*(summary.held_out or summary.confirm), *summary.recorded],
        not_offered={} if summary.offered else params,
    )
    write_atomic(tuner.folder / "best.toml", preset)
    write_atomic(tuner.folder / SUMMARY_FILE, summary.to_json())


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
    status: str = NOT_JUDGED,
    tuned_on: Sequence[str] = (),
    judged_on: Sequence[str] = (),
    not_offered: Mapping[str, Any] | None = None,
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
        not_offered: Settings of the best trial where the verdict recommends none: comments.
    """
    fixed = spec.space.fixed
    remarks = [remark]
    if tuned_on:
        remarks.append(f"Tuned on {_listed(tuned_on)}.")
    if judged_on:
        remarks.append(f"Judged on {_listed(judged_on)}.")
    if fixed:
        names = ", ".join(_lines(fixed))
        remarks.append(f"Fixed in that study, not part of these settings: {names}.")
    if not_offered:
        names = ", ".join(_lines(not_offered))
        remarks.append(f"The best trial's settings, which are no result to use: {names}.")
    comments = [f"# {line}" for text in remarks for line in textwrap.wrap(text, 100)]
    settings = {
        name: value for name, value in {**held_settings(spec), **tuned}.items() if name not in fixed
    }
    # of a study with a choice of trackers: the settings that the chosen one has
    tracker = str(settings.pop(TRACKER, spec.tracker))
    if TRACKER in tuned:
        settings = known_settings(tracker, settings)
    head = [
        f"# settings of {tracker}",
        *comments,
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
