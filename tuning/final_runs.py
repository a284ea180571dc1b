"""After the trials: the best run again in fresh repeats, the held-out check, importances, the preset."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import write_atomic

from .importance import importances, inert_parameters
from .objective import Configuration, Instance, InstanceFailedError, Outcome
from .preset import preset_text
from .samplers import is_feasible
from .study import Tuner
from .study_file import StudySpec
from .summary import Candidate, StudySummary, conclude, paired_ratio

FRESH_SEEDS = 1000
"""Seeds of the final runs: none that a trial has used."""


def fresh_repeats(spec: StudySpec) -> list[tuple[int, int]]:
    """As many pairs of seed and start offset as a trial has per sequence, none of which a trial has used.

    Both change at once: the offset is what makes another run for a tracker that draws nothing from its seed.
    """
    count = len(spec.seeds) * len(spec.offsets)
    unused = [offset for offset in range(count + len(spec.offsets)) if offset not in spec.offsets]
    return [(FRESH_SEEDS + index, unused[index]) for index in range(count)]


def describe_repeats(repeats: Sequence[tuple[int, int]]) -> str:
    """Pairs of seed and start offset in words."""
    return ", ".join(f"seed {seed} from frame {offset}" for seed, offset in repeats)


def finish(tuner: Tuner, on_note: Callable[[str], None] | None = None, *, jobs: int = 1) -> StudySummary:
    """Run the best configurations again, check them on the held-out split and write preset and summary.

    The candidate that is best on the tune split in fresh repeats is chosen; the held-out split only judges it.

    Args:
        tuner: A study with finished trials.
        on_note: Told what is going on.
        jobs: Runs at a time.

    Returns:
        The summary; `best.toml` and `summary.json` lie in the study's folder.

    Raises:
        StudyError: No trial has finished.
    """
    spec = tuner.spec
    note = on_note or (lambda _: None)
    best = best_trials(tuner.study, spec.top)
    if not best:
        raise StudyError(f"study '{spec.name}' has no finished trial", "run it first, or see why its trials failed")
    repeats = fresh_repeats(spec)
    tune = tuner.evaluator.instances(spec.tune, repeats)
    held_out = tuner.evaluator.instances(spec.held_out, repeats)
    note("default settings in fresh repeats")
    default = _run(tuner, spec.space.fixed, [*tune, *held_out], jobs)
    candidates = []
    for trial in best:
        note(f"trial {trial.number} in fresh repeats")
        candidates.append(_run_again(tuner, trial, default, tune, held_out, jobs))
    candidates.sort(key=lambda c: (not c.feasible, c.tune.ratio if c.tune else math.inf))
    chosen = candidates[0]
    names = [parameter.name for parameter in tuner.space]
    finished = tuner.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    gain = chosen.feasible and chosen.held_out is not None and chosen.held_out.shows_gain
    summary = StudySummary(
        name=spec.name,
        tracker=spec.tracker,
        protocol=tuner.evaluator.protocol.describe(),
        trials=count_states(tuner.study),
        candidates=candidates,
        chosen=chosen.trial,
        improves=gain and not tuner.split_notes,
        conclusion=conclude(chosen, tuner.split_notes),
        repeats=describe_repeats(repeats),
        split_notes=tuner.split_notes,
        importances=importances(tuner.study, names),
        inert=inert_parameters(finished, names),
        held_out=list(spec.held_out),
        tune=list(spec.tune),
    )
    settings = {**spec.space.fixed, **chosen.params}
    write_atomic(tuner.folder / "best.toml", preset_text(settings, spec.tracker, summary.conclusion))
    write_atomic(tuner.folder / "summary.json", summary.to_json())
    return summary


def _run_again(
    tuner: Tuner,
    trial: FrozenTrial,
    default: Mapping[Instance, Outcome],
    tune: Sequence[Instance],
    held_out: Sequence[Instance],
    jobs: int,
) -> Candidate:
    """A trial's configuration in fresh repeats on both splits, compared with the default's runs there."""
    candidate = Candidate(trial=trial.number, params=trial.params, values=list(trial.values))
    try:
        again = _run(tuner, tuner.settings_of(trial), [*tune, *held_out], jobs)
    except InstanceFailedError as error:
        return candidate.model_copy(update={"failed": str(error), "feasible": False})
    violations = Configuration([again[instance] for instance in tune]).violations(tuner.spec)
    found = {
        "tune": paired_ratio(again, default, tune),
        "held_out": paired_ratio(again, default, held_out) if held_out else None,
        "frame_ms": 1e3 * float(np.mean([outcome.frame_s for outcome in again.values()])),
        "default_frame_ms": 1e3 * float(np.mean([outcome.frame_s for outcome in default.values()])),
        "feasible": all(value <= 0 for value in violations.values()),
    }
    return candidate.model_copy(update=found)


def best_trials(study: optuna.Study, count: int) -> list[FrozenTrial]:
    """The best finished trials that fulfil the constraints; with several objectives the front, most accurate first.

    Trials that were ended early are left out; if none is feasible, the least bad ones are taken.
    """
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    whole = [trial for trial in finished if "early_stopped" not in trial.user_attrs]
    feasible = [trial for trial in whole if is_feasible(trial)] or whole
    if len(study.directions) > 1:
        front = {trial.number for trial in study.best_trials}
        feasible = [trial for trial in feasible if trial.number in front] or feasible
    sign = 1.0 if study.directions[0] == optuna.study.StudyDirection.MINIMIZE else -1.0
    ranked = sorted(feasible, key=lambda trial: (sign * trial.values[0], trial.number))
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


def _run(
    tuner: Tuner, settings: Mapping[str, Any], instances: Sequence[Instance], jobs: int
) -> dict[Instance, Outcome]:
    """Run a configuration without the stage cache, so that its times are its own."""

    def one(instance: Instance) -> Outcome:
        outcome = tuner.evaluator.run(settings, instance, cache=False)
        assert outcome is not None
        return outcome

    with ThreadPoolExecutor(jobs, thread_name_prefix="dynslam-final") as pool:
        return dict(zip(instances, pool.map(one, instances), strict=True))
