"""Running studies: a pilot first, then the trials; and the screening that may come before both."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.records import write_atomic
from dynslam_bench.core.settings import Scalar

from .blocks import Block, scenes
from .objectives import ACCURACY, Objective, Outcomes, together
from .pilot import FEWEST, Pilot, refuse_hopeless, run_pilot
from .screening import Screening, screen
from .screening_plan import live, plan
from .study import OnEvent, OnRun, StudyEvent, Tuner
from .study_file import StudySpec

PILOT_FILE, SCREENING_FILE = "pilot.json", "screening.json"
SCREENED_BLOCKS = 4
"""Blocks that a screening takes if nothing else is asked for."""


def run_study(
    spec: StudySpec,
    *,
    results: str | Path = "results",
    jobs: int = 1,
    on_event: OnEvent | None = None,
    on_run: OnRun | None = None,
) -> Tuner:
    """Run a study to its end, or go on with it; a pilot runs first where the study asks for one.

    Args:
        spec: The study.
        results: The results folder; the study's own files lie in ``studies/<name>``.
        jobs: Trials at a time.
        on_event: Told of everything that happens.
        on_run: Told of every run, those of `finish` among them.

    Returns:
        The study, for `finish`.

    Raises:
        DynslamError: See `Tuner`; or the pilot shows that the study could find nothing.
    """
    tuner = Tuner(spec, results)
    tuner.on_run = on_run
    begin(tuner, jobs=jobs, on_event=on_event)
    tuner.run(jobs=jobs, on_event=on_event)
    return tuner


def begin(tuner: Tuner, *, jobs: int = 1, on_event: OnEvent | None = None) -> None:
    """Run a new study's pilot, if it asks for one, and say what it found.

    Raises:
        StudyError: The study could find nothing.
    """
    if not tuner.spec.pilot or (tuner.folder / PILOT_FILE).is_file() or tuner.study.get_trials(deepcopy=False)[1:]:
        return

    def say(text: str) -> None:
        if on_event is not None:
            on_event(StudyEvent("pilot", 0, 1, text))

    if len(scenes(tuner.design.race)) < FEWEST:
        say(f"no pilot: it takes {FEWEST} scenes to tune on")
        return
    found = pilot_of(tuner, jobs=jobs)
    say(found.sentence)
    if found.warning:
        say(found.warning)
    if not tuner.spec.at_equal_accuracy:  # settings that leave the poses alone show their speed in any case
        refuse_hopeless(found)


def pilot_of(tuner: Tuner, *, jobs: int = 1) -> Pilot:
    """Run a study's pilot; `pilot.json` in its folder holds it.

    It looks at the study's own objectives, or at accuracy where a gain counts only at equal accuracy: that is then the
    hard part.

    Raises:
        StudyError: The default settings fail, or there are too few scenes.
    """

    def run(values: Mapping[str, Any], blocks: Sequence[Block]) -> Outcomes:
        return tuner.evaluate({**tuner.spec.space.fixed, **values}, blocks, jobs=jobs)

    objective = ACCURACY if tuner.spec.at_equal_accuracy else together(tuner.objectives)
    split = tuner.design.held_out if len(scenes(tuner.design.held_out)) >= FEWEST else None
    found = run_pilot(
        tuner.space,
        tuner.base,
        run,
        tuner.design.reference,
        objective,
        seed=tuner.spec.sampler_seed,
        jobs=jobs,
        split=split,
    )
    write_atomic(tuner.folder / PILOT_FILE, found.to_json())
    return found


def screen_study(
    tuner: Tuner, *, points: int = 2, blocks: int = SCREENED_BLOCKS, jobs: int = 1,
    on_done: Callable[[int, int], None] | None = None,
) -> Screening:  # fmt: skip
    """Find the settings of a study's space that matter; `screening.json` in its folder holds them.

    Args:
        tuner: The study.
        points: From how many points settings are moved: the default and others near it.
        blocks: On how many of its blocks, of different scenes where there are so many.
        jobs: Runs at a time.
        on_done: Told how many configurations of how many are done.

    Raises:
        StudyError: See `screening.screen`.
    """
    chosen = tuner.design.race[:blocks]
    objectives: list[Objective] = list(dict.fromkeys([*tuner.objectives, ACCURACY]))

    def run(values: Mapping[str, Scalar]) -> Outcomes:
        return tuner.evaluate({**tuner.spec.space.fixed, **values}, chosen)

    usable = live(tuner.space, tuner.base)
    if not usable:
        raise StudyError("no setting of the space has an effect at the default", "fix what switches them on")
    found = screen(
        plan(usable, tuner.base, points, tuner.spec.sampler_seed), run, objectives, jobs=jobs, on_done=on_done
    )
    write_atomic(tuner.folder / SCREENING_FILE, found.to_json())
    return found
