"""A stored study as a pandas frame: one row a trial."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import optuna
from optuna.trial import FrozenTrial

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.reading import read_json

from .storage import open_storage, study_folder
from .study_file import StudySpec, make_study, read_study

if TYPE_CHECKING:
    import pandas as pd

_SPEC_FILE = "study.json"


class Study:
    """A stored study, to be looked at.

    Attributes:
        spec: What it asks for.
        study: Optuna's study.
    """

    def __init__(self, spec: StudySpec, study: optuna.Study) -> None:
        self.spec = spec
        self.study = study

    @classmethod
    def open(cls, study: StudySpec | Path | str, results: Path | str = "results") -> Study:
        """Open a study; nothing is run, and neither tracker nor sequences need to be there.

        Args:
            study: A study, its TOML file, or its folder in the results (``results/studies/NAME``).
            results: The results folder; a study's own folder says where it lies.

        Raises:
            StudyError: There is no such study.
        """
        spec, root = _spec_of(study, Path(results))
        if not spec.storage and not study_folder(root, spec).is_dir():
            raise StudyError(f"there is no study '{spec.name}' in {root}", "dynslam-bench tune run STUDY.toml")
        try:
            found = optuna.load_study(study_name=spec.name, storage=open_storage(root, spec))
        except KeyError as error:
            raise StudyError(
                f"the storage holds no study '{spec.name}'", "dynslam-bench tune run STUDY.toml"
            ) from error
        return cls(spec, found)

    def frame(self) -> pd.DataFrame:
        """All trials.

        Returns:
            One line a trial, in order; whatever is missing is ``pd.NA``. ``Int64``: trial (0 is the default), runs
            (that it was evaluated on). ``string``: state (``complete``, ``pruned``, ``fail``, ``running``,
            ``waiting``), reason (why it was pruned or failed; missing else). ``boolean``: feasible (all constraints
            hold; missing where nothing was measured). ``Float64``: one column for each objective, named after
            ``value_``, as told to Optuna (accuracy: mean natural logarithm of the ATE ratio to the default settings,
            less is better; speed: real-time factor, more is better), ratio (the geometric-mean ATE ratio, below 1 is
            better than the default; missing if accuracy is no objective), coverage (share, 0 to 1), fps (frames a
            second), duration_s (seconds from the start of the trial to its end). Then a column ``params.NAME`` for
            each tuned setting, in its own unit: ``Float64``, ``Int64``, ``boolean`` or ``string``, missing where its
            condition did not hold.
        """
        import pandas as pd

        trials = self.study.get_trials(deepcopy=False)
        objectives = [f"value_{objective}" for objective in self.spec.objectives]
        kinds = {"trial": "Int64", "state": "string"} | dict.fromkeys([*objectives, "ratio"], "Float64")
        kinds |= dict.fromkeys(["duration_s", "coverage", "fps"], "Float64")
        kinds |= {"runs": "Int64", "feasible": "boolean", "reason": "string"}
        names = sorted({name for trial in trials for name in trial.params})
        lines = [self._line(trial) for trial in trials]
        frame = pd.DataFrame(lines, columns=list(kinds)).astype(kinds)
        for name in names:
            drawn = [trial.params.get(name) for trial in trials]
            frame[f"params.{name}"] = pd.Series(drawn, dtype=_dtype(drawn))
        return frame

    def _line(self, trial: FrozenTrial) -> dict[str, Any]:
        values = dict(zip(self.spec.objectives, trial.values or [], strict=False))
        notes, constraints = trial.user_attrs, trial.user_attrs.get("constraints")
        accuracy = values.get("accuracy")
        return {
            "trial": trial.number,
            "state": trial.state.name.lower(),
            **{f"value_{objective}": value for objective, value in values.items()},
            "ratio": None if accuracy is None else math.exp(accuracy),
            "duration_s": None if trial.duration is None else trial.duration.total_seconds(),
            "coverage": notes.get("coverage"),
            "fps": notes.get("fps"),
            "runs": len(notes.get("instances", [])),
            "feasible": None if constraints is None else all(value <= 0 for value in constraints.values()),
            "reason": notes.get("reason"),
        }


def _spec_of(study: StudySpec | Path | str, results: Path) -> tuple[StudySpec, Path]:
    """The study and the results folder that it lies in."""
    if isinstance(study, StudySpec):
        return study, results
    path = Path(study).expanduser()
    stored = path / _SPEC_FILE
    if stored.is_file():
        return make_study(read_json(stored, kind=StudyError), stored), path.absolute().parents[1]
    if path.is_dir():
        raise StudyError(f"{path} holds no study: it has no {_SPEC_FILE}", "name results/studies/NAME")
    return read_study(path), results


def _dtype(values: list[Any]) -> str:
    kinds = {type(value) for value in values if value is not None}
    if kinds == {bool}:
        return "boolean"
    if kinds == {int}:
        return "Int64"
    return "Float64" if kinds <= {int, float} else "string"
