"""``tune space|run|worker|extend|status|best``."""

from __future__ import annotations

import logging
import math
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from dynslam_bench import tuning
from dynslam_bench.cli.options import AsJson, Jobs, Results
from dynslam_bench.cli.output import (
    Advance,
    announce,
    fields,
    note,
    present,
    progress,
    table,
    write,
)
from dynslam_bench.cli.running import event_text
from dynslam_bench.cli.trackers import range_text
from dynslam_bench.core import write_atomic

if TYPE_CHECKING:
    from dynslam_bench.runs import RunEvent

app = typer.Typer(
    help="Studies: tune a tracker's settings through its environment.", no_args_is_help=True
)
Study = Annotated[Path, typer.Argument(metavar="STUDY.toml", help="The study.")]


@app.callback()
def silence_optuna() -> None:
    """Silence Optuna's messages before every command of the group."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    # it warns of trials that pruning never saw
    logging.getLogger("optuna.visualization").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)


@app.command()
def space(
    study: Study, results: Results = Path("results"), jobs: Jobs = 1, as_json: AsJson = False
) -> None:
    """Show which settings a study tunes, what its scenes could show, and how long it takes."""
    plan = tuning.StudyPlan(tuning.read_study(study), results)
    preview = plan.preview(jobs)

    rows = []
    for parameter in plan.space:
        name = parameter.name
        # a setting that only other choices give an effect has no value in the baseline
        value = "-" if plan.search.why_not(name, {}) else plan.base[name]
        rows.append((name, range_text(parameter), value, parameter.unit, parameter.meaning))
    settings = table(("setting", "range", "baseline", "unit", "meaning"), rows)
    lines = [settings, "", *preview.figures, *preview.proposal]
    present({"settings": plan.space, "preview": preview}, *lines)


@app.command()
def run(
    study: Study,
    results: Results = Path("results"),
    jobs: Jobs = 1,
    trials: Annotated[
        Optional[int], typer.Option(min=2, help="Finished trials, in place of the file's.")
    ] = None,
    choose: Annotated[
        Optional[int],
        typer.Option(min=0, help="Judge this trial, e.g. of the front, in place of the best."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run a study or continue it; then check the best on the held-out split, and write the page."""
    _tune(study, results, jobs, trials=trials, choose=choose)


@app.command()
def extend(
    study: Study,
    results: Results = Path("results"),
    jobs: Jobs = 1,
    scenes: Annotated[
        int,
        typer.Option(
            min=0, help="Further rendered scenes to judge on, where the study is extendable."
        ),
    ] = 0,
    trials: Annotated[int, typer.Option(min=0, help="Further trials.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Continue a study with more scenes and trials, where its verdict is not settled."""
    _tune(study, results, jobs, more_scenes=scenes, more_trials=trials)


def _tune(study: Path, results: Path, jobs: int, **how: Any) -> None:
    """Run or continue a study with a progress bar, and show its conclusion; for `how` see `api.tune`."""
    from dynslam_bench.api import tune

    spec = tuning.read_study(study)
    with progress(f"trials of study {spec.name}") as advance:
        bar = StudyBar(advance)
        outcome = tune(
            spec,
            results=results,
            jobs=jobs,
            on_event=bar.event,
            on_run=bar.run,
            on_note=bar.note,
            **how,
        )
    show_summary(outcome.tuner, outcome.summary, outcome.page)


@app.command()
def worker(study: Study, results: Results = Path("results"), jobs: Jobs = 1) -> None:
    """Only run trials of a study, beside other workers on the same storage."""
    spec = tuning.read_study(study)
    with progress(f"trials of study {spec.name}") as advance:
        bar = StudyBar(advance)
        tuner = tuning.run_study(
            spec, results=results, jobs=jobs, on_event=bar.event, on_run=bar.run
        )
    write(f"study '{spec.name}' has its {tuner.trials} trials")


@app.command()
def status(study: Study, results: Results = Path("results"), as_json: AsJson = False) -> None:
    """Show the progress of a study."""
    from dynslam_bench.tuning.storage import (
        Heartbeats,
        best_trials,
        count_states,
        extension_of,
        front_trials,
    )

    stored = tuning.Study.open(study, results)
    facts: dict[str, Any] = {
        "study": stored.spec.name,
        "folder": stored.folder,
        "asked_for": stored.spec.trials + extension_of(stored.study)["trials"],
    }
    facts |= count_states(stored.study)
    facts["running_trials"] = [
        f"{number} ({state})" for number, state in Heartbeats(stored.study).running().items()
    ]

    # the best settings: those that the conclusion offers if there is one, else of the trial with the best values
    settings: dict[str, Any] = {}
    summary = stored.folder / "summary.json"
    conclusion = tuning.StudySummary.read(summary) if summary.is_file() else None
    if conclusion is not None and conclusion.best is not None:  # as `tune best`
        facts |= {"best_trial": conclusion.best.trial, "conclusion": conclusion.conclusion}
        settings = conclusion.offered
    else:
        for trial in best_trials(stored.study, 1):
            # values are natural logarithms of ratios to the baseline
            ratios = [math.exp(value) for value in trial.values]
            facts |= {"best_trial": trial.number, "best_ratios": ratios}
            settings = trial.params
    lines = ["", table(("setting", "value"), list(settings.items()))] if settings else []

    # several objectives: the trials to choose from
    front = front_trials(stored.study)
    if front:
        facts["front"] = [trial.number for trial in front]
        rows = [
            (trial.number, *(f"{math.exp(value):.3f}" for value in trial.values)) for trial in front
        ]
        headings = [f"ratio of {name}" for name in stored.spec.objectives]
        lines += [
            "",
            "The front, each to be judged by tune run --choose TRIAL:",
            table(("trial", *headings), rows),
        ]
    present(facts | {"best_settings": settings}, fields(facts), *lines)


@app.command()
def best(
    study: Study,
    results: Results = Path("results"),
    trial: Annotated[
        Optional[int], typer.Option(min=0, help="Of a trial, in place of the best.")
    ] = None,
    output: Annotated[
        Optional[Path], typer.Option("-o", "--output", help="Write the preset there.")
    ] = None,
) -> None:
    """Write a study's settings as a preset that `run --settings` takes."""
    text = tuning.read_preset_text(tuning.read_study(study), results, trial)
    if output is not None:
        write_atomic(output, text)
    write(text.rstrip() if output is None else str(output))


class StudyBar:
    """The progress bar of a study: its current part, and the last event of a run in it.

    Args:
        advance: Updates the bar.
    """

    def __init__(self, advance: Advance) -> None:
        self._advance = advance
        self._runs = 0
        self._part = "baseline"
        self._done = 0.0
        self._total: float | None = None

    def event(self, event: tuning.StudyEvent) -> None:
        """A trial has started or finished, or the study has begun another part."""
        if event.kind == "preview":
            announce(event.text)
            return
        if event.kind == "finished":
            note(event.text)
        # trials are counted, the baseline's runs are not
        total = None if event.kind == "reference" else event.total
        self._begin(event.text, event.number + (event.kind == "finished"), total)

    def note(self, text: str) -> None:
        """The final check has begun a step."""
        note(text)
        self._begin(text, 0, None)

    def run(self, event: RunEvent) -> None:
        """A run has started, progressed or finished."""
        self._runs += event.kind == "finished"
        plural = "s" if self._runs != 1 else ""
        step = f"{self._part}, {self._runs} run{plural} made: {event_text(event)}"
        self._advance(self._done, self._total, step)

    def _begin(self, part: str, done: float, total: float | None) -> None:
        """Show a part of the study, with how much of it is done; a total of None is unknown."""
        self._part = part
        self._done = done
        self._total = total
        self._advance(done, total, part)


def show_summary(tuner: tuning.Study, summary: tuning.StudySummary, page: Path) -> None:
    """Show the conclusion, the best settings and the paths of page and preset."""
    from dynslam_bench.tuning.judgement import next_step
    from dynslam_bench.tuning.plan import seen_note

    preset = tuner.folder / "best.toml"
    best = summary.best
    lines = [summary.conclusion]
    if best is not None and best.scene_errors:
        lines.append(best.errors_sentence)
    if caution := seen_note(summary.seen):
        lines.append(caution)
    lines.append("")
    if best is not None:
        if not summary.is_to_use:
            lines.append("The best trial's settings, which are no result to use:")
        lines += [table(("setting", "value"), list(best.params.items())), ""]
    lines.append(f"preset: {preset}\npage:   {page}")
    configuration = tuner.configuration(best.params if best is not None else {})
    sentence, command = next_step(tuner.spec, summary, tuner.baseline, configuration)
    lines += ["", sentence, f"  {command}"]
    present({"summary": summary, "page": page, "preset": preset}, *lines)
