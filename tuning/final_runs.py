"""After the trials: the best judged again on instances that none has seen, the choice, the held-out check, the preset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import write_atomic
from dynslam_bench.tuning.evaluate import InstanceFailedError, held_protocol
from dynslam_bench.tuning.objectives import ACCURACY, SPEED, Objective, Outcomes, together, violations
from dynslam_bench.tuning.presets import write_presets
from dynslam_bench.tuning.splits import splits_seen
from dynslam_bench.tuning.study_file import StudySpec
from dynslam_bench.tuning.summary import PICKS, Candidate, Ratio, StudySummary, choose, compared, conclude, pick
from dynslam_bench.tuning.trials import best_trials, count_states, importances, inert_parameters
from dynslam_bench.tuning.tuner import Tuner


def finish(tuner: Tuner, on_note: Callable[[str], None] | None = None, *, jobs: int = 1) -> StudySummary:
    """Judge the best trials on the `confirm` instances, choose one or the default, check it, write preset and summary.

    The choice has the smallest upper confidence bound of its ratio to the default on `confirm`, allowing for the number
    of candidates; where no bound lies below 1, it is the default. The held-out split and the recordings only judge.

    Args:
        tuner: A study with finished trials.
        on_note: Told what is going on.
        jobs: Runs at a time.

    Returns:
        The summary; `best.toml` and `summary.json` lie in the study's folder.

    Raises:
        StudyError: No trial has finished.
    """
    spec, design = tuner.spec, tuner.design
    note = on_note or (lambda _: None)
    best = [trial for trial in best_trials(tuner.study, spec.top + 1) if trial.number > 0][: spec.top]
    if not best_trials(tuner.study, 1):
        raise StudyError(f"study '{spec.name}' has no finished trial", "run it first, or see why its trials failed")
    candidates = []
    if best:
        note(f"the default and {_named(best)} on {len(design.confirm)} instances that no trial has seen")
        default, *again = tuner.evaluate_beside(
            [spec.space.fixed, *map(tuner.settings_of, best)], design.confirm, jobs=jobs
        )
        if isinstance(default, InstanceFailedError):
            raise default
        candidates = [
            _confirmed(tuner, trial, found, default, len(best)) for trial, found in zip(best, again, strict=True)
        ]
    chosen = choose(candidates)
    picks = _picks(spec, candidates, chosen)
    for trial_number in dict.fromkeys(number for number in picks.values() if number is not None):
        note(f"trial {trial_number} on the held-out instances")
        place = next(index for index, each in enumerate(candidates) if each.trial == trial_number)
        candidates[place] = _judged(tuner, candidates[place], jobs)
    if chosen is not None:
        chosen = next(each for each in candidates if each.trial == chosen.trial)
        candidates = [chosen, *(each for each in candidates if each is not chosen)]
    summary = _summary(tuner, candidates, chosen, picks)
    write_presets(tuner, summary)
    write_atomic(tuner.folder / "summary.json", summary.to_json())
    return summary


def _summary(
    tuner: Tuner, candidates: list[Candidate], chosen: Candidate | None, picks: dict[str, int | None]
) -> StudySummary:
    """What came out of the study."""
    spec, design, notes = tuner.spec, tuner.design, list(tuner.design.notes)
    names = [parameter.name for parameter in tuner.space]
    finished = tuner.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    return StudySummary(
        name=spec.name,
        tracker=spec.tracker,
        protocol=held_protocol(spec.protocol).describe(),
        trials=count_states(tuner.study),
        candidates=candidates,
        chosen=None if chosen is None else chosen.trial,
        improves=chosen is not None and chosen.is_confirmed and not notes,
        conclusion=conclude(candidates, None if chosen is None else chosen.trial, notes),
        split_notes=notes,
        importances=importances(tuner.study, names),
        inert=inert_parameters(finished, names),
        confirm=[str(instance) for instance in design.confirm],
        held_out=[str(instance) for instance in design.held_out],
        recorded=[str(instance) for instance in design.recorded],
        tune=[str(instance) for instance in design.race],
        picks=picks,
        seen=splits_seen(tuner.defaults, design),
    )


def _named(trials: Sequence[FrozenTrial]) -> str:
    return f"trial{'s' * (len(trials) > 1)} {' and '.join(str(trial.number) for trial in trials)}"


def _confirmed(
    tuner: Tuner, trial: FrozenTrial, again: Outcomes | InstanceFailedError, default: Outcomes, candidates: int
) -> Candidate:
    """A trial's settings on the instances for the choice, of several candidates."""
    candidate = Candidate(trial=trial.number, params=trial.params, values=list(trial.values))
    if isinstance(again, InstanceFailedError):
        return candidate.model_copy(update={"failed": str(again), "feasible": False})
    found = {
        "confirm": compared(again, default, objective=together(tuner.objectives), candidates=candidates),
        "on_confirm": _beside(again, default),
        "ate_margin": tuner.spec.ate_margin if tuner.spec.at_equal_accuracy else None,
        "frame_ms": _frame_ms(again),
        "default_frame_ms": _frame_ms(default),
        "feasible": all(value <= 0 for value in violations(tuner.spec, again).values()),
    }
    return candidate.model_copy(update=found)


def _judged(tuner: Tuner, chosen: Candidate, jobs: int) -> Candidate:
    """The choice on the held-out instances and on recordings."""
    fixed, found = tuner.spec.space.fixed, dict[str, Any]()
    for split, instances in (("held_out", tuner.design.held_out), ("recorded", tuner.design.recorded)):
        if not instances:
            continue
        default, tuned = tuner.evaluate_beside([fixed, {**fixed, **chosen.params}], instances, jobs=jobs)
        for each in (default, tuned):
            if isinstance(each, InstanceFailedError):
                return chosen.model_copy(update={"failed": str(each), "feasible": False})
        assert not isinstance(default, InstanceFailedError) and not isinstance(tuned, InstanceFailedError)
        after: Objective = ACCURACY if split == "recorded" else together(tuner.objectives)
        found[split] = compared(tuned, default, objective=after)
        found |= {"on_held_out": _beside(tuned, default)} if split == "held_out" else {}
    return chosen.model_copy(update=found)


def _beside(outcomes: Outcomes, default: Outcomes) -> dict[str, Ratio]:
    """Accuracy and speed, whatever the study is after."""
    return {each.name: compared(outcomes, default, objective=each) for each in (ACCURACY, SPEED)}


def _picks(spec: StudySpec, candidates: Sequence[Candidate], chosen: Candidate | None) -> dict[str, int | None]:
    """Which trial is which preset: of a study of several objectives three, else the choice alone."""
    best = {"best": None if chosen is None else chosen.trial}
    if len(spec.objectives) == 1:
        return best
    known = [each for each in candidates if each.feasible and each.confirm is not None]
    found = {name: pick(name, known, spec.ate_margin) for name in PICKS}
    return best | {name: None if each is None else each.trial for name, each in found.items()}


def _frame_ms(outcomes: Outcomes) -> float:
    return 1e3 * float(np.mean([outcome.frame_s for outcome in outcomes.values()]))
