"""Studies from Python: run one with custom objectives, samplers and callbacks, trial by trial, or open a stored one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import optuna
from optuna.trial import FrozenTrial

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.settings import Scalar
from dynslam_bench.tuning.final_runs import finish
from dynslam_bench.tuning.instances import ProblemInstance
from dynslam_bench.tuning.objectives import Cost, Objective, find_objective, own_objective
from dynslam_bench.tuning.page import write_page
from dynslam_bench.tuning.plan import Preview
from dynslam_bench.tuning.storage import load_study, read_stored
from dynslam_bench.tuning.study_file import StudySpec, make_spec, read_study
from dynslam_bench.tuning.summary import StudySummary
from dynslam_bench.tuning.trials import trials_frame
from dynslam_bench.tuning.tuner import Evaluation, OnEvent, OnRun, StudyEvent, Tuner

if TYPE_CHECKING:
    import pandas as pd


Callback = Callable[[optuna.Study, FrozenTrial], object]
"""Called after each trial, as Optuna's own."""


class Study:
    """A study, to be run or to be looked at.

    Example:
        ``Study(tracker="orb-slam2", tune=["synthetic/walking_xyz?scene=0-3&frames=80"], name="few").run().finish()``

    Args:
        spec: The study, or its TOML file; None if the fields say it all.
        results: The results folder.
        objective: In place of the spec's: names of objectives, or functions from
            `evaluate.Outcome` to a cost above 0, one or several.
        sampler: Any of Optuna's, in place of the spec's.
        callbacks: Called with Optuna's study and the trial after each trial.
        **fields: Fields of `StudySpec`, in place of the spec's; `tune`, `confirm` and `held_out` take instances, too.

    Attributes:
        spec: What it asks for.
        study: Optuna's study.

    Raises:
        DynslamError: See `Tuner`.
    """

    spec: StudySpec
    study: optuna.Study
    _tuner: Tuner | None

    def __init__(
        self,
        spec: StudySpec | Path | str | None = None,
        *,
        results: Path | str = "results",
        objective: str | Cost | Sequence[str | Cost] | None = None,
        sampler: optuna.samplers.BaseSampler | None = None,
        callbacks: Iterable[Callback] = (),
        **fields: Any,
    ) -> None:
        base = read_study(spec) if isinstance(spec, Path | str) else spec
        objectives = _objectives(objective)
        changes = {key: _texts(value) for key, value in fields.items()}
        if objectives is not None:
            changes["objectives"] = tuple(objective.name for objective in objectives)
        values = {} if base is None else base.model_dump()
        self.spec = make_spec({"name": "study", **values, **changes}, "the study")
        self._tuner = tuner = Tuner(self.spec, results, objectives=objectives, sampler=sampler)
        self.study = tuner.study
        self._callbacks = tuple(callbacks)

    @classmethod
    def open(cls, study: StudySpec | Path | str, results: Path | str = "results") -> Study:
        """Open a stored study to look at; nothing is run, and neither tracker nor sequences need to be there.

        Args:
            study: A study, its TOML file, or its folder in the results (``results/studies/NAME``).
            results: The results folder; a study's own folder says where it lies.

        Raises:
            StudyError: There is no such study.
        """
        opened, root = cls.__new__(cls), Path(results)
        if isinstance(study, StudySpec):
            opened.spec = study
        elif (path := Path(study).expanduser()).is_dir():
            opened.spec, root = read_stored(path)
        else:
            opened.spec = read_study(path)
        opened.study, opened._tuner = load_study(root, opened.spec), None
        return opened

    def preview(self, *, jobs: int = 1) -> Preview:
        """What the study could show and how long it takes; see `plan.Plan.preview`."""
        return self._running().preview(jobs)

    def run(self, *, jobs: int = 1) -> Study:
        """Run the trials that are missing.

        Raises:
            StudyError: The baseline fails, or the study was opened to be looked at.
        """
        self._running().run(jobs=jobs, on_event=self._call_back)
        return self

    def ask(self, settings: Mapping[str, Scalar] | None = None) -> optuna.Trial:
        """The next trial, as the sampler proposes it; see `Tuner.ask`."""
        return self._running().ask(settings)

    def evaluate(self, trial: optuna.Trial) -> Evaluation:
        """Run a trial; see `Tuner.run_trial`."""
        return self._running().run_trial(trial)

    def tell(self, trial: optuna.Trial, evaluation: Evaluation) -> None:
        """Store what a trial came to."""
        self._running().tell(trial, evaluation)

    def extend(self, *, scenes: int = 0, trials: int = 0) -> Study:
        """Ask for more rendered scenes to judge on and for more trials; `run` and `finish` then go on."""
        self._running().extend(scenes=scenes, trials=trials)
        return self

    def finish(self, *, jobs: int = 1) -> StudySummary:
        """Judge the best trials, write presets, summary and page; see `final_runs.finish`."""
        tuner = self._running()
        summary = finish(tuner, jobs=jobs)
        write_page(tuner, summary)
        return summary

    def frame(self) -> pd.DataFrame:
        """All trials; see `trials.trials_frame`.

        Raises:
            StudyError: The storage holds something else than this package stores of a trial.
        """
        try:
            return trials_frame(self.spec, self.study)
        except (AttributeError, TypeError, ValueError, LookupError, ArithmeticError) as error:
            raise StudyError(f"the storage of study '{self.spec.name}' holds what is no trial: {error}") from error

    def _running(self) -> Tuner:
        if self._tuner is None:
            raise StudyError(f"study '{self.spec.name}' was opened to be looked at", "Study(...) makes one to run")
        return self._tuner

    def _call_back(self, event: StudyEvent) -> None:
        if event.kind == "finished" and self._callbacks:
            trial = self.study.get_trials(deepcopy=False)[event.number]
            for callback in self._callbacks:
                callback(self.study, trial)


def _objectives(given: str | Cost | Sequence[str | Cost] | None) -> list[Objective] | None:
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
) -> Tuner:
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
        DynslamError: See `Tuner`.
    """
    tuner = Tuner(spec, results)
    if scenes or trials:
        tuner.extend(scenes=scenes, trials=trials)
    tuner.on_run = on_run
    if on_event is not None and not tuner.study.get_trials(deepcopy=False)[1:]:
        for line in tuner.preview(jobs).lines:
            on_event(StudyEvent("preview", 0, tuner.trials, line))
    tuner.run(jobs=jobs, on_event=on_event)
    return tuner
