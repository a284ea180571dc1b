"""Running a study: trial 0 is the default, trials run on growing sets of instances, everything resumes."""

from __future__ import annotations

import json
import math
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import optuna
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import digest, write_atomic
from dynslam_bench.core.sanitise import storable, words_without_passwords
from dynslam_bench.core.settings import apply_overrides, flatten
from dynslam_bench.runs import RunEvent, RunStore
from dynslam_bench.runs.identity import resolve
from dynslam_bench.runs.record import program_of
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning.evaluate import CancelledError, InstanceFailedError, Outcome, evaluate
from dynslam_bench.tuning.instances import ProblemInstance
from dynslam_bench.tuning.objectives import Objective, Outcomes, coverage, find_objective, fps, violations
from dynslam_bench.tuning.pruning import build_pruner, is_dominated, step_name, steps
from dynslam_bench.tuning.samplers import build_sampler
from dynslam_bench.tuning.space import default_configuration, search_space, suggest
from dynslam_bench.tuning.splits import design_of
from dynslam_bench.tuning.storage import open_storage, study_folder, without_password, worker_is_dead, worker_name
from dynslam_bench.tuning.study_file import StudySpec

DONE = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.FAIL)
CRASHED_WORKER = "worker ended in the middle of the trial"


@dataclass(frozen=True)
class StudyEvent:
    """Something happened in a study.

    Attributes:
        kind: ``pilot`` (what it found), ``reference`` (runs with the default settings), ``started`` or ``finished`` (a
            trial).
        number: Of the trial.
        total: How many there are to be.
        text: One line.
    """

    kind: Literal["pilot", "reference", "started", "finished"]
    number: int
    total: int
    text: str


OnEvent = Callable[[StudyEvent], None]
OnRun = Callable[[RunEvent], None]
"""Called with every event of every run of a study, possibly by several threads at a time."""


class Tuner:
    """A study that is ready to run.

    Args:
        spec: The study.
        results: The results folder.
        reading: Only look at a stored study: one of another version of the code opens too, but runs nothing more.
        objectives: In place of those that the study names, in their order.
        sampler: In place of the one that the study names.

    Attributes:
        on_run: Called with every event of every run from now on; None for no calls.

    Raises:
        DynslamError: Anything in the spec is unknown, unfit, missing or does not agree with what is stored under the
            study's name; nothing has run then. With `reading` also when nothing is stored.
    """

    def __init__(
        self,
        spec: StudySpec,
        results: str | Path = "results",
        *,
        reading: bool = False,
        objectives: Sequence[Objective] | None = None,
        sampler: optuna.samplers.BaseSampler | None = None,
    ) -> None:
        self.spec = spec
        self.results = Path(results)
        self.reading = reading
        self.tracker = TRACKERS.get(spec.tracker)
        defaults = apply_overrides(self.tracker.settings(), spec.space.fixed)
        self.space = search_space(
            self.tracker.settings, spec.space, {instance.sequence for instance in spec.instances(*spec.tune)}
        )
        self.defaults, self.base = defaults, flatten(defaults)
        if spec.pruner == "wilcoxon" and len(spec.objectives) > 1:
            raise StudyError(
                f"pruner 'wilcoxon' takes one objective, the study has {len(spec.objectives)}", "use halving or none"
            )
        self.objectives = [find_objective(name) for name in spec.objectives] if objectives is None else list(objectives)
        sampler = build_sampler(spec) if sampler is None else sampler
        self.design = design_of(spec, accept=reading)
        self.steps = self._steps()
        self.store = RunStore(self.results)
        self.store.prepare()
        self.folder = study_folder(self.results, spec)
        self.study = self._open(sampler)
        self._lock = threading.Lock()
        self._interrupted = threading.Event()
        self._reference: dict[ProblemInstance, Outcome] = {}
        self.on_run: OnRun | None = None

    def run(self, *, jobs: int = 1, on_event: OnEvent | None = None) -> optuna.Study:
        """Run trials until the study has as many finished ones as it asks for.

        Several processes, on one or many machines, may do so at the same time on one storage.

        Args:
            jobs: Trials at a time in this process.
            on_event: Called with every event.

        Raises:
            StudyError: The default settings themselves fail on a sequence; says where and why. Or the study was opened
                for reading.
        """
        if self.reading:
            raise StudyError(f"study '{self.spec.name}' was opened for reading")
        self.reference(on_event, jobs)
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

    def reference(self, on_event: OnEvent | None = None, jobs: int = 1) -> dict[ProblemInstance, Outcome]:
        """The default settings' outcomes on the tune split, to which every trial is compared."""
        missing = [instance for instance in self.design.reference if instance not in self._reference]
        if on_event is not None:
            on_event(StudyEvent("reference", 0, len(missing), "the default settings"))
        with self._ending_all():
            try:
                self._reference.update(self.evaluate(self.spec.space.fixed, missing, jobs=jobs))
            except InstanceFailedError as error:
                raise StudyError(
                    f"the default settings fail: {error.args[0]}", "a study needs a default that runs"
                ) from error
            except CancelledError as error:
                raise StudyError("interrupted") from error
        return self._reference

    def evaluate(
        self,
        settings: Mapping[str, Any],
        instances: Sequence[ProblemInstance],
        *,
        jobs: int = 1,
        cache: bool | None = None,
    ) -> dict[ProblemInstance, Outcome]:
        """Run settings on instances as this study does; see `evaluate.evaluate`. `cache` None is the study's own."""
        return evaluate(
            self.spec.tracker, settings, instances, results=self.store, jobs=jobs, protocol=self.spec.protocol,
            threads=self.spec.threads, cache=self.spec.cache if cache is None else cache,
            data_root=self.spec.data_root, study=self.spec.name, cancelled=self._interrupted.is_set, on_run=self.on_run,
        )  # fmt: skip

    def evaluate_beside(
        self, configurations: Sequence[Mapping[str, Any]], instances: Sequence[ProblemInstance], *, jobs: int = 1
    ) -> list[dict[ProblemInstance, Outcome] | InstanceFailedError]:
        """Run configurations instance by instance, without the stage cache, so that their times can be compared.

        Other load on the machine then slows all of them alike.

        Returns:
            For each configuration its outcomes, or the error of its first failed run; it runs on no instance after it.
        """
        outcomes: list[dict[ProblemInstance, Outcome]] = [{} for _ in configurations]
        failed: dict[int, InstanceFailedError] = {}

        def one(number: int, instance: ProblemInstance) -> None:
            if number not in failed:
                try:
                    outcomes[number].update(self.evaluate(configurations[number], [instance], cache=False))
                except InstanceFailedError as error:
                    failed.setdefault(number, error)

        with ThreadPoolExecutor(jobs, thread_name_prefix="dynslam-beside") as pool, self._ending_all():
            for future in [
                pool.submit(one, number, instance) for instance in instances for number in range(len(outcomes))
            ]:
                future.result()
        return [failed.get(number, outcome) for number, outcome in enumerate(outcomes)]

    def settings_of(self, trial: FrozenTrial) -> dict[str, Any]:
        """The overrides that a trial ran with."""
        return {**self.spec.space.fixed, **trial.params}

    def values(self, outcomes: Outcomes) -> list[float]:
        """The objectives' values: natural logarithms of ratios to the default settings, less is better."""
        return [objective.value(outcomes, self._reference) for objective in self.objectives]

    def _steps(self) -> list[int]:
        """The steps at which every objective has an instance that counts."""
        *early, last = steps(self.spec.pruner, len(self.design.tune))
        counted = [[objective.counts(instance) for instance in self.design.tune] for objective in self.objectives]
        return [*(step for step in early if all(any(flags[:step]) for flags in counted)), last]

    def _one(self, on_event: OnEvent | None) -> None:
        with self._lock:
            trial = self.study.ask()
            values = suggest(trial, self.space)
        trial.set_user_attr("worker", worker_name())
        if on_event is not None:
            on_event(StudyEvent("started", trial.number, self.spec.trials, f"trial {trial.number}"))
        state, result, text = self._evaluate(trial, values)
        with self._lock:
            self.study.tell(trial, result, state=state)
        if on_event is not None:
            on_event(StudyEvent("finished", trial.number, self.spec.trials, f"trial {trial.number}: {text}"))

    def _evaluate(self, trial: optuna.Trial, values: dict[str, Any]) -> tuple[TrialState, list[float] | None, str]:
        settings = {**self.spec.space.fixed, **values}
        outcomes: dict[ProblemInstance, Outcome] = {}
        started = time.perf_counter()
        try:
            for step in self.steps:
                first = len(outcomes)
                outcomes |= self.evaluate(settings, self.design.tune[first:step])
                result = self.values(outcomes)
                self._record(trial, outcomes)
                if self._pruned(trial, outcomes, result, first) and trial.number > 0:
                    text = f"pruned after {step} of {self.steps[-1]} instances"
                    trial.set_user_attr("reason", text)
                    return TrialState.PRUNED, None, text
        except CancelledError:
            trial.set_user_attr("reason", CRASHED_WORKER)
            return TrialState.FAIL, None, "interrupted"
        except InstanceFailedError as error:
            trial.set_user_attr("reason", str(error))
            return TrialState.FAIL, None, f"failed: {error}"
        finally:
            trial.set_user_attr("wall_s", round(time.perf_counter() - started, 3))
        violated = violations(self.spec, outcomes, self._reference)
        for name, value in violated.items():
            trial.set_constraint(name, value)
        parts = [
            f"{objective.what} x {math.exp(value):.3f}"
            for objective, value in zip(self.objectives, result, strict=True)
        ]
        broken = [name for name, value in violated.items() if value > 0]
        text = ", ".join(parts) + (f", violates {' and '.join(broken)}" if broken else "")
        return TrialState.COMPLETE, result, text

    def _pruned(self, trial: optuna.Trial, outcomes: Outcomes, values: list[float], first: int) -> bool:
        """Report a trial's values and ask the pruner; `first` instances were reported before.

        Optuna's pruners know no constraints: a trial that violates one at a step takes no part in the comparison there.
        """
        step, final = len(outcomes), len(outcomes) == self.steps[-1]
        if self.spec.pruner == "wilcoxon":
            for index, value in enumerate(self.objectives[0].by_start(outcomes, self._reference)):
                if index >= first:
                    trial.report(value, index)
            return not final and trial.should_prune()
        if final or any(value > 0 for value in violations(self.spec, outcomes, self._reference).values()):
            return False
        if len(values) == 1:
            trial.report(values[0], step)
            return trial.should_prune()
        trial.set_user_attr(step_name(step), values)
        return is_dominated(self.study.get_trials(deepcopy=False), trial.number, step)

    def _record(self, trial: optuna.Trial, outcomes: Outcomes) -> None:
        trial.set_user_attr("coverage", coverage(outcomes))
        trial.set_user_attr("fps", fps(outcomes))
        rows = [[str(instance), run.run_id, run.ate_m, run.coverage, run.frame_s] for instance, run in outcomes.items()]
        trial.set_user_attr("instances", rows)

    def _more(self) -> bool:
        """Whether another trial is wanted; running ones count, those of dead workers do not."""
        with self._lock:
            self._fail_trials_of_dead_workers()
            trials = self.study.get_trials(deepcopy=False)
            counted = [t for t in trials if t.state in DONE and t.user_attrs.get("reason") != CRASHED_WORKER]
            running = [t for t in trials if t.state == TrialState.RUNNING]
            return len(counted) + len(running) < self.spec.trials

    def _fail_trials_of_dead_workers(self) -> None:
        """Mark as failed the trials that a killed worker of this host left running."""
        for trial in self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            worker = trial.user_attrs.get("worker", "")
            if worker and worker_is_dead(worker):
                with suppress(RuntimeError):  # another worker has done so meanwhile
                    self.study._storage.set_trial_user_attr(trial._trial_id, "reason", CRASHED_WORKER)
                    self.study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)

    def _open(self, sampler: optuna.samplers.BaseSampler) -> optuna.Study:
        """The stored study, or a new one whose first trial is the default, whatever is enqueued later."""
        name, absent = self.spec.name, f"there is no study '{self.spec.name}' in {self.results}"
        if self.reading and not self.spec.storage and not self.folder.is_dir():
            raise StudyError(absent, "dynslam-bench tune run STUDY.toml")
        storage = open_storage(self.results, self.spec)
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        how: dict[str, Any] = {"storage": storage, "study_name": name, "sampler": sampler}
        how["pruner"] = build_pruner(self.spec.pruner)
        try:
            if self.reading:
                study = optuna.load_study(**how)
            else:
                study = optuna.create_study(directions=["minimize"] * len(self.objectives), **how)
                self._begin(study)
        except optuna.exceptions.DuplicatedStudyError:
            study = optuna.load_study(**how)
        except KeyError as error:
            raise StudyError(absent, "dynslam-bench tune run STUDY.toml") from error
        except Exception as error:  # storages raise their drivers' errors
            raise StudyError(without_password(f"cannot open study '{name}': {error}", self.spec.storage)) from None
        self._check_identity(study)
        if not self.spec.storage:
            write_atomic(self.folder / "study.json", json.dumps(self.spec.for_others(), indent=2) + "\n")
        return study

    def _begin(self, study: optuna.Study) -> None:
        """What a new study begins with; the identity comes last, other workers wait for it."""
        study.set_user_attr("spec", self.spec.for_others())
        study.set_user_attr("command", words_without_passwords(storable(sys.argv)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            study.set_metric_names(list(self.spec.objectives))
        study.enqueue_trial(default_configuration(self.space, self.base))
        study.set_user_attr("identity", self._identity())

    def _check_identity(self, study: optuna.Study) -> None:
        """Refuse a stored study that was made with something else; data and program count only to go on with it."""
        deadline = time.monotonic() + 10.0
        while (stored := study.user_attrs.get("identity")) is None and time.monotonic() < deadline:
            time.sleep(0.05)  # another worker is beginning the study
        if stored is None:
            raise StudyError(
                f"the storage holds a study '{self.spec.name}' that is none of this toolkit", "give yours another name"
            )
        identity = self._identity()
        if different := difference(stored, identity):
            raise StudyError(
                f"study '{self.spec.name}' is stored with other {different}",
                f"give the study another name, or delete {self.folder}",
            )

    def _identity(self) -> dict[str, Any]:
        """What must be the same when a study is resumed; without data and program, which reading does not need."""
        spec = self.spec.model_dump(mode="json", exclude={"trials", "timeout_s", "top", "storage", "pilot"})
        if self.reading:
            return spec
        return {**spec, **self._made_of(), "parameters": digest([repr(parameter) for parameter in self.space])}

    def _made_of(self) -> dict[str, Any]:
        """The content of the study's sequences, and the program that runs on them: code, weights, libraries, device."""
        spec = self.spec
        first: dict[str, ProblemInstance] = {}
        for instance in spec.instances(*spec.tune, *spec.confirm, *spec.held_out):
            first.setdefault(instance.sequence, instance)
        how: dict[str, Any] = {"data_root": spec.data_root, "threads": spec.threads, "settings": dict(spec.space.fixed)}
        data: dict[str, str] = {}
        program: dict[str, str] = {}
        for sequence, instance in first.items():
            identity = resolve(instance.run_spec(spec.tracker, **how)).identity
            data[sequence] = digest([identity["content"], identity["camera"]])
            program |= program_of(identity) | {"device": identity["device"]}
        return {"data": data, "program": program}


def difference(stored: dict[str, Any], now: dict[str, Any]) -> str:
    """The first thing of an identity that is stored otherwise, in words; empty where there is none."""
    changed = [key for key in now if stored.get(key) != now[key]]
    if not changed:
        return ""
    key = changed[0]
    there, here = stored.get(key), now[key]
    if key in ("data", "program"):
        names = [name for name in here if (there or {}).get(name) != here[name]]
        if key == "data":
            return f"data: the content of {', '.join(names[:3])} is not what it was"
        key, there, here = names[0], (there or {}).get(names[0]), here[names[0]]
        return f"{key}: {there} there, {here} here"
    more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
    return f"{key}{more}: {json.dumps(there)[:80]} there, {json.dumps(here)[:80]} here"
