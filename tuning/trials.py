"""Reading the trials of a study."""

from __future__ import annotations

import optuna
from optuna.trial import FrozenTrial, TrialState

from .blocks import Block, parse_blocks
from .objectives import Outcomes
from .samplers import is_feasible


def best_trials(study: optuna.Study, count: int) -> list[FrozenTrial]:
    """The best trials that came to their end and fulfil the constraints, without repeats of the same settings.

    With several objectives the front: the best in the first one, the best in the second, and so on in turn. If no trial
    is feasible, the least bad ones.
    """
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    feasible = [trial for trial in finished if is_feasible(trial)] or finished
    if len(study.directions) > 1:
        front = {trial.number for trial in study.best_trials}
        feasible = [trial for trial in feasible if trial.number in front] or feasible
    count_of = len(study.directions)
    orders = [sorted(feasible, key=lambda trial: (trial.values[index], trial.number)) for index in range(count_of)]
    ranked = [trial for turn in zip(*orders, strict=True) for trial in turn]
    distinct: list[FrozenTrial] = []
    for trial in ranked:
        if all(trial.params != other.params for other in distinct):
            distinct.append(trial)
    return distinct[:count]


def count_states(study: optuna.Study) -> dict[str, int]:
    """How many trials are complete, pruned, failed, running, waiting."""
    counts: dict[str, int] = {}
    for trial in study.get_trials(deepcopy=False):
        counts[trial.state.name.lower()] = counts.get(trial.state.name.lower(), 0) + 1
    return counts


def errors_in(outcomes: Outcomes) -> dict[Block, float]:
    """ATE in metres on each block."""
    return {block: outcome.ate_m for block, outcome in outcomes.items()}


def errors_of(trial: FrozenTrial) -> dict[Block, float]:
    """ATE in metres on each block that a trial ran on."""
    return {parse_blocks(text)[0]: float(ate) for text, _, ate, *_ in trial.user_attrs.get("blocks", [])}
