"""After the trials: the best are judged on unseen instances, one is chosen, checked on held-out ones and kept."""

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
from dynslam_bench.tuning.evaluate import InstanceFailedError, held_protocol
from dynslam_bench.tuning.objectives import ACCURACY, SPEED, Outcomes, together, violations
from dynslam_bench.tuning.splits import seen_note, splits_seen
from dynslam_bench.tuning.storage import study_folder
from dynslam_bench.tuning.study_file import StudySpec
from dynslam_bench.tuning.summary import PICKS, Candidate, Ratio, StudySummary, choose, compared, conclude, pick, worth
from dynslam_bench.tuning.trials import best_trials, count_states, importances
from dynslam_bench.tuning.tuner import Tuner


def finish(tuner: Tuner, on_note: Callable[[str], None] | None = None, *, jobs: int = 1) -> StudySummary:
    """Judge the best trials on the `confirm` instances, choose one or the default, check it, write preset and summary.

    The choice has the smallest upper confidence bound of its ratio to the default on `confirm`, allowing for the number
    of candidates; where no bound lies below 1, it is the default. The held-out split and the recordings only judge.

    Args:
        tuner: A study with finished trials.
        on_note: Called with a line on every step.
        jobs: Runs at a time.

    Returns:
        The summary; `best.toml` and `summary.json` lie in the study's folder.

    Raises:
        StudyError: No trial has finished.
    """
    spec, design = tuner.spec, tuner.design
    note = on_note or (lambda _: None)
    finished = best_trials(tuner.study, spec.top + 1)
    if not finished:
        raise StudyError(f"study '{spec.name}' has no finished trial", "run it first, or see why its trials failed")
    best = [trial for trial in finished if trial.number > 0][: spec.top]
    candidates = []
    if best:
        numbers = " and ".join(str(trial.number) for trial in best)
        note(
            f"the default and trial{'s' * (len(best) > 1)} {numbers} on {len(design.confirm)} instances that no trial "
            "has seen"
        )
        settings = [spec.space.fixed, *map(tuner.settings_of, best)]
        default, *repeated = tuner.evaluate_beside(settings, design.confirm, jobs=jobs)
        if isinstance(default, InstanceFailedError):
            raise default
        candidates = [
            _confirm(tuner, trial, outcomes, default, len(best)) for trial, outcomes in zip(best, repeated, strict=True)
        ]
    chosen = choose(candidates)
    picks = _picks(spec, candidates, chosen)
    for place, candidate in enumerate(candidates):
        if candidate.trial in picks.values():
            note(f"trial {candidate.trial} on the held-out instances")
            candidates[place] = _judge(tuner, candidate, jobs)
    number = None if chosen is None else chosen.trial
    candidates.sort(key=lambda candidate: candidate.trial != number)
    notes = list(design.notes)
    summary = StudySummary(
        name=spec.name,
        tracker=spec.tracker,
        protocol=held_protocol(spec.protocol).describe(),
        trials=count_states(tuner.study),
        candidates=candidates,
        chosen=number,
        improves=number is not None and candidates[0].is_confirmed and not notes,
        conclusion=conclude(candidates, number, notes),
        split_notes=notes,
        importances=importances(tuner.study),
        confirm=list(map(str, design.confirm)),
        held_out=list(map(str, design.held_out)),
        recorded=list(map(str, design.recorded)),
        tune=list(map(str, design.tune)),
        picks=picks,
        seen=splits_seen(tuner.defaults, design),
    )
    write_presets(tuner, summary)
    write_atomic(tuner.folder / "summary.json", summary.to_json())
    return summary


def _confirm(
    tuner: Tuner, trial: FrozenTrial, outcomes: Outcomes | InstanceFailedError, default: Outcomes, candidates: int
) -> Candidate:
    """A trial's settings on the instances for the choice, of several candidates."""
    candidate = Candidate(trial=trial.number, params=trial.params, values=list(trial.values))
    if isinstance(outcomes, InstanceFailedError):
        return candidate.model_copy(update={"failed": str(outcomes), "feasible": False})
    return candidate.model_copy(
        update={
            "confirm": compared(outcomes, default, objective=together(tuner.objectives), candidates=candidates),
            "on_confirm": _accuracy_and_speed(outcomes, default),
            "ate_margin": tuner.spec.ate_margin if tuner.spec.at_equal_accuracy else None,
            "frame_ms": _frame_ms(outcomes),
            "default_frame_ms": _frame_ms(default),
            "feasible": all(value <= 0 for value in violations(tuner.spec, outcomes).values()),
        }
    )


def _judge(tuner: Tuner, candidate: Candidate, jobs: int) -> Candidate:
    """The candidate on the held-out instances and on recordings."""
    fixed, update = tuner.spec.space.fixed, dict[str, Any]()
    for split, instances in (("held_out", tuner.design.held_out), ("recorded", tuner.design.recorded)):
        if not instances:
            continue
        default, tuned = tuner.evaluate_beside([fixed, {**fixed, **candidate.params}], instances, jobs=jobs)
        if isinstance(default, InstanceFailedError) or isinstance(tuned, InstanceFailedError):
            error = default if isinstance(default, InstanceFailedError) else tuned
            return candidate.model_copy(update={"failed": str(error), "feasible": False})
        objective = ACCURACY if split == "recorded" else together(tuner.objectives)
        update[split] = compared(tuned, default, objective=objective)
        if split == "held_out":
            update["on_held_out"] = _accuracy_and_speed(tuned, default)
    return candidate.model_copy(update=update)


def _accuracy_and_speed(outcomes: Outcomes, default: Outcomes) -> dict[str, Ratio]:
    return {objective.name: compared(outcomes, default, objective=objective) for objective in (ACCURACY, SPEED)}


def _picks(spec: StudySpec, candidates: Sequence[Candidate], chosen: Candidate | None) -> dict[str, int | None]:
    """Which trial is which preset: of a study of several objectives three, else the choice alone."""
    picks = {"best": chosen}
    if len(spec.objectives) > 1:
        feasible = [candidate for candidate in candidates if candidate.feasible and candidate.confirm is not None]
        picks |= {name: pick(name, feasible, spec.ate_margin) for name in PICKS}
    return {name: None if candidate is None else candidate.trial for name, candidate in picks.items()}


def _frame_ms(outcomes: Outcomes) -> float:
    return 1e3 * float(np.mean([outcome.frame_s for outcome in outcomes.values()]))


def write_presets(tuner: Tuner, summary: StudySummary) -> None:
    """Write every pick as a preset: tuned settings alone, with what they are worth and where that was seen."""
    spec = tuner.spec
    for name, number in summary.picks.items():
        candidate = next((one for one in summary.candidates if one.trial == number), None)
        remark = summary.conclusion if name == "best" else worth(name, candidate, summary.split_notes)
        text = preset_text(
            {} if candidate is None else candidate.params,
            spec.tracker,
            " ".join(filter(None, (remark, seen_note(summary.seen)))),
            fixed=spec.space.fixed,
            tuned_on=[*summary.tune, *summary.confirm],
            judged_on=[*summary.held_out, *summary.recorded] if candidate is not None else (),
        )
        write_atomic(tuner.folder / f"{name}.toml", text)


def read_preset_text(spec: StudySpec, results: Path | str = "results", pick: str = "best") -> str:
    """A preset of a study, as text; of one that is not finished the best trial so far.

    Args:
        spec: The study.
        results: The results folder.
        pick: ``best``; of a study of several objectives ``fast``, ``balanced`` and ``accurate``, too.

    Raises:
        StudyError: There is no such study or preset.
    """
    folder = study_folder(Path(results), spec)
    if (folder / "summary.json").is_file():
        picks = list(StudySummary.read(folder / "summary.json").picks) or ["best"]
        if pick not in picks:
            hint = did_you_mean(pick, picks) if len(picks) > 1 else 'objectives = ["accuracy", "speed"] make three'
            raise StudyError(f"study '{spec.name}' has no preset '{pick}'", hint)
        return read_text(folder / f"{pick}.toml", kind=StudyError)
    if pick != "best":
        raise StudyError(f"study '{spec.name}' is not finished: no presets yet", "dynslam-bench tune run STUDY.toml")
    best = best_trials(Tuner(spec, results, reading=True).study, 1)
    if not best:
        raise StudyError(f"study '{spec.name}' has no finished trial", "dynslam-bench tune run STUDY.toml")
    remark = f"Trial {best[0].number}, the best so far; not judged on instances that no trial has seen."
    return preset_text(best[0].params, spec.tracker, remark, fixed=spec.space.fixed)


# The text of a preset.


def preset_text(
    tuned: Mapping[str, Any],
    tracker: str,
    remark: str,
    *,
    fixed: Mapping[str, Any] | None = None,
    tuned_on: Sequence[str] = (),
    judged_on: Sequence[str] = (),
) -> str:
    """TOML text of tuned settings, a dotted name and its value a line.

    What a study had fixed, for example the source of its masks, is only a comment, so that the preset runs wherever
    the tracker does.

    Args:
        tuned: The tuned settings; empty for the default.
        tracker: For which tracker.
        remark: A line on what they are worth.
        fixed: What every run of the study had besides.
        tuned_on: Instances that trials and choice saw.
        judged_on: Instances that judged.
    """
    remarks = [remark]
    if tuned_on:
        remarks.append(f"Tuned on {_listed(tuned_on)}.")
    if judged_on:
        remarks.append(f"Judged on {_listed(judged_on)}.")
    if fixed:
        remarks.append(f"Fixed in that study, not part of these settings: {', '.join(_lines(fixed))}.")
    head = [f"settings of {tracker}", *(line for text in remarks for line in textwrap.wrap(text, 100))]
    return "\n".join([*(f"# {line}" for line in head), "", *_lines(tuned), ""])


def _lines(settings: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {json.dumps(value)}" for name, value in sorted(settings.items())]


def _listed(instances: Sequence[str]) -> str:
    """Instances by their sequences, with their number."""
    names = list(dict.fromkeys(re.sub(r"[?&](?!scene=)[^?&]*", "", text) for text in instances))
    shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return f"{len(instances)} instance{'s' * (len(instances) != 1)} of {shown}"
