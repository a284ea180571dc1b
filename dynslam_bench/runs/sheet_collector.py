"""Collects what the five-panel sheet of a run shows while the run goes on, and writes it at the end."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dynslam_bench.contracts.map_outputs import MapOutputs
from dynslam_bench.envs.rendering import CULLED, KEPT, MASK, Canvas, Image
from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.slam.outputs.sheet_panels import draw_sheet, write_sheet

from .truth import aligned_truth

SHOWN = 9
"""Frames, and keyframes, on a sheet."""
SHEET_FILE = "sheet.png"
FEATURES = (("kept", KEPT), ("culled", CULLED), ("mask", MASK))


class SheetWriter:
    """Input, frames with their features, keyframes, map and track of one run as ``sheet.png``.

    Args:
        path: Where to write.
        env: The run's environment.
    """

    def __init__(self, path: Path, env: SlamEnv) -> None:
        self._path, self._env = path, env
        self._canvas = Canvas(env.sequence, env.tracker_spec.label)
        self._wanted = set(_spread(len(env.sequence)))
        self._frames: list[Image] = []

    def add(self) -> None:
        """Keep the picture of the current frame if it is one of those shown."""
        if self._env.episode.outcomes[-1].index in self._wanted:
            self._frames.append(self._canvas.picture(self._env.frame, self._env.result))

    def write(self, outputs: MapOutputs, track: Trajectory) -> None:
        """Draw and write the sheet.

        Args:
            outputs: Keyframes and map points.
            track: The run's final trajectory, or the online one.
        """
        sequence = self._env.sequence
        own = [record.frame for record in outputs.keyframes if record.frame >= 0]  # others are of an earlier run
        shown = [own[row] for row in _spread(len(own))]
        title = f"{self._env.tracker_spec.label}  |  {sequence.id}"
        keyframes = [sequence[index].rgb for index in shown]
        truth, ate_m = aligned_truth(sequence.ground_truth, track)
        sheet = draw_sheet(title, sequence[0].rgb, self._frames, keyframes, outputs, track, truth, ate_m, FEATURES)
        write_sheet(self._path, sheet)


def _spread(count: int) -> list[int]:
    """At most `SHOWN` indices spread over `count` things, the first and the last among them."""
    return sorted({int(index) for index in np.linspace(0, max(count - 1, 0), min(SHOWN, count)).round()})
