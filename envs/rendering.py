"""The picture of one frame: features and masks on the image, the trajectory from above, and a line of numbers."""

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, Sequence, TrackResult
from dynslam_bench.core.number_text import length_text
from dynslam_bench.envs.episode import Episode
from dynslam_bench.evaluation.alignment import align
from dynslam_bench.evaluation.online import truths_at
from dynslam_bench.geometry import Array, se3

Image = NDArray[np.uint8]

HEIGHT = 480
"""Height of the image, and size of the plot beside it, in pixels."""
STRIP = 64
"""Height of the line of numbers below, in pixels."""
LEGEND = 470
"""Width of the legend at the right end of that line, in pixels."""
ALIGN_FROM = 30
"""Tracked frames with ground truth from which on the estimate is drawn aligned."""
# Colours, red first: features, mask and trajectories, then text, ground and states.
KEPT = (86, 180, 233)
CULLED = (213, 94, 0)
MASK = (240, 228, 66)
TRUTH = (90, 90, 90)
TRUTH_AHEAD = (205, 205, 205)
ESTIMATE = (20, 90, 220)
_INK = (30, 30, 30)
_PAPER = (250, 250, 250)
_STATE_COLOUR = {
    "ok": (30, 140, 30),
    "lost": (200, 30, 30),
    "initialising": (190, 120, 0),
    "dropped": (120, 120, 120),
}


class Canvas:
    """Draws the frames of one episode; all pictures of a sequence have the same even size, as video encoders want.

    Left: the image the tracker saw, see `annotated`.
    Right: the estimated camera centres (blue), aligned, over the ground truth (grey), both in the
    first camera's frame, with a scale bar, seen along the axis in which the true path spreads
    least: from above where there is no truth. Below: state, counts, errors, and from `ALIGN_FROM`
    frames on the ATE of the frames so far.

    Args:
        sequence: The sequence of the episode.
        label: Name of the tracker.
    """

    def __init__(self, sequence: Sequence, label: str) -> None:
        self._scale = HEIGHT / sequence.camera.height
        self._width = 2 * round(sequence.camera.width * self._scale / 2)
        self._title = f"{label}  |  {sequence.id}"
        self._frames = len(sequence)

        # true poses by frame, in the first camera's frame, and the view in which they spread most
        truth = truths_at(sequence.ground_truth, sequence.timestamps)
        origin = se3.inverse(next(iter(truth.values()), np.eye(4)))
        self._truth = {index: origin @ pose for index, pose in truth.items()}
        positions = np.array([pose[:3, 3] for pose in self._truth.values()]).reshape(-1, 3)
        self._view = main_view(positions)
        self._truth_path = positions @ VIEWS[self._view].T

    def draw(self, frame: Frame, result: TrackResult, episode: Episode) -> Image:
        """The picture of the episode's last frame, uint8 ``[544, W + 480, 3]``, RGB.

        W is the image's width at 480 rows.
        """
        # estimated centres [N, 3] in the first camera's frame, cut where the tracker was lost
        centres, pieces, ate_m = align_to_truth(episode, self._truth)
        # image and plot side by side, the line of numbers below
        plot = self._plot(centres @ VIEWS[self._view].T, pieces, episode.outcomes[-1].index)
        body = np.concatenate([self.picture(frame, result), plot], axis=1)
        return np.concatenate([body, self._strip(result, episode, ate_m, body.shape[1])], axis=0)

    def picture(self, frame: Frame, result: TrackResult) -> Image:
        """The image alone with its features and mask, uint8 ``[480, W, 3]``, red first."""
        return annotated(frame.rgb, result, self._width)

    def _plot(self, estimate: Array, pieces: list[slice], now: int) -> Image:
        """A square plot of the estimated centres ``[N, 2]`` over the ground truth up to frame `now` and ahead."""
        # scale: all paths and the origin fit, with a margin of 60 pixels
        plot = np.full((HEIGHT, HEIGHT, 3), _PAPER, np.uint8)
        points = np.concatenate([self._truth_path, estimate, np.zeros((1, 2))])
        low = points.min(axis=0)
        high = points.max(axis=0)
        metres_a_pixel = max(float((high - low).max()), 0.1) / (HEIGHT - 120)
        centre = (low + high) / 2

        def to_pixels(points: Array) -> Array:
            offset = (points - centre) / metres_a_pixel
            return np.stack([HEIGHT / 2 + offset[:, 0], HEIGHT / 2 - offset[:, 1]], axis=1)

        # the true path, that of the frames so far darker
        _grid(plot, centre, metres_a_pixel)
        passed = self._truth_path[: sum(index <= now for index in self._truth)]
        for path, colour, thickness in ((self._truth_path, TRUTH_AHEAD, 1), (passed, TRUTH, 2)):
            if len(path) > 1:
                _polyline(plot, to_pixels(path), colour, thickness)

        # the estimate in its pieces, and the camera now
        for piece in pieces:
            _polyline(plot, to_pixels(estimate[piece]), ESTIMATE, 2)
        if len(estimate):
            x, y = to_pixels(estimate[-1:])[0].round().astype(int).tolist()
            cv2.circle(plot, (x, y), 5, ESTIMATE, -1, cv2.LINE_AA)

        # scale, name of the view, frame
        _scale_bar(plot, metres_a_pixel)
        _text(plot, self._view, (HEIGHT - 215, HEIGHT - 13), (120, 120, 120), 0.42)
        cv2.rectangle(plot, (0, 0), (HEIGHT - 1, HEIGHT - 1), (200, 200, 200), 1)
        return plot

    def _strip(
        self, result: TrackResult, episode: Episode, ate_m: float | None, width: int
    ) -> Image:
        """Title, state, numbers and legend below the picture, uint8 ``[64, width, 3]``."""
        strip = np.full((STRIP, width, 3), 235, np.uint8)
        last = episode.outcomes[-1]
        _text(strip, shortened(self._title, width - LEGEND - 20, 0.5), (10, 24), _INK, 0.5)
        _text(strip, last.state, (10, 50), _STATE_COLOUR[last.state], 0.5, 2)
        numbers = self._numbers(result, episode, ate_m)
        _text(strip, "   ".join(numbers), (130, 50), _INK, 0.45)

        # legend: circles for features and mask, lines for trajectories
        for x, name, colour in (
            (LEGEND, "kept", KEPT),
            (395, "culled", CULLED),
            (320, "mask", MASK),
        ):
            cv2.circle(strip, (width - x, 19), 5, colour, -1, cv2.LINE_AA)
            _text(strip, name, (width - x + 10, 24), _INK, 0.45)
        for x, name, colour in ((245, "estimate", ESTIMATE), (135, "ground truth", TRUTH)):
            cv2.line(strip, (width - x, 19), (width - x + 20, 19), colour, 3, cv2.LINE_AA)
            _text(strip, name, (width - x + 26, 24), _INK, 0.45)
        return strip

    def _numbers(self, result: TrackResult, episode: Episode, ate_m: float | None) -> list[str]:
        """Frame, time, counts and errors in words."""
        last = episode.outcomes[-1]
        numbers = [
            f"frame {last.index + 1}/{self._frames}",
            f"t {last.timestamp - episode.outcomes[0].timestamp:.2f} s",
        ]
        names = {
            "keypoints": "features",
            "culled": "culled",
            "inliers": "inliers",
            "keyframes": "kf",
        }
        for key, name in names.items():
            if key in result.stats:
                numbers.append(f"{name} {result.stats[key]:.0f}")

        error = last.error
        if error is None:
            numbers.append("no ground truth here")
        else:
            numbers.append(f"pose error {1000 * error.trans_m:.1f} mm, {error.rot_deg:.2f} deg")
            if error.frame_trans_m is not None:
                numbers.append(f"frame error {1000 * error.frame_trans_m:.1f} mm")
        if ate_m is not None:
            numbers.append(f"ATE so far {1000 * ate_m:.1f} mm")
        return numbers


def annotated(rgb: Image, result: TrackResult, width: int) -> Image:
    """An image as its tracker saw it: static features as circles, dynamic ones as crosses, the dynamic mask in yellow.

    Args:
        rgb: The image, uint8 ``[H, W, 3]``, red first.
        result: What the tracker said of it.
        width: Width of the returned image, pixels; its pixels are square as the image's.
    """
    # the dynamic mask, blended and outlined
    image = np.array(rgb, dtype=np.uint8)
    scale = width / image.shape[1]
    if result.dynamic_mask is not None and result.dynamic_mask.any():
        mask = np.asarray(result.dynamic_mask, dtype=bool)
        image[mask] = (0.6 * image[mask] + 0.4 * np.array(MASK)).astype(np.uint8)
        outlines, _ = cv2.findContours(
            mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
        )
        cv2.drawContours(image, outlines, -1, MASK, 1, cv2.LINE_AA)

    # resize the image before anything thin is drawn on it
    size = (width, round(image.shape[0] * scale))
    image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if result.keypoints_xy is None:
        return image

    # features, static ones as circles and dynamic ones as crosses
    points = np.asarray(result.keypoints_xy, dtype=np.float64).reshape(-1, 2)
    is_static = np.ones(len(points), bool)
    if result.keypoints_keep is not None:
        is_static = np.asarray(result.keypoints_keep, bool)
    radius = max(round(width / 320), 1)
    cross = (cv2.MARKER_TILTED_CROSS, 2 * radius + 3, radius, cv2.LINE_AA)
    pixels = (points * scale).round().astype(int).tolist()
    for (x, y), static in zip(pixels, is_static.tolist(), strict=True):
        if static:
            cv2.circle(image, (x, y), radius, KEPT, -1, cv2.LINE_AA)
        else:
            cv2.drawMarker(image, (x, y), CULLED, *cross)
    return image


VIEWS = {
    "from above: x right, z up": np.array([[1.0, 0, 0], [0, 0, 1]]),
    "from behind: x right, y down": np.array([[1.0, 0, 0], [0, -1, 0]]),
    "from the side: z right, y down": np.array([[0, 0, 1.0], [0, -1, 0]]),
}
"""Projections ``[2, 3]`` of the first camera's frame to the right and up, by the name of the view."""


def main_view(positions: Array) -> str:
    """The view in which positions ``[N, 3]`` spread most; that from above for fewer than two, and for a tie."""
    spread = positions.std(axis=0) if len(positions) > 1 else np.zeros(3)
    return max(VIEWS, key=lambda view: float(np.round((np.abs(VIEWS[view]) @ spread).sum(), 9)))


def align_to_truth(
    episode: Episode, truth: dict[int, Array]
) -> tuple[Array, list[slice], float | None]:
    """The estimate in the truth's frame.

    They are joined at the first frame that has both, and aligned by least squares over all frames
    so far (as for the ATE) from `ALIGN_FROM` frames on.

    Returns:
        Camera centres ``[N, 3]`` in metres, the pieces of them without a gap, and the ATE in metres
        where it is known.
    """
    tracked = [(o.index, o.T_world_cam) for o in episode.outcomes if o.T_world_cam is not None]
    if not tracked:
        return np.zeros((0, 3)), [], None

    # estimated poses [N, 4, 4], and of those with ground truth rows and true poses
    poses = np.array([pose for _, pose in tracked])
    both = [row for row, (index, _) in enumerate(tracked) if index in truth]
    true = np.array([truth[tracked[row][0]] for row in both])

    # align by least squares, by the first pose with ground truth, or to the first camera
    ate_m = None
    if len(both) >= ALIGN_FROM:
        aligned = align(poses[both], true, "se3").apply(poses)
        errors_m = aligned[both][:, :3, 3] - true[:, :3, 3]
        ate_m = float(np.sqrt(np.square(errors_m).sum(axis=1).mean()))
    elif both:
        aligned = true[0] @ se3.inverse(poses[both[0]]) @ poses
    else:
        aligned = se3.inverse(poses[0]) @ poses

    # pieces of frames that follow each other
    breaks = np.flatnonzero(np.diff([index for index, _ in tracked]) > 1) + 1
    bounds = [0, *breaks.tolist(), len(aligned)]
    return aligned[:, :3, 3], [slice(a, b) for a, b in pairwise(bounds)], ate_m


def shortened(text: str, width: int, scale: float) -> str:
    """A text of at most so many pixels: what does not fit is left out of its middle."""
    kept = len(text)
    short = text
    while kept > 2 and cv2.getTextSize(short, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] > width:
        kept -= 1
        short = f"{text[: (kept + 1) // 2]}...{text[len(text) - kept // 2 :]}"
    return short


def _polyline(image: Image, points: Array, colour: tuple[int, int, int], thickness: int) -> None:
    """Draw a path through points ``[N, 2]`` in pixels; OpenCV takes them in sixteenths (4 bits)."""
    fixed = np.clip(points * 16, -(2**20), 2**20).round().astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(image, [fixed], False, colour, thickness, cv2.LINE_AA, 4)


def _nice_length(metres: float) -> float:
    """The largest of 1, 2 or 5 times a power of ten that is not above `metres`."""
    power = 10.0 ** np.floor(np.log10(metres))
    return float(max(step * power for step in (1, 2, 5) if step * power <= metres * (1 + 1e-9)))


def _grid(plot: Image, centre: Array, metres_a_pixel: float) -> None:
    """Draw lines at round coordinates, some four of them in each direction."""
    step = _nice_length(metres_a_pixel * HEIGHT / 4)
    half = HEIGHT / 2 * metres_a_pixel
    for axis, sign in ((0, 1), (1, -1)):
        first = np.ceil((centre[axis] - half) / step) * step
        for value in np.arange(first, centre[axis] + half, step):
            at = round(float(HEIGHT / 2 + sign * ((value - centre[axis]) / metres_a_pixel)))
            start, end = ((at, 0), (at, HEIGHT)) if axis == 0 else ((0, at), (HEIGHT, at))
            cv2.line(plot, start, end, (232, 232, 232), 1)


def _scale_bar(plot: Image, metres_a_pixel: float) -> None:
    """Draw a bar of a round length, at most 140 pixels, with that length."""
    length = _nice_length(metres_a_pixel * 140)
    pixels = round(length / metres_a_pixel)
    y = HEIGHT - 18
    cv2.line(plot, (16, y), (16 + pixels, y), _INK, 2)
    for x in (16, 16 + pixels):
        cv2.line(plot, (x, y - 4), (x, y + 4), _INK, 2)
    _text(plot, length_text(length), (16, y - 10), _INK, 0.45)


def _text(
    image: Image,
    text: str,
    at: tuple[int, int],
    colour: tuple[int, int, int],
    scale: float,
    thickness: int = 1,
) -> None:
    """Write text from its lower left corner on, in pixels."""
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, thickness, cv2.LINE_AA)
