"""The figure of a run, five panels as in the paper's Figures 4 to 8: input, frames, keyframes, map, trajectory."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageOps

from dynslam_bench.contracts.tracker import MapOutputs
from dynslam_bench.core import write_atomic
from dynslam_bench.core.number_text import length_text, mm
from dynslam_bench.geometry import Trajectory, se3

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]
Colour = tuple[int, int, int]
Legend = Sequence[tuple[str, Colour]]

PANEL = (480, 360)
"""Width and height of a panel, pixels."""
PANEL_TITLE_HEIGHT = 28
"""Height of a panel's title, pixels."""
FIGURE_TITLE_HEIGHT = 44
"""Height of the figure's title, pixels."""
GAP = 12
"""Space between panels, pixels."""
INK = (40, 40, 40)
"""Texts and the scale bar."""
GREY = (150, 150, 150)
"""Frames of panels, the ground truth, the path through the keyframes."""
BLUE = (30, 110, 200)
"""The track and the cameras."""
RED = (210, 40, 40)
"""End of the track."""
GREEN = (30, 150, 30)
"""Start of the track."""
CAMERA = np.array(
    [[0, 0, 0], [-0.8, -0.6, 1], [0.8, -0.6, 1], [0.8, 0.6, 1], [-0.8, 0.6, 1], [0, 0, 0]]
)
"""Outline of a camera, its depth is 1."""


def write_run_figure(
    path: Path,
    title: str,
    first_image: Pixels,
    frames: Sequence[Pixels],
    keyframes: Sequence[Pixels],
    outputs: MapOutputs,
    track: Trajectory,
    ground_truth: Trajectory | None = None,
    ate_m: float | None = None,
    features: Legend = (),
) -> None:
    """Draw the figure and write it as PNG: three panels above, two below.

    Args:
        path: The file.
        title: Heading, e.g. the sequence's id.
        first_image: The input: the first colour image, uint8 ``[H, W, 3]``, red first.
        frames: A selection of frames with their features drawn, as `SlamEnv.render` gives them or
            plain.
        keyframes: Images of keyframes.
        outputs: Keyframes and map points.
        track: The final trajectory.
        ground_truth: Drawn in grey, already aligned to the track; None to leave it out.
        ate_m: The track's absolute error in metres, written beside it; None where it is not known.
        features: What the colours on `frames` mean.

    Raises:
        DynslamError: The folder cannot be written.
    """
    # map and track are drawn in the plane in which the map spreads most
    plane = _main_plane(outputs.positions if len(outputs.positions) >= 3 else track.positions)
    length = f"{track.path_length_m if len(track) else 0.0:.2f} m"
    error = "" if ate_m is None else f", ATE {mm(ate_m)} mm"
    lines = [("track", BLUE), ("start", GREEN), ("end", RED)]
    if ground_truth is not None:
        lines.append(("truth", GREY))
    panels = [
        _Panel("1  input sequence", (), _mosaic([first_image])),
        _Panel(f"2  frames ({len(track)} tracked)", features, _mosaic(frames)),
        _Panel(f"3  keyframes ({len(outputs.keyframes)})", (), _mosaic(keyframes)),
        _Panel(
            f"4  map points ({len(outputs.positions)})",
            [("cameras", BLUE)],
            _draw_map(outputs, plane),
        ),
        _Panel(f"5  final track ({length}{error})", lines, _draw_track(track, ground_truth, plane)),
    ]

    # three panels above; two below, in the middle
    column_width = PANEL[0] + GAP
    row_height = PANEL[1] + PANEL_TITLE_HEIGHT + GAP
    figure = Image.new(
        "RGB", (3 * column_width + GAP, FIGURE_TITLE_HEIGHT + 2 * row_height + GAP), "white"
    )
    ImageDraw.Draw(figure).text((GAP, 10), title, INK, font_size=22)
    for i, panel in enumerate(panels):
        row, column = divmod(i, 3)
        x = GAP + column * column_width + row * column_width // 2
        _paste_panel(figure, panel, x, FIGURE_TITLE_HEIGHT + row * row_height)
    data = io.BytesIO()
    figure.save(data, "PNG")
    write_atomic(path, data.getvalue())


class _Panel(NamedTuple):
    """A picture with its title, and what its colours mean."""

    title: str
    legend: Legend
    picture: Image.Image


def _paste_panel(figure: Image.Image, panel: _Panel, x: int, y: int) -> None:
    """Paste a panel with its top left corner at a pixel: title and legend above, a frame around the picture."""
    width, height = PANEL
    draw = ImageDraw.Draw(figure)
    draw.text((x, y + 6), panel.title, INK, font_size=15)
    # the legend ends at the right edge
    right = x + width
    for words, colour in reversed(panel.legend):
        right -= int(draw.textlength(words, font_size=12)) + 20
        draw.text((right + 14, y + 8), words, INK, font_size=12)
        draw.ellipse((right, y + 10, right + 10, y + 20), colour)
    top = y + PANEL_TITLE_HEIGHT
    figure.paste(panel.picture, (x, top))
    draw.rectangle((x - 1, top - 1, x + width, top + height), outline=GREY)


def _mosaic(images: Sequence[Pixels]) -> Image.Image:
    """The images in rows of equal cells, each as large as its proportions allow."""
    panel = Image.new("RGB", PANEL, "white")
    side = int(np.ceil(np.sqrt(len(images))))
    for i, image in enumerate(images):
        size = PANEL[0] // side, PANEL[1] // side
        cell = ImageOps.pad(Image.fromarray(image).convert("RGB"), size, color="white")
        panel.paste(cell, (i % side * size[0], i // side * size[1]))
    return panel


def _main_plane(cloud: Array) -> Array:
    """Two axes ``[3, 2]`` of the plane in which points ``[N, 3]`` spread most."""
    if len(cloud) < 3:
        return np.eye(3)[:, [0, 2]]
    centred = cloud - np.median(cloud, axis=0)
    near = np.linalg.norm(centred, axis=1)
    # without the farthest tenth of the points
    centred = centred[near <= np.quantile(near, 0.9)]
    _, vectors = np.linalg.eigh(centred.T @ centred)
    axes = vectors[:, ::-1][:, :2]
    # eigenvectors have no sign of their own: their largest component becomes positive
    signs = np.sign(axes[np.abs(axes).argmax(axis=0), [0, 1]])
    return np.asarray(axes * signs)


class _Axes:
    """A panel with a scale bar, and where plane coordinates in metres lie in it.

    Args:
        shown: Points ``[N, 2]`` that are all to be in view.
    """

    def __init__(self, shown: Array) -> None:
        corners = shown if len(shown) else np.zeros((1, 2))
        low = corners.min(axis=0)
        high = corners.max(axis=0)
        self._centre = (low + high) / 2
        self._scale = 0.88 * float((PANEL / np.maximum(high - low, 1e-3)).min())
        self.image = Image.new("RGB", PANEL, "white")
        self.draw = ImageDraw.Draw(self.image)
        # the scale bar is the largest power of ten of metres that fits 0.4 of the width
        bar = 10.0 ** np.floor(np.log10(0.4 * PANEL[0] / self._scale))
        end = 12 + int(bar * self._scale)
        y = PANEL[1] - 14
        self.draw.line((12, y, end, y), INK, 2)
        self.draw.text((end + 6, y - 6), length_text(bar), INK, font_size=11)

    def pixels(self, xy: Array) -> NDArray[np.int64]:
        """Pixels ``[N, 2]`` of plane coordinates ``[N, 2]``, metres; y points up."""
        offset = (xy - self._centre) * self._scale * (1, -1)
        return np.asarray(np.rint(offset + np.array(PANEL) / 2).clip(-10000, 10000), np.int64)

    def line(self, xy: Array, colour: Colour, width: int = 1) -> None:
        """Draw a line through plane coordinates ``[N, 2]``, metres."""
        self.draw.line(self.pixels(xy).ravel().tolist(), colour, width)


def _draw_map(outputs: MapOutputs, plane: Array) -> Image.Image:
    """The points but for outliers, the cameras of the root map's keyframes, and the path through them."""
    poses = [record.T_world_cam for record in outputs.keyframes if not record.map]
    centres = np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3)
    flat = outputs.positions @ plane
    bulk = np.quantile(flat, [0.01, 0.99], axis=0) if len(flat) else flat
    axes = _Axes(np.concatenate([centres @ plane, bulk]))

    # points, two pixels wide, dark enough for a white ground
    pixels = axes.pixels(flat)
    inside = ((pixels >= 0) & (pixels < np.array(PANEL) - 1)).all(axis=1)
    columns, rows = pixels[inside].T
    picture = np.array(axes.image)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        picture[rows + dy, columns + dx] = np.minimum(outputs.colours[inside], 200)
    axes.image.paste(Image.fromarray(picture))

    # cameras, as large as a twentieth of the path's extent
    span = float(np.ptp(centres, axis=0).max()) if len(centres) else 0.0
    for pose in poses:
        axes.line(se3.transform(pose, max(0.05 * span, 0.04) * CAMERA) @ plane, BLUE)
    axes.line(centres @ plane, GREY)
    return axes.image


def _draw_track(track: Trajectory, ground_truth: Trajectory | None, plane: Array) -> Image.Image:
    """The track with its ends, and the ground truth behind it."""
    flat = track.positions @ plane
    truth = np.zeros((0, 2)) if ground_truth is None else ground_truth.positions @ plane
    axes = _Axes(np.concatenate([flat, truth]))
    axes.line(truth, GREY, 2)
    axes.line(flat, BLUE, 2)
    ends = flat[[0, -1]] if len(flat) else flat
    for (x, y), colour in zip(axes.pixels(ends).tolist(), (GREEN, RED), strict=False):
        axes.draw.ellipse((x - 5, y - 5, x + 5, y + 5), colour)
    return axes.image
