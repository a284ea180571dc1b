"""After the trials: the best judged again on blocks that none has seen, the choice, the held-out check, the preset."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import write_atomic

from .constraints import violations
from .evaluate import BlockFailedError, held_protocol
from .importance import importances, inert_parameters
from .objectives import Outcomes
from .preset import preset_text
from .study import Tuner
from .summary import Candidate, StudySummary, choose, compared, conclude
from .trials import best_trials, count_states


def finish(tuner: Tuner, on_note: Callable[[str], None] | None = None, *, jobs: int = 1) -> StudySummary:
    """Judge the best trials on the `confirm` blocks, choose one or the default, check it, write preset and summary.

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
    note(f"the default settings on {len(design.confirm)} blocks that no trial has seen")
    default = tuner.evaluate(spec.space.fixed, design.confirm, jobs=jobs, cache=False) if best else {}
    candidates = []
    for trial in best:
        note(f"trial {trial.number} on the same blocks")
        candidates.append(_confirmed(tuner, trial, default, len(best), jobs))
    chosen = choose(candidates)
    if chosen is not None:
        note(f"trial {chosen.trial} on the held-out blocks")
        judged = _judged(tuner, chosen, jobs)
        candidates = [judged, *(candidate for candidate in candidates if candidate is not chosen)]
        chosen = judged
    names = [parameter.name for parameter in tuner.space]
    finished = tuner.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    notes = list(design.notes)
    summary = StudySummary(
        name=spec.name,
        tracker=spec.tracker,
        protocol=held_protocol(spec.protocol).describe(),
        trials=count_states(tuner.study),
        candidates=candidates,
        chosen=None if chosen is None else chosen.trial,
        improves=chosen is not None and chosen.holds_up and not notes,
        conclusion=conclude(candidates, None if chosen is None else chosen.trial, notes),
        split_notes=notes,
        importances=importances(tuner.study, names),
        inert=inert_parameters(finished, names),
        confirm=[str(block) for block in design.confirm],
        held_out=[str(block) for block in design.held_out],
        recorded=[str(block) for block in design.recorded],
        tune=[str(block) for block in design.race],
    )
    settings = {**spec.space.fixed, **(chosen.params if chosen is not None else {})}
    write_atomic(tuner.folder / "best.toml", preset_text(settings, spec.tracker, summary.conclusion))
    write_atomic(tuner.folder / "summary.json", summary.to_json())
    return summary


def _confirmed(tuner: Tuner, trial: FrozenTrial, default: Outcomes, candidates: int, jobs: int) -> Candidate:
    """A trial's settings on the blocks for the choice, without the stage cache, so that its times are its own."""
    candidate = Candidate(trial=trial.number, params=trial.params, values=list(trial.values))
    try:
        again = tuner.evaluate(tuner.settings_of(trial), tuner.design.confirm, jobs=jobs, cache=False)
    except BlockFailedError as error:
        return candidate.model_copy(update={"failed": str(error), "feasible": False})
    found = {
        "confirm": compared(again, default, objective=tuner.objectives[0], candidates=candidates),
        "frame_ms": _frame_ms(again),
        "default_frame_ms": _frame_ms(default),
        "feasible": all(value <= 0 for value in violations(tuner.spec, again).values()),
    }
    return candidate.model_copy(update=found)


def _judged(tuner: Tuner, chosen: Candidate, jobs: int) -> Candidate:
    """The choice on the held-out blocks and on recordings."""
    settings = {**tuner.spec.space.fixed, **chosen.params}
    found = {}
    try:
        for split, blocks in (("held_out", tuner.design.held_out), ("recorded", tuner.design.recorded)):
            if blocks:
                tuned = tuner.evaluate(settings, blocks, jobs=jobs, cache=False)
                default = tuner.evaluate(tuner.spec.space.fixed, blocks, jobs=jobs, cache=False)
                found[split] = compared(tuned, default, objective=tuner.objectives[0])
    except BlockFailedError as error:
        return chosen.model_copy(update={"failed": str(error), "feasible": False})
    return chosen.model_copy(update=found)


def _frame_ms(outcomes: Outcomes) -> float:
    return 1e3 * float(np.mean([outcome.frame_s for outcome in outcomes.values()]))
