"""The page of a study: result, settings, course, importances and all trials; Optuna's plots lie beside it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import optuna
from markupsafe import Markup
from optuna.trial import TrialState

from dynslam_bench.core.records import write_atomic
from dynslam_bench.core.settings import Parameter, Scalar
from dynslam_bench.core.toml import setting_text
from dynslam_bench.reports.figures import GRID, axis, guide, layout_of
from dynslam_bench.reports.html.page import Block, Section, render
from dynslam_bench.reports.model.row import SEEN, command_line
from dynslam_bench.reports.tables.table import Column, Table, TableCell, number, numbers, to_csv
from dynslam_bench.tuning.final_runs import preset_text
from dynslam_bench.tuning.instances import ProblemInstance, scenes
from dynslam_bench.tuning.samplers import is_feasible
from dynslam_bench.tuning.splits import FEWEST_STARTS, Design, seen_note
from dynslam_bench.tuning.summary import Candidate, Ratio, StudySummary, Verdict, worth
from dynslam_bench.tuning.trials import EARLIER, FEWEST_TRIALS, errors_of
from dynslam_bench.tuning.tuner import Tuner

PLOTS_FILE = "plots.html"
_PLOTS = Markup(
    '<a href="{}">Optuna\'s plots</a><iframe src="{}" title="Optuna\'s plots" width="100%" height="900"></iframe>'
)
_CONTOURS = 4
"""Contours of so many parameters are drawn, the most important ones."""


def write_page(tuner: Tuner, summary: StudySummary) -> Path:
    """Write the page of a finished study.

    Args:
        tuner: The study.
        summary: What `finish` made of it.

    Returns:
        Path of ``index.html`` in the study's folder; its tables lie beside it as CSV, Optuna's plots in `PLOTS_FILE`.
    """
    spec = tuner.spec
    candidates, trials = _candidates(summary), _trials(tuner, summary)
    proven = summary.verdict == Verdict.PROVEN
    settings = settings_table(tuner.space, tuner.base, summary.best.params if summary.best else {}, proven)
    for table in (candidates, trials, settings):
        write_atomic(tuner.folder / "csv" / f"{table.id}.csv", to_csv(table))
    write_atomic(tuner.folder / PLOTS_FILE, _plots(tuner, list(summary.importances)))
    result = [Block("table", table=candidates)]
    if figure := _ratio_figure(summary):
        caption = (
            "Ratio to the baseline and its 95 % interval: on the instances of the choice (confirm), which no trial had "
            "seen, and, for the best trial, on the held-out instances and on recordings."
        )
        result.append(Block("figure", figure="ratios", chart=figure, caption=caption))
    conclusion = [summary.conclusion, *filter(None, [_shipped(summary), seen_note(summary.seen)])]
    sections = [
        Section("result", "What the study found", "Result", conclusion, result),
        Section(
            "preset", "Settings: baseline, best trial, range", "Settings", _picks(summary),
            _preset(tuner, summary, settings),
        ),
        Section(
            "course", "How it went", "Course", [*warnings_of(tuner), _importance_note(summary)],
            [Block("list", entries=[_PLOTS.format(PLOTS_FILE, PLOTS_FILE)])],
        ),
        Section("trials", "All trials", "Trials", [], [Block("table", table=trials)]),
    ]  # fmt: skip
    html = render(
        sections,
        title=f"Study {spec.name}: {spec.tracker}",
        protocol=summary.protocol,
        facts=[
            (str(sum(summary.trials.values())), "trials"),
            (str(summary.trials.get("pruned", 0)), "pruned"),
            (str(summary.trials.get("fail", 0)), "failed"),
            (_size(tuner.design.tune), "to tune on"),
            (_size(tuner.design.confirm), "to choose on"),
            (_size(tuner.design.held_out), "held out"),
        ],
        footer=f"Sampler {spec.sampler}, pruner {spec.pruner}, Optuna {optuna.__version__}. "
        f"Reproduce: {command_line(tuner.study.user_attrs.get('command', []))}",
    )
    path = tuner.folder / "index.html"
    write_atomic(path, html)
    return path


def _size(instances: Sequence[ProblemInstance]) -> str:
    return f"{len(instances)} runs, {len(scenes(instances))} scenes" if instances else "none"


def _plots(tuner: Tuner, important: list[str]) -> str:
    """Optuna's own plots of the study, in one HTML text that works offline; ratios in place of logarithms."""
    from optuna import visualization

    names = [f"ratio of {objective.what} to the baseline" for objective in tuner.objectives]
    target: dict[str, Any] = {"target": lambda trial: math.exp(trial.values[0]), "target_name": names[0]}
    params = important or [parameter.name for parameter in tuner.space]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # experimental; of trials that pruning never saw
        figures = [
            visualization.plot_optimization_history(tuner.study, **target),
            visualization.plot_parallel_coordinate(tuner.study, **target),
            visualization.plot_slice(tuner.study, **target),
            visualization.plot_contour(tuner.study, params=params[:_CONTOURS], **target),
        ]
        if important:
            evaluator = optuna.importance.PedAnovaImportanceEvaluator()
            figures.append(visualization.plot_param_importances(tuner.study, evaluator=evaluator, **target))
        if len(names) == 1:
            figures.append(visualization.plot_intermediate_values(tuner.study))
        elif len(names) < 4:
            figures.append(
                visualization.plot_pareto_front(
                    tuner.study, targets=lambda trial: list(map(math.exp, trial.values)), target_names=names
                )
            )
    return "\n".join(str(figure.to_html(full_html=False, include_plotlyjs=figure is figures[0])) for figure in figures)


def _preset(tuner: Tuner, summary: StudySummary, settings: Table) -> list[Block]:
    """The best settings with their status, and how to use them only if they are proven."""
    shown, best = Block("table", table=settings), summary.best
    if best is None:
        return [shown]
    text = preset_text(tuner, best.params, summary.conclusion, status=summary.verdict.value)
    if summary.verdict != Verdict.PROVEN:
        return [shown, Block("code", title=f"best.toml, not recommended: {summary.verdict.value}", text=text)]
    command = f"dynslam-bench run {tuner.spec.tracker} SEQUENCE --settings best.toml"
    return [shown, Block("code", text=text), Block("code", title="Use them", text=command)]


def _shipped(summary: StudySummary) -> str:
    """The default settings beside a baseline that is something else; empty if it is not."""
    ratios = "; ".join(f"{split.replace('_', '-')}: {ratio}" for split, ratio in summary.shipped.items())
    return f"Ratios are to {summary.baseline}. The default settings of {summary.tracker}: {ratios}." if ratios else ""


def _picks(summary: StudySummary) -> list[str]:
    """What the presets of a study of several objectives are worth."""
    by_trial = {candidate.trial: candidate for candidate in summary.candidates}
    return [
        worth(name, None if trial is None else by_trial[trial], summary.split_notes)
        for name, trial in summary.picks.items()
        if name != "best"
    ]


def _importance_note(summary: StudySummary) -> str:
    if not summary.importances:
        return f"No importances: they need {FEWEST_TRIALS} complete or pruned trials that differ."
    shares = ", ".join(f"{name} {importance}" for name, importance in summary.importances.items())
    return f"Importances (PED-ANOVA) and their 95 % intervals: {shares}. They add up to 100 % even where none matters."


def _ratio_figure(summary: StudySummary) -> dict[str, Any] | None:
    """Each candidate's ratio with its interval on every split."""
    traces: list[dict[str, Any]] = []
    styles = (("confirm", "#1f6fb4", "circle"), ("held_out", "#d9542b", "square"), ("recorded", "#3a8f5c", "diamond"))
    for split, colour, symbol in styles:
        points: list[tuple[str, Ratio]] = [
            (f"trial {candidate.trial}", ratio)
            for candidate in summary.candidates
            if (ratio := getattr(candidate, split)) is not None
        ]
        if not points:
            continue
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": split.replace("_", "-"),
                "error_x": {
                    "type": "data",
                    "symmetric": False,
                    "color": colour,
                    "array": [0.0 if ratio.high is None else ratio.high - ratio.ratio for _, ratio in points],
                    "arrayminus": [0.0 if ratio.low is None else ratio.ratio - ratio.low for _, ratio in points],
                },
                "x": [ratio.ratio for _, ratio in points],
                "y": [label for label, _ in points],
                "marker": {"size": 11, "color": colour, "symbol": symbol},
            }
        )
    if not traces:
        return None
    layout = layout_of(
        height=160 + 50 * len(summary.candidates),
        shapes=[guide(x=1.0)],
        margin={"l": 90, "r": 20, "t": 30, "b": 60},
        xaxis=axis("ratio to the baseline (left is better)"),
        yaxis={"autorange": "reversed", "gridcolor": GRID},
    )
    return {"data": traces, "layout": layout}


def fewer_starts(design: Design) -> str:
    """Why the baseline itself may have another ratio than 1; empty where trials ran from as many starts as it."""
    if len(design.reference) == len(design.tune):
        return ""
    return (
        f" Ratios are to the median of the baseline over {FEWEST_STARTS} or more starts in each scene, but every "
        "trial, the baseline as trial 0 too, ran from fewer: so the ratio of trial 0, and with it the best so far, may "
        "differ from 1 though no setting was changed."
    )


def warnings_of(tuner: Tuner) -> list[str]:
    """What a reader of the course should know, in sentences."""
    notes = []
    if _seeds_change_nothing(tuner):
        notes.append(
            "The seeds changed nothing: all runs that differ in the seed alone are equal, so they count as copies and "
            "not as repeats. Name start offsets in place of seeds."
        )
    complete = tuner.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len(complete) < 20:
        notes.append(f"Only {len(complete)} trials were finished: the best value is partly luck.")
    infeasible = sum(not is_feasible(trial) for trial in complete)
    if infeasible:
        least_bad = "the least bad were judged on unseen instances, and have to fulfil the constraints there"
        what = least_bad if infeasible == len(complete) else "they are not candidates"
        notes.append(f"{infeasible} of {len(complete)} trials violate a constraint: {what}.")
    if "speed" in tuner.spec.objectives:
        notes.append(
            "Trials ran at different times, so their ratios of processor time depend on the machine's other load. On "
            "the instances of the choice and the held-out ones baseline and candidates ran in turn: those count."
        )
    return notes


def _seeds_change_nothing(tuner: Tuner) -> bool:
    """Whether there are runs of one trial that differ in the seed alone, and all of them are equal to the bit."""
    errors: dict[tuple[int, ProblemInstance], list[float]] = {}
    for trial in tuner.study.get_trials(deepcopy=False):
        for instance, ate in errors_of(trial).items():
            errors.setdefault((trial.number, replace(instance, seed=0)), []).append(ate)
    repeats = [values for values in errors.values() if len(values) > 1]
    return bool(repeats) and all(len(set(values)) == 1 for values in repeats)


def _candidates(summary: StudySummary) -> Table:
    def ratio(value: Ratio | None) -> TableCell:
        if value is None:
            return TableCell("-")
        return TableCell(f"{value.ratio:.3f}", f"{value.interval} n={value.n}".strip(), value.ratio)

    def time(candidate: Candidate) -> TableCell:
        if candidate.frame_ms is None:
            return TableCell("-")
        return TableCell(f"{candidate.frame_ms:.1f}", f"baseline {candidate.baseline_frame_ms:.1f}", candidate.frame_ms)

    rows = [
        [
            TableCell(
                str(candidate.trial),
                value=float(candidate.trial),
                emphasis="best" if candidate is summary.best else "",
            ),
            number(math.exp(candidate.values[0]) if candidate.values else None, ".3f"),
            ratio(candidate.confirm),
            number(candidate.bound if math.isfinite(candidate.bound) else None, ".3f"),
            ratio(candidate.held_out),
            ratio(candidate.recorded),
            time(candidate),
            TableCell(candidate.failed or ("yes" if candidate.feasible else "no")),
        ]
        for candidate in summary.candidates
    ]
    caption = (
        "Ratios to the baseline on the same instances: the median of a scene's starts, the mean over scenes (trimmed "
        "from ten on), and the 95 % interval over scenes. The candidate with the smallest upper bound on instances "
        "that no trial saw is the best, chosen where that bound lies below 1; held-out instances and recordings "
        f"judge it. Frame times without the stage cache.{_cautions(summary)}"
    )
    optimistic = "the trial's own value, optimistic: the trial was selected for it"
    one_sided = "one-sided upper bound for the choice; allows for the number of candidates"
    tune, confirm, held_out = _marked(
        summary, ("in the trial", "tune"), ("unseen instances", "confirm"), ("held-out", "held_out")
    )
    columns = [Column("trial"), Column(tune, meaning=optimistic), *numbers(confirm)]
    columns += [Column("upper bound", meaning=one_sided), *numbers(held_out, "recorded", "frame ms")]
    columns += [Column("constraints hold", numeric=False)]
    return Table("candidates", "The best trials, judged again", caption, columns, rows)


def _cautions(summary: StudySummary) -> str:
    """What every table says of a study whose splits are not apart, or whose masks were trained on its scenes."""
    apart = f"The splits are NOT apart: {'; '.join(summary.split_notes)}." if summary.split_notes else ""
    return "".join(f" {text}" for text in (apart, seen_note(summary.seen)) if text)


def _marked(summary: StudySummary, *headings: tuple[str, str]) -> list[str]:
    """Headings of columns, with `SEEN` behind those of a split whose scenes the masks' network was trained on."""
    return [f"{heading} {SEEN}" if split in summary.seen else heading for heading, split in headings]


def _trials(tuner: Tuner, summary: StudySummary) -> Table:
    names = [parameter.name for parameter in tuner.space]
    rows = [
        [
            number(float(trial.number), ".0f"),
            TableCell(
                trial.state.name.lower(), tip=trial.user_attrs.get("reason") or trial.user_attrs.get(EARLIER, "")
            ),
            *(number(math.exp(value), ".3f") for value in trial.values or ()),
            *(TableCell("-") for _ in tuner.objectives if not trial.values),
            number(trial.user_attrs.get("coverage"), ".3f"),
            number(trial.user_attrs.get("fps"), ".1f"),
            *(_value(trial.params.get(name)) for name in names),
        ]
        for trial in tuner.study.get_trials(deepcopy=False)
    ]
    headings = _marked(summary, *((f"ratio of {objective.what}", "tune") for objective in tuner.objectives))
    columns = [Column("trial"), Column("state", numeric=False), *numbers(*headings, "coverage", "fps", *names)]
    caption = (
        "Behind the state stand the reasons of pruned and failed trials, and the study that an earlier trial is of."
    )
    return Table("trials", "All trials", caption + fewer_starts(tuner.design) + _cautions(summary), columns, rows)


def settings_table(space: Sequence[Parameter], baseline: dict[str, Any], best: dict[str, Any], proven: bool) -> Table:
    """Every tuned setting: the baseline's value, the best trial's, and the range that was searched."""
    rows = [
        [
            TableCell(parameter.name),
            _value(baseline.get(parameter.name)),
            _value(best.get(parameter.name)),
            TableCell(_range(parameter)),
            TableCell(parameter.unit),
        ]
        for parameter in space
    ]
    setting, searched, unit = (Column(name, numeric=False) for name in ("setting", "range", "unit"))
    columns = [setting, Column("baseline"), Column("best trial"), searched, unit]
    caption = "What was searched." + ("" if proven else " The best trial is not proven: keep the baseline.")
    return Table("settings", "Baseline, best trial and range", caption, columns, rows)


def _value(value: Scalar | None) -> TableCell:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return number(float(value), ".4g")
    return TableCell("–" if value is None else setting_text(value))


def _range(parameter: Parameter) -> str:
    if parameter.low is None or parameter.high is None:
        return ", ".join(map(setting_text, parameter.choices)) or "true, false"
    return f"{parameter.low:g} to {parameter.high:g}{', log' * (parameter.scale == 'log')}"
