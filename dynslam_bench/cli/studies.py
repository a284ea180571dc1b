"""``tune space|pilot|screen|run|worker|status|best|report``."""

from __future__ import annotations

import json
import logging
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from dynslam_bench import tuning
from dynslam_bench.cli.options import AsJson, Jobs, Results
from dynslam_bench.cli.output import Advance, fields, note, present, progress, table, write
from dynslam_bench.cli.running import event_text
from dynslam_bench.cli.trackers import range_text

if TYPE_CHECKING:
    from dynslam_bench.runs import RunEvent

app = typer.Typer(help="Studies: tune a tracker's settings through its environment.", no_args_is_help=True)
Study = Annotated[Path, typer.Argument(metavar="STUDY.toml", help="The study.")]


@app.callback()
def silence_optuna() -> None:
    """Studies: tune a tracker's settings through its environment."""  # the group's help
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    logging.getLogger("optuna.visualization").setLevel(logging.ERROR)  # it warns of trials that pruning never saw
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)


@app.command()
def space(study: Study, as_json: AsJson = False) -> None:
    """Show which settings a study tunes, and within which limits."""
    from dynslam_bench.trackers import TRACKERS

    spec = tuning.read_study(study)
    sequences = {instance.sequence for instance in spec.instances(*spec.tune)}
    parameters = tuning.search_space(TRACKERS.get(spec.tracker).settings, spec.space, sequences)

    rows = [(p.name, range_text(p), p.default, p.unit, p.meaning) for p in parameters]
    present(parameters, table(("setting", "range", "default", "unit", "meaning"), rows))


@app.command()
def pilot(study: Study, results: Results = Path("results"), jobs: Jobs = 1, as_json: AsJson = False) -> None:
    """Measure the spread of a study's instances: what it could show, and what 5, 10 and 20 % would take."""
    outcome = tuning.pilot_of(tuning.Tuner(tuning.read_study(study), results), jobs=jobs)

    rows = [(f"{100 * n.effect:.0f} %", n.scenes, n.instances, f"{n.minutes:.0f}") for n in outcome.needs]
    lines = [f"{outcome.sentence}.\n", table(("gain", "scenes", "runs of one configuration", "minutes"), rows)]
    present(outcome, *lines, *([f"\nWarning: {outcome.warning}."] if outcome.warning else []))


@app.command()
def screen(
    study: Study,
    results: Results = Path("results"),
    jobs: Jobs = 1,
    points: Annotated[int, typer.Option(min=1, help="Points to move from: the default, and others near it.")] = 2,
    instances: Annotated[int, typer.Option(min=2, help="Instances of the study to run on.")] = 4,
    as_json: AsJson = False,
) -> None:
    """Find which settings matter, before a study: one at a time, on several instances; print the few worth tuning."""
    tuner = tuning.Tuner(tuning.read_study(study), results)
    with progress(f"screening {tuner.spec.name}") as advance:
        outcome = tuning.screen_study(tuner, points=points, instances=instances, jobs=jobs, on_done=advance)

    verdicts = {name: "kept" for name in outcome.kept} | dict.fromkeys(outcome.dead, "no effect")
    rows = [
        (e.name, e.objective, f"{e.size:.3f}", f"[{e.low:.3f}, {e.high:.3f}]", verdicts.get(e.name, ""))
        for e in outcome.effects
    ]
    extent = f"these {outcome.instances} instances ({outcome.runs} runs)"
    advice = f"No setting matters more than chance on {extent}: try more instances."
    if outcome.kept:
        advice = f"[space]\ninclude = [{', '.join(json.dumps(name) for name in outcome.kept)}]"
    present(
        outcome,
        table(("setting", "of", "effect (log ratio)", "90 % interval", ""), rows),
        "",
        *(f"{name} broke a run: {reason}" for name, reason in outcome.failed.items()),
        advice,
    )


@app.command()
def run(
    study: Study,
    results: Results = Path("results"),
    jobs: Jobs = 1,
    trials: Annotated[Optional[int], typer.Option(min=2, help="Finished trials, in place of the file's.")] = None,  # noqa: UP045
    as_json: AsJson = False,
) -> None:
    """Run a study or continue it; then check the best on the held-out split, and write the page."""
    from dynslam_bench.api import tune

    spec = tuning.read_study(study)
    with progress(f"study {spec.name}") as advance:
        bar = StudyBar(advance)
        outcome = tune(
            spec, results=results, jobs=jobs, trials=trials, on_event=bar.event, on_run=bar.run, on_note=bar.note
        )
    show_summary(outcome.tuner, outcome.summary, outcome.page)


@app.command()
def worker(study: Study, results: Results = Path("results"), jobs: Jobs = 1) -> None:
    """Only run trials of a study, beside other workers on the same storage."""
    spec = tuning.read_study(study)
    with progress(f"study {spec.name}") as advance:
        bar = StudyBar(advance)
        tuning.run_study(spec, results=results, jobs=jobs, on_event=bar.event, on_run=bar.run)
    write(f"study '{spec.name}' has its {spec.trials} trials")


@app.command()
def status(study: Study, results: Results = Path("results"), as_json: AsJson = False) -> None:
    """Show the progress of a study."""
    from dynslam_bench.tuning.trials import best_trials, count_states

    tuner = tuning.Tuner(tuning.read_study(study), results, reading=True)
    facts: dict[str, Any] = {"study": tuner.spec.name, "folder": tuner.folder, "asked_for": tuner.spec.trials}
    facts |= count_states(tuner.study)
    settings: dict[str, Any] = {}
    for trial in best_trials(tuner.study, 1):
        facts |= {"best_trial": trial.number, "best_values": trial.values}
        settings = trial.params
    lines = ["", table(("setting", "value"), list(settings.items()))] if settings else []
    present(facts | {"best_settings": settings}, fields(facts), *lines)


@app.command()
def best(
    study: Study,
    results: Results = Path("results"),
    pick: Annotated[
        str, typer.Option(help="best; of a study of several objectives fast, balanced, accurate too.")
    ] = "best",
    output: Annotated[Optional[Path], typer.Option("-o", "--output", help="Write the preset there.")] = None,  # noqa: UP045
) -> None:
    """Write a study's settings as a preset that `run --settings` takes."""
    from dynslam_bench.core.records import write_atomic

    text = tuning.read_preset_text(tuning.read_study(study), results, pick)
    if output is not None:
        write_atomic(output, text)
    write(text.rstrip() if output is None else str(output))


@app.command()
def report(study: Study, results: Results = Path("results"), as_json: AsJson = False) -> None:
    """Write a study's page; the best trials are checked first if they are not yet."""
    from dynslam_bench.tuning.storage import study_folder

    spec = tuning.read_study(study)
    stored = study_folder(results, spec) / "summary.json"
    tuner = tuning.Tuner(spec, results, reading=stored.is_file())
    if stored.is_file():
        summary = tuning.StudySummary.read(stored)
    else:
        tuner.reference()
        with progress(f"checking the best of {spec.name}") as advance:
            bar = StudyBar(advance)
            tuner.on_run = bar.run
            summary = tuning.finish(tuner, bar.note)
    show_summary(tuner, summary, tuning.write_page(tuner, summary))


class StudyBar:
    """The progress bar of a study: its current part, and the last event of a run in it.

    Args:
        advance: Updates the bar.
    """

    def __init__(self, advance: Advance) -> None:
        self._advance, self._runs = advance, 0
        self._part, self._at = "pilot", (0.0, None)

    def event(self, event: tuning.StudyEvent) -> None:
        """A trial has started or finished, or the study has begun another part."""
        if event.kind in ("pilot", "finished"):
            note(event.text)
        if event.kind in ("started", "finished"):
            self._begin(event.text, event.number + (event.kind == "finished"), event.total)
        elif event.kind == "reference":
            self._begin("the default settings", 0, event.total)

    def note(self, text: str) -> None:
        """The final check has begun a step."""
        note(text)
        self._begin(text, 0, None)

    def run(self, event: RunEvent) -> None:
        """A run has started, progressed or finished."""
        self._runs += event.kind == "finished"
        self._advance(*self._at, f"{self._part}, {self._runs} runs made: {event_text(event)}")

    def _begin(self, part: str, done: float, total: Any) -> None:
        self._part, self._at = part, (done, total)
        self._advance(done, total, part)


def show_summary(tuner: tuning.Tuner, summary: tuning.StudySummary, page: Path) -> None:
    """The conclusion, the chosen settings and the paths of page and preset."""
    from dynslam_bench.tuning.splits import seen_note

    preset = tuner.folder / "best.toml"
    lines = [summary.conclusion, *filter(None, [seen_note(summary.seen)]), ""]
    if summary.chosen is not None:
        lines += [table(("setting", "value"), list(summary.candidates[0].params.items())), ""]
    lines.append(f"preset: {preset}\npage:   {page}")
    present({"summary": summary, "page": page, "preset": preset}, *lines)
