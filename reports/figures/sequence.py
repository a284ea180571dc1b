"""Figures of one sequence: trajectories seen along the three axes, and the error over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.evaluation.evaluate import pose_errors
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry.trajectory import Trajectory

from ..model.board import Board
from .style import Figure, axis, colours, layout_of, rounded, significant, wrapped

_TRUTH = "#111827"
_MOST_POINTS = 500


def sequence_figures(
    board: Board, truth: Trajectory, estimates: Mapping[str, Trajectory], protocol: Protocol
) -> tuple[Figure, Figure]:
    """Trajectories seen along the three axes, and the error over time, of one sequence.

    Args:
        board: Gives labels and colours.
        truth: Ground truth.
        estimates: Variant key to the trajectory of one of its runs.
        protocol: How to align.

    Returns:
        The two figures; lines are broken where a gap is longer than twice the median interval.
    """
    palette = colours(board)
    places = (("x", "y", 0, 1), ("x", "z", 0, 2), ("y", "z", 1, 2))
    start = float(truth.timestamps[0])
    paths: list[dict[str, Any]] = []
    errors: list[dict[str, Any]] = []
    shown = set((board.ranked_order() or board.trackers)[:6]) | ({board.reference} if board.reference else set())
    drawn: list[tuple[str, str, NDArray[np.float64], NDArray[np.float64], str]] = []
    window = _overlap(truth, estimates)
    drawn.append(("", "ground truth", window.timestamps, window.positions, _TRUTH))
    for key, estimate in estimates.items():
        aligned, _, series = pose_errors(estimate, truth, protocol)
        drawn.append((key, wrapped(board.labels[key]), aligned.timestamps, aligned.positions, palette[key]))
        stamps, values = broken(aligned.timestamps - start, series["trans_m"][:, None])
        errors.append(
            _line_trace(wrapped(board.labels[key]), palette[key], stamps, values[:, 0], key in shown, width=1.6)
            | {"hovertemplate": "%{y:.4f} m at %{x:.2f} s<extra>%{fullData.name}</extra>"}
        )
    for key, name, stamps, positions, colour in drawn:
        _, xyz = broken(stamps, positions)
        for panel, (_, _, i, j) in enumerate(places, start=1):
            suffix = "" if panel == 1 else str(panel)
            trace = _line_trace(name, colour, xyz[:, i], xyz[:, j], not key or key in shown, width=1.4 if key else 2.4)
            paths.append(
                trace | {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "legendgroup": key, "showlegend": panel == 1,
                         "hoverinfo": "name"}
            )  # fmt: skip
    layout = layout_of(height=max(430, 110 + 19 * len(drawn)))
    centre, half = _view(window, [xyz for key, _, _, xyz, _ in drawn if key in shown])
    for panel, (a, b, i, j) in enumerate(places, start=1):
        suffix = "" if panel == 1 else str(panel)
        left = (panel - 1) * 0.36
        layout[f"xaxis{suffix}"] = axis(f"{a} (m)") | {
            "domain": [left, left + 0.28], "constrain": "domain",
            "range": [significant(centre[i] - half), significant(centre[i] + half)],
        }  # fmt: skip
        layout[f"yaxis{suffix}"] = axis(f"{b} (m)") | {
            "anchor": f"x{suffix}", "scaleanchor": f"x{suffix}", "constrain": "domain",
            "range": [significant(centre[j] - half), significant(centre[j] + half)],
        }  # fmt: skip
    over_time = layout_of(
        height=max(340, 100 + 19 * len(errors)),
        xaxis=axis("time since the first true pose (s)"),
        yaxis=axis("absolute error (m)") | {"rangemode": "tozero"},
    )
    return {"data": paths, "layout": layout}, {"data": errors, "layout": over_time}


def broken(
    stamps: NDArray[np.float64], values: NDArray[np.float64], most: int = _MOST_POINTS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Thin a series and put NaN where the time between two poses exceeds twice the median interval.

    Args:
        stamps: Seconds ``[N]``.
        values: ``[N, K]``.
        most: About how many points to keep.

    Returns:
        Stamps ``[M]`` and values ``[M, K]`` with NaN rows in the gaps.
    """
    if len(stamps) < 3:
        return stamps, values
    intervals = np.diff(stamps)
    piece = np.concatenate([[0], np.cumsum(intervals > 2 * np.median(intervals))])
    step = max(1, -(-len(stamps) // most))
    keep = np.arange(len(stamps)) % step == 0
    edge = np.diff(piece) > 0
    keep |= np.append(edge, True) | np.append(True, edge)  # the ends of every piece stay
    kept = np.flatnonzero(keep)
    breaks = np.flatnonzero(np.diff(piece[kept]) > 0) + 1
    middle = (stamps[kept][breaks - 1] + stamps[kept][breaks]) / 2
    return (
        np.insert(stamps[kept], breaks, middle),
        np.insert(values[kept], breaks, np.nan, axis=0),
    )


def _overlap(truth: Trajectory, estimates: Mapping[str, Trajectory]) -> Trajectory:
    """The part of the ground truth within the time of the estimates."""
    if not estimates:
        return truth
    start = min(float(e.timestamps[0]) for e in estimates.values()) - 0.02
    stop = max(float(e.timestamps[-1]) for e in estimates.values()) + 0.02
    inside = (truth.timestamps >= start) & (truth.timestamps <= stop)
    return truth.select(inside) if inside.sum() > 1 else truth


def _view(truth: Trajectory, shown: Sequence[NDArray[np.float64]]) -> tuple[NDArray[np.float64], float]:
    """Centre and half the width of a cube that holds the truth and the shown paths, but no more than thrice the truth.

    A path that runs away is cut off rather than shrinking all others to a dot.
    """
    low, high = truth.positions.min(axis=0), truth.positions.max(axis=0)
    most = 1.5 * max(float((high - low).max()), 0.1)
    centre = (low + high) / 2
    reach = [float(np.abs(xyz - centre).max()) for xyz in (truth.positions, *shown) if len(xyz)]
    return centre, 1.06 * max(min(max(reach), most), 0.01)


def _line_trace(
    name: str, colour: str, x: NDArray[np.float64], y: NDArray[np.float64], visible: bool, width: float
) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": rounded(x.tolist()),
        "y": rounded(y.tolist()),
        "line": {"color": colour, "width": width},
        "connectgaps": False,
        "visible": True if visible else "legendonly",
    }
