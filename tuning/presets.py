"""The presets of a study: written when it is finished, read by their names."""

from __future__ import annotations

from pathlib import Path

from dynslam_bench.core.errors import StudyError, did_you_mean
from dynslam_bench.core.reading import read_text
from dynslam_bench.core.records import write_atomic

from .preset import preset_text
from .seen import seen_note
from .storage import study_folder
from .study import Tuner
from .study_file import StudySpec
from .summary import StudySummary, worth
from .trials import best_trials


def write_presets(tuner: Tuner, summary: StudySummary) -> None:
    """Write every pick as a preset: tuned settings alone, with what they are worth and where that was seen."""
    spec = tuner.spec
    for name, number in summary.picks.items():
        candidate = next((each for each in summary.candidates if each.trial == number), None)
        found = summary.conclusion if name == "best" else worth(name, candidate, summary.split_notes)
        text = preset_text(
            {} if candidate is None else candidate.params,
            spec.tracker,
            " ".join(filter(None, (found, seen_note(summary.seen)))),
            fixed=spec.space.fixed,
            tuned_on=[*summary.tune, *summary.confirm],
            judged_on=[*summary.held_out, *summary.recorded] if candidate is not None else (),
        )
        write_atomic(tuner.folder / f"{name}.toml", text)


def read_preset_text(spec: StudySpec, results: Path | str = "results", pick: str = "best") -> str:
    """A preset of a study, as text; of one that is not finished the best trial so far.

    Args:
        spec: The study.
        results: The results folder.
        pick: ``best``; of a study of several objectives ``fast``, ``balanced`` and ``accurate``, too.

    Raises:
        StudyError: There is no such study or preset.
    """
    folder = study_folder(Path(results), spec)
    if (folder / "summary.json").is_file():
        picks = list(StudySummary.read(folder / "summary.json").picks) or ["best"]
        if pick not in picks:
            hint = did_you_mean(pick, picks) if len(picks) > 1 else 'objectives = ["accuracy", "speed"] make three'
            raise StudyError(f"study '{spec.name}' has no preset '{pick}'", hint)
        return read_text(folder / f"{pick}.toml", kind=StudyError)
    if pick != "best":
        raise StudyError(f"study '{spec.name}' is not finished: no presets yet", "dynslam-bench tune run STUDY.toml")
    found = best_trials(Tuner(spec, results, reading=True).study, 1)
    if not found:
        raise StudyError(f"study '{spec.name}' has no finished trial", "dynslam-bench tune run STUDY.toml")
    remark = f"Trial {found[0].number}, the best so far; not judged on blocks that no trial has seen."
    return preset_text(found[0].params, spec.tracker, remark, fixed=spec.space.fixed)
