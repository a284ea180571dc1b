"""After the trials: the best are judged on unseen instances, one is chosen, checked on held-out ones and written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from optuna.trial import FrozenTrial

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import write_atomic
from dynslam_bench.tuning.evaluate import InstanceFailedError, held_protocol
from dynslam_bench.tuning.objectives import ACCURACY, SPEED, Outcomes, together, violations
from dynslam_bench.tuning.presets import write_presets
from dynslam_bench.tuning.splits import splits_seen
from dynslam_bench.tuning.study_file import StudySpec
from dynslam_bench.tuning.summary import PICKS, Candidate, Ratio, StudySummary, choose, compared, conclude, pick
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
