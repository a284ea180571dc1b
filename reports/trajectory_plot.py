"""Trajectories of files beside their ground truth: the tracks, and the error over time (as `evo_ape -p` draws them)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core import ReportError, write_atomic
from dynslam_bench.core.number_text import mm
from dynslam_bench.envs.rendering import VIEWS, main_view
from dynslam_bench.geometry import Array, Trajectory, se3
from dynslam_bench.reports.figures import COLOURS, DASHES, NEUTRAL, safe

if TYPE_CHECKING:
    import plotly.graph_objects as go
    from matplotlib.figure import Figure

PICTURES = (".png", ".svg", ".pdf")
"""Endings of pictures; ``.html`` is a page."""
GAP_STEPS = 5.0
"""A line is broken where the next pose is farther away in time than so many median steps: frames were lost between."""
SIZE_INCHES = (11.0, 4.8)
"""Width and height of a picture: both panels beside each other on a page in landscape."""
DOTS_PER_INCH = 150
"""Resolution of a PNG."""
_MATPLOTLIB_DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-."}


@dataclass(frozen=True, eq=False)
class PlottedTrajectory:
    """An estimate beside its ground truth.

    Attributes:
        label: Name in the legend.
        aligned: Estimated poses with ground truth, aligned to it as the protocol has it.
        errors_m: Absolute translation errors of these poses, metres ``[N]``.
        rmse_m: Root mean square of these errors, metres.
    """

    label: str
    aligned: Trajectory
    errors_m: Array
    rmse_m: float

    @property
    def title(self) -> str:
        """The label with the error."""
        return f"{self.label}: {mm(self.rmse_m)} mm"


def plot_trajectories(
    estimates: Sequence[PlottedTrajectory], truth: Trajectory, path: str | Path
) -> Path:
    """Draw tracks and errors over time into a file.

    The tracks are seen along the axis in which the true path spreads least, in the frame of the
    first true camera: from above for a camera that is carried around.

    Args:
        estimates: What is drawn.
        truth: True camera-to-world poses; those within the time of the estimates are drawn.
        path: Its ending is ``.html`` (a page that needs nothing beside it), ``.png``, ``.svg`` or
            ``.pdf``.

    Returns:
        The file.

    Raises:
        ReportError: Another ending.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in (".html", *PICTURES):
        raise ReportError(
            f"a plot cannot be written to {path.name}",
            f"give it one of the endings .html, {', '.join(PICTURES)}",
        )
    panels = _Panels(estimates, truth)
    path.parent.mkdir(parents=True, exist_ok=True)
    if ending == ".html":
        page = panels.page().to_html(include_plotlyjs=True, full_html=True)
        write_atomic(path, page.encode())
        return path
    # `savefig` chooses the format by the ending, so the file is written under a name that keeps it
    part = path.with_name(f".{path.stem}.part{ending}")
    panels.picture().savefig(part, dpi=DOTS_PER_INCH)
    part.replace(path)
    return path


class _Panels:
    """Lines of the two panels: paths in metres in the main view, and errors in millimetres over seconds."""

    def __init__(self, estimates: Sequence[PlottedTrajectory], truth: Trajectory) -> None:
        self.estimates = estimates
        first_s = min(float(one.aligned.timestamps[0]) for one in estimates)
        last_s = max(float(one.aligned.timestamps[-1]) for one in estimates)
        self._first_s = first_s

        # true poses within the estimates' time, and the view in which they spread most
        during = (truth.timestamps >= first_s) & (truth.timestamps <= last_s)
        truth = truth.select(np.flatnonzero(during)) if during.any() else truth
        self._origin = se3.inverse(truth.T_world_cam[0])
        self.view = main_view(self._positions(truth))
        self.true_path = self._path(truth)
        self.paths = [self._path(one.aligned) for one in estimates]
        self.errors_mm = [self._error_line(one) for one in estimates]
        # all colours in solid lines, then all of them dashed, and so on
        styles = [(colour, dash) for dash in DASHES for colour in COLOURS]
        self.styles = [styles[at % len(styles)] for at in range(len(estimates))]

    def _positions(self, trajectory: Trajectory) -> Array:
        """Camera centres in the first true camera's frame in metres ``[N, 3]``."""
        return (self._origin @ trajectory.T_world_cam)[:, :3, 3]

    def _path(self, trajectory: Trajectory) -> Array:
        """Camera centres in the view in metres ``[N, 2]``, with nan where frames are missing."""
        centres = self._positions(trajectory) @ VIEWS[self.view].T
        return np.insert(centres, _gaps(trajectory.timestamps), np.nan, axis=0)

    def _error_line(self, estimate: PlottedTrajectory) -> Array:
        """Seconds since the first pose and errors in millimetres ``[N, 2]``, with nan where frames are missing."""
        stamps = estimate.aligned.timestamps
        line = np.stack([stamps - self._first_s, 1000 * estimate.errors_m], axis=1)
        return np.insert(line, _gaps(stamps), np.nan, axis=0)

    @property
    def axes(self) -> tuple[str, str]:
        """Titles of the axes of the tracks; x is right, y down and z ahead of the first camera."""
        titles = []
        for direction in VIEWS[self.view]:
            axis = int(np.abs(direction).argmax())
            sign = "-" if direction[axis] < 0 else ""
            titles.append(f"{sign}{'xyz'[axis]} (m)")
        return titles[0], titles[1]

    def picture(self) -> Figure:
        """Both panels as a figure of matplotlib."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=SIZE_INCHES, layout="constrained")
        tracks, errors = figure.subplots(1, 2)
        tracks.plot(*self.true_path.T, color=NEUTRAL, linewidth=2.5, label="ground truth")
        for at, estimate in enumerate(self.estimates):
            colour, dash = self.styles[at]
            look = {"color": colour, "linestyle": _MATPLOTLIB_DASHES[dash], "linewidth": 1.3}
            tracks.plot(*self.paths[at].T, label=estimate.title, **look)
            errors.plot(*self.errors_mm[at].T, **look)
        tracks.set(
            title=f"tracks, {self.view.partition(':')[0]}",
            xlabel=self.axes[0],
            ylabel=self.axes[1],
        )
        tracks.set_aspect("equal", adjustable="datalim")
        errors.set(
            title="absolute translation error",
            xlabel="time (s)",
            ylabel="error (mm)",
            ylim=(0, None),
        )
        for panel in (tracks, errors):
            panel.grid(color="#e3e7ec")
            panel.spines[["top", "right"]].set_visible(False)
        # the legend stands below both panels, where it covers no line
        figure.legend(loc="outside lower center", ncols=min(3, 1 + len(self.estimates)))
        return figure

    def page(self) -> go.Figure:
        """Both panels as a figure of plotly."""
        import plotly.graph_objects as go
        from plotly.subplots import make_subplots

        titles = (f"tracks, {self.view.partition(':')[0]}", "absolute translation error")
        figure = make_subplots(1, 2, subplot_titles=titles)
        true_line = {"color": NEUTRAL, "width": 4}
        x, y = self.true_path.T
        figure.add_trace(go.Scatter(x=x, y=y, name="ground truth", line=true_line), 1, 1)
        for at, estimate in enumerate(self.estimates):
            colour, dash = self.styles[at]
            look = {
                "name": safe(estimate.title),
                "legendgroup": str(at),
                "line": {"color": colour, "dash": dash, "width": 2},
            }
            x, y = self.paths[at].T
            figure.add_trace(go.Scatter(x=x, y=y, **look), 1, 1)
            x, y = self.errors_mm[at].T
            figure.add_trace(go.Scatter(x=x, y=y, showlegend=False, **look), 1, 2)
        figure.update_traces(mode="lines")
        figure.update_xaxes(title=self.axes[0], row=1, col=1)
        figure.update_yaxes(title=self.axes[1], scaleanchor="x", row=1, col=1)
        figure.update_xaxes(title="time (s)", row=1, col=2)
        figure.update_yaxes(title="error (mm)", rangemode="tozero", row=1, col=2)
        figure.update_layout(template="plotly_white", legend={"orientation": "h", "y": -0.15})
        return figure


def _gaps(stamps: Array) -> NDArray[np.intp]:
    """Rows before which poses are missing: the step in time is over `GAP_STEPS` median ones."""
    steps = np.diff(stamps)
    if not len(steps):
        return np.zeros(0, dtype=np.intp)
    return np.flatnonzero(steps > GAP_STEPS * np.median(steps)) + 1
