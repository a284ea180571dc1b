"""One sheet a sequence with five panels, as in the paper's Figures 4 to 8: input, frames, keyframes, map, track."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.tracker import MapOutputs
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.records import write_atomic
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PANEL = (480, 360)
"""Width and height of a panel, pixels."""
_TITLE = 28
_INK = (40, 40, 40)
_GREY = (150, 150, 150)
_BLUE = (200, 110, 30)
_RED = (40, 40, 210)
_GREEN = (30, 150, 30)
Legend = tuple[tuple[str, tuple[int, int, int]], ...]
"""Words and their colours, red first."""


def draw_sheet(
    title: str,
    first_image: Image,
    frames: Sequence[Image],
    keyframes: Sequence[Image],
    outputs: MapOutputs,
    track: Trajectory,
    ground_truth: Trajectory | None = None,
    ate_m: float | None = None,
    features: Legend = (),
) -> Image:
    """Draw the sheet.

    Args:
        title: Heading, e.g. the sequence's id.
        first_image: The input: the first colour image, uint8 ``[H, W, 3]``, red first.
        frames: A selection of frames with their features drawn, as `SlamEnv.render` gives them or plain; up to nine.
        keyframes: Images of keyframes, up to nine.
        outputs: Keyframes and map points.
        track: The final trajectory.
        ground_truth: Drawn in grey, already aligned to the track; None to leave it out.
        ate_m: The track's absolute error in metres, written beside it; None where it is not known.
        features: What the colours on `frames` mean.

    Returns:
        The sheet, uint8 ``[H, W, 3]``, red first: three panels above, two below.
    """
    plane = _main_plane(outputs.positions, track.positions)
    length = f"{track.path_length_m if len(track) else 0.0:.2f} m"
    error = "" if ate_m is None else f", ATE {1000 * ate_m:.1f} mm"
    marks: Legend = (("track", _BLUE[::-1]), ("start", _GREEN), ("end", _RED[::-1]))
    marks += () if ground_truth is None else (("truth", _GREY),)
    panels: list[tuple[str, Legend, Image]] = [
        ("1  input sequence", (), _fit(first_image, PANEL)),
        (f"2  frames ({len(track)} tracked)", features, _mosaic(frames)),
        (f"3  keyframes ({len(outputs.keyframes)})", (), _mosaic(keyframes)),
        (f"4  map points ({len(outputs.positions)})", (("cameras", _BLUE[::-1]),), _draw_map(outputs, plane)),
        (f"5  final track ({length}{error})", marks, _draw_track(track, ground_truth, plane)),
    ]
    width, height = PANEL
    gap, head = 12, 44
    sheet = np.full((head + 2 * (height + _TITLE + gap) + gap, 3 * (width + gap) + gap, 3), 255, np.uint8)
    _text(sheet, title, (gap, 30), 0.8, 2)
    for i, (label, legend, picture) in enumerate(panels):
        row, column = divmod(i, 3)
        x = gap + column * (width + gap) + (row * (width + gap) // 2)
        y = head + row * (height + _TITLE + gap)
        _text(sheet, label, (x, y + 20), 0.55)
        _draw_legend(sheet, legend, x + width, y + 20)
        sheet[y + _TITLE : y + _TITLE + height, x : x + width] = picture
        cv2.rectangle(sheet, (x - 1, y + _TITLE - 1), (x + width, y + _TITLE + height), _GREY, 1)
    return sheet


def _text(image: Image, text: str, at: tuple[int, int], size: float, width: int = 1) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, width, cv2.LINE_AA)


def _draw_legend(sheet: Image, legend: Legend, right: int, baseline: int) -> None:
    """Dots and words that end at a pixel column."""
    for words, colour in reversed(legend):
        (width, _), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)
        right -= width
        _text(sheet, words, (right, baseline), 0.42)
        cv2.circle(sheet, (right - 9, baseline - 5), 5, colour, -1, cv2.LINE_AA)
        right -= 26


def write_sheet(path: Path, sheet: Image) -> None:
    """Write a sheet as PNG.

    Raises:
        DynslamError: The folder cannot be written.
    """
    done, data = cv2.imencode(".png", np.ascontiguousarray(sheet[..., ::-1]))
    if not done:
        raise DynslamError(f"cannot encode a sheet of {sheet.shape[1]}x{sheet.shape[0]} pixels as PNG")
    write_atomic(path, data.tobytes())


def _fit(image: Image, size: tuple[int, int]) -> Image:
    """The image scaled into a white panel without changing its proportions."""
    width, height = size
    panel = np.full((height, width, 3), 255, np.uint8)
    if image.size == 0:
        return panel
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    scale = min(width / image.shape[1], height / image.shape[0])
    inner = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    small = cv2.resize(image, inner, interpolation=cv2.INTER_AREA)
    x, y = (width - inner[0]) // 2, (height - inner[1]) // 2
    panel[y : y + inner[1], x : x + inner[0]] = small
    return panel


def _mosaic(images: Sequence[Image]) -> Image:
    panel = np.full((PANEL[1], PANEL[0], 3), 255, np.uint8)
    if not len(images):
        return panel
    chosen = [images[i] for i in np.unique(np.linspace(0, len(images) - 1, min(9, len(images))).round().astype(int))]
    side = int(np.ceil(np.sqrt(len(chosen))))
    width, height = PANEL[0] // side, PANEL[1] // side
    for i, image in enumerate(chosen):
        row, column = divmod(i, side)
        panel[row * height : (row + 1) * height, column * width : (column + 1) * width] = _fit(image, (width, height))
    return panel


def _main_plane(points: Array, track: Array) -> Array:
    """Two axes ``[3, 2]`` of the plane in which the points spread most."""
    cloud = points if len(points) >= 3 else track
    if len(cloud) < 3:
        return np.eye(3)[:, [0, 2]]
    centred = cloud - np.median(cloud, axis=0)
    near = np.linalg.norm(centred, axis=1)
    centred = centred[near <= np.quantile(near, 0.9)]
    _, vectors = np.linalg.eigh(centred.T @ centred)
    axes = vectors[:, ::-1][:, :2]
    signs = np.sign(axes[np.abs(axes).argmax(axis=0), [0, 1]])
    return np.asarray(axes * signs)


class _Canvas:
    """Maps plane coordinates in metres to the pixels of a panel.

    Args:
        visible: Points ``[N, 2]`` that are all to be in view.
        cloud: Points ``[M, 2]`` of which outliers may be cut off.
    """

    def __init__(self, visible: Array, cloud: Array | None = None) -> None:
        self.image = np.full((PANEL[1], PANEL[0], 3), 255, np.uint8)
        bulk = np.zeros((0, 2)) if cloud is None or not len(cloud) else np.quantile(cloud, [0.01, 0.99], axis=0)
        corners = np.concatenate([visible, bulk])
        corners = corners if len(corners) else np.array([[0.0, 0.0], [1.0, 1.0]])
        low, high = corners.min(axis=0), corners.max(axis=0)
        self._centre = (low + high) / 2
        size = np.maximum(high - low, 1e-3)
        self._scale = 0.88 * float(min(PANEL[0] / size[0], PANEL[1] / size[1]))

    def pixels(self, xy: Array) -> NDArray[np.int32]:
        offset = (xy - self._centre) * self._scale
        return np.asarray(np.rint(offset * (1, -1) + (PANEL[0] / 2, PANEL[1] / 2)).clip(-10000, 10000), np.int32)

    def line(self, xy: Array, colour: tuple[int, int, int], width: int = 1) -> None:
        if len(xy) > 1:
            cv2.polylines(self.image, [self.pixels(xy)[:, None]], False, colour, width, cv2.LINE_AA)

    def scale_bar(self) -> None:
        length = 10.0 ** np.floor(np.log10(0.4 * PANEL[0] / self._scale))
        pixels, y = int(length * self._scale), PANEL[1] - 14
        cv2.line(self.image, (12, y), (12 + pixels, y), _INK, 2)
        _text(self.image, f"{length:g} m", (18 + pixels, y + 4), 0.4)


def _draw_map(outputs: MapOutputs, plane: Array) -> Image:
    poses = [record.T_world_cam for record in outputs.keyframes if not record.map]
    centres = np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3)
    flat = outputs.positions @ plane
    canvas = _Canvas(centres @ plane, flat)
    pixels = canvas.pixels(flat)
    inside = ((pixels >= 0) & (pixels < np.array(PANEL) - 1)).all(axis=1)
    columns, rows = pixels[inside].T
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        canvas.image[rows + dy, columns + dx] = np.minimum(outputs.colours[inside], 200)
    span = float(np.ptp(centres, axis=0).max()) if len(centres) else 0.0
    size = max(0.05 * span, 0.04)
    outline = size * np.array([[0, 0, 0], [-0.8, -0.6, 1], [0.8, -0.6, 1], [0.8, 0.6, 1], [-0.8, 0.6, 1], [0, 0, 0]])
    for pose in poses:
        canvas.line(se3.transform(pose, outline) @ plane, _BLUE[::-1])
    canvas.line(centres @ plane, _GREY)
    canvas.scale_bar()
    return canvas.image


def _draw_track(track: Trajectory, ground_truth: Trajectory | None, plane: Array) -> Image:
    flat = track.positions @ plane
    truth = np.zeros((0, 2)) if ground_truth is None else ground_truth.positions @ plane
    canvas = _Canvas(np.concatenate([flat, truth]))
    canvas.line(truth, _GREY, 2)
    canvas.line(flat, _BLUE[::-1], 2)
    if len(flat):
        start, end = canvas.pixels(flat[[0, -1]])
        cv2.circle(canvas.image, (int(start[0]), int(start[1])), 5, _GREEN, -1, cv2.LINE_AA)
        cv2.circle(canvas.image, (int(end[0]), int(end[1])), 5, _RED[::-1], -1, cv2.LINE_AA)
    canvas.scale_bar()
    return canvas.image
