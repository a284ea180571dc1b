"""The presets of a study: written when it is finished, read by their names."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import StudyError, did_you_mean
from dynslam_bench.core.reading import read_text
from dynslam_bench.core.records import write_atomic
from dynslam_bench.tuning.splits import seen_note
from dynslam_bench.tuning.storage import study_folder
from dynslam_bench.tuning.study_file import StudySpec
from dynslam_bench.tuning.summary import StudySummary, worth
from dynslam_bench.tuning.trials import best_trials
from dynslam_bench.tuning.tuner import Tuner


def write_presets(tuner: Tuner, summary: StudySummary) -> None:
    """Write every pick as a preset: tuned settings alone, with what they are worth and where that was seen."""
    spec = tuner.spec
    for name, number in summary.picks.items():
        candidate = next((one for one in summary.candidates if one.trial == number), None)
        remark = summary.conclusion if name == "best" else worth(name, candidate, summary.split_notes)
        text = preset_text(
            {} if candidate is None else candidate.params,
            spec.tracker,
            " ".join(filter(None, (remark, seen_note(summary.seen)))),
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
    best = best_trials(Tuner(spec, results, reading=True).study, 1)
    if not best:
        raise StudyError(f"study '{spec.name}' has no finished trial", "dynslam-bench tune run STUDY.toml")
    remark = f"Trial {best[0].number}, the best so far; not judged on instances that no trial has seen."
    return preset_text(best[0].params, spec.tracker, remark, fixed=spec.space.fixed)


# The text of a preset.


def preset_text(
    tuned: Mapping[str, Any],
    tracker: str,
    remark: str,
    *,
    fixed: Mapping[str, Any] | None = None,
    tuned_on: Sequence[str] = (),
    judged_on: Sequence[str] = (),
) -> str:
    """TOML text of tuned settings, a dotted name and its value a line.

    What a study had fixed, for example the source of its masks, is only a comment, so that the preset runs wherever
    the tracker does.

    Args:
        tuned: The tuned settings; empty for the default.
        tracker: For which tracker.
        remark: A line on what they are worth.
        fixed: What every run of the study had besides.
        tuned_on: Instances that trials and choice saw.
        judged_on: Instances that judged.
    """
    remarks = [remark]
    if tuned_on:
        remarks.append(f"Tuned on {_listed(tuned_on)}.")
    if judged_on:
        remarks.append(f"Judged on {_listed(judged_on)}.")
    if fixed:
        values = ", ".join(f"{name} = {json.dumps(value)}" for name, value in sorted(fixed.items()))
        remarks.append(f"Fixed in that study, not part of these settings: {values}.")
    head = [f"settings of {tracker}", *(line for text in remarks for line in textwrap.wrap(text, 100))]
    values = [f"{name} = {json.dumps(value)}" for name, value in sorted(tuned.items())]
    return "\n".join([*(f"# {line}" for line in head), "", *values, ""])


def _listed(instances: Sequence[str]) -> str:
    """Instances by their sequences, with their number."""
    names = list(dict.fromkeys(re.sub(r"[?&](?!scene=)[^?&]*", "", text) for text in instances))
    shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    return f"{len(instances)} instance{'s' * (len(instances) != 1)} of {shown}"
