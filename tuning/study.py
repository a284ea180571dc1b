"""A study: trial 0 is the baseline, trials run on growing sets of instances, everything resumes."""

from __future__ import annotations

import json
import math
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import optuna
from optuna.distributions import BaseDistribution
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import FrozenTrial, TrialState, create_trial

from dynslam_bench.core import (
    DynslamError,
    StudyError,
    exclusive_lock,
    read_settings,
    storable,
    translate_errors,
    words_without_passwords,
    write_atomic,
)
from dynslam_bench.core.records import digest, validated
from dynslam_bench.core.seeding import stream
from dynslam_bench.core.settings import Scalar
from dynslam_bench.evaluation.verdicts import FEWEST
from dynslam_bench.runs import RunEvent, resolve, run_many
from dynslam_bench.runs.record import program_of
from dynslam_bench.tuning.database import without_password
from dynslam_bench.tuning.objectives import (
    CancelledError,
    Configuration,
    Cost,
    InstanceFailedError,
    Objective,
    Outcome,
    Outcomes,
    combined_objective,
    coverage,
    crashed,
    find_objective,
    fps,
    hold_last_pose_protocol,
    outcome,
    own_objective,
)
from dynslam_bench.tuning.plan import StudyPlan, design_of
from dynslam_bench.tuning.space import starting_point
from dynslam_bench.tuning.storage import (
    EARLIER,
    NAMELESS_S,
    SPEC_FILE,
    Heartbeats,
    best_trials,
    extension_of,
    load_study,
    open_storage,
    quiet,
    read_stored,
    study_folder,
    trials_frame,
    worker_name,
)
from dynslam_bench.tuning.study_file import (
    TRACKER,
    ProblemInstance,
    PrunerName,
    SamplerName,
    StudySpec,
    read_study,
)

if TYPE_CHECKING:
    import pandas as pd

    from dynslam_bench.tuning.judgement import StudySummary

_WAIT_S = 2.0
"""Interval at which a worker without a trial looks whether those of the others have ended, seconds."""
_NAMES_S = 0.2
"""Interval at which it is looked whether running trials have their workers' names, seconds."""
_BEGINNING_S = 10.0
"""Seconds to wait for a worker that is beginning the study on the same storage."""
_PRUNED_AFTER = "pruned_after"
"""User attribute: after how many instances the pruner ended a trial. Optuna's pruner gives its answer once."""
SUMMARY_FILE = "summary.json"
"""In a study's folder once it has its verdict."""
CRASHED_WORKER = "worker ended in the middle of the trial"
"""Why earlier versions marked a trial as failed that is not counted as one; now it waits to be run again."""


@dataclass(frozen=True)
class StudyEvent:
    """Something happened in a study.

    Attributes:
        kind: ``preview`` (what it could show), ``reference`` (runs of the baseline), ``started`` or
            ``finished`` (a trial).
        number: Number of the trial.
        total: How many there are to be.
        text: One line.
    """

    kind: Literal["preview", "reference", "started", "finished"]
    number: int
    total: int
    text: str


OnEvent = Callable[[StudyEvent], None]
OnRun = Callable[[RunEvent], None]
"""Called with every event of every run of a study, possibly by several threads at a time."""


@dataclass(frozen=True)
class Evaluation:
    """Outcome of a trial.

    Attributes:
        state: Complete, pruned or failed; waiting if it was interrupted, and is to be run again.
        text: In words.
        values: The objectives' (natural logarithms of ratios to the baseline, less is better); None
            if it failed.
    """

    state: TrialState
    text: str
    values: list[float] | None = None


class Study(StudyPlan):
    """A study to be run: at once, or trial by trial with `ask`, `evaluate` and `tell`.

    Example:
        ``Study(tracker="orb-slam2", tune=["synthetic/walking_xyz?scene=0-3&frames=80"], name="few").run().finish()``

    Args:
        spec: The study, or its TOML file; None if the fields say it all.
        results: The results folder.
        objective: In place of the spec's: names of objectives, or functions from
            `objectives.Outcome` to a cost above 0, one or several.
        sampler: Any of Optuna's or a name, in place of the spec's.
        pruner: Any of Optuna's or a name, in place of the spec's. `WilcoxonPruner` is told the value of each
            instance, every other one the value over all instances so far.
        constraints: Hard constraints by name, beside the spec's: functions of `objectives.Outcome`
            whose mean over the instances has to be <= 0.
        callbacks: Called with Optuna's study and the trial after each trial.
        **fields: Fields of `StudySpec`, in place of the spec's; `tune`, `confirm` and `held_out` take instances, too.

    Attributes:
        study: Optuna's study.
        on_run: Called with every event of every run from now on; None for no calls.

    Raises:
        DynslamError: Anything in the spec is unknown, unfit, missing or does not agree with what is
            stored under the study's name; nothing has run then.
    """

    def __init__(
        self,
        spec: StudySpec | Path | str | None = None,
        results: str | Path = "results",
        *,
        objective: str | Cost | Sequence[str | Cost] | None = None,
        sampler: optuna.samplers.BaseSampler | SamplerName | None = None,
        pruner: optuna.pruners.BasePruner | PrunerName | None = None,
        constraints: Mapping[str, Callable[[Outcome], float]] | None = None,
        callbacks: Iterable[Callable[[optuna.Study, FrozenTrial], object]] = (),
        **fields: Any,
    ) -> None:
        # the spec, with the fields that are given in place of its own
        base = read_study(spec) if isinstance(spec, Path | str) else spec
        changes = {key: _texts(value) for key, value in fields.items()}
        # by name they are fields of the spec
        if isinstance(sampler, str):
            changes["sampler"] = sampler
            sampler = None
        if isinstance(pruner, str):
            changes["pruner"] = pruner
            pruner = None
        objectives = _objectives(objective)
        if objectives is not None:
            changes["objectives"] = tuple(objective.name for objective in objectives)
        if base is None or changes:
            values = {"name": "study"} if base is None else base.model_dump()
            base = validated(StudySpec, values | changes, "the study", StudyError)
        super().__init__(base, results, objectives=objectives, constraints=constraints)

        # pruner, callbacks, and what the study depends on
        self._has_own_pruner = pruner is not None
        self._pruner = pruner or build_pruner(base.pruner)
        self._callbacks = tuple(callbacks)
        self.store.prepare()
        self.folder = study_folder(self.results, base)
        self._identity = self._identify()
        if constraints:
            self._identity["constraints"] = sorted(constraints)

        # the state of this worker's threads
        self._lock = threading.RLock()
        self._interrupted = threading.Event()
        self._is_exhausted = False
        self._reference: dict[ProblemInstance, Outcome] = {}
        self.on_run: OnRun | None = None

        # the stored study, or a new one
        self.study = self._open(sampler or StreamedSampler(base), list(self._beginnings()))
        self._heartbeats = Heartbeats(self.study)
        if self.extension["scenes"]:
            self.design = design_of(base, further=self.extension["scenes"])

    @property
    def sampler_name(self) -> str:
        """Proposer of settings: the spec's sampler, or the class of the one that was given."""
        sampler = self.study.sampler
        if isinstance(sampler, StreamedSampler):
            return self.spec.sampler
        return type(sampler).__name__

    @property
    def pruner_name(self) -> str:
        """Pruner of trials: the spec's, or the class of the one that was given."""
        return type(self._pruner).__name__ if self._has_own_pruner else self.spec.pruner

    @property
    def extension(self) -> dict[str, int]:
        """Scenes and trials that `extend` has added."""
        return extension_of(self.study)

    @property
    def trials(self) -> int:
        """Number of finished trials that the study asks for."""
        return self.spec.trials + self.extension["trials"]

    def extend(self, *, scenes: int = 0, trials: int = 0) -> None:
        """Ask for more trials, and for more rendered scenes to judge on.

        Raises:
            StudyError: So many scenes cannot be made; or the study has its verdict, and looking at it
                again would claim falsely too often.
        """
        if (self.folder / SUMMARY_FILE).is_file():
            self._check_second_look(scenes, trials)
        total = {
            "scenes": self.extension["scenes"] + scenes,
            "trials": self.extension["trials"] + trials,
        }
        self.design = design_of(self.spec, further=total["scenes"])
        self.study.set_user_attr("extension", total)

    def _check_second_look(self, scenes: int, trials: int) -> None:
        """Refuse what would be judged on scenes that have judged already, unless the level was planned for it.

        Scenes that are too few for any claim may see other trials, but then get no further scenes.
        """
        from dynslam_bench.tuning.judgement import StudySummary

        best = StudySummary.read(self.folder / SUMMARY_FILE).best
        evidence = None if best is None else best.evidence
        judged = 0 if evidence is None else evidence.all_scenes
        name = self.spec.name
        if trials and judged >= FEWEST:
            raise StudyError(
                f"study '{name}' has its verdict; {trials} more trials would be judged on the same scenes",
                f'begin a new study with other held-out scenes and start = ["{self.folder}"]',
            )
        if scenes and judged and not self.spec.extendable:
            raise StudyError(
                f"study '{name}' has its verdict and is not extendable: a second look would claim falsely too often",
                "begin a new study with other held-out scenes, or with extendable = true",
            )

    def run(self, *, jobs: int = 1, on_event: OnEvent | None = None) -> Study:
        """Run trials until the study has as many finished ones as it asks for.

        Several processes, on one or many machines, may do so at the same time on one storage.

        Args:
            jobs: Trials at a time in this process.
            on_event: Called with every event.

        Raises:
            StudyError: The baseline fails on a sequence; says where and why.
        """
        self.reference(on_event, jobs)
        self._await_names()
        tell = on_event or (lambda _: None)
        self._in_threads(jobs, self._run_trials, [(tell,)] * jobs)
        return self

    def _run_trials(self, tell: OnEvent) -> None:
        """Run one trial after the other until no more are wanted and no other worker runs one."""
        while not self._interrupted.is_set():
            with self._lock:  # between the count and the new trial no other thread adds one
                trial = self.ask() if self._more() else None
            if trial is None:
                if not self._others_run():
                    return
                # should one of their workers end, its trial is made again here
                self._interrupted.wait(_WAIT_S)
                continue
            name = f"trial {trial.number}"
            tell(StudyEvent("started", trial.number, self.trials, name))
            try:
                evaluation = self.evaluate(trial)
                self.tell(trial, evaluation)
            # another worker took this one for dead, and was quicker
            except UpdateFinishedTrialError:
                continue
            text = f"{name}: {evaluation.text}"
            tell(StudyEvent("finished", trial.number, self.trials, text))
            for callback in self._callbacks:
                callback(self.study, self.study.get_trials(deepcopy=False)[trial.number])

    def _in_threads(
        self, jobs: int, work: Callable[..., None], tasks: Iterable[tuple[Any, ...]]
    ) -> None:
        """Do work several tasks at a time; whatever interrupts the waiting ends the runs of all threads at once."""
        with ThreadPoolExecutor(jobs, thread_name_prefix="dynslam-tune") as pool:
            try:
                for future in [pool.submit(work, *task) for task in tasks]:
                    future.result()
            except BaseException:
                self._interrupted.set()
                raise

    def reference(
        self, on_event: OnEvent | None = None, jobs: int = 1
    ) -> dict[ProblemInstance, Outcome]:
        """The baseline's outcomes on the tune split, to which every trial is compared.

        Raises:
            StudyError: The baseline fails; says where and why.
        """
        missing = [
            instance for instance in self.design.reference if instance not in self._reference
        ]
        if on_event is not None and missing:
            on_event(StudyEvent("reference", 0, len(missing), "the baseline"))
        baseline, _ = self.evaluate_beside(
            [], missing, jobs=jobs, cache=self.spec.cache, crash_is_loss=False
        )
        self._reference |= baseline
        return self._reference

    def outcomes(
        self,
        settings: Mapping[str, Any],
        instances: Sequence[ProblemInstance],
        *,
        tracker: str = "",
        cache: bool | None = None,
    ) -> dict[ProblemInstance, Outcome]:
        """Run settings on instances, one after the other; runs that are stored are taken from there.

        Args:
            settings: Overrides, dotted name to value.
            instances: Instances that are run.
            tracker: Id of the tracker; the study's if empty.
            cache: Whether to use the stage cache, whose times are those of when its entries were
                made; None for what the study says.

        Raises:
            InstanceFailedError: A run crashed, timed out, ran out of memory or was invalid.
            CancelledError: The study was interrupted.
            DynslamError: Settings or an instance are unknown or unfit.
        """
        spec = self.spec
        results = dict[ProblemInstance, Outcome]()
        protocol = hold_last_pose_protocol(spec.protocol)
        interrupted = self._interrupted.is_set
        for instance in instances:
            if interrupted():
                raise CancelledError(f"interrupted before {instance}")
            configuration = Configuration(tracker or spec.tracker, settings)
            run = self.run_spec(instance, configuration, cache=cache)
            (record,) = run_many(
                [run],
                results=self.store,
                protocol=protocol,
                cancelled=interrupted,
                on_event=self.on_run,
            )
            results[instance] = outcome(self.store, record, instance, protocol, spec.data_root)
        return results

    def evaluate_beside(
        self,
        configurations: Sequence[Configuration],
        instances: Sequence[ProblemInstance],
        *,
        jobs: int = 1,
        cache: bool = False,
        crash_is_loss: bool = True,
    ) -> tuple[
        dict[ProblemInstance, Outcome], list[dict[ProblemInstance, Outcome] | InstanceFailedError]
    ]:
        """Run the baseline and configurations instance by instance: other load on the machine slows all of them alike.

        A crash is a loss there, of whichever side: one scene of many that judge decides nothing alone.

        Args:
            configurations: What to run.
            instances: Instances that each is run on.
            jobs: Runs at a time.
            cache: Whether to use the stage cache, with which times cannot be compared.
            crash_is_loss: Whether a baseline that crashes has lost that instance, and no more.

        Returns:
            The outcomes of the baseline, and for each configuration its outcomes, or the error of
            its first run where all of its runs crashed.

        Raises:
            StudyError: The baseline crashes: everywhere, or at all where that is no loss; says where and why.
        """
        several = [self.baseline, *configurations]
        results: list[dict[ProblemInstance, Outcome]] = [{} for _ in several]
        errors: list[dict[ProblemInstance, InstanceFailedError]] = [{} for _ in several]

        def baseline_fails(error: InstanceFailedError) -> StudyError:
            return StudyError(f"the baseline fails: {error.args[0]}", "a study needs one that runs")

        def run_one(instance: ProblemInstance, number: int) -> None:
            tracker, settings = several[number]
            try:
                results[number] |= self.outcomes(settings, [instance], tracker=tracker, cache=cache)
            except InstanceFailedError as error:
                if number == 0 and not crash_is_loss:
                    raise baseline_fails(error) from error
                errors[number][instance] = error
                results[number][instance] = crashed(instance, str(error), self.spec.data_root)

        # on each instance all configurations in turn, before the next instance
        self._in_threads(jobs, run_one, product(instances, range(len(several))))

        # who crashed everywhere has shown nothing
        crashed_everywhere = [
            next(iter(failed.values())) if failed and len(failed) == len(instances) else None
            for failed in errors
        ]
        if crashed_everywhere[0] is not None:
            raise baseline_fails(crashed_everywhere[0])
        others = zip(results[1:], crashed_everywhere[1:], strict=True)
        return results[0], [result if error is None else error for result, error in others]

    @staticmethod
    def open(study: StudySpec | Path | str, results: Path | str = "results") -> StoredStudy:
        """Open a stored study to look at; see `StoredStudy`."""
        return StoredStudy(study, results)

    def finish(self, *, jobs: int = 1, trial: int | None = None) -> StudySummary:
        """Judge the best trials, or the one of that number; write preset, summary and page; see `judgement.finish`."""
        from dynslam_bench.tuning.judgement import finish
        from dynslam_bench.tuning.page import write_page

        summary = finish(self, jobs=jobs, trial=trial)
        write_page(self, summary)
        return summary

    def frame(self) -> pd.DataFrame:
        """All trials; see `storage.trials_frame`."""
        return trials_frame(self.spec, self.study)

    def configuration_of(self, trial: FrozenTrial | optuna.Trial) -> Configuration:
        """Tracker and settings that a trial runs with."""
        return self.configuration(trial.params)

    def ask(self, settings: Mapping[str, Scalar] | None = None) -> optuna.Trial:
        """The next trial: the first is the baseline's, then come those that wait, then the sampler's.

        Args:
            settings: A configuration to wait in line; what it does not say is as the baseline has
                it.

        Raises:
            StudyError: It sets what the study does not tune, or is out of range.
        """
        with self._lock:
            if settings is not None:
                self.study.enqueue_trial(starting_point(settings, self.search))
            self._heartbeats.beat()
            trial = self.study.ask()
            self.search.suggest(trial)
            trial.set_user_attr("worker", worker_name())
        return trial

    def evaluate(self, trial: optuna.Trial) -> Evaluation:
        """Run a trial on one instance after the other until it ends or is pruned."""
        self.check_plugins()
        with self._heartbeats.beating():
            reference = self._reference or self.reference()
            try:
                outcomes, is_pruned = self._run_until_pruned(trial)
            except CancelledError:
                return Evaluation(TrialState.WAITING, "interrupted, it waits to be run again")
            except InstanceFailedError as error:
                return Evaluation(TrialState.FAIL, str(error))
        self._store_outcomes(trial, outcomes, reference)
        if is_pruned:
            done = f"{len(outcomes)} of {len(self.design.tune)} instances"
            return Evaluation(TrialState.PRUNED, f"pruned after {done}")

        # the objectives' values, and how far each constraint is violated
        values = [objective.value(outcomes, reference) for objective in self.objectives]
        violated = self.violations(outcomes, reference)
        for name, value in violated.items():
            trial.set_constraint(name, value)

        ratios = zip(self.objectives, values, strict=True)
        text = ", ".join(f"{objective.what} x {math.exp(value):.3f}" for objective, value in ratios)
        if broken := " and ".join(name for name, value in violated.items() if value > 0):
            text += f", violates {broken}"
        return Evaluation(TrialState.COMPLETE, text, values)

    def _run_until_pruned(self, trial: optuna.Trial) -> tuple[dict[ProblemInstance, Outcome], bool]:
        """The outcomes on the instances that a trial ran on, and whether it was pruned after the last of them.

        Raises:
            CancelledError: The study was interrupted.
            InstanceFailedError: A run failed.
        """
        # a trial whose worker was killed was not pruned before the last step that it reported
        stored = self.study.get_trials(deepcopy=False)[trial.number]
        passed = max(stored.intermediate_values, default=0)

        tracker, settings = self.configuration_of(trial)
        outcomes: dict[ProblemInstance, Outcome] = {}
        for instance in self.design.tune:
            outcomes |= self.outcomes(settings, [instance], tracker=tracker)
            if len(outcomes) >= passed and self._prune(trial, outcomes, instance):
                return outcomes, True
        return outcomes, False

    def _store_outcomes(self, trial: optuna.Trial, outcomes: Outcomes, reference: Outcomes) -> None:
        """Keep with a trial what its runs came to: means, log ratios by scene, and a row for each instance."""
        scenes = combined_objective(self.objectives).ratios(outcomes, reference)
        rows = [
            [str(instance), run.run_id, run.ate_m, run.coverage, run.frame_s]
            for instance, run in outcomes.items()
        ]
        trial.set_user_attr("coverage", coverage(outcomes))
        trial.set_user_attr("fps", fps(outcomes))
        trial.set_user_attr("scenes", scenes)
        trial.set_user_attr("instances", rows)

    def _prune(self, trial: optuna.Trial, outcomes: Outcomes, last: ProblemInstance) -> bool:
        """Report a trial's value after its last instance, and ask Optuna's pruner, which takes one objective.

        For Wilcoxon's test that is the instance's own value. Optuna's pruners know no constraints:
        a trial that violates one takes no part in the comparison of successive halving.
        """
        objective = self.objectives[0]
        reference = self._reference
        step = len(outcomes)
        if trial.user_attrs.get(_PRUNED_AFTER) == step:  # its worker was killed after that
            return True
        never_prunes = isinstance(self._pruner, optuna.pruners.NopPruner)
        if never_prunes or len(self.objectives) > 1 or not objective.counts(last):
            return False
        with quiet():  # a value that a killed worker has reported is not reported again
            if isinstance(self._pruner, optuna.pruners.WilcoxonPruner):
                (value,) = objective.by_start({last: outcomes[last]}, reference)
                trial.report(value, step)
            elif max(self.violations(outcomes, reference).values(), default=0) <= 0:
                trial.report(objective.value(outcomes, reference), step)
        is_pruned = 0 < trial.number and step < len(self.design.tune) and trial.should_prune()
        if is_pruned:
            trial.set_user_attr(_PRUNED_AFTER, step)
        return is_pruned

    def tell(self, trial: optuna.Trial, evaluation: Evaluation) -> None:
        """Store what a trial came to."""
        if evaluation.state == TrialState.WAITING:
            self._put_back(self.study.get_trials(deepcopy=False)[trial.number])
            return
        if evaluation.state != TrialState.COMPLETE:
            trial.set_user_attr("reason", evaluation.text)
        with self._lock:
            # a worker that took this one for dead has put the trial back: Optuna ends running ones
            if self.study.get_trials(deepcopy=False)[trial.number].state == TrialState.WAITING:
                self._storage.set_trial_state_values(self._id_of(trial), TrialState.RUNNING)
            try:
                self.study.tell(
                    trial, evaluation.values, state=evaluation.state, skip_if_finished=True
                )
            except RuntimeError as error:
                # samplers of a grid stop the study after their last point, which Optuna takes as a
                # fault of those who ask and tell; the trial is stored by then
                if "Study.stop" not in str(error):
                    raise
                self._is_exhausted = True

    def _put_back(self, trial: FrozenTrial) -> None:
        """Let a running trial wait to be run again: it keeps its number, and so its settings.

        Nothing is done where another worker has run it meanwhile, or runs it.
        """
        worker = trial.user_attrs.get("worker", "")
        with self._turn("put-back"), suppress(UpdateFinishedTrialError):
            trial_id = self._id_of(trial)
            now = self._storage.get_trial(trial_id)
            if now.state != TrialState.RUNNING or now.user_attrs.get("worker", "") != worker:
                return
            self._storage.set_trial_user_attr(trial_id, "worker", "")
            self._storage.set_trial_state_values(trial_id, TrialState.WAITING)

    def _id_of(self, trial: optuna.Trial | FrozenTrial) -> int:
        """The storage's own number of a trial, which counts those of all its studies."""
        study_id = self._storage.get_study_id_from_name(self.spec.name)
        return self._storage.get_trial_id_from_study_id_trial_number(study_id, trial.number)

    def _turn(self, what: str) -> AbstractContextManager[None]:
        """Do something alone among the workers that share the study's folder; a database has no such lock.

        Raises:
            StudyError: The folder cannot be written.
        """
        if self.spec.storage:
            return nullcontext()
        with translate_errors(
            StudyError, f"cannot write {self.folder}", "check the permissions and the free space"
        ):
            self.folder.mkdir(parents=True, exist_ok=True)
        return exclusive_lock(self.folder / f".{what}")

    def _await_names(self) -> None:
        """Wait until each running trial has its worker's name, or that worker is known to have been killed before.

        Else a later trial would be proposed without what such a trial comes to.
        """
        deadline = time.monotonic() + NAMELESS_S + 1.0
        while time.monotonic() < deadline and not self._interrupted.is_set():
            running = self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
            nameless = [trial for trial in running if not trial.user_attrs.get("worker")]
            if all(map(self._heartbeats.is_dead, nameless)):
                return
            time.sleep(_NAMES_S)

    def _more(self) -> bool:
        """Whether another trial is wanted; running ones count, those of dead workers wait to be run again."""
        if self._is_exhausted:
            return False
        with self._lock:
            for trial in self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
                if self._heartbeats.is_dead(trial):
                    self._put_back(trial)
            own = [
                trial
                for trial in self.study.get_trials(deepcopy=False)
                if trial.state != TrialState.WAITING
                and trial.user_attrs.get("reason") != CRASHED_WORKER
                and EARLIER not in trial.user_attrs
            ]
            return len(own) < self.trials

    def _others_run(self) -> bool:
        """Whether workers of other processes run trials."""
        running = self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
        return any(trial.user_attrs.get("worker") != worker_name() for trial in running)

    def _beginnings(self) -> Iterator[FrozenTrial | dict[str, Scalar]]:
        """Trials of earlier studies that a new one knows, and settings that it tries after its baseline."""
        for entry in self.spec.start:
            if isinstance(entry, str) and Path(entry).expanduser().is_dir():
                yield from self._earlier(Path(entry).expanduser())
            else:
                preset = read_settings(Path(entry)) if isinstance(entry, str) else entry
                yield starting_point(preset, self.search)

    def _earlier(self, folder: Path) -> Iterator[FrozenTrial | dict[str, Scalar]]:
        """Complete trials of an earlier study, marked as such; its best ones are to be tried again."""
        spec, results = read_stored(folder)
        study = load_study(results, spec)
        if spec.objectives != self.spec.objectives:
            raise StudyError(
                f"the earlier study '{spec.name}' has other objectives: {', '.join(spec.objectives)}"
            )
        source = f"study {spec.name}"
        if study.user_attrs.get("identity", {}).get("code") != self._identity["code"]:
            source += ", other code"
        marks = {EARLIER: source}
        spans = self.search.distributions()
        best = {trial.number for trial in best_trials(study, self.spec.top)}
        for trial in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            params = {name: value for name, value in trial.params.items() if name in spans}
            with suppress(StudyError):  # out of this study's range
                params = starting_point(params, self.search)
                if trial.number in best:
                    yield params  # to be run on this study's instances
                effective = self.search.effective(params)
                yield create_trial(
                    params=effective,
                    distributions={name: spans[name] for name in effective},
                    values=trial.values,
                    user_attrs=marks,
                )

    def _open(
        self,
        sampler: optuna.samplers.BaseSampler,
        beginnings: Sequence[FrozenTrial | dict[str, Scalar]],
    ) -> optuna.Study:
        """The stored study, or a new one whose first trial is the baseline, whatever is enqueued later."""
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._storage = open_storage(self.results, self.spec)
        how: Any = {
            "storage": self._storage,
            "study_name": self.spec.name,
            "sampler": sampler,
            "pruner": self._pruner,
        }
        directions: list[Literal["minimize", "maximize"]] = ["minimize"] * len(self.objectives)
        try:
            # one worker begins the study, the others load it
            with self._turn("begin"):
                try:
                    study = optuna.create_study(directions=directions, **how)
                    self._begin(study, beginnings)
                except optuna.exceptions.DuplicatedStudyError:
                    study = optuna.load_study(**how)
                    self._await_identity(study)
                    if self._is_half_begun(study):
                        self._begin(study, beginnings)
        except DynslamError:
            raise
        except Exception as error:  # storages raise their drivers' errors
            text = f"cannot open study '{self.spec.name}': {error}"
            raise StudyError(without_password(text, self.spec.storage)) from None

        # refuse a study of other things; write it beside its trials for those who look at it
        self._check_identity(study)
        if study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            self.check_plugins()
        if not self.spec.storage:
            text = json.dumps(self.spec.for_others(), indent=2) + "\n"
            write_atomic(self.folder / SPEC_FILE, text)
        return study

    def _begin(
        self, study: optuna.Study, beginnings: Sequence[FrozenTrial | dict[str, Scalar]]
    ) -> None:
        """Store what a new study begins with; the identity comes last, other workers wait for it.

        Where a process was killed that began the study, this goes on from there.
        """
        study.set_user_attr("spec", self.spec.for_others())
        study.set_user_attr("command", words_without_passwords(storable(sys.argv)))
        with quiet():
            study.set_metric_names(list(self.spec.objectives))

        # trial 0 has the baseline's settings; then trials of earlier studies, and settings to try once
        first = {parameter.name: self.base[parameter.name] for parameter in self.space}
        entries: list[FrozenTrial | dict[str, Scalar]] = [first]
        settings: list[dict[str, Any]] = [first]
        for beginning in beginnings:
            if isinstance(beginning, FrozenTrial):
                settings.append(beginning.params)
            elif beginning in settings:
                continue
            else:
                settings.append(beginning)
            entries.append(beginning)

        # those that a killed process has stored are there already
        stored = len(study.get_trials(deepcopy=False))
        for entry in entries[stored:]:
            if isinstance(entry, FrozenTrial):
                study.add_trial(entry)
            else:
                study.enqueue_trial(entry)
        study.set_user_attr("identity", self._identity)

    def _await_identity(self, study: optuna.Study) -> None:
        """Wait for a worker that is beginning the study; one that shares the study's folder has done so."""
        deadline = time.monotonic() + (_BEGINNING_S if self.spec.storage else 0.0)
        while "identity" not in study.user_attrs and time.monotonic() < deadline:
            time.sleep(0.05)

    def _is_half_begun(self, study: optuna.Study) -> bool:
        """Whether a process of this toolkit began the stored study and was killed before it had an identity."""
        facts = study.user_attrs
        if "identity" in facts:
            return False
        # another program's study has trials or attributes of its own; tuples are lists in a storage
        spec = json.loads(json.dumps(self.spec.for_others()))
        is_empty = not facts and not study.get_trials(deepcopy=False)
        return facts.get("spec") == spec or is_empty

    def _check_identity(self, study: optuna.Study) -> None:
        """Refuse a stored study that was made with something else; data and program count only to go on with it."""
        stored = study.user_attrs.get("identity")
        if stored is None:
            raise StudyError(
                f"the storage holds a study '{self.spec.name}' that is none of this toolkit",
                "give yours another name",
            )
        changed = [key for key, value in self._identity.items() if stored.get(key) != value]
        if changed:
            first = changed[0]
            there = json.dumps(stored.get(first))[:80]
            here = json.dumps(self._identity.get(first))[:80]
            more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
            raise StudyError(
                f"study '{self.spec.name}' is stored with other {first}{more}: {there} there, {here} here",
                f"give the study another name, or delete {self.folder}",
            )

    def _identify(self) -> dict[str, Any]:
        """Identity of a study: everything that must be the same when it is resumed, by name.

        Beside the study's fields these are the baseline's settings, the content of its sequences,
        and the program that runs on them: code, weights, libraries, device.
        """
        spec = self.spec
        identity = spec.model_dump(
            mode="json", exclude={"trials", "top", "storage", "start", "baseline"}
        )
        instances = spec.instances(*spec.tune, *spec.confirm, *spec.held_out)
        # the first instance of each sequence stands for it
        first_of = {instance.sequence: instance for instance in reversed(instances)}
        configuration = self.configuration({})
        programs: dict[str, set[str]] = defaultdict(set)
        for sequence, instance in first_of.items():
            run = resolve(self.run_spec(instance, configuration, cache=False)).identity
            identity[f"content of {sequence}"] = digest([run["content"], run["camera"]])
            for name, value in (program_of(run) | {"device": run["device"]}).items():
                programs[name].add(value)
        # rendered and recorded sequences are read by other code, and may have other sources of masks
        identity |= {name: " ".join(sorted(values)) for name, values in programs.items()}
        for tracker in self.trackers[1:]:
            other = self.configuration({TRACKER: tracker})
            run = resolve(self.run_spec(instances[0], other, cache=False)).identity
            identity[f"program of {tracker}"] = digest(program_of(run))
        identity["baseline settings"] = [self.baseline.tracker, dict(self.baseline.settings)]
        return identity | {"parameters": digest([repr(parameter) for parameter in self.space])}


class StoredStudy:
    """A stored study to look at; nothing is run, and neither tracker nor sequences need to be there.

    Args:
        study: A study, its TOML file, or its folder in the results (``results/studies/NAME``).
        results: The results folder; a study's own folder says where it lies.

    Attributes:
        spec: What it asks for.
        folder: Its folder in the results.
        study: Optuna's study.

    Raises:
        StudyError: There is no such study.
    """

    def __init__(self, study: StudySpec | Path | str, results: Path | str = "results") -> None:
        root = Path(results)
        if isinstance(study, StudySpec):
            self.spec = study
        elif (path := Path(study).expanduser()).is_dir():
            self.spec, root = read_stored(path)
        else:
            self.spec = read_study(path)
        self.folder = study_folder(root, self.spec)
        self.study = load_study(root, self.spec)

    def frame(self) -> pd.DataFrame:
        """All trials; see `storage.trials_frame`.

        Raises:
            StudyError: The storage holds something else than this package stores of a trial.
        """
        try:
            return trials_frame(self.spec, self.study)
        except (AttributeError, TypeError, ValueError, LookupError, ArithmeticError) as error:
            text = f"the storage of study '{self.spec.name}' holds what is no trial: {error}"
            raise StudyError(text) from error


def _objectives(given: str | Cost | Sequence[str | Cost] | None) -> list[Objective] | None:
    """Objectives by their names, and those that are functions of a user; None for those of the spec."""
    if given is None:
        return None
    several = [given] if isinstance(given, str) or callable(given) else given
    return [find_objective(one) if isinstance(one, str) else own_objective(one) for one in several]


def _texts(value: Any) -> Any:
    """Instances and paths as the texts that name them; any other value as it is."""
    if isinstance(value, list | tuple):
        return tuple(map(_texts, value))
    return str(value) if isinstance(value, ProblemInstance | Path) else value


def run_study(
    spec: StudySpec,
    *,
    results: str | Path = "results",
    jobs: int = 1,
    scenes: int = 0,
    trials: int = 0,
    on_event: OnEvent | None = None,
    on_run: OnRun | None = None,
) -> Study:
    """Run a study to its end, or go on with it.

    Args:
        spec: The study.
        results: The results folder; the study's own files lie in ``studies/<name>``.
        jobs: Trials at a time.
        scenes: Rendered scenes to add to those that choose and judge.
        trials: Trials to add.
        on_event: Called with every event.
        on_run: Called with every event of every run, those of `finish` included.

    Returns:
        The study, for `finish`.

    Raises:
        DynslamError: See `Study`.
    """
    tuner = Study(spec, results)
    if scenes or trials:
        tuner.extend(scenes=scenes, trials=trials)
    tuner.on_run = on_run
    # a new study says what it could show: its figures at once, its proposal after the baseline's runs
    if on_event is not None and not tuner.study.get_trials(deepcopy=False)[1:]:
        for line in tuner.preview(jobs).figures:
            on_event(StudyEvent("preview", 0, tuner.trials, line))
        tuner.reference(on_event, jobs)
        for line in tuner.preview(jobs).proposal:
            on_event(StudyEvent("preview", 0, tuner.trials, line))
    return tuner.run(jobs=jobs, on_event=on_event)


# Samplers and pruners by name. All trials meet the same growing sets of instances, on which
# Optuna's pruners end the worse ones early: asynchronous successive halving (Li et al. 2020) or
# Wilcoxon's signed-rank test against the best trial. Optuna prunes no trials of several objectives.

_STARTUP_TRIALS = 8
"""Random trials before a model of the values proposes settings."""


class StreamedSampler(optuna.samplers.BaseSampler):
    """Makes a sampler for each trial, seeded by the study's seed and the trial's number.

    Numbers are given out by the storage, so no two workers, and no worker that goes on later, draw
    from one stream, and a study with one worker gives the same trials again. `Study.ask` draws all
    settings of a trial before the next.

    Args:
        spec: The study; what a sampler knows of earlier trials it reads from Optuna's study.
    """

    def __init__(self, spec: StudySpec) -> None:
        self._spec = spec

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """Make the trial's sampler; it has drawn none of the trial's settings yet."""
        seed = int(stream(self._spec.sampler_seed, "sampler", trial.number).integers(2**31))
        with quiet():
            self._sampler = _SAMPLERS[self._spec.sampler](self._spec, seed)
        self._drawn = set[str]()
        self._sampler.before_trial(study, trial)

    def infer_relative_search_space(
        self, study: optuna.Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        """See Optuna."""
        return self._sampler.infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """See Optuna."""
        return self._sampler.sample_relative(study, trial, search_space)

    def sample_independent(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """See Optuna.

        Settings that a killed worker has drawn for this trial are drawn again, so that the others
        are what that worker would have drawn after them.
        """
        given = trial.system_attrs.get("fixed_params", {})
        for name, distribution in trial.distributions.items():
            if name not in self._drawn and name not in given and not distribution.single():
                self._drawn.add(name)
                self._sampler.sample_independent(study, trial, name, distribution)
        self._drawn.add(param_name)
        return self._sampler.sample_independent(study, trial, param_name, param_distribution)


_SAMPLERS: dict[SamplerName, Callable[[StudySpec, int], optuna.samplers.BaseSampler]] = {
    "random": lambda spec, seed: optuna.samplers.RandomSampler(seed=seed),
    "tpe": lambda spec, seed: optuna.samplers.TPESampler(
        n_startup_trials=min(_STARTUP_TRIALS, spec.trials // 2), constant_liar=True, seed=seed
    ),
    "nsga2": lambda spec, seed: optuna.samplers.NSGAIISampler(
        population_size=max(8, spec.trials // 5), seed=seed
    ),
    "gp": lambda spec, seed: optuna.samplers.GPSampler(n_startup_trials=_STARTUP_TRIALS, seed=seed),
}


FIRST_STEP = 3
"""Instances that every trial runs on before it may be pruned."""
WILCOXON_LEVEL = 0.1
"""Level of Wilcoxon's test: a trial is pruned below it."""

_PRUNERS: dict[PrunerName, Callable[[], optuna.pruners.BasePruner]] = {
    "halving": lambda: optuna.pruners.SuccessiveHalvingPruner(
        min_resource=FIRST_STEP, reduction_factor=2
    ),
    "wilcoxon": lambda: optuna.pruners.WilcoxonPruner(
        p_threshold=WILCOXON_LEVEL, n_startup_steps=FIRST_STEP
    ),
    "none": optuna.pruners.NopPruner,
}


def build_pruner(name: PrunerName) -> optuna.pruners.BasePruner:
    """Optuna's pruner of that name."""
    with quiet():
        return _PRUNERS[name]()
