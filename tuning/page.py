"""The study page: history, importances, slices, Pareto front, tune against held-out, in one offline HTML file."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.core.records import write_atomic
from dynslam_bench.reports.html.page import Block, Section, render
from dynslam_bench.reports.tables.table import Column, Table, TableCell, to_csv

from .final_runs import Candidate, Ratio, StudySummary
from .preset import preset_text
from .samplers import is_feasible
from .study import Tuner

_MODEBAR = {"bgcolor": "rgba(0,0,0,0)", "color": "#c4c9d1", "activecolor": "#1f6fb4"}
_NAMES = {"accuracy": "log ATE ratio to the default (less is better)", "speed": "real-time factor (more is better)"}


def write_page(tuner: Tuner, summary: StudySummary) -> Path:
    """Write the page of a finished study.

    Args:
        tuner: The study.
        summary: What `finish` made of it.

    Returns:
        Path of ``index.html`` in the study's folder; its tables lie beside it as CSV.
    """
    spec, study = tuner.spec, tuner.study
    summary = summary.model_copy(update={"split_notes": tuner.split_notes})  # a stored one may be older than the check
    tables = [_candidates(summary), _trials(tuner, summary)]
    figures = _figures(tuner, summary)
    settings = {**spec.space.fixed, **summary.candidates[0].params}
    sections = [
        Section(
            "result", "What the study found", "Result", [summary.conclusion],
            [Block("table", table=tables[0]), *_shown(figures, "ratios")],
        ),
        Section(
            "preset", "The chosen settings", "Settings", [],
            [
                Block("code", text=preset_text(settings, spec.tracker, summary.conclusion)),
                Block("code", title="Use them", text=f"dynslam-bench run {spec.tracker} SEQUENCE --settings best.toml"),
            ],
        ),
        Section("course", "How it went", "Course", _warnings(tuner), _shown(figures, "history", "front")),
        Section(
            "parameters", "Which settings matter", "Parameters",
            ["Importances are shares of the variance that a parameter explains alone (PED-ANOVA); with few trials they "
             "are rough."],
            _shown(figures, "importances", "slices"),
        ),
        Section("trials", "All trials", "Trials", [], [Block("table", table=tables[1])]),
    ]  # fmt: skip
    for table in tables:
        write_atomic(tuner.folder / "csv" / f"{table.id}.csv", to_csv(table))
    states = summary.trials
    html = render(
        [section for section in sections if section.blocks],
        figures,
        title=f"Study {spec.name}: {spec.tracker}",
        protocol=summary.protocol,
        facts=[
            (str(sum(states.values())), "trials"),
            (str(states.get("pruned", 0)), "pruned"),
            (str(states.get("fail", 0)), "failed"),
            (str(len(spec.tune)), "tune sequences"),
            (str(len(spec.held_out)), "held-out sequences"),
            (str(len(spec.seeds) * len(spec.offsets)), "repeats (seeds x start offsets)"),
        ],
        footer=f"Sampler {spec.sampler}, pruner {spec.pruner}, Optuna {optuna.__version__}. "
        f"Reproduce: {' '.join(study.user_attrs.get('command', []))}",
    )
    path = tuner.folder / "index.html"
    write_atomic(path, html)
    return path


def _figures(tuner: Tuner, summary: StudySummary) -> dict[str, dict[str, Any]]:
    """Optuna's own plots, and the ratios with their intervals."""
    study, spec = tuner.study, tuner.spec
    several = len(spec.objectives) > 1
    target: Callable[[FrozenTrial], float] | None = (lambda trial: float(trial.values[0])) if several else None
    name = _NAMES[spec.objectives[0]]
    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    shared = sorted({key for trial in finished for key in trial.params})
    figures: dict[str, Any] = {}
    if finished:
        plots = optuna.visualization
        figures["history"] = plots.plot_optimization_history(study, target=target, target_name=name)
        if summary.importances:
            figures["importances"] = plots.plot_param_importances(study, target=target, target_name=name)
        if shared:
            ranked = sorted(shared, key=lambda key: -summary.importances.get(key, 0.0))[:5]
            figures["slices"] = plots.plot_slice(study, params=ranked, target=target, target_name=name)
        if several:
            figures["front"] = plots.plot_pareto_front(study, target_names=[_NAMES[o] for o in spec.objectives])
    drawn = {key: _plain(figure) for key, figure in figures.items()}
    ratios = _ratio_figure(summary)
    return drawn if ratios is None else {"ratios": ratios, **drawn}


def _plain(figure: Any) -> dict[str, Any]:
    """A plotly figure as the page draws it: data and layout, without the bulky template."""
    specification = json.loads(figure.to_json())
    layout = specification["layout"]
    layout.pop("template", None)
    layout.pop("title", None)
    for name, axis in layout.items():
        if name.startswith(("xaxis", "yaxis")):
            axis |= {"automargin": True, "gridcolor": "#e5e7eb", "zeroline": False}
    layout["modebar"] = _MODEBAR
    layout |= {"paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)"}
    layout.setdefault("height", 420)
    layout.pop("width", None)
    return {"data": specification["data"], "layout": layout}


def _ratio_figure(summary: StudySummary) -> dict[str, Any] | None:
    """Tune against held-out: each candidate's ratio with its interval on both splits."""
    traces = []
    for split, colour, symbol in (("tune", "#1f6fb4", "circle"), ("held_out", "#d9542b", "square")):
        points: list[tuple[str, Ratio]] = [
            (f"trial {candidate.trial}", ratio)
            for candidate in summary.candidates
            if (ratio := getattr(candidate, split)) is not None
        ]
        if not points:
            continue
        traces.append(
            {
                "type": "scatter", "mode": "markers", "name": split.replace("_", "-"),
                "x": [ratio.ratio for _, ratio in points], "y": [name for name, _ in points],
                "marker": {"size": 11, "color": colour, "symbol": symbol},
                "error_x": {
                    "type": "data", "symmetric": False, "color": colour,
                    "array": [ratio.high - ratio.ratio for _, ratio in points],
                    "arrayminus": [ratio.ratio - ratio.low for _, ratio in points],
                },
            }
        )  # fmt: skip
    if not traces:
        return None
    line = {"type": "line", "x0": 1, "x1": 1, "yref": "paper", "y0": 0, "y1": 1,
            "line": {"color": "#9ca3af", "dash": "dash"}}  # fmt: skip
    layout = {
        "height": 160 + 50 * len(summary.candidates), "shapes": [line], "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)", "modebar": _MODEBAR, "margin": {"l": 90, "r": 20, "t": 30, "b": 60},
        "xaxis": {"title": {"text": "ATE ratio to the default settings (left is better)"}, "gridcolor": "#e5e7eb"},
        "yaxis": {"autorange": "reversed", "gridcolor": "#e5e7eb"},
    }  # fmt: skip
    return {"data": traces, "layout": layout}


def _shown(figures: dict[str, dict[str, Any]], *names: str) -> list[Block]:
    captions = {
        "ratios": "Geometric-mean ATE ratio in fresh repeats and its 95 % bootstrap interval.",
        "history": "Every finished trial; trial 0 is the default.",
        "front": "Accuracy against speed.",
        "importances": "",
        "slices": "The most important settings against the objective.",
    }
    return [Block("figure", figure=name, caption=captions[name]) for name in names if name in figures]


def _warnings(tuner: Tuner) -> list[str]:
    notes = _copies(tuner)
    finished = tuner.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len(finished) < 20:
        notes.append(f"Only {len(finished)} trials were finished: the best value is partly luck.")
    broken = [trial for trial in finished if not is_feasible(trial)]
    if broken:
        notes.append(f"{len(broken)} trials violate a constraint and are not candidates.")
    return notes


def _copies(tuner: Tuner) -> list[str]:
    """What seeds changed: runs of the same trial that differ in the seed only and are equal to the last bit."""
    if len(tuner.spec.seeds) < 2:
        return []
    errors: dict[tuple[Any, ...], list[float]] = {}
    for trial in tuner.study.get_trials(deepcopy=False):
        for sequence, _, _, ate, _, _, *offset in trial.user_attrs.get("instances", []):
            errors.setdefault((trial.number, sequence, *offset), []).append(ate)
    several = [each for each in errors.values() if len(each) > 1]
    if not several or any(len(set(each)) > 1 for each in several):
        return []
    return [
        f"The {len(tuner.spec.seeds)} seeds changed nothing: all runs that differ in the seed alone are equal, so they "
        "count as copies and not as repeats. Name start offsets in place of seeds."
    ]


def _candidates(summary: StudySummary) -> Table:
    def ratio(value: Ratio | None) -> TableCell:
        if value is None:
            return TableCell("-")
        return TableCell(f"{value.ratio:.3f}", f"[{value.low:.3f}, {value.high:.3f}] n={value.n}", value.ratio)

    def time(candidate: Candidate) -> TableCell:
        if candidate.frame_ms is None:
            return TableCell("-")
        return TableCell(f"{candidate.frame_ms:.1f}", f"default {candidate.default_frame_ms:.1f}", candidate.frame_ms)

    rows = [
        [
            TableCell(str(candidate.trial), value=float(candidate.trial), emphasis="best" if number == 0 else ""),
            TableCell(f"{math.exp(candidate.values[0]):.3f}", value=math.exp(candidate.values[0])),
            ratio(candidate.tune),
            ratio(candidate.held_out),
            time(candidate),
            TableCell(candidate.failed or ("yes" if candidate.feasible else "no")),
        ]
        for number, candidate in enumerate(summary.candidates)
    ]
    caption = (
        "ATE ratios to the default settings on the same sequences and repeats, geometric mean, 95 % bootstrap interval "
        "over sequences and repeats. The best on the tune split in fresh repeats is chosen; the held-out split only "
        f"judges. Frame times without the stage cache.{_repeats(summary)}{_apart(summary)}"
    )
    columns = [
        Column("trial"), Column("in the study", meaning="the trial's own value, optimistic: it was selected for it"),
        Column("tune, fresh repeats"), Column("held-out"), Column("frame ms"),
        Column("constraints hold", numeric=False),
    ]  # fmt: skip
    return Table("candidates", "The best trials, run again", caption, columns, rows)


def _repeats(summary: StudySummary) -> str:
    return (
        f" Fresh repeats: {summary.repeats}; for a tracker that draws nothing from its seed, the start alone counts."
        if summary.repeats
        else ""
    )


def _apart(summary: StudySummary) -> str:
    """A warning for every table of a study whose splits are not apart."""
    return f" The splits are NOT apart: {'; '.join(summary.split_notes)}." if summary.split_notes else ""


def _trials(tuner: Tuner, summary: StudySummary) -> Table:
    names = [parameter.name for parameter in tuner.space]
    objectives = tuner.spec.objectives
    rows = []
    for trial in tuner.study.get_trials(deepcopy=False):
        values = trial.values or [None] * len(objectives)
        ratios = [None if v is None else (math.exp(v) if o == "accuracy" else v)
                  for v, o in zip(values, objectives, strict=True)]  # fmt: skip
        rows.append(
            [
                TableCell(str(trial.number), value=float(trial.number)),
                TableCell(trial.state.name.lower(), tip=trial.user_attrs.get("reason", "")),
                *(TableCell("" if value is None else f"{value:.3f}", value=value) for value in ratios),
                _number(trial.user_attrs.get("coverage"), "{:.3f}"),
                _number(trial.user_attrs.get("fps"), "{:.1f}"),
                *(_value(trial.params.get(name)) for name in names),
            ]
        )
    columns = [
        Column("trial"), Column("state", numeric=False),
        *(Column("ATE ratio" if objective == "accuracy" else "real-time factor") for objective in objectives),
        Column("coverage"), Column("fps"), *(Column(name) for name in names),
    ]  # fmt: skip
    caption = f"Reasons of pruned and failed trials stand behind their state.{_apart(summary)}"
    return Table("trials", "All trials", caption, columns, rows)


def _number(value: Any, form: str) -> TableCell:
    return TableCell() if value is None else TableCell(form.format(value), value=float(value))


def _value(value: Any) -> TableCell:
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return TableCell(f"{value:.4g}", value=float(value))
    return TableCell("" if value is None else str(value))
