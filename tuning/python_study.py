"""Studies from Python: blocks, objectives, samplers and callbacks of one's own, and stored studies to look at."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import optuna
from optuna.trial import FrozenTrial

from dynslam_bench.core.errors import SequenceError, SettingsError, StudyError
from dynslam_bench.core.reading import read_json
from dynslam_bench.core.settings import Scalar
from dynslam_bench.core.toml import read_toml

from .blocks import Block
from .final_runs import finish
from .frame import trials_frame
from .objectives import Cost, Objective, find_objective, own_objective
from .old_form import converted
from .page import write_page
from .pilot import Pilot
from .screening import Screening
from .starting import begin, pilot_of, screen_study
from .storage import open_storage, study_folder
from .study import StudyEvent, Tuner
from .study_file import StudySpec, make_spec, read_study
from .summary import StudySummary
from .warm_start import starting_point

if TYPE_CHECKING:
    import pandas as pd

_SPEC_FILE = "study.json"
Callback = Callable[[optuna.Study, FrozenTrial], object]
"""Called after each trial, as Optuna's own."""


class Study:
    """A study, to be run or to be looked at.

    Example:
        ``Study(tracker="orb-slam2", tune=["synthetic/walking_xyz?scene=0-3&frames=80"], name="few").run().finish()``

    Args:
        spec: The study, or its TOML file; None if the fields say it all.
        results: The results folder.
        objective: In place of the spec's: names of objectives, or functions of one's own that give what a run costs
            (`evaluate.Outcome` to a number above 0), one or several.
        sampler: Any of Optuna's, in place of the spec's.
        callbacks: Called with Optuna's study and the trial after each trial.
        start: Presets (TOML files, or settings by dotted name) that are tried right after the default.
        **fields: Fields of `StudySpec`, in place of the spec's; `tune`, `confirm` and `held_out` take blocks, too.

    Attributes:
        spec: What it asks for.
        study: Optuna's study.

    Raises:
        DynslamError: See `Tuner`; or a preset holds settings that the study neither tunes nor has.
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
        start: Iterable[Path | str | Mapping[str, Scalar]] = (),
        **fields: Any,
    ) -> None:
        base = read_study(spec) if isinstance(spec, Path | str) else spec
        objectives = _objectives(objective)
        given = {key: _texts(value) for key, value in fields.items()}
        if objectives is not None:
            given["objectives"] = tuple(each.name for each in objectives)
        known = {} if base is None else base.model_dump()
        self.spec = make_spec({"name": "study", **known, **given}, "the study")
        self._tuner = tuner = Tuner(self.spec, results, objectives=objectives, sampler=sampler)
        self.study = tuner.study
        self._callbacks = tuple(callbacks)
        self._summary: StudySummary | None = None
        for preset in start:
            values = preset if isinstance(preset, Mapping) else read_preset(Path(preset))
            tuner.study.enqueue_trial(starting_point(values, tuner.space, tuner.base), skip_if_exists=True)

    @classmethod
    def open(cls, study: StudySpec | Path | str, results: Path | str = "results") -> Study:
        """Open a stored study to look at; nothing is run, and neither tracker nor sequences need to be there.

        Args:
            study: A study, its TOML file, or its folder in the results (``results/studies/NAME``).
            results: The results folder; a study's own folder says where it lies.

        Raises:
            StudyError: There is no such study.
        """
        spec, root = _spec_of(study, Path(results))
        if not spec.storage and not study_folder(root, spec).is_dir():
            raise StudyError(f"there is no study '{spec.name}' in {root}", "dynslam-bench tune run STUDY.toml")
        opened = cls.__new__(cls)
        try:
            opened.study = optuna.load_study(study_name=spec.name, storage=open_storage(root, spec))
        except KeyError as error:
            raise StudyError(
                f"the storage holds no study '{spec.name}'", "dynslam-bench tune run STUDY.toml"
            ) from error
        opened.spec, opened._tuner = spec, None
        return opened

    def run(self, *, jobs: int = 1) -> Study:
        """Run the trials that are missing; a pilot first, if the study is new and asks for one.

        Raises:
            StudyError: The default settings fail, the pilot shows that the study could find nothing, or it was opened
                to be looked at.
        """
        tuner = self._running()
        begin(tuner, jobs=jobs)
        tuner.run(jobs=jobs, on_event=self._told)
        return self

    def finish(self, *, jobs: int = 1) -> StudySummary:
        """Judge the best trials, write presets, summary and page; see `final_runs.finish`."""
        tuner = self._running()
        summary = finish(tuner, jobs=jobs)
        write_page(tuner, summary)
        return summary

    def pilot(self, *, jobs: int = 1) -> Pilot:
        """What the study's blocks could show; see `starting.pilot_of`."""
        return pilot_of(self._running(), jobs=jobs)

    def screen(self, *, points: int = 2, blocks: int = 4, jobs: int = 1) -> Screening:
        """Which settings matter; see `starting.screen_study`."""
        return screen_study(self._running(), points=points, blocks=blocks, jobs=jobs)

    def frame(self) -> pd.DataFrame:
        """All trials; see `frame.trials_frame`.

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

    def _told(self, event: StudyEvent) -> None:
        if event.kind == "finished" and self._callbacks:
            trial = self.study.get_trials(deepcopy=False)[event.number]
            for callback in self._callbacks:
                callback(self.study, trial)


def read_preset(path: Path) -> dict[str, Scalar]:
    """A preset's settings by dotted name.

    Raises:
        SettingsError: It cannot be read, or is no TOML.
    """
    try:
        document = read_toml(path.expanduser())
    except SequenceError as error:
        raise SettingsError(str(error)) from None
    return dict(_flat(document))


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _objectives(given: str | Cost | Sequence[str | Cost] | None) -> list[Objective] | None:
    if given is None:
        return None
    several = [given] if isinstance(given, str) or callable(given) else list(given)
    return [find_objective(each) if isinstance(each, str) else own_objective(each) for each in several]


def _texts(value: Any) -> Any:
    """Blocks as the texts that name them."""
    if isinstance(value, Block):
        return (str(value),)
    several = isinstance(value, list | tuple) and any(isinstance(each, Block) for each in value)
    return tuple(map(str, value)) if several else value


def _spec_of(study: StudySpec | Path | str, results: Path) -> tuple[StudySpec, Path]:
    """The study and the results folder that it lies in."""
    if isinstance(study, StudySpec):
        return study, results
    path = Path(study).expanduser()
    stored = path / _SPEC_FILE
    if stored.is_file():
        values = read_json(stored, kind=StudyError)
        return make_spec(
            converted(values)[0] if isinstance(values, dict) else values, str(stored)
        ), path.absolute().parents[1]
    if path.is_dir():
        raise StudyError(f"{path} holds no study: it has no {_SPEC_FILE}", "name results/studies/NAME")
    return read_study(path), results
