"""The study page: history, importances, slices, Pareto front, tune against held-out, in one offline HTML file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import TrialState

from dynslam_bench.core.records import write_atomic
from dynslam_bench.core.toml import setting_text
from dynslam_bench.reports.figures import GRID, axis, guide, layout_of
from dynslam_bench.reports.html.page import Block as Piece
from dynslam_bench.reports.html.page import Section, render
from dynslam_bench.reports.model.row import SEEN, command_line
from dynslam_bench.reports.tables.table import Column, Table, TableCell, number, numbers, to_csv
from dynslam_bench.tuning.figures import MOST_SLICES, Star, front, history, settings_table, slices
from dynslam_bench.tuning.instances import ProblemInstance, scenes
from dynslam_bench.tuning.presets import preset_text
from dynslam_bench.tuning.samplers import is_feasible
from dynslam_bench.tuning.splits import FEWEST_STARTS, Design, seen_note, splits_seen
from dynslam_bench.tuning.summary import Candidate, Ratio, StudySummary, worth
from dynslam_bench.tuning.trials import FEWEST_TRIALS, best_trials, errors_of, importances, inert_parameters
from dynslam_bench.tuning.tuner import Tuner


def write_page(tuner: Tuner, summary: StudySummary) -> Path:
    """Write the page of a finished study.

    Args:
        tuner: The study.
        summary: What `finish` made of it.

    Returns:
        Path of ``index.html`` in the study's folder; its tables lie beside it as CSV.
    """
    spec, study = tuner.spec, tuner.study
    summary = summary.model_copy(
        update={"split_notes": list(tuner.design.notes)}
    )  # a stored one may be older than the check
    summary = summary.model_copy(update={"inert": _inert(tuner), "importances": _importances(tuner)})
    summary = summary.model_copy(update={"seen": splits_seen(tuner.defaults, tuner.design)})
    tables = [_candidates(summary), _trials(tuner, summary), _settings(tuner, summary)]
    figures = _figures(tuner, summary)
    result = [Piece("table", table=tables[0]), *_shown(tuner, figures, "ratios")]
    sections = [
        Section("result", "What the study found", "Result", _found(summary), result),
        Section(
            "preset",
            "Settings: default, best trial, range",
            "Settings",
            _picks(summary),
            _preset(tuner, summary, tables[2]),
        ),
        Section("course", "How it went", "Course", warnings_of(tuner), _shown(tuner, figures, "history", "front")),
        Section("parameters", "Which settings matter", "Parameters", _importance_notes(tuner, summary), []),
        Section("trials", "All trials", "Trials", [], [Piece("table", table=tables[1])]),
    ]
    sections[3].blocks += _shown(tuner, figures, "importances", "slices")
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
            (str(states.get("pruned", 0)), "dropped out of the race"),
            (str(states.get("fail", 0)), "failed"),
            (_size(tuner.design.race), "to tune on"),
            (_size(tuner.design.confirm), "to choose on"),
            (_size(tuner.design.held_out), "held out"),
        ],
        footer=f"Sampler {spec.sampler}, race {spec.race}, Optuna {optuna.__version__}. "
        f"Reproduce: {command_line(study.user_attrs.get('command', []))}",
    )
    path = tuner.folder / "index.html"
    write_atomic(path, html)
    return path


def _found(summary: StudySummary) -> list[str]:
    return [summary.verdict, *filter(None, [seen_note(summary.seen)])]


def _size(instances: Sequence[ProblemInstance]) -> str:
    return f"{len(instances)} runs, {len(scenes(instances))} scenes" if instances else "none"


def _names(tuner: Tuner) -> list[str]:
    return [parameter.name for parameter in tuner.space]


def _inert(tuner: Tuner) -> list[str]:
    return inert_parameters(tuner.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)), _names(tuner))


def _importances(tuner: Tuner) -> dict[str, float]:
    return importances(tuner.study, _names(tuner))


def _preset(tuner: Tuner, summary: StudySummary, settings: Table) -> list[Piece]:
    """The chosen settings; how to use them stands there only if they hold up on the held-out split."""
    spec, shown = tuner.spec, Piece("table", table=settings)
    if summary.chosen is None:
        return [shown]
    chosen = summary.candidates[0]
    text = preset_text({**spec.space.fixed, **chosen.params}, spec.tracker, summary.verdict)
    if not summary.improves:
        return [shown, Piece("code", title="Not recommended: they do not hold up; shown as a record", text=text)]
    command = f"dynslam-bench run {spec.tracker} SEQUENCE --settings best.toml"
    return [shown, Piece("code", text=text), Piece("code", title="Use them", text=command)]


def _picks(summary: StudySummary) -> list[str]:
    """What the presets of a study of several objectives are worth."""
    by_trial = {candidate.trial: candidate for candidate in summary.candidates}
    return [
        worth(name, None if number is None else by_trial[number], summary.split_notes)
        for name, number in summary.picks.items()
        if name != "best"
    ]


def _importance_notes(tuner: Tuner, summary: StudySummary) -> list[str]:
    count = summary.trials.get("complete", 0)
    if summary.importances:
        notes = [
            "Importances are shares among the settings that matter more than chance (PED-ANOVA, against the same "
            "trials with shuffled values)."
        ]
    elif count < FEWEST_TRIALS:
        notes = [f"No importances: they would need {FEWEST_TRIALS} complete trials, there are {count}."]
    else:
        notes = ["No importances: no setting matters more than chance could make it."]
    if summary.inert:
        notes.append(f"Without any effect in these trials: {', '.join(summary.inert)}.")
    return notes


def _importance_figure(summary: StudySummary) -> dict[str, Any]:
    names = list(reversed(summary.importances))
    shares = [summary.importances[name] for name in names]
    bars = {"type": "bar", "orientation": "h", "x": shares, "y": names, "marker": {"color": "#1f6fb4"}}
    layout = layout_of(
        height=140 + 32 * len(names),
        xaxis=axis("share of the importance") | {"range": [0, 1.02]},
        yaxis={"automargin": True},
        showlegend=False,
    )
    return {"data": [bars], "layout": layout}


def _figures(tuner: Tuner, summary: StudySummary) -> dict[str, dict[str, Any]]:
    """Ratios with their intervals, trials in their order, the front, settings against the objective."""
    finished = tuner.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    whats = [each.what for each in tuner.objectives]
    star = star_of(summary)
    figures: dict[str, dict[str, Any]] = {}
    ratio = _ratio_figure(summary)
    if ratio is not None:
        figures["ratios"] = ratio
    if finished:
        figures["history"] = history(finished, whats[0], star)
        used = [each for each in tuner.space if any(each.name in trial.params for trial in finished)]
        if used:
            ranked = sorted(used, key=lambda each: -summary.importances.get(each.name, 0.0))[:MOST_SLICES]
            figures["slices"] = slices(finished, ranked, tuner.base, whats[0], star)
        if len(whats) > 1:
            best = {trial.number for trial in best_trials(tuner.study, len(finished))}
            figures["front"] = front(finished, best, whats, star)
    if summary.importances:
        figures["importances"] = _importance_figure(summary)
    return figures


def star_of(summary: StudySummary) -> Star | None:
    """The trial that the page is about: the chosen one, else the first candidate; None without any."""
    if not summary.candidates:
        return None
    return summary.candidates[0].trial, "best trial" if summary.chosen is None else "chosen"


def _settings(tuner: Tuner, summary: StudySummary) -> Table:
    chosen = summary.candidates[0].params if summary.candidates else None
    return settings_table(tuner.space, tuner.base, chosen, summary.improves)


def _ratio_figure(summary: StudySummary) -> dict[str, Any] | None:
    """Tune against held-out: each candidate's ratio with its interval on both splits."""
    traces = []
    drawn = (("confirm", "#1f6fb4", "circle"), ("held_out", "#d9542b", "square"), ("recorded", "#3a8f5c", "diamond"))
    for split, colour, symbol in drawn:
        points: list[tuple[str, Ratio]] = [
            (f"trial {candidate.trial}", ratio)
            for candidate in summary.candidates
            if (ratio := getattr(candidate, split)) is not None
        ]
        if points:
            traces.append(_ratio_trace(split.replace("_", "-"), points, colour, symbol))
    if not traces:
        return None
    layout = layout_of(
        height=160 + 50 * len(summary.candidates),
        shapes=[guide(x=1.0)],
        margin={"l": 90, "r": 20, "t": 30, "b": 60},
        xaxis=axis("ratio to the default settings (left is better)"),
        yaxis={"autorange": "reversed", "gridcolor": GRID},
    )
    return {"data": traces, "layout": layout}


def _ratio_trace(name: str, points: list[tuple[str, Ratio]], colour: str, symbol: str) -> dict[str, Any]:
    ratios = [ratio for _, ratio in points]
    bars: dict[str, Any] = {"type": "data", "symmetric": False, "color": colour}
    bars["array"] = [0.0 if ratio.high is None else ratio.high - ratio.ratio for ratio in ratios]
    bars["arrayminus"] = [0.0 if ratio.low is None else ratio.ratio - ratio.low for ratio in ratios]
    trace: dict[str, Any] = {"type": "scatter", "mode": "markers", "name": name, "error_x": bars}
    trace |= {"x": [ratio.ratio for ratio in ratios], "y": [label for label, _ in points]}
    return trace | {"marker": {"size": 11, "color": colour, "symbol": symbol}}


def _shown(tuner: Tuner, figures: dict[str, dict[str, Any]], *names: str) -> list[Piece]:
    captions = {
        "ratios": "Ratio to the default settings and its 95 % interval: on the instances of the choice (confirm), which "
        "no trial had seen, and, for the choice alone, on the held-out instances and on recordings.",
        "history": "Every trial that came to the end of the race, on its own instances; trial 0 is the default."
        + fewer_starts(tuner.design),
        "front": "One objective against the other, with those that no other trial beats in both.",
        "importances": "",
        "slices": "The first settings (by importance where that is known) against the objective.",
    }
    return [Piece("figure", figure=name, caption=captions[name]) for name in names if name in figures]


def fewer_starts(design: Design) -> str:
    """Why the default itself may have another ratio than 1; empty where it has 1, since all ran from the same starts.

    It has no start beside those of the trials where they have `FEWEST_STARTS` or more at every place.
    """
    if len(design.reference) == len(design.race):
        return ""
    return (
        f" Ratios are to the median of the default over {FEWEST_STARTS} or more starts in each scene, but every trial, "
        "the default as trial 0 too, ran from fewer: so the ratio of trial 0, and with it the best so far, may differ "
        "from 1 though no setting was changed."
    )


def warnings_of(tuner: Tuner) -> list[str]:
    """What a reader of the course should know, in sentences."""
    notes = _copies(tuner)
    finished = tuner.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len(finished) < 20:
        notes.append(f"Only {len(finished)} trials were finished: the best value is partly luck.")
    broken = [trial for trial in finished if not is_feasible(trial)]
    if broken and len(broken) == len(finished):
        notes.append(
            f"None of the {len(finished)} trials fulfils the constraints on its own instances, which may be too few to "
            "show it: the least bad were judged on instances that no trial had seen, and have to fulfil them there."
        )
    elif broken:
        notes.append(f"{len(broken)} trials violate a constraint and are not candidates.")
    if "speed" in tuner.spec.objectives:
        notes.append(
            "Trials ran at different times: what else the machine did then is in their ratios of processor time. On "
            "the instances of the choice and on held-out ones the default and the candidates ran in turn: those count."
        )
    return notes


def _copies(tuner: Tuner) -> list[str]:
    """What seeds changed: runs of the same trial that differ in the seed only and are equal to the last bit."""
    errors: dict[tuple[int, ProblemInstance], list[float]] = {}
    for trial in tuner.study.get_trials(deepcopy=False):
        for instance, ate in errors_of(trial).items():
            errors.setdefault((trial.number, replace(instance, seed=0)), []).append(ate)
    several = [each for each in errors.values() if len(each) > 1]
    if not several or any(len(set(each)) > 1 for each in several):
        return []
    return [
        "The seeds changed nothing: all runs that differ in the seed alone are equal, so they count as copies and not "
        "as repeats. Name start offsets in place of seeds."
    ]


def _candidates(summary: StudySummary) -> Table:
    def ratio(value: Ratio | None) -> TableCell:
        if value is None:
            return TableCell("-")
        return TableCell(f"{value.ratio:.3f}", f"{value.interval} n={value.n}".strip(), value.ratio)

    def time(candidate: Candidate) -> TableCell:
        if candidate.frame_ms is None:
            return TableCell("-")
        return TableCell(f"{candidate.frame_ms:.1f}", f"default {candidate.default_frame_ms:.1f}", candidate.frame_ms)

    rows = [
        [
            TableCell(
                str(each.trial), value=float(each.trial), emphasis="best" if each.trial == summary.chosen else ""
            ),
            number(math.exp(each.values[0]), ".3f"),
            ratio(each.confirm),
            number(each.bound if math.isfinite(each.bound) else None, ".3f"),
            ratio(each.held_out),
            ratio(each.recorded),
            time(each),
            TableCell(each.failed or ("yes" if each.feasible else "no")),
        ]
        for each in summary.candidates
    ]
    caption = (
        "Ratios to the default settings on the same instances: the median of a scene's starts, the mean over scenes "
        "(trimmed from ten on), and the 95 % interval over scenes. On instances that no trial had seen the one with the "
        "smallest upper bound is chosen, where that lies below 1, and else the default; held-out instances and recordings "
        f"only judge the choice. Frame times without the stage cache.{_cautions(summary)}"
    )
    optimistic = "the trial's own value, optimistic: it was selected for it"
    one_sided = "one-sided upper bound for the choice; allows for the number of candidates"
    race, confirm, held_out = _marked(
        summary, ("in the race", "tune"), ("unseen instances", "confirm"), ("held-out", "held_out")
    )
    columns = [Column("trial"), Column(race, meaning=optimistic), *numbers(confirm)]
    columns += [Column("upper bound", meaning=one_sided), *numbers(held_out, "recorded", "frame ms")]
    columns += [Column("constraints hold", numeric=False)]
    return Table("candidates", "The best trials, judged again", caption, columns, rows)


def _cautions(summary: StudySummary) -> str:
    """What every table of a study has to say whose splits are not apart, or whose masks knew the scenes."""
    apart = f"The splits are NOT apart: {'; '.join(summary.split_notes)}." if summary.split_notes else ""
    return "".join(f" {text}" for text in (apart, seen_note(summary.seen)) if text)


def _marked(summary: StudySummary, *headings: tuple[str, str]) -> list[str]:
    """Headings of columns, with `SEEN` behind those of a split whose scenes the network behind the masks knew."""
    return [f"{heading} {SEEN}" if split in summary.seen else heading for heading, split in headings]


def _trials(tuner: Tuner, summary: StudySummary) -> Table:
    names = [parameter.name for parameter in tuner.space]
    objectives = tuner.spec.objectives
    rows = []
    for trial in tuner.study.get_trials(deepcopy=False):
        shown = [None if value is None else math.exp(value) for value in trial.values or [None] * len(objectives)]
        rows.append(
            [
                number(float(trial.number), ".0f"),
                TableCell(trial.state.name.lower(), tip=trial.user_attrs.get("reason", "")),
                *(number(value, ".3f") for value in shown),
                number(trial.user_attrs.get("coverage"), ".3f"),
                number(trial.user_attrs.get("fps"), ".1f"),
                *(_value(trial.params.get(name)) for name in names),
            ]
        )
    headings = _marked(summary, *((f"ratio of {each.what}", "tune") for each in tuner.objectives))
    columns = [Column("trial"), Column("state", numeric=False), *numbers(*headings)]
    columns += numbers("coverage", "fps", *names)
    caption = "Reasons of dropped (pruned) and failed trials stand behind their state."
    caption += fewer_starts(tuner.design) + _cautions(summary)
    return Table("trials", "All trials", caption, columns, rows)


def _value(value: Any) -> TableCell:
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return TableCell(f"{value:.4g}", value=float(value))
    return TableCell("" if value is None else setting_text(value))
