"""``tune space|pilot|screen|run|worker|status|best|report``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from dynslam_bench.cli.options import AsJson, Jobs, Results
from dynslam_bench.cli.output import Advance, note, progress, write, write_fields, write_json, write_table
from dynslam_bench.cli.running import run_words

if TYPE_CHECKING:
    from dynslam_bench.runs import RunEvent
    from dynslam_bench.tuning import StudySpec, StudySummary, Tuner

app = typer.Typer(help="Studies: tune a tracker's settings through its environment.", no_args_is_help=True)


@app.callback()
def _quiet() -> None:
    """Studies: tune a tracker's settings through its environment."""
    hush_optuna()


Study = Annotated[Path, typer.Argument(metavar="STUDY.toml", help="The study.")]


@app.command()
def space(study: Study, as_json: AsJson = False) -> None:
    """Show which settings a study tunes, and within which limits."""
    from dataclasses import asdict

    from dynslam_bench.trackers import TRACKERS
    from dynslam_bench.tuning import read_study, search_space

    spec = read_study(study)
    sequences = {instance.sequence for instance in spec.instances(*spec.tune)}
    found = search_space(TRACKERS.get(spec.tracker).settings, spec.space, sequences)
    if as_json:
        write_json([asdict(parameter) for parameter in found])
        return
    rows = []
    for parameter in found:
        limits = parameter.choices or (parameter.low, parameter.high)
        span = ", ".join(map(str, limits)) if parameter.choices else f"{parameter.low:g} to {parameter.high:g}"
        if parameter.scale == "log":
            span += " (log)"
        conditions = [f"{name} = {' or '.join(map(str, values))}" for name, values in parameter.when]
        rows.append(
            (parameter.name, span, parameter.default, parameter.unit, " and ".join(conditions), parameter.meaning)
        )
    write_table(("setting", "range", "default", "unit", "only if", "meaning"), rows)


@app.command()
def pilot(study: Study, results: Results = Path("results"), jobs: Jobs = 1, as_json: AsJson = False) -> None:
    """Measure the spread of a study's instances: what it could show, and what 5, 10 and 20 % would take."""
    from dynslam_bench.tuning import Tuner, pilot_of, read_study

    found = pilot_of(Tuner(read_study(study), results), jobs=jobs)
    if as_json:
        write_json(found)
        return
    write(f"{found.sentence}.")
    write()
    rows = [(f"{100 * need.effect:.0f} %", need.scenes, need.instances, f"{need.minutes:.0f}") for need in found.needs]
    write_table(("gain", "scenes", "runs of one configuration", "minutes"), rows)
    if found.warning:
        write()
        write(f"Warning: {found.warning}.")


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
    from dynslam_bench.tuning import Tuner, read_study, screen_study

    tuner = Tuner(read_study(study), results)
    with progress(f"screening {tuner.spec.name}") as advance:
        found = screen_study(tuner, points=points, instances=instances, jobs=jobs, on_done=advance)
    if as_json:
        write_json(found)
        return
    state = {name: "kept" for name in found.kept} | dict.fromkeys(found.dead, "no effect")
    rows = [
        (each.name, each.objective, f"{each.size:.3f}", f"[{each.low:.3f}, {each.high:.3f}]", state.get(each.name, ""))
        for each in found.effects
    ]
    write_table(("setting", "of", "effect (log ratio)", "90 % interval", ""), rows)
    write()
    for name, reason in found.failed.items():
        write(f"{name} broke a run: {reason}")
    if not found.kept:
        write(
            f"No setting matters more than chance on these {found.instances} instances ({found.runs} runs): try more instances."
        )
        return
    write("[space]")
    write(f"include = [{', '.join(json.dumps(name) for name in found.kept)}]")


@app.command()
def run(
    study: Study,
    results: Results = Path("results"),
    jobs: Jobs = 1,
    trials: Annotated[Optional[int], typer.Option(min=2, help="Finished trials, in place of the file's.")] = None,  # noqa: UP045
    as_json: AsJson = False,
) -> None:
    """Run a study, or go on with it; then run the best again, check them on the held-out split, write the page."""
    from dynslam_bench.tuning import read_study, write_page

    spec = read_study(study)
    if trials is not None:
        spec = spec.model_copy(update={"trials": trials})
    tuner = run_trials(spec, results, jobs)
    summary = conclude(tuner, jobs=jobs)
    show_summary(tuner, summary, write_page(tuner, summary), as_json=as_json)


@app.command()
def worker(study: Study, results: Results = Path("results"), jobs: Jobs = 1) -> None:
    """Only run trials of a study, beside other workers on the same storage."""
    from dynslam_bench.tuning import read_study

    tuner = run_trials(read_study(study), results, jobs)
    write(f"study '{tuner.spec.name}' has its {tuner.spec.trials} trials")


@app.command()
def status(study: Study, results: Results = Path("results"), as_json: AsJson = False) -> None:
    """Show how far a study is."""
    from dynslam_bench.tuning import Tuner, read_study
    from dynslam_bench.tuning.trials import best_trials, count_states

    tuner = Tuner(read_study(study), results, reading=True)
    facts: dict[str, Any] = {
        "study": tuner.spec.name,
        "folder": tuner.folder,
        "asked_for": tuner.spec.trials,
        **count_states(tuner.study),
    }
    best = best_trials(tuner.study, 1)
    if best:
        facts |= {"best_trial": best[0].number, "best_values": list(best[0].values), "best_settings": best[0].params}
    if as_json:
        write_json(facts)
        return
    settings = facts.pop("best_settings", {})
    write_fields(facts)
    if settings:
        write()
        write_table(("setting", "value"), list(settings.items()))


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
    from dynslam_bench.tuning import read_preset_text, read_study

    text = read_preset_text(read_study(study), results, pick)
    if output is None:
        write(text.rstrip())
    else:
        write_atomic(output, text)
        write(str(output))


@app.command()
def report(study: Study, results: Results = Path("results"), as_json: AsJson = False) -> None:
    """Write a study's page; the best are run again if that was not done yet."""
    from dynslam_bench.tuning import StudySummary, Tuner, read_study, write_page
    from dynslam_bench.tuning.storage import study_folder

    spec = read_study(study)
    stored = study_folder(results, spec) / "summary.json"
    tuner = Tuner(spec, results, reading=stored.is_file())
    if stored.is_file():
        summary = StudySummary.read(stored)
    else:
        tuner.reference()
        summary = conclude(tuner)
    show_summary(tuner, summary, write_page(tuner, summary), as_json=as_json)


class _Told:
    """Progress of a study: which part of it is under way, and the run in it that told last.

    Args:
        advance: Shows it.
        doing: What is under way at first.
    """

    def __init__(self, advance: Advance, doing: str) -> None:
        self._advance, self._runs = advance, 0
        self.at: tuple[float, float | None] = (0, None)
        self.doing = doing

    def begin(self, doing: str, done: float = 0, total: float | None = None) -> None:
        """Another part begins."""
        self.doing, self.at = doing, (done, total)
        self._advance(*self.at, doing)

    def run(self, event: RunEvent) -> None:
        """A run has told something."""
        self._runs += event.kind == "finished"
        self._advance(*self.at, f"{self.doing}, {self._runs} runs made: {run_words(event)}")


def run_trials(spec: StudySpec, results: Path, jobs: int) -> Tuner:
    """`run_study` with a progress bar."""
    from dynslam_bench.tuning import StudyEvent, run_study

    with progress(f"study {spec.name}") as advance:
        shown = _Told(advance, "pilot")

        def told(event: StudyEvent) -> None:
            if event.kind in ("pilot", "finished"):
                note(event.text)
            if event.kind == "finished":
                shown.begin(event.text, event.number + 1, event.total)
            elif event.kind == "reference":
                shown.begin(f"{spec.tracker} as it is by default", 0, spec.trials)
            elif event.kind == "started":
                shown.begin(event.text, event.number, event.total)

        return run_study(spec, results=results, jobs=jobs, on_event=told, on_run=shown.run)


def conclude(tuner: Tuner, jobs: int = 1) -> StudySummary:
    """Run the best again and check them, with a progress bar."""
    from dynslam_bench.tuning import finish

    with progress(f"checking the best of {tuner.spec.name}") as advance:
        shown = _Told(advance, "")
        tuner.on_run = shown.run

        def told(text: str) -> None:
            note(text)
            shown.begin(text)

        return finish(tuner, told, jobs=jobs)


def show_summary(tuner: Tuner, summary: StudySummary, page: Path, *, as_json: bool) -> None:
    """Conclusion, chosen settings and where everything lies."""
    from dynslam_bench.tuning.splits import seen_note

    preset = tuner.folder / "best.toml"
    if as_json:
        write_json({"summary": summary, "page": page, "preset": preset})
        return
    write(summary.conclusion)
    if caution := seen_note(summary.seen):
        write(caution)
    write()
    if summary.chosen is not None:
        write_table(("setting", "value"), list(summary.candidates[0].params.items()))
        write()
    write(f"preset: {preset}")
    write(f"page:   {page}")


def hush_optuna() -> None:
    """Keep Optuna's own log and its remarks on experimental features off the terminal."""
    import warnings

    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
