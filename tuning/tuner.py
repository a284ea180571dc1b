"""Running a study: trial 0 is the default, trials race on growing sets of instances, everything resumes."""

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
from dynslam_bench.core.reading import read_json
from dynslam_bench.core.records import digest, write_atomic
from dynslam_bench.core.sanitise import storable, words_without_passwords
from dynslam_bench.core.settings import apply_overrides, flatten
from dynslam_bench.runs import RunEvent, RunStore
from dynslam_bench.runs.identity import resolve
from dynslam_bench.runs.record import program_of
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning import pruning as race
from dynslam_bench.tuning.evaluate import CancelledError, InstanceFailedError, Outcome, evaluate
from dynslam_bench.tuning.instances import ProblemInstance
from dynslam_bench.tuning.objectives import Objective, Outcomes, coverage, find_objective, fps, violations
from dynslam_bench.tuning.samplers import build_sampler, set_constraints
from dynslam_bench.tuning.space import default_configuration, search_space, suggest
from dynslam_bench.tuning.splits import design_of
from dynslam_bench.tuning.storage import open_storage, study_folder, without_password, worker_is_dead, worker_name
from dynslam_bench.tuning.study_file import NEW, StudySpec, converted, is_old
from dynslam_bench.tuning.trials import best_trials, errors_in, errors_of

DONE = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.FAIL)
MADE_OF = ("parameters", "data", "program", "version", "source")
"""What of a study's identity tells the data and the program that made it: must be the same to go on, not to read."""
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
"""Told of every run that a study makes, also while it goes on; several threads may tell at a time."""


class Tuner:
    """A study that is ready to run.

    Args:
        spec: The study.
        results: The results folder.
        reading: Only look at a stored study: one of another version of the code opens too, but runs nothing more.
        objectives: In place of those that the study names, in their order.
        sampler: In place of the one that the study names.

    Attributes:
        on_run: Told of every run that the study makes from now on; None for nobody.

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
        self.spec = spec = as_stored(spec, study_folder(Path(results), spec) / "study.json") if reading else spec
        self.results = Path(results)
        self.reading = reading
        self.tracker = TRACKERS.get(spec.tracker)
        defaults = apply_overrides(self.tracker.settings(), spec.space.fixed)
        self.space = search_space(
            self.tracker.settings, spec.space, {instance.sequence for instance in spec.instances(*spec.tune)}
        )
        self.defaults, self.base = defaults, flatten(defaults)
        if spec.race == "wilcoxon" and len(spec.objectives) > 1:
            raise StudyError(
                f"race 'wilcoxon' takes one objective, the study has {len(spec.objectives)}",
                "use halving, rejection or none",
            )
        self.objectives = [find_objective(each) for each in spec.objectives] if objectives is None else list(objectives)
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
            on_event: Told of everything that happens.

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
        _tell(on_event, "reference", 0, len(missing), "the default settings")
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
        """Run settings on instances as this study runs them; see `evaluate.evaluate`. `cache` is the study's if None."""
        return evaluate(
            self.spec.tracker, settings, instances, results=self.store, jobs=jobs, protocol=self.spec.protocol,
            threads=self.spec.threads, cache=self.spec.cache if cache is None else cache,
            data_root=self.spec.data_root, study=self.spec.name, cancelled=self._interrupted.is_set, on_run=self.on_run,
        )  # fmt: skip

    def evaluate_beside(
        self, configurations: Sequence[Mapping[str, Any]], instances: Sequence[ProblemInstance], *, jobs: int = 1
    ) -> list[dict[ProblemInstance, Outcome] | InstanceFailedError]:
        """Run several configurations instance by instance, without the stage cache, so that their times can be compared.

        Whatever else the machine does at a time then slows all of them alike.

        Returns:
            For each configuration its outcomes, or why its first failing run failed; it runs on no further instance then.
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
        return [failed.get(number, found) for number, found in enumerate(outcomes)]

    def settings_of(self, trial: FrozenTrial) -> dict[str, Any]:
        """The overrides that a trial ran with."""
        return {**self.spec.space.fixed, **trial.params}

    def _steps(self) -> list[int]:
        """The steps of the race at which every objective has a instance that counts."""
        found = race.steps(self.spec.race, len(self.design.race))
        return [
            step
            for step in found[:-1]
            if all(any(map(each.counts, self.design.race[:step])) for each in self.objectives)
        ] + found[-1:]

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
        outcomes: dict[ProblemInstance, Outcome] = {}
        started = time.perf_counter()
        try:
            for position, step in enumerate(self.steps):
                outcomes |= self.evaluate(settings, self.design.race[len(outcomes) : step])
                result = self.values(outcomes)
                final = step == self.steps[-1]
                self._record(trial, outcomes, final=final)
                if not final:
                    race.note(trial, step, result)
                    if trial.number > 0 and self._drops(trial.number, position, outcomes):
                        text = f"dropped after {step} of {self.steps[-1]} instances"
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
        return TrialState.COMPLETE, result, self._describe(result, outcomes)

    def values(self, outcomes: Outcomes) -> list[float]:
        """The objectives' values: natural logarithms of ratios to the default settings, less is better."""
        return [each.value(outcomes, self._reference) for each in self.objectives]

    def _describe(self, result: list[float], outcomes: Outcomes) -> str:
        parts = [f"{each.what} x {math.exp(value):.3f}" for each, value in zip(self.objectives, result, strict=True)]
        violated = [name for name, value in violations(self.spec, outcomes, self._reference).items() if value > 0]
        return ", ".join(parts) + (f", violates {' and '.join(violated)}" if violated else "")

    def _drops(self, number: int, position: int, outcomes: Mapping[ProblemInstance, Outcome]) -> bool:
        """Whether a trial leaves the race at a step."""
        if self.spec.race == "wilcoxon":
            best = best_trials(self.study, 1)
            return bool(best) and race.is_worse(errors_in(outcomes), errors_of(best[0]))
        trials = self.study.get_trials(deepcopy=False)
        return race.leaves(trials, number, self.steps, position)

    def _record(self, trial: optuna.Trial, outcomes: Mapping[ProblemInstance, Outcome], *, final: bool) -> None:
        set_constraints(trial, violations(self.spec, outcomes, self._reference), final=final)
        trial.set_user_attr("coverage", coverage(outcomes))
        trial.set_user_attr("fps", fps(outcomes))
        rows = [[str(instance), o.run_id, o.ate_m, o.coverage, o.frame_s] for instance, o in outcomes.items()]
        trial.set_user_attr("instances", rows)

    def _more(self) -> bool:
        """Whether another trial is wanted; running ones count, those of dead workers do not."""
        with self._lock:
            self._bury_dead_workers()
            trials = self.study.get_trials(deepcopy=False)
            counted = [t for t in trials if t.state in DONE and t.user_attrs.get("reason") != CRASHED_WORKER]
            running = [t for t in trials if t.state == TrialState.RUNNING]
            return len(counted) + len(running) < self.spec.trials

    def _bury_dead_workers(self) -> None:
        """Trials that a killed worker of this host left running are over."""
        for trial in self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            worker = trial.user_attrs.get("worker", "")
            if worker and worker_is_dead(worker):
                with suppress(RuntimeError):  # another worker has buried it meanwhile
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
        how["pruner"] = optuna.pruners.NopPruner()
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
            said = without_password(f"cannot open study '{name}': {error}", self.spec.storage)
            raise StudyError(said) from None
        stored, identity = _identity_of(study), self._identity()
        if stored is None:
            raise StudyError(
                f"the storage holds a study '{name}' that is none of this toolkit", "give yours another name"
            )
        if not same(stored, identity, but=MADE_OF if self.reading else ()):
            raise StudyError(
                f"study '{name}' is stored with other {difference(stored, identity)}",
                f"give the study another name, or delete {self.folder}",
            )
        if not self.spec.storage:
            write_atomic(self.folder / "study.json", json.dumps(self.spec.for_others(), indent=2) + "\n")
        return study

    def _begin(self, study: optuna.Study) -> None:
        """What a new study begins with; the identity comes last, others wait for it."""
        study.set_user_attr("spec", self.spec.for_others())
        study.set_user_attr("command", words_without_passwords(storable(sys.argv)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            study.set_metric_names(list(self.spec.objectives))
        study.enqueue_trial(default_configuration(self.space, self.base))
        study.set_user_attr("identity", self._identity())

    def _identity(self) -> dict[str, Any]:
        """What must be the same when a study is resumed."""
        spec = self.spec.model_dump(mode="json", exclude={"trials", "timeout_s", "top", "storage", "pilot"})
        if not self.spec.allow_overlap:
            del spec["allow_overlap"]  # as in studies of before it was there
        identity = {**spec, "parameters": digest([repr(parameter) for parameter in self.space])}
        return identity if self.reading else identity | self._made_of()

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


def _identity_of(study: optuna.Study, wait_s: float = 10.0) -> dict[str, Any] | None:
    """What a stored study was made with, as soon as the worker that begins it has said so; None if nobody does."""
    deadline = time.monotonic() + wait_s
    while (found := study.user_attrs.get("identity")) is None and time.monotonic() < deadline:
        time.sleep(0.05)
    return None if found is None else dict(found)


def _tell(
    on_event: OnEvent | None, kind: Literal["reference", "started", "finished"], number: int, total: int, text: str
) -> None:
    if on_event is not None:
        on_event(StudyEvent(kind, number, total, text))


# What a stored study was made with, beside what it would be made with now.


def as_stored(spec: StudySpec, file: Path) -> StudySpec:
    """A study that is only read, with the start offsets that it had: one of before there were any began at frame 0."""
    if "offsets" in spec.model_fields_set or not file.is_file():
        return spec
    stored = read_json(file, kind=StudyError)
    return spec if not isinstance(stored, dict) or "offsets" in stored else spec.model_copy(update={"offsets": (0,)})


def same(stored: dict[str, Any], now: dict[str, Any], but: tuple[str, ...]) -> bool:
    """Whether two identities agree, but for some keys."""
    if is_old(stored):
        stored, _ = converted(stored)
        but = (*but, *NEW)
    return all(_of(stored, key) == _of(now, key) for key in (stored.keys() | now.keys()) - set(but))


def _of(identity: dict[str, Any], key: str) -> Any:
    """A part of a study's identity; studies from before there were start offsets had none."""
    return identity.get(key, [0] if key == "offsets" else None)


def difference(stored: dict[str, Any], now: dict[str, Any]) -> str:
    """The first thing in which two identities differ, in words."""
    for key in ("data", "program"):
        there, here = stored.get(key) or {}, now.get(key) or {}
        names = [name for name in here if there.get(name) != here[name]]
        if names and key == "data":
            return f"data: the content of {', '.join(names[:3])} is not what it was"
        if names:
            return f"{names[0]}: {there.get(names[0])} there, {here[names[0]]} here"
    changed = [key for key in now if _of(stored, key) != now[key]]
    first = changed[0] if changed else next(iter(stored.keys() - now.keys()), "content")
    more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
    return f"{first}{more}: {_short(stored.get(first))} there, {_short(now.get(first))} here"


def _short(value: Any, limit: int = 80) -> str:
    text = json.dumps(value)
    return text if len(text) <= limit else text[: limit - 3] + "..."
