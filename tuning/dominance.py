"""Ending trials early in studies of several objectives, which Optuna's pruners cannot do."""

from __future__ import annotations

from collections.abc import Sequence

from optuna.trial import FrozenTrial


def hopeless(
    log_ratios: Sequence[float],
    rtf: float,
    instances: Sequence[object],
    finished: Sequence[FrozenTrial],
    objectives: Sequence[str],
) -> bool:
    """Whether a trial is dominated even if all that is left goes as well as anything ever went.

    Args:
        log_ratios: Log ATE ratios of the instances so far.
        rtf: Real-time factor so far; instances differ little, so it stands for the rest.
        instances: All instances of a trial.
        finished: Completed trials, with the ratios of their instances.
        objectives: The study's objectives, in order.

    Returns:
        True if a finished, feasible trial is at least as good in every objective as the optimistic bound.
    """
    if len(log_ratios) < 2 or not finished:
        return False
    best = min(log_ratios)
    for trial in finished:
        values = dict(zip(objectives, trial.values, strict=True))
        best = min(best, values.get("accuracy", best))
    left = len(instances) - len(log_ratios)
    bound = {"accuracy": (sum(log_ratios) + left * best) / len(instances), "speed": rtf}
    for trial in finished:
        if any(value > 0 for value in trial.user_attrs.get("constraints", {}).values()):
            continue
        values = dict(zip(objectives, trial.values, strict=True))
        if all(
            values[name] <= bound[name] if name == "accuracy" else values[name] >= bound[name] for name in objectives
        ):
            return True
    return False
