"""The page of a study: verdict, what to do, errors in millimetres, what was tried and judged, settings, all trials."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import plotly.graph_objects as go
from optuna.trial import TrialState

from dynslam_bench.core import read_text, setting_text, write_atomic
from dynslam_bench.core.number_text import mm
from dynslam_bench.core.settings import Parameter, Scalar
from dynslam_bench.evaluation.verdicts import ComparisonVerdict, PairedRatio
from dynslam_bench.reports.build_report import sections_page
from dynslam_bench.reports.figures import COLOURS, GUIDE, NEUTRAL, log_axis, mm_axis, rounded, safe
from dynslam_bench.reports.html.page import Block, Section, figure_blocks, write_assets
from dynslam_bench.reports.model.names import shortened
from dynslam_bench.reports.model.row import SEEN, command_line
from dynslam_bench.reports.tables.table import (
    Column,
    Emphasis,
    Table,
    TableCell,
    csv_text,
    number,
    numbers,
)
from dynslam_bench.tuning.judgement import (
    Candidate,
    SceneErrors,
    StudySummary,
    next_step,
    preset_text,
)
from dynslam_bench.tuning.plan import FEWEST_STARTS, Design, seen_note
from dynslam_bench.tuning.storage import EARLIER, FEWEST_TRIALS, front_trials, is_feasible, quiet
from dynslam_bench.tuning.study import Study
from dynslam_bench.tuning.study_file import scenes

_LEVELS = {ComparisonVerdict.PROVEN: "green", ComparisonVerdict.WORSE: "red"}
"""Colour of the verdict; all others are amber."""
_CONTOURS = 4
"""Contours of so many parameters are drawn, the most important ones."""
_FEW_TRIALS = 20
"""With fewer finished trials the page warns that the best value is partly luck."""


def write_page(tuner: Study, summary: StudySummary) -> Path:
    """Write the page of a finished study.

    Args:
        tuner: The study.
        summary: What `finish` made of it.

    Returns:
        Path of ``index.html`` in the study's folder; its tables lie beside it as CSV.
    """
    # the tables, as CSV too
    spec = tuner.spec
    candidates = _candidates(summary)
    trials = _trials(tuner, summary)
    params = summary.best.params if summary.best else {}
    proven = summary.verdict == ComparisonVerdict.PROVEN
    settings = settings_table(tuner.space, tuner.base, params, proven)
    for table in (candidates, trials, settings):
        write_atomic(tuner.folder / "csv" / f"{table.id}.csv", csv_text(table.frame()))

    # the sections
    note = seen_note(summary.seen)
    caption = (
        "Ratios to the baseline, below 1 is better: of the trials, where the best is partly luck; of the best ones "
        "on scenes that no trial had seen; and of the best one on the held-out scenes and recordings. Bars: intervals "
        "over scenes (Hodges and Lehmann). The star is what is proven."
    )
    sentence, command = next_step(spec, summary, tuner.baseline, tuner.configuration(params))
    sections = [
        Section("next", "Do this", [], [Block(text=command, caption=sentence)]),
        _scenes_section(tuner, summary),
        Section(
            "result",
            "Tried, chosen, judged",
            [note] if note else [],
            [*figure_blocks(_funnel_figure(tuner, summary), caption), Block(table=candidates)],
        ),
        Section(
            "preset", "Settings: baseline, best trial, range", [], _preset(tuner, summary, settings)
        ),
        Section(
            "course",
            "How it went",
            [*warnings_of(tuner), _importance_note(summary)],
            _plots(tuner, summary),
        ),
        Section("trials", "All trials", [], [Block("All trials", trials, folded=True)]),
    ]

    if len(tuner.objectives) > 1:
        sections.insert(2, _front(tuner))
    started_with = command_line(tuner.study.user_attrs.get("command", []))
    made_with = (
        f"Sampler {tuner.sampler_name}, pruner {tuner.pruner_name}, Optuna {optuna.__version__}."
    )
    html = sections_page(
        sections,
        title=f"Study {spec.name}: {spec.tracker}",
        banner=summary.conclusion,
        level=_LEVELS.get(summary.verdict, "amber"),
        protocol=f"{_asked(tuner, summary)} {summary.protocol}.",
        evaluates=True,
        links=[],
        footer=f"{made_with} Reproduce: {started_with}",
    )
    write_assets(tuner.folder)
    write_atomic(tuner.folder / "index.html", html)
    return tuner.folder / "index.html"


def _asked(tuner: Study, summary: StudySummary) -> str:
    """The question of the study, in words."""
    goals = " and ".join(objective.what for objective in tuner.objectives)
    trials = ", ".join(f"{count} {state}" for state, count in summary.trials.items() if count)
    design = tuner.design
    splits = {
        "to tune on": design.tune,
        "to choose on": design.confirm,
        "held out": design.held_out,
    }
    sizes = ", ".join(
        f"{name} {len(instances)} runs, {len(scenes(instances))} scenes"
        for name, instances in splits.items()
    )
    text = (
        f"Do other values of {len(tuner.space)} settings give {tuner.spec.tracker} less {goals} than "
        f"{summary.baseline}? Trials: {trials}. Runs: {sizes}."
    )
    limits = {"coverage": tuner.spec.min_coverage, "frames a second": tuner.spec.min_fps}
    constraints = [
        f"{name} of {least:g} or more" for name, least in limits.items() if least is not None
    ]
    constraints += [f"{name} of {most:g} or less" for name, most in tuner.spec.limits.items()]
    constraints += list(tuner.constraints)
    if constraints:
        text += f" Constraints: {', '.join(constraints)}."
    return text


def _plots(tuner: Study, summary: StudySummary) -> list[Block]:
    """Optuna's own plots of the study; ratios in place of logarithms."""
    important = list(summary.importances)
    tried = {name for trial in tuner.study.get_trials(deepcopy=False) for name in trial.params}
    params = important or [parameter.name for parameter in tuner.space if parameter.name in tried]
    blocks = []
    for title, figure in _optuna_figures(tuner, params, bool(important)).items():
        # a row of contours for each parameter
        height = 60 + 170 * min(len(params), _CONTOURS) if title == "Contours" else 450
        figure.update_layout(title=None, template={}, height=figure.layout.height or height)
        if title in ("Contours", "Slices"):  # whole names of settings overlap
            for axis in (*figure.select_xaxes(), *figure.select_yaxes()):
                last_part = (axis.title.text or "").rpartition(".")[2]
                axis.update(title={"text": last_part, "font": {"size": 11}})
        blocks += figure_blocks(figure, f"{title}, as Optuna draws it.", title)
    return blocks


def _optuna_figures(tuner: Study, params: list[str], has_importances: bool) -> dict[str, go.Figure]:
    """Optuna's plots that fit the number of objectives, by title.

    Args:
        tuner: The study.
        params: Names of the parameters, the most important first.
        has_importances: Whether there are trials enough for importances.
    """
    from optuna import visualization

    names = [f"ratio of {objective.what} to the baseline" for objective in tuner.objectives]
    target: dict[str, Any] = {
        "target": lambda trial: math.exp(trial.values[0]),
        "target_name": names[0],
    }
    with quiet():
        figures = {
            "History": visualization.plot_optimization_history(tuner.study, **target),
            "Parallel coordinates": visualization.plot_parallel_coordinate(tuner.study, **target),
            "Slices": visualization.plot_slice(tuner.study, **target),
            "Contours": visualization.plot_contour(
                tuner.study, params=params[:_CONTOURS], **target
            ),
        }
        for name in ("History", "Slices"):
            figures[name].add_hline(1.0, **GUIDE)
        if has_importances:
            evaluator = optuna.importance.PedAnovaImportanceEvaluator()
            figures["Importances"] = visualization.plot_param_importances(
                tuner.study, evaluator=evaluator, **target
            )
        if len(names) == 1:
            # this plot takes no function of the value: its traces are logarithms
            steps = visualization.plot_intermediate_values(tuner.study)
            steps.for_each_trace(lambda trace: trace.update(y=np.exp(np.asarray(trace.y, float))))
            steps.update_yaxes(title=names[0])
            figures["Intermediate values"] = steps
        elif len(names) < 4:
            figures["Pareto front"] = visualization.plot_pareto_front(
                tuner.study,
                targets=lambda trial: list(map(math.exp, trial.values)),
                target_names=names,
            )
    return figures


def _preset(tuner: Study, summary: StudySummary, settings: Table) -> list[Block]:
    """The best settings beside the baseline's, and the preset with its status."""
    shown = Block(table=settings)
    text = read_text(tuner.folder / "best.toml")
    if summary.is_to_use:
        return [shown, Block("best.toml", text=text)]
    why = "the default settings are as good" if summary.keeps_default else summary.verdict.value
    return [shown, Block(title=f"best.toml, not recommended: {why}", text=text)]


def _front(tuner: Study) -> Section:
    """The Pareto front: where its trials lie, their settings, and how to take one of them."""
    front = front_trials(tuner.study)
    names = [parameter.name for parameter in tuner.space]
    rows = []
    for trial in front:
        ratios = [number(math.exp(value), ".3f") for value in trial.values]
        settings = [_value(trial.params.get(name)) for name in names]
        rows.append([TableCell(str(trial.number), value=trial.number), *ratios, *settings])
    headings = [f"ratio of {objective.what}" for objective in tuner.objectives]
    table = Table(
        "front",
        "The front",
        "No other trial that fulfils the constraints is better in all objectives. The ratios are those of the trials, "
        "and optimistic: the front was selected for them.",
        [Column("trial"), *numbers(*headings, *names)],
        rows,
    )

    # each trial of the front as a preset to copy
    presets = []
    for trial in front:
        pairs = zip(tuner.objectives, trial.values, strict=True)
        values = ", ".join(f"{one.what} x {math.exp(value):.3f}" for one, value in pairs)
        remark = (
            f"Trial {trial.number} of the front, {values}; not judged on scenes that no trial saw."
        )
        text = preset_text(tuner.spec, trial.params, remark)
        presets.append(Block(title=f"Trial {trial.number}: {values}", text=text, folded=True))
    note = (
        "Open a trial for its settings as a preset. Before a study has its verdict, dynslam-bench tune run "
        "STUDY.toml --choose TRIAL has that trial judged on the held-out instances, in place of the best in all "
        "objectives together."
    )
    write_atomic(tuner.folder / "csv" / "front.csv", csv_text(table.frame()))
    return Section("front", "The front: choose", [note], [Block(table=table), *presets])


def _importance_note(summary: StudySummary) -> str:
    """The importances of the settings with their intervals, or why there are none."""
    if not summary.importances:
        return f"No importances: they need {FEWEST_TRIALS} complete or pruned trials that differ."
    shares = ", ".join(f"{name} {importance}" for name, importance in summary.importances.items())
    return f"Importances (PED-ANOVA) and their 95 % intervals: {shares}. They add up to 100 % even where none matters."


def _scenes_section(tuner: Study, summary: StudySummary) -> Section:
    """The errors of the baseline and of the best trial on every scene that judged, in millimetres."""
    title = "Baseline and best trial on every scene"
    best = summary.best
    if best is None or not best.scene_errors:
        return Section("scenes", title)

    # the scenes where the candidate gains most first
    ordered = sorted(best.scene_errors, key=lambda scene: scene.candidate_m / scene.baseline_m)
    short = shortened([scene.scene for scene in ordered])
    rows = []
    for scene in ordered:
        lost = [
            who
            for who, is_lost in (("baseline", scene.lost_by_baseline), ("trial", scene.lost))
            if is_lost
        ]
        rows.append(
            [
                TableCell(scene.scene),
                TableCell(mm(scene.baseline_m), value=scene.baseline_m),
                TableCell(mm(scene.candidate_m), value=scene.candidate_m),
                number(scene.candidate_m / scene.baseline_m, ".3f"),
                TableCell(" and ".join(lost)),
            ]
        )
    columns = [
        Column("scene", numeric=False),
        Column("baseline", "ATE, mm", full="baseline_m"),
        Column(f"trial {best.trial}", "ATE, mm", full="trial_m"),
        Column("ratio", meaning="below 1 the trial is better"),
        Column("lost by", numeric=False),
    ]
    words = "ATE in millimetres, lost frames held: median of a scene's starts."
    table = Table("scenes", "The same as a table", words, columns, rows)
    write_atomic(tuner.folder / "csv" / "scenes.csv", csv_text(table.frame()))
    caption = f"{best.errors_sentence} Crosses: lost track in half of the runs or more. {words}"
    figure = _scenes_figure(ordered, short, best.trial)
    return Section(
        "scenes",
        title,
        [],
        [*figure_blocks(figure, caption), Block(table.title, table, folded=True)],
    )


def _scenes_figure(
    ordered: Sequence[SceneErrors], short: Mapping[str, str], trial: int
) -> go.Figure:
    """A line a scene from the baseline's error to the trial's, on a logarithmic axis in millimetres."""
    names = [safe(short[scene.scene]) for scene in ordered]
    baseline_mm = [1000 * scene.baseline_m for scene in ordered]
    trial_mm = [1000 * scene.candidate_m for scene in ordered]

    # the lines that join them: a gap behind each
    joined_x: list[float | None] = []
    joined_y: list[str | None] = []
    for name, one, other in zip(names, baseline_mm, trial_mm, strict=True):
        joined_x += [one, other, None]
        joined_y += [name, name, None]
    line = {"color": NEUTRAL, "width": 2}
    traces = [
        go.Scatter(
            x=joined_x, y=joined_y, mode="lines", line=line, hoverinfo="skip", showlegend=False
        )
    ]

    # the two errors
    sides = (
        ("baseline", baseline_mm, [scene.lost_by_baseline for scene in ordered], NEUTRAL),
        (f"trial {trial}", trial_mm, [scene.lost for scene in ordered], COLOURS[0]),
    )
    for who, errors_mm, lost, colour in sides:
        traces.append(
            go.Scatter(
                x=rounded(errors_mm),
                y=names,
                mode="markers",
                name=who,
                marker={
                    "color": colour,
                    "size": 11,
                    "symbol": ["x" if is_lost else "circle" for is_lost in lost],
                },
                hovertemplate="%{y}<br>%{x:.3g} mm<extra>%{fullData.name}</extra>",
            )
        )
    layout: dict[str, Any] = {
        "template": {},
        "height": 130 + 22 * len(names),
        "xaxis": mm_axis("absolute trajectory error (mm), left is better"),
        "yaxis": {"categoryorder": "array", "categoryarray": names[::-1]},
        "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom"},
    }
    return go.Figure(traces, go.Layout(**layout))


def _funnel_figure(tuner: Study, summary: StudySummary) -> go.Figure:
    """Ratios of all trials, of the confirmed candidates, and of the choice where it is judged."""
    # the trials with other settings, spread over the width of their stage so that they do not hide each other
    finished = tuner.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    tried = [trial for trial in finished if trial.number > 0]
    spread = 0.5 * (np.random.default_rng(0).random(len(tried)) - 0.5)
    stages = [f"tried: {len(tried)} whole trials"]
    traces = [
        go.Scatter(
            x=spread,
            y=[math.exp(trial.values[0]) for trial in tried],
            mode="markers",
            name="trials",
            text=[f"trial {trial.number}" for trial in tried],
            marker={"color": NEUTRAL, "opacity": 0.7, "size": 7},
            hovertemplate="%{text}: %{y:.3f}<extra></extra>",
        )
    ]

    # the candidates on each split that judged some of them
    splits = {"confirm": "unseen scenes", "held_out": "held out", "recorded": "recordings"}
    for (split, words), colour in zip(splits.items(), COLOURS, strict=False):
        judged: list[tuple[Candidate, PairedRatio]] = [
            (candidate, ratio)
            for candidate in summary.candidates
            if (ratio := getattr(candidate, split)) is not None and ratio.ratio is not None
        ]
        if judged:
            traces.append(_judged_trace(judged, summary, len(stages), words, colour))
            stages.append(f"{words}: {len(judged)}")

    axis = {
        "tickvals": list(range(len(stages))),
        "ticktext": stages,
        "range": [-0.5, len(stages) - 0.5],
    }
    layout = {"height": 420, "template": {}, "showlegend": False, "xaxis": axis}
    figure = go.Figure(traces, go.Layout(yaxis=log_axis("ratio to the baseline"), **layout))
    figure.add_hline(1.0, **GUIDE)
    # annotations on a logarithmic axis take the logarithm of their place
    figure.add_annotation(
        x=0.0,
        xref="paper",
        xanchor="left",
        y=math.log10(1.0),
        yanchor="bottom",
        text="baseline",
        showarrow=False,
    )
    # an invisible point on the line: axes are fitted to points, not to lines
    figure.add_trace(go.Scatter(x=[0], y=[1.0], mode="markers", opacity=0, hoverinfo="skip"))
    return figure


def _judged_trace(
    judged: list[tuple[Candidate, PairedRatio]],
    summary: StudySummary,
    position: int,
    words: str,
    colour: str,
) -> go.Scatter:
    """Ratios of candidates with bars for their intervals, side by side at one stage; what is proven is a star."""
    x = position + 0.5 * (np.linspace(0, 1, len(judged) + 2)[1:-1] - 0.5)
    symbols = []
    above = []
    below = []
    for candidate, ratio in judged:
        is_proven = candidate is summary.best and summary.verdict is ComparisonVerdict.PROVEN
        symbols.append("star" if is_proven else "circle")
        centre = ratio.ratio or 0.0
        above.append(0.0 if ratio.high is None else ratio.high - centre)
        below.append(0.0 if ratio.low is None else centre - ratio.low)
    return go.Scatter(
        x=x,
        y=[ratio.ratio for _, ratio in judged],
        mode="markers",
        name=words,
        error_y={"type": "data", "symmetric": False, "array": above, "arrayminus": below},
        text=[f"trial {candidate.trial}" for candidate, _ in judged],
        marker={"color": colour, "symbol": symbols, "size": 12},
        hovertemplate="%{text}: %{y:.3f}<extra></extra>",
    )


def fewer_starts(design: Design) -> str:
    """Why the baseline itself may have another ratio than 1; empty where trials ran from as many starts as it."""
    if len(design.reference) == len(design.tune):
        return ""
    return (
        f" Ratios are to the median of the baseline over {FEWEST_STARTS} or more starts in each scene, but every "
        "trial, the baseline as trial 0 too, ran from fewer: so the ratio of trial 0, and with it the best so far, may "
        "differ from 1 though no setting was changed."
    )


def warnings_of(tuner: Study) -> list[str]:
    """Warnings on the course of a study, in sentences."""
    complete = tuner.study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    infeasible = sum(not is_feasible(trial) for trial in complete)
    notes = []
    if len(complete) < _FEW_TRIALS:
        notes.append(f"Only {len(complete)} trials were finished: the best value is partly luck.")
    if infeasible:
        notes.append(
            f"{infeasible} of {len(complete)} trials violate a constraint. They are candidates only where all do, and "
            "then have to fulfil it on unseen instances."
        )
    if "speed" in tuner.spec.objectives:
        notes.append(
            "Trials ran at different times, so their ratios of processor time depend on the machine's other load. "
            "On the instances of the choice and the held-out ones baseline and candidates ran in turn: those count."
        )
    return notes


def _candidates(summary: StudySummary) -> Table:
    """The table of the best trials, as they were judged again on the splits."""

    def ratio(value: PairedRatio | None) -> TableCell:
        """A cell with a ratio, its interval and the number of scenes."""
        if value is None or value.ratio is None:
            return TableCell()
        scenes_text = f"{value.scenes} of {value.all_scenes}"
        return TableCell(
            f"{value.ratio:.3f}", f"{value.interval} {scenes_text}".strip(), value.ratio
        )

    def losses(candidate: Candidate) -> TableCell:
        """A cell with the scenes lost by the candidate and by the baseline."""
        evidence = candidate.evidence
        if evidence is None:
            return TableCell()
        text = f"{len(evidence.losses)} : {len(evidence.losses_baseline)}"
        return TableCell(text, value=len(evidence.losses))

    rows = []
    for candidate in summary.candidates:
        emphasis: Emphasis = "best" if candidate is summary.best else ""
        trial_value = math.exp(candidate.values[0]) if candidate.values else None
        chosen_by = None if candidate.choice is None else math.exp(candidate.choice)
        holds = "yes" if candidate.feasible else "no"
        rows.append(
            [
                TableCell(str(candidate.trial), value=candidate.trial, emphasis=emphasis),
                number(trial_value, ".3f"),
                number(chosen_by, ".3f"),
                ratio(candidate.confirm),
                ratio(candidate.held_out),
                losses(candidate),
                ratio(candidate.recorded),
                ratio((candidate.on_held_out or candidate.on_confirm).get("speed")),
                TableCell(candidate.failed or holds),
            ]
        )
    caption = (
        "Ratios to the baseline on the same instances: median of a scene's starts, typical ratio over the scenes "
        "where both succeed (Hodges and Lehmann) with its interval, and of how many scenes. Losses: scenes that the "
        "candidate alone lost or has three times the error in, and the reverse. The mean where it was chosen counts "
        "losses in full; it ranks the candidates and shows nothing. "
        f"Processor times are on unseen instances, without the stage cache. {seen_note(summary.seen)}"
    )
    optimistic = "the trial's own value, optimistic: the trial was selected for it"
    tune, confirm, held_out = _marked(
        summary, ("in the trial", "tune"), ("unseen instances", "confirm"), ("held-out", "held_out")
    )
    columns = [
        Column("trial"),
        Column(tune, meaning=optimistic),
        Column("mean where chosen", meaning="mean ratio on the instances of the choice"),
        *numbers(confirm, held_out),
        Column(
            "losses", meaning="of the candidate alone : of the baseline alone, where it is judged"
        ),
        *numbers("recorded", "processor time"),
        Column("constraints hold", numeric=False),
    ]
    return Table("candidates", "The best trials, judged again", caption, columns, rows)


def _marked(summary: StudySummary, *headings: tuple[str, str]) -> list[str]:
    """Headings of columns, with `SEEN` behind those of a split whose scenes the masks' network was trained on."""
    return [
        f"{heading} {SEEN}" if split in summary.seen else heading for heading, split in headings
    ]


def _trials(tuner: Study, summary: StudySummary) -> Table:
    """The table of all trials with their values, coverage, speed and settings."""
    names = [parameter.name for parameter in tuner.space]
    rows = []
    for trial in tuner.study.get_trials(deepcopy=False):
        facts = trial.user_attrs
        ratios = [number(math.exp(value), ".3f") for value in trial.values or ()]
        if not trial.values:  # a failed one has an empty cell for each objective
            ratios = [TableCell() for _ in tuner.objectives]
        rows.append(
            [
                TableCell(str(trial.number), value=trial.number),
                TableCell(trial.state.name.lower(), facts.get("reason") or facts.get(EARLIER, "")),
                *ratios,
                number(facts.get("coverage"), ".3f"),
                number(facts.get("fps"), ".1f"),
                *(_value(trial.params.get(name)) for name in names),
            ]
        )
    headings = _marked(
        summary, *((f"ratio of {objective.what}", "tune") for objective in tuner.objectives)
    )
    columns = [
        Column("trial"),
        Column("state", numeric=False),
        *numbers(*headings, "coverage", "fps", *names),
    ]
    caption = f"Pages of its runs: dynslam-bench report --trials.{fewer_starts(tuner.design)} {seen_note(summary.seen)}"
    return Table("trials", "All trials", caption, columns, rows)


def settings_table(
    space: Sequence[Parameter], baseline: dict[str, Any], best: dict[str, Any], proven: bool
) -> Table:
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
    caption = "What was searched."
    if not proven:
        caption += " The best trial is not proven: keep the baseline."
    return Table("settings", "Baseline, best trial and range", caption, columns, rows)


def _value(value: Scalar | None) -> TableCell:
    """The cell of a setting's value; a dash where there is none."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return number(float(value), ".4g")
    return TableCell("–" if value is None else setting_text(value))


def _range(parameter: Parameter) -> str:
    """The values that were searched."""
    if parameter.low is None or parameter.high is None:
        return ", ".join(map(setting_text, parameter.choices)) or "true, false"
    scale = ", log" if parameter.scale == "log" else ""
    return f"{parameter.low:g} to {parameter.high:g}{scale}"
