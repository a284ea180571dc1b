"""Running a study: trial 0 is the default, instances are shuffled, hopeless trials end early, everything resumes."""

from __future__ import annotations

import json
import math
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

import optuna
from optuna.trial import FrozenTrial, TrialState

import dynslam_bench
from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.harmless import storable
from dynslam_bench.core.passwords import without_passwords
from dynslam_bench.core.records import digest, write_atomic
from dynslam_bench.core.seeding import stream
from dynslam_bench.core.settings import apply_overrides, flatten
from dynslam_bench.runs.identity import source_fingerprint
from dynslam_bench.trackers import TRACKERS

from .dominance import hopeless
from .objective import Configuration, Evaluator, Instance, InstanceFailedError, Outcome, check_sequences, log_ratio
from .samplers import build_pruner, build_sampler, set_constraints
from .space import default_configuration, search_space, suggest
from .splits import check_splits
from .storage import open_storage, study_folder, worker_is_dead, worker_name
from .storage_address import without_password
from .stored_identity import as_stored, difference, same
from .study_file import StudySpec

DONE = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.FAIL)
CODE = ("version", "source")
"""What of a study's identity tells the code that ran it: must be the same to go on, not to read."""
CRASHED_WORKER = "worker ended in the middle of the trial"


@dataclass(frozen=True)
class StudyEvent:
    """Something happened in a study.

    Attributes:
        kind: ``reference`` (a run with the default settings), ``started`` or ``finished`` (a trial).
        number: Of the trial, or of the reference run.
        total: How many there are to be.
        text: One line.
    """

    kind: Literal["reference", "started", "finished"]
    number: int
    total: int
    text: str


OnEvent = Callable[[StudyEvent], None]


class Tuner:
    """A study that is ready to run.

    Args:
        spec: The study.
        results: The results folder.
        reading: Only look at a stored study: one of another version of the code opens too, but runs nothing more.

    Raises:
        DynslamError: Anything in the spec is unknown, unfit, missing or does not agree with what is stored under the
            study's name; nothing has run then. With `reading` also when nothing is stored.
    """

    def __init__(self, spec: StudySpec, results: str | Path = "results", *, reading: bool = False) -> None:
        self.spec = spec = as_stored(spec, study_folder(Path(results), spec) / "study.json") if reading else spec
        self.results = Path(results)
        self.reading = reading
        self.tracker = TRACKERS.get(spec.tracker)
        defaults = apply_overrides(self.tracker.settings(), spec.space.fixed)
        self.space = search_space(self.tracker.settings, spec.space)
        self.base = flatten(defaults)
        sampler, pruner = build_sampler(spec), build_pruner(spec)
        check_sequences(spec)
        self.split_notes = check_splits(spec, refuse=not reading)
        self.evaluator = Evaluator(spec, self.results)
        self.evaluator.store.prepare()
        self.tune_instances = self.evaluator.instances(spec.tune, list(product(spec.seeds, spec.offsets)))
        self.folder = study_folder(self.results, spec)
        self.study = self._open(sampler, pruner)
        self._lock = threading.Lock()
        self._interrupted = threading.Event()
        self._reference: dict[Instance, Outcome] = {}

    def run(self, *, jobs: int = 1, on_event: OnEvent | None = None) -> optuna.Study:
        """Run trials until the study has as many finished ones as it asks for.

        Several processes, on one or many machines, may do so at the same time on one storage.

        Args:
            jobs: Trials at a time in this process.
            on_event: Told of everything that happens.

        Raises:
            StudyError: The default settings themselves fail on a sequence; says where and why. Or the study was opened
                for reading.
        """
        if self.reading:
            raise StudyError(f"study '{self.spec.name}' was opened for reading")
        self._bury_dead_workers()
        self.reference(on_event, jobs)
        if not self.study.get_trials(deepcopy=False):
            self.study.enqueue_trial(default_configuration(self.space, self.base), skip_if_exists=True)
        deadline = None if self.spec.timeout_s is None else time.monotonic() + self.spec.timeout_s

        def work() -> None:
            while (deadline is None or time.monotonic() < deadline) and not self._interrupted.is_set() and self._more():
                self._one(on_event)

        with ThreadPoolExecutor(jobs, thread_name_prefix="dynslam-tune") as pool, self._ending_all():
            for future in [pool.submit(work) for _ in range(jobs)]:
                future.result()
        return self.study

    @contextmanager
    def _ending_all(self) -> Iterator[None]:
        """Whatever interrupts the waiting ends the runs of all threads at once."""
        try:
            yield
        except BaseException:
            self._interrupted.set()
            raise

    def reference(self, on_event: OnEvent | None = None, jobs: int = 1) -> dict[Instance, Outcome]:
        """The default settings' outcomes on the tune split, to which every trial is compared."""
        missing = [instance for instance in self.tune_instances if instance not in self._reference]

        def one(instance: Instance) -> Outcome:
            number = self.tune_instances.index(instance)
            _tell(on_event, "reference", number, len(self.tune_instances), str(instance))
            try:
                outcome = self.evaluator.run(
                    self.spec.space.fixed, instance, cache=self.spec.cache, cancelled=self._interrupted.is_set
                )  # fmt: skip
            except InstanceFailedError as error:
                raise StudyError(f"the default settings fail: {error}", "a study needs a default that runs") from error
            if outcome is None:
                raise StudyError("interrupted")
            return outcome

        with ThreadPoolExecutor(jobs, thread_name_prefix="dynslam-reference") as pool, self._ending_all():
            self._reference.update(zip(missing, pool.map(one, missing), strict=True))
        return self._reference

    def settings_of(self, trial: FrozenTrial) -> dict[str, Any]:
        """The overrides that a trial ran with."""
        return {**self.spec.space.fixed, **trial.params}

    def _one(self, on_event: OnEvent | None) -> None:
        with self._lock:
            trial = self.study.ask()
            values = suggest(trial, self.space, self.base)
        trial.set_user_attr("worker", worker_name())
        _tell(on_event, "started", trial.number, self.spec.trials, f"trial {trial.number}")
        state, result, text = self._evaluate(trial, values)
        with self._lock:
            self.study.tell(trial, result, state=state)
        _tell(on_event, "finished", trial.number, self.spec.trials, f"trial {trial.number}: {text}")

    def _evaluate(self, trial: optuna.Trial, values: dict[str, Any]) -> tuple[TrialState, list[float] | None, str]:
        settings = {**self.spec.space.fixed, **values}
        order = list(self.tune_instances)
        stream(self.spec.sampler_seed, "order", trial.number).shuffle(order)
        found = Configuration()
        started = time.perf_counter()
        try:
            for position, instance in enumerate(order):
                watch = self._watch(trial, found, instance, position)
                outcome = self.evaluator.run(
                    settings, instance, cache=self.spec.cache, on_progress=watch, cancelled=self._interrupted.is_set
                )  # fmt: skip
                if outcome is None and self._interrupted.is_set():
                    trial.set_user_attr("reason", CRASHED_WORKER)
                    return TrialState.FAIL, None, "interrupted"
                if outcome is None:
                    return self._pruned(trial, found, f"pruned on {instance.sequence}")
                found.outcomes.append(outcome)
                if self._should_stop(trial, found, instance, position):
                    if len(self.spec.objectives) > 1 or self.spec.pruner == "wilcoxon":
                        break
                    return self._pruned(trial, found, f"pruned after {position + 1} of {len(order)} runs")
        except InstanceFailedError as error:
            trial.set_user_attr("reason", str(error))
            return TrialState.FAIL, None, f"failed: {error}"
        finally:
            trial.set_user_attr("wall_s", round(time.perf_counter() - started, 3))
        self._record(trial, found)
        early = len(found.outcomes) < len(order)
        if early:
            trial.set_user_attr("early_stopped", f"after {len(found.outcomes)} of {len(order)} runs")
        result = self._result(found, pessimistic=early)
        return TrialState.COMPLETE, result, _describe(result, self.spec, found) + (" (ended early)" if early else "")

    def _result(self, found: Configuration, pessimistic: bool = False) -> list[float]:
        """The objectives' values; after an early end the missing instances count as the worst seen ones."""
        ratios = found.log_ratios(self._reference)
        if pessimistic and len(self.spec.objectives) > 1:
            ratios = ratios + [max(ratios)] * (len(self.tune_instances) - len(ratios))
        accuracy = sum(ratios) / len(ratios)
        return [accuracy if objective == "accuracy" else found.rtf for objective in self.spec.objectives]

    def _record(self, trial: optuna.Trial, found: Configuration) -> None:
        set_constraints(trial, found.violations(self.spec))
        trial.set_user_attr("coverage", found.coverage)
        trial.set_user_attr("fps", found.fps)
        trial.set_user_attr("rtf", found.rtf)
        trial.set_user_attr(
            "instances",
            [
                [o.instance.sequence, o.instance.seed, o.run_id, o.ate_m, o.coverage, o.frame_s, o.instance.offset]
                for o in found.outcomes
            ],
        )

    def _pruned(self, trial: optuna.Trial, found: Configuration, text: str) -> tuple[TrialState, None, str]:
        if found.outcomes:
            self._record(trial, found)
        trial.set_user_attr("reason", text)
        return TrialState.PRUNED, None, text

    def _should_stop(self, trial: optuna.Trial, found: Configuration, instance: Instance, position: int) -> bool:
        """After a run: report it, and ask whether going on is worth while."""
        if position + 1 == len(self.tune_instances):
            return False
        ratios = found.log_ratios(self._reference)
        if len(self.spec.objectives) > 1:
            return hopeless(ratios, found.rtf, self.tune_instances, self._finished(), self.spec.objectives)
        if self.spec.pruner == "none":
            return False
        if self.spec.pruner == "wilcoxon":
            trial.report(ratios[-1], self.tune_instances.index(instance))
        else:
            trial.report(sum(ratios) / len(ratios), 2 * position + 1)
        return bool(trial.should_prune()) and trial.number > 0

    def _watch(
        self, trial: optuna.Trial, found: Configuration, instance: Instance, position: int
    ) -> Callable[[dict[str, Any]], bool] | None:
        """In mid-run, about half-way: report the running mean that includes the run's error so far.

        The error of the first frames is compared with the default settings' on the same frames.
        """
        if len(self.spec.objectives) > 1 or self.spec.pruner not in ("median", "hyperband") or trial.number == 0:
            return None
        ratios = found.log_ratios(self._reference)
        reported = False

        def progress(partial: dict[str, Any]) -> bool:
            nonlocal reported
            ate = partial.get("metrics", {}).get("ate_rmse_m")
            done, total = partial["frames_done"], partial["frames"]
            if reported or ate is None or not 0.4 <= done / total <= 0.7:
                return True
            so_far = self.evaluator.ate_of_first(self._reference[instance].run_id, done)
            if so_far is None:
                return True
            reported = True
            trial.report((sum(ratios) + log_ratio(float(ate), so_far)) / (len(ratios) + 1), 2 * position)
            return not trial.should_prune()

        return progress

    def _finished(self) -> list[FrozenTrial]:
        return self.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))

    def _more(self) -> bool:
        """Whether another trial is wanted; running ones count, those of dead workers do not."""
        with self._lock:
            trials = self.study.get_trials(deepcopy=False)
            counted = [t for t in trials if t.state in DONE and t.user_attrs.get("reason") != CRASHED_WORKER]
            running = [t for t in trials if t.state == TrialState.RUNNING]
            return len(counted) + len(running) < self.spec.trials

    def _bury_dead_workers(self) -> None:
        """Trials that a killed worker of this host left running are over."""
        for trial in self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            worker = trial.user_attrs.get("worker", "")
            if worker and worker_is_dead(worker):
                self.study._storage.set_trial_user_attr(trial._trial_id, "reason", CRASHED_WORKER)
                self.study.tell(trial.number, state=TrialState.FAIL)

    def _open(self, sampler: optuna.samplers.BaseSampler, pruner: optuna.pruners.BasePruner) -> optuna.Study:
        directions: list[Literal["minimize", "maximize"]] = [
            "minimize" if objective == "accuracy" else "maximize" for objective in self.spec.objectives
        ]
        if self.reading and not self.spec.storage and not self.folder.is_dir():
            raise StudyError(
                f"there is no study '{self.spec.name}' in {self.results}", "dynslam-bench tune run STUDY.toml"
            )
        storage = open_storage(self.results, self.spec)
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        try:
            study = optuna.create_study(
                storage=storage, study_name=self.spec.name, directions=directions, sampler=sampler, pruner=pruner,
                load_if_exists=True,
            )  # fmt: skip
        except Exception as error:  # storages raise their drivers' errors
            said = without_password(f"cannot open study '{self.spec.name}': {error}", self.spec.storage)
            raise StudyError(said) from None
        identity = self._identity()
        stored = study.user_attrs.get("identity")
        if stored is None:
            study.set_user_attr("identity", identity)
            study.set_user_attr("spec", self.spec.for_others())
            study.set_user_attr("command", [without_passwords(word) for word in storable(sys.argv)])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
                study.set_metric_names(list(self.spec.objectives))
        elif not same(stored, identity, but=CODE if self.reading else ()):
            raise StudyError(
                f"study '{self.spec.name}' is stored with other {difference(stored, identity)}",
                f"give the study another name, or delete {self.folder}",
            )
        if not self.spec.storage:
            write_atomic(self.folder / "study.json", json.dumps(self.spec.for_others(), indent=2) + "\n")
        return study

    def _identity(self) -> dict[str, Any]:
        """What must be the same when a study is resumed."""
        spec = self.spec.model_dump(mode="json", exclude={"trials", "timeout_s", "top", "storage"})
        if not self.spec.allow_overlap:
            del spec["allow_overlap"]  # as in studies of before it was there
        defaults = apply_overrides(self.tracker.settings(), self.spec.space.fixed)
        masks = str(getattr(getattr(defaults, "segmentation", None), "source", ""))
        return {
            **spec,
            "version": dynslam_bench.__version__,
            "source": source_fingerprint(self.tracker, defaults, masks),
            "parameters": digest([repr(parameter) for parameter in self.space]),
        }


def run_study(
    spec: StudySpec, *, results: str | Path = "results", jobs: int = 1, on_event: OnEvent | None = None
) -> Tuner:
    """Run a study to its end, or go on with it.

    Args:
        spec: The study.
        results: The results folder; the study's own files lie in ``studies/<name>``.
        jobs: Trials at a time.
        on_event: Told of everything that happens.

    Returns:
        The study, for `finish`.

    Raises:
        DynslamError: See `Tuner`.
    """
    tuner = Tuner(spec, results)
    tuner.run(jobs=jobs, on_event=on_event)
    return tuner


def _describe(result: list[float], spec: StudySpec, found: Configuration) -> str:
    parts = []
    for objective, value in zip(spec.objectives, result, strict=True):
        parts.append(f"ATE x {math.exp(value):.3f}" if objective == "accuracy" else f"{value:.2f} x real time")
    violated = [name for name, value in found.violations(spec).items() if value > 0]
    return ", ".join(parts) + (f", violates {' and '.join(violated)}" if violated else "")


def _tell(
    on_event: OnEvent | None, kind: Literal["reference", "started", "finished"], number: int, total: int, text: str
) -> None:
    if on_event is not None:
        on_event(StudyEvent(kind, number, total, text))
