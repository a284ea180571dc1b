"""After the trials: the best are judged on unseen instances, the best of them on held-out ones and kept as a preset."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from optuna.trial import FrozenTrial

from dynslam_bench.core.errors import StudyError, did_you_mean
from dynslam_bench.core.reading import read_text
from dynslam_bench.core.records import write_atomic
from dynslam_bench.tuning.evaluate import Configuration, InstanceFailedError, held_protocol
from dynslam_bench.tuning.instances import ProblemInstance
from dynslam_bench.tuning.objectives import ACCURACY, SPEED, Outcomes, spread_test, together, violations
from dynslam_bench.tuning.plan import Plan
from dynslam_bench.tuning.splits import seen_note, splits_seen
from dynslam_bench.tuning.storage import study_folder
from dynslam_bench.tuning.study_file import StudySpec
from dynslam_bench.tuning.summary import (
    PICKS,
    Candidate,
    Ratio,
    StudySummary,
    Verdict,
    compared,
    judge,
    pick,
    worth,
)
from dynslam_bench.tuning.trials import best_trials, count_states, importances, scene_ratios
from dynslam_bench.tuning.tuner import Tuner


def finish(tuner: Tuner, on_note: Callable[[str], None] | None = None, *, jobs: int = 1) -> StudySummary:
    """Judge the best trials on the `confirm` instances and the best of them on the others, write preset and summary.

    The best has the smallest upper confidence bound of its ratio to the baseline on `confirm`, allowing for the number
    of candidates; where that bound lies below 1 it is the choice. The held-out split and the recordings only judge.

    Args:
        tuner: A study with finished trials.
        on_note: Called with a line on every step.
        jobs: Runs at a time.

    Returns:
        The summary; `best.toml` and `summary.json` lie in the study's folder.

    Raises:
        StudyError: No trial has finished, or the baseline fails.
    """
    spec, design = tuner.spec, tuner.design
    note = on_note or (lambda _: None)
    finished = best_trials(tuner.study, spec.top + 1)
    if not finished:
        raise StudyError(f"study '{spec.name}' has no finished trial", "run it first, or see why its trials failed")
    is_rival = tuner.baseline.tracker != spec.tracker  # then trial 0, the default settings, is a candidate too
    best = [trial for trial in finished if trial.number > 0 or is_rival][: spec.top]
    candidates, shipped = [_candidate(trial) for trial in best], dict[str, Ratio]()
    if best and design.confirm:
        numbers = " and ".join(str(trial.number) for trial in best)
        note(
            f"the baseline and trial{'s' * (len(best) > 1)} {numbers} on {len(design.confirm)} instances that no trial "
            "has seen"
        )
        candidates, shipped = _confirm(tuner, best, jobs)
    candidates.sort(key=lambda candidate: (candidate.bound, bool(candidate.failed), not candidate.feasible))
    picks = _picks(spec, candidates)
    for place, candidate in enumerate(candidates):
        if design.confirm and not candidate.failed and (place == 0 or candidate.trial in picks.values()):
            note(f"trial {candidate.trial} on the held-out instances")
            candidates[place] = _judge(tuner, candidate, jobs, shipped)
    ratios = scene_ratios(tuner.study)
    p_value, notes = spread_test(list(ratios.values())), list(design.notes)
    verdict, conclusion = judge(candidates, p_value, notes)
    summary = StudySummary(
        name=spec.name,
        tracker=spec.tracker,
        baseline=spec.baseline or "default settings",
        protocol=held_protocol(spec.protocol).describe(),
        trials=count_states(tuner.study),
        candidates=candidates,
        verdict=verdict,
        conclusion=conclusion,
        p_value=p_value,
        shipped=shipped,
        split_notes=notes,
        importances=importances(tuner.study),
        confirm=list(map(str, design.confirm)),
        held_out=list(map(str, design.held_out)),
        recorded=list(map(str, design.recorded)),
        tune=list(map(str, design.tune)),
        picks=picks,
        seen=splits_seen(tuner.defaults, design),
    )
    for name, number in picks.items():
        write_atomic(tuner.folder / f"{name}.toml", _preset_of(tuner, summary, name, number))
    write_atomic(tuner.folder / "summary.json", summary.to_json())
    return summary


def _candidate(trial: FrozenTrial, **more: Any) -> Candidate:
    return Candidate(trial=trial.number, params=trial.params, values=list(trial.values or ()), **more)


def _beside(
    tuner: Tuner, settings: Sequence[Mapping[str, Any]], instances: Sequence[ProblemInstance], jobs: int
) -> tuple[Outcomes, list[Outcomes | InstanceFailedError], Outcomes | None]:
    """Outcomes of the baseline, of settings of the study's tracker, and of the shipped default if that is another.

    Raises:
        StudyError: The baseline fails.
    """
    configurations = [tuner.baseline, *(Configuration(tuner.spec.tracker, {**tuner.held, **one}) for one in settings)]
    configurations += [] if tuner.shipped is None else [tuner.shipped]
    baseline, *others = tuner.evaluate_beside(configurations, instances, jobs=jobs)
    if isinstance(baseline, InstanceFailedError):
        raise StudyError(f"the baseline fails: {baseline.args[0]}", "a study needs one that runs")
    shipped = None if tuner.shipped is None else others.pop()
    return baseline, list(others), None if isinstance(shipped, InstanceFailedError) else shipped


def _confirm(tuner: Tuner, trials: Sequence[FrozenTrial], jobs: int) -> tuple[list[Candidate], dict[str, Ratio]]:
    """Trials' settings on the instances for the choice, and the shipped default there if it is not the baseline."""
    baseline, repeated, shipped = _beside(tuner, [trial.params for trial in trials], tuner.design.confirm, jobs)
    objective, candidates = together(tuner.objectives), []
    for trial, outcomes in zip(trials, repeated, strict=True):
        if isinstance(outcomes, InstanceFailedError):
            candidates.append(_candidate(trial, failed=str(outcomes), feasible=False))
            continue
        candidates.append(
            _candidate(
                trial,
                confirm=compared(outcomes, baseline, objective=objective, candidates=len(trials)),
                on_confirm=_accuracy_and_speed(outcomes, baseline),
                ate_margin=tuner.spec.ate_margin if tuner.spec.at_equal_accuracy else None,
                frame_ms=_frame_ms(outcomes),
                baseline_frame_ms=_frame_ms(baseline),
                feasible=all(value <= 0 for value in violations(tuner.spec, outcomes).values()),
            )
        )
    return candidates, {} if shipped is None else {"confirm": compared(shipped, baseline, objective=objective)}


def _judge(tuner: Tuner, candidate: Candidate, jobs: int, shipped: dict[str, Ratio]) -> Candidate:
    """The candidate on the held-out instances and on recordings; `shipped` gains the shipped default's ratio there."""
    update: dict[str, Any] = {}
    for split, instances in (("held_out", tuner.design.held_out), ("recorded", tuner.design.recorded)):
        if not instances:
            continue
        baseline, (tuned,), default = _beside(tuner, [candidate.params], instances, jobs)
        if isinstance(tuned, InstanceFailedError):
            return candidate.model_copy(update={"failed": str(tuned), "feasible": False})
        objective = ACCURACY if split == "recorded" else together(tuner.objectives)
        update[split] = compared(tuned, baseline, objective=objective)
        if split == "held_out":
            update["on_held_out"] = _accuracy_and_speed(tuned, baseline)
        if default is not None:
            shipped[split] = compared(default, baseline, objective=objective)
    return candidate.model_copy(update=update)


def _accuracy_and_speed(outcomes: Outcomes, baseline: Outcomes) -> dict[str, Ratio]:
    return {objective.name: compared(outcomes, baseline, objective=objective) for objective in (ACCURACY, SPEED)}


def _picks(spec: StudySpec, candidates: Sequence[Candidate]) -> dict[str, int | None]:
    """Which trial is which preset: of a study of several objectives four, else the best alone."""
    picks = {"best": candidates[0] if candidates else None}
    if len(spec.objectives) > 1:
        feasible = [candidate for candidate in candidates if candidate.feasible and candidate.confirm is not None]
        picks |= {name: pick(name, feasible, spec.ate_margin) for name in PICKS}
    return {name: None if candidate is None else candidate.trial for name, candidate in picks.items()}


def _frame_ms(outcomes: Outcomes) -> float:
    return 1e3 * float(np.mean([outcome.frame_s for outcome in outcomes.values()]))


def _preset_of(tuner: Tuner, summary: StudySummary, name: str, number: int | None) -> str:
    """A pick as a preset: tuned settings with what they are worth and where that was seen."""
    candidate = next((one for one in summary.candidates if one.trial == number), None)
    remark = summary.conclusion if name == "best" else worth(name, candidate, summary.split_notes)
    return preset_text(
        tuner,
        {} if candidate is None else candidate.params,
        " ".join(filter(None, (remark, seen_note(summary.seen)))),
        status=summary.verdict.value if candidate is summary.best else Verdict.NOT_JUDGED.value,
        tuned_on=[*summary.tune, *summary.confirm],
        judged_on=[*summary.held_out, *summary.recorded] if candidate is not None else (),
    )


def read_preset_text(
    spec: StudySpec, results: Path | str = "results", pick: str = "best", trial: int | None = None
) -> str:
    """A preset of a study, as text; of one that is not finished the best trial so far.

    Args:
        spec: The study.
        results: The results folder.
        pick: ``best``; of a study of several objectives ``fast``, ``balanced`` and ``accurate``, too.
        trial: The number of a trial whose settings are asked for instead.

    Raises:
        StudyError: There is no such study, preset or trial.
    """
    folder = study_folder(Path(results), spec)
    if trial is None and (folder / "summary.json").is_file():
        picks = list(StudySummary.read(folder / "summary.json").picks)
        if pick not in picks:
            hint = did_you_mean(pick, picks) if len(picks) > 1 else 'objectives = ["accuracy", "speed"] make three'
            raise StudyError(f"study '{spec.name}' has no preset '{pick}'", hint)
        return read_text(folder / f"{pick}.toml", kind=StudyError)
    if pick != "best":
        raise StudyError(f"study '{spec.name}' is not finished: no presets yet", "dynslam-bench tune run STUDY.toml")
    tuner = Tuner(spec, results, reading=True)
    trials = best_trials(tuner.study, 1)
    if trial is not None:
        trials = [one for one in tuner.study.get_trials(deepcopy=False) if one.number == trial]
    if not trials:
        what = "finished trial" if trial is None else f"trial {trial}"
        raise StudyError(f"study '{spec.name}' has no {what}", "dynslam-bench tune status STUDY.toml")
    remark = f"Trial {trials[0].number}{', the best so far' * (trial is None)}; not judged on scenes that no trial saw."
    return preset_text(tuner, trials[0].params, remark)


# The text of a preset.


def preset_text(
    plan: Plan,
    tuned: Mapping[str, Any],
    remark: str,
    *,
    status: str = Verdict.NOT_JUDGED.value,
    tuned_on: Sequence[str] = (),
    judged_on: Sequence[str] = (),
) -> str:
    """TOML text of tuned settings: their status, then a dotted name and its value a line under ``[settings]``.

    The settings of a baseline that is a preset are among them. What a study had fixed, for example the source of its
    masks, is only a comment, so that the preset runs wherever the tracker does.

    Args:
        plan: The study.
        tuned: The tuned settings; empty for the baseline's.
        remark: A line on what they are worth.
        status: The verdict on them.
        tuned_on: Instances that trials and choice saw.
        judged_on: Instances that judged.
    """
    fixed = plan.spec.space.fixed
    remarks = [remark]
    if tuned_on:
        remarks.append(f"Tuned on {_listed(tuned_on)}.")
    if judged_on:
        remarks.append(f"Judged on {_listed(judged_on)}.")
    if fixed:
        remarks.append(f"Fixed in that study, not part of these settings: {', '.join(_lines(fixed))}.")
    head = [f"settings of {plan.spec.tracker}", *(line for text in remarks for line in textwrap.wrap(text, 100))]
    settings = {name: value for name, value in {**plan.held, **tuned}.items() if name not in fixed}
    return "\n".join(
        [*(f"# {line}" for line in head), "", f"status = {json.dumps(status)}", "", "[settings]", *_lines(settings), ""]
    )


def _lines(settings: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {json.dumps(value)}" for name, value in sorted(settings.items())]


def _listed(instances: Sequence[str]) -> str:
    """Instances by their sequences, with their number."""
    names = list(dict.fromkeys(re.sub(r"[?&](?!scene=)[^?&]*", "", text) for text in instances))
    shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return f"{len(instances)} instance{'s' * (len(instances) != 1)} of {shown}"
