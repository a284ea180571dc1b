"""After the trials: the best run again in fresh repeats, the held-out check, importances, the preset."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState
from pydantic import Field

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import Record, write_atomic
from dynslam_bench.core.seeding import stream

from .objective import Configuration, Instance, InstanceFailedError, Outcome, log_ratio
from .preset import preset_text
from .samplers import is_feasible
from .study import Tuner
from .study_file import StudySpec

FRESH_SEEDS = 1000
"""Seeds of the final runs: none that a trial has used."""
RESAMPLES = 4000
FEWEST_SEQUENCES = 3
"""With fewer sequences an interval over sequences means nothing."""


class Ratio(Record):
    """A geometric-mean ATE ratio to the default settings, with its 95 % interval.

    Attributes:
        ratio: Below 1 is better than the default.
        low: Lower end of the bootstrap interval over sequences and repeats.
        high: Upper end.
        n: Paired runs.
        sequences: How many sequences they come from.
    """

    ratio: float
    low: float
    high: float
    n: int
    sequences: int

    @property
    def shows_gain(self) -> bool:
        """Whether the whole interval lies below 1, over enough sequences for an interval."""
        return self.high < 1 and self.sequences >= FEWEST_SEQUENCES

    @property
    def verdict(self) -> str:
        """What may be concluded."""
        if self.sequences < FEWEST_SEQUENCES:
            return (
                f"on {self.sequences} sequence{'s' * (self.sequences > 1)} only, from which nothing follows for others"
            )
        if self.high < 1:
            return f"better than the default by {100 * (1 - self.ratio):.1f} %"
        if self.low > 1:
            return f"worse than the default by {100 * (self.ratio - 1):.1f} %"
        return "no difference to the default that these runs could show"


class Candidate(Record):
    """One of the best configurations, run again.

    Attributes:
        trial: Its number.
        params: The tuned settings.
        values: What its trial had been worth.
        tune: On the tune split in fresh repeats.
        held_out: On the held-out split; None without one.
        frame_ms: Mean milliseconds a frame, timed without the stage cache.
        default_frame_ms: The same of the default settings.
        feasible: Whether the constraints hold in the new runs.
        failed: Why it could not be run again; empty if it could.
    """

    trial: int
    params: dict[str, Any]
    values: list[float]
    tune: Ratio | None = None
    held_out: Ratio | None = None
    frame_ms: float | None = None
    default_frame_ms: float | None = None
    feasible: bool = True
    failed: str = ""


class StudySummary(Record):
    """What came out of a study; `summary.json` in its folder.

    Attributes:
        name: The study.
        tracker: The tracker.
        protocol: Description of the protocol.
        trials: Trials by state.
        candidates: The best configurations, run again; the chosen one first.
        chosen: Number of the trial whose settings became the preset.
        improves: Whether the chosen settings beat the default on the held-out split: the whole interval below 1, and
            the splits are apart.
        conclusion: One sentence.
        importances: Share of the objective's variance that each parameter explains (PED-ANOVA).
        held_out: The held-out sequences.
        tune: The tune sequences.
        repeats: What the fresh repeats were, in words.
        split_notes: How the splits are not apart, where the study accepts that; to be shown beside every number.
    """

    name: str
    tracker: str
    protocol: str
    trials: dict[str, int]
    candidates: list[Candidate]
    chosen: int
    improves: bool
    conclusion: str
    importances: dict[str, float] = Field(default_factory=dict)
    held_out: list[str] = Field(default_factory=list)
    tune: list[str] = Field(default_factory=list)
    repeats: str = ""
    split_notes: list[str] = Field(default_factory=list)


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
        candidate = Candidate(trial=trial.number, params=trial.params, values=list(trial.values))
        try:
            again = _run(tuner, tuner.settings_of(trial), [*tune, *held_out], jobs)
        except InstanceFailedError as error:
            candidates.append(candidate.model_copy(update={"failed": str(error), "feasible": False}))
            continue
        config = Configuration([again[instance] for instance in tune])
        candidates.append(
            candidate.model_copy(
                update={
                    "tune": paired_ratio(again, default, tune),
                    "held_out": paired_ratio(again, default, held_out) if held_out else None,
                    "frame_ms": 1e3 * float(np.mean([outcome.frame_s for outcome in again.values()])),
                    "default_frame_ms": 1e3 * float(np.mean([outcome.frame_s for outcome in default.values()])),
                    "feasible": all(value <= 0 for value in config.violations(spec).values()),
                }
            )
        )
    candidates.sort(key=lambda c: (not c.feasible, c.tune.ratio if c.tune else math.inf))
    chosen = candidates[0]
    summary = StudySummary(
        name=spec.name, tracker=spec.tracker, protocol=tuner.evaluator.protocol.describe(),
        trials=count_states(tuner.study), candidates=candidates, chosen=chosen.trial,
        improves=chosen.held_out is not None and chosen.held_out.shows_gain and not tuner.split_notes,
        conclusion=_conclude(chosen, tuner.split_notes), repeats=describe_repeats(repeats),
        split_notes=tuner.split_notes,
        importances=importances(tuner.study), held_out=list(spec.held_out), tune=list(spec.tune),
    )  # fmt: skip
    settings = {**spec.space.fixed, **chosen.params}
    write_atomic(tuner.folder / "best.toml", preset_text(settings, spec.tracker, summary.conclusion))
    write_atomic(tuner.folder / "summary.json", summary.to_json())
    return summary


def best_trials(study: optuna.Study, count: int) -> list[FrozenTrial]:
    """The best finished trials that fulfil the constraints; with several objectives the front, most accurate first.

    Trials that were ended early are left out; if none is feasible, the least bad ones are taken.
    """
    whole = [
        trial for trial in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        if "early_stopped" not in trial.user_attrs
    ]  # fmt: skip
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


def paired_ratio(
    outcomes: Mapping[Instance, Outcome], default: Mapping[Instance, Outcome], instances: Sequence[Instance]
) -> Ratio:
    """Geometric-mean ATE ratio over paired runs, with a bootstrap interval over sequences and, within them, repeats."""
    by_sequence: dict[str, list[float]] = {}
    for instance in instances:
        ratio = log_ratio(outcomes[instance].ate_m, default[instance].ate_m)
        by_sequence.setdefault(instance.sequence, []).append(ratio)
    groups = [np.array(values) for values in by_sequence.values()]
    rng = stream(0, "bootstrap", *sorted(by_sequence))
    size = np.array([len(values) for values in groups])
    padded = np.stack([np.pad(values, (0, size.max() - len(values))) for values in groups])
    drawn = rng.integers(len(groups), size=(RESAMPLES, len(groups)))  # sequences, then repeats within each of them
    member = (rng.random((*drawn.shape, size.max())) * size[drawn][..., None]).astype(np.intp)
    counts = np.arange(size.max()) < size[drawn][..., None]
    means = (padded[drawn[..., None], member] * counts).sum(axis=2) / size[drawn]
    low, high = np.quantile(means.mean(axis=1), [0.025, 0.975])
    centre = float(np.mean([values.mean() for values in groups]))
    return Ratio(
        ratio=math.exp(centre), low=math.exp(low), high=math.exp(high), n=len(instances), sequences=len(groups)
    )


def importances(study: optuna.Study) -> dict[str, float]:
    """Parameter importances of the first objective, largest first; empty where there is too little to tell."""
    finished = [t for t in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)) if t.params]
    if len(finished) < 4:
        return {}
    target = None if len(study.directions) == 1 else (lambda trial: trial.values[0])
    try:
        found = optuna.importance.get_param_importances(study, target=target)
    except (ValueError, RuntimeError):  # all values equal, or no parameter common to enough trials
        return {}
    return {name: float(value) for name, value in found.items() if math.isfinite(value)}


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


def _conclude(chosen: Candidate, split_notes: Sequence[str]) -> str:
    if chosen.failed:
        return f"trial {chosen.trial} was best, but failed when run again: {chosen.failed}"
    assert chosen.tune is not None
    text = f"trial {chosen.trial}: on the tune split {_show(chosen.tune)} ({chosen.tune.verdict})"
    if chosen.held_out is None:
        return text + "; no held-out split was given, so nothing is known about other sequences"
    held = f"; on the held-out split {_show(chosen.held_out)} ({chosen.held_out.verdict})"
    few = "; fewer than five held-out sequences: the interval is rough" if 3 <= chosen.held_out.sequences < 5 else ""
    return text + held + few + (f"; THE SPLITS ARE NOT APART: {'; '.join(split_notes)}" if split_notes else "")


def _show(ratio: Ratio) -> str:
    return f"ATE x {ratio.ratio:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]"
