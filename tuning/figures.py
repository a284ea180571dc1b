"""Figures and table of the study page that compare trials: ratios to the default, with default and chosen marked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from optuna.trial import FrozenTrial

from dynslam_bench.core.settings import Parameter, Scalar
from dynslam_bench.core.toml import setting_text
from dynslam_bench.reports.figures import axis, guide, layout_of, log_axis, significant
from dynslam_bench.reports.tables.table import Column, Table, TableCell, number

Figure = dict[str, Any]

MOST_SLICES = 5
_TRIAL, _BEST, _DEFAULT, _CHOSEN = "#1f6fb4", "#8a8f98", "#2a9d6f", "#d9542b"


Star = tuple[int, str]
"""The trial that a page is about, and its name there: ``chosen`` only if it was."""


def ratios(trial: FrozenTrial) -> list[float]:
    """The objectives of a complete trial as ratios to the default settings, less is better."""
    return [math.exp(value) for value in trial.values]


def history(trials: Sequence[FrozenTrial], what: str, star: Star | None) -> Figure:
    """The first objective of every complete trial, in their order, and the best so far."""
    found = {trial.number: ratios(trial)[0] for trial in trials}
    best = [min(list(found.values())[: at + 1]) for at in range(len(found))]
    line = {"mode": "lines", "name": "best so far", "x": list(found), "y": [significant(value) for value in best]}
    data = [
        line | {"line": {"color": _BEST, "width": 2}},
        *_marked([(number, number, value) for number, value in found.items()], star),
    ]
    layout = layout_of(
        height=420,
        xaxis=axis("trial") | {"whole": True},
        yaxis=log_axis(f"ratio of {what} to the default (less is better)", [1.0, *found.values()]),
        shapes=[guide(y=1.0)],
    )
    return {"data": data, "layout": layout}


def slices(
    trials: Sequence[FrozenTrial],
    space: Sequence[Parameter],
    default: Mapping[str, Any],
    what: str,
    star: Star | None,
) -> Figure:
    """The first objective against each of some settings, a panel each; trial 0 stands at the default value."""
    data: list[Figure] = []
    layout = layout_of(height=380, shapes=[guide(y=1.0)])
    for at, parameter in enumerate(space):
        tag = "" if at == 0 else str(at + 1)
        points = []
        for trial in trials:
            value = trial.params.get(parameter.name, default.get(parameter.name) if trial.number == 0 else None)
            if value is not None:
                points.append((trial.number, value if _is_number(value) else setting_text(value), ratios(trial)[0]))
        kind = "category" if any(isinstance(x, str) for _, x, _ in points) else parameter.scale
        layout[f"xaxis{tag}"] = axis(parameter.name, type=kind)
        title = f"ratio of {what} to the default" if at == 0 else ""
        layout[f"yaxis{tag}"] = log_axis(title, [1.0, *(y for _, _, y in points)])
        for trace in _marked(points, star):
            data.append(trace | {"xaxis": f"x{tag}", "yaxis": f"y{tag}", "showlegend": at == 0})
    return {"data": data, "layout": layout}


def front(trials: Sequence[FrozenTrial], best: set[int], whats: Sequence[str], star: Star | None) -> Figure:
    """The first objective against the second; a line joins the `best`, which no other beats in all."""
    found = {trial.number: ratios(trial)[:2] for trial in trials}
    joined = sorted(found[number] for number in best if number in found)
    x, y = ([pair[which] for pair in joined] for which in (0, 1))
    line = {"mode": "lines", "name": "front", "x": x, "y": y, "line": {"color": _BEST, "width": 2, "dash": "dot"}}
    titles = [f"ratio of {what} to the default (less is better)" for what in whats]
    layout = layout_of(
        height=440,
        xaxis=log_axis(titles[0], [1.0, *(pair[0] for pair in found.values())]),
        yaxis=log_axis(titles[1], [1.0, *(pair[1] for pair in found.values())]),
        shapes=[guide(x=1.0), guide(y=1.0)],
    )
    return {
        "data": [line, *_marked([(key, pair[0], pair[1]) for key, pair in found.items()], star)],
        "layout": layout,
    }


def settings_table(
    space: Sequence[Parameter], default: Mapping[str, Scalar], chosen: Mapping[str, Scalar] | None, holds: bool
) -> Table:
    """Every tuned setting: default, chosen value, and the range that was searched."""
    rows = []
    for parameter in space:
        rows.append(
            [
                TableCell(parameter.name),
                _value(default.get(parameter.name)),
                _value(None if chosen is None else chosen.get(parameter.name)),
                TableCell(_range(parameter)),
                TableCell(parameter.unit),
            ]
        )
    words = [Column(name, numeric=False) for name in ("setting", "range", "unit")]
    columns = [words[0], Column("default"), Column("chosen" if holds else "best trial"), *words[1:]]
    caption = "What was searched." if holds else "What was searched; the best trial does not hold up: keep the default."
    return Table("settings", "Default, chosen and range", caption, columns, rows)


def _marked(points: Sequence[tuple[int, Any, float]], star: Star | None) -> list[Figure]:
    """The trials ``(number, x, y)`` as points; the default (trial 0) and the star are marked."""
    special, name = star or (0, "")
    kinds = [
        ("trial", [point for point in points if point[0] not in (0, special)], _TRIAL, "circle", 9),
        ("default", [point for point in points if point[0] == 0], _DEFAULT, "diamond", 13),
        (name, [point for point in points if point[0] == special != 0], _CHOSEN, "star", 14),
    ]
    return [
        {
            "type": "scatter",
            "mode": "markers",
            "name": name,
            "x": [x for _, x, _ in some],
            "y": [significant(y) for _, _, y in some],
            "text": [f"trial {key}" for key, _, _ in some],
            "marker": {"color": colour, "symbol": symbol, "size": size},
            "hovertemplate": "%{text}<br>%{x}: %{y}<extra></extra>",
        }
        for name, some, colour, symbol, size in kinds
        if some
    ]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _value(value: Scalar | None) -> TableCell:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return number(float(value), ".4g")
    return TableCell("–" if value is None else setting_text(value))


def _range(parameter: Parameter) -> str:
    if parameter.low is None or parameter.high is None:
        return ", ".join(map(setting_text, parameter.choices)) or "true, false"
    return f"{parameter.low:g} to {parameter.high:g}{', log' * (parameter.scale == 'log')}"
