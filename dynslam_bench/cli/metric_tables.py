"""Metrics of trajectories as tables: lengths in millimetres, angles in degrees; JSON has metres."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from dynslam_bench.cli.output import cell_text, table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from dynslam_bench.evaluation import Evaluation

STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
"""Statistics of an error, in the order of the columns."""
_METRIC = re.compile(rf"(?P<error>.+)_(?P<statistic>{'|'.join(STATISTICS)})_(?P<unit>[a-z]+)$")
"""Name of a statistic of an error."""
_SUM_OF_SQUARES = "_sse_"
"""In names of sums of squared errors, which JSON alone has."""


def statistics_table(metrics: Mapping[str, float]) -> str:
    """Errors as rows, their statistics as columns; then the metrics that are single numbers."""
    rows: dict[str, dict[str, float]] = {}
    single = []
    for name, value in metrics.items():
        # `ate_rmse_m` is the statistic `rmse` of the error `ate` in the unit `m`
        match = _METRIC.match(name)
        if _SUM_OF_SQUARES in name:
            continue
        if match is None or name.startswith("static_camera"):
            single.append((name, value))
            continue
        error = f"{match['error']} ({_shown_unit(match['unit'])})"
        rows.setdefault(error, {})[match["statistic"]] = _shown_scale(match["unit"]) * value
    cells = [
        [error, *[values.get(statistic) for statistic in STATISTICS]]
        for error, values in rows.items()
    ]
    lines = [table(("error", *STATISTICS), cells)]
    lines += ["  ".join((_shown_name(name), _shown_value(name, value))) for name, value in single]
    return "\n".join(lines)


def comparison_table(names: Sequence[str], results: Sequence[Evaluation]) -> str:
    """A row for each of several estimates: its absolute errors, and its relative ones by their rmse.

    Args:
        names: Names of the estimates.
        results: Their evaluations under one protocol.
    """
    shown = [
        name
        for name in results[0].metrics
        if name.endswith(("_rmse_m", "_rmse_deg", "ate_median_m", "ate_max_m"))
    ]
    rows = []
    for estimate, result in zip(names, results, strict=True):
        values = [_shown_value(name, result.metrics.get(name)) for name in shown]
        rows.append([estimate, result.n_pairs, *values])
    return table(("file", "poses", *map(_shown_name, shown)), rows)


def _shown_name(name: str) -> str:
    """The name of a metric with its unit in parentheses, ``ate_rmse (mm)``."""
    stem, _, unit = name.rpartition("_")
    return f"{stem} ({_shown_unit(unit)})" if unit in ("m", "deg") else name


def _shown_value(name: str, value: float | None) -> str:
    """The value of a metric in the unit of `_shown_name`; empty for None."""
    return "" if value is None else cell_text(_shown_scale(name.rpartition("_")[2]) * value)


def _shown_unit(unit: str) -> str:
    """The unit that a table has for one of a metric's name."""
    return "mm" if unit == "m" else unit


def _shown_scale(unit: str) -> float:
    """How many of the shown units make one of a metric's name."""
    return 1000.0 if unit == "m" else 1.0
