"""B13: inside boxes, keep the patches that match where the camera's motion predicts them (DynaTM-SLAM)."""

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FilterResult, FilterState, FrameBundle, Need
from dynslam_bench.culling import Number, ObjectFilter
from dynslam_bench.culling.semantic import dynamic_boxes, in_boxes
from dynslam_bench.culling.settings import TemplateSettings
from dynslam_bench.geometry import Camera, se3

MIN_DEPTH_M = 0.1
"""Points nearer than this to the camera plane are not compared."""


class TemplateFilter(ObjectFilter[TemplateSettings]):
    """Drops features in dynamic boxes whose patch does not match at its predicted place in the latest frames.

    Stats: ``dropped``, ``in_boxes``, ``tested``, ``median_zncc``.
    """

    name = "template"
    needs: frozenset[Need] = frozenset({"boxes", "depth", "prediction", "previous"})
    stats_names = ("dropped", "in_boxes", "tested", "median_zncc")

    def reset(self, camera: Camera | None = None) -> None:
        """Forget the window."""
        self._window: list[tuple[NDArray[np.uint8], NDArray[np.float64]]] = []

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Compare patches; features in boxes without depth or history are dropped."""
        # the latest frames and their poses
        if state.previous is not None and state.T_world_prev is not None:
            self._window = [(state.previous.gray, state.T_world_prev), *self._window]
        self._window = self._window[: self.settings.window]

        # features in boxes have to prove that they are static
        xy = frame.keypoints.xy
        boxed = in_boxes(xy, dynamic_boxes(frame, self.segmentation)).any(axis=0)
        keep = np.asarray(~boxed)
        rows = np.flatnonzero(boxed & (frame.z > 0))
        stats: dict[str, Number] = {"in_boxes": float(np.count_nonzero(boxed))}
        if state.T_world_pred is None or not self._window or not len(rows):
            return self.verdict(keep, **stats)

        # scores of the patches ``[window, K]`` at their predicted places in each of the frames
        local = state.camera.unproject(frame.xy[rows], frame.z[rows])
        world = se3.transform(state.T_world_pred, local)
        current = patches(frame.gray, xy[rows].astype(np.float64), self.settings.patch_px)
        scores = np.full((len(self._window), len(rows)), np.nan)
        for number, (gray, pose) in enumerate(self._window):
            local = se3.transform(se3.inverse(pose), world)
            ahead = local[:, 2] > MIN_DEPTH_M
            pixels = np.full((len(rows), 2), -1e3)
            pixels[ahead] = state.camera.distort_points(state.camera.project(local[ahead]))
            scores[number] = zncc(current, patches(gray, pixels, self.settings.patch_px))

        # the median score decides; what was never tested is dropped
        tested = np.isfinite(scores).any(axis=0)
        median = np.full(len(rows), -1.0)
        median[tested] = np.nanmedian(scores[:, tested], axis=0)
        keep[rows] = median >= self.settings.zncc
        if tested.any():
            stats |= {
                "tested": np.count_nonzero(tested),
                "median_zncc": float(np.median(median[tested])),
            }
        return self.verdict(keep, **stats)


def patches(gray: NDArray[np.uint8], xy: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Square patches ``[N, size * size]`` around rounded pixels ``[N, 2]``; NaN where they leave the image."""
    # patches that lie in the image as a whole
    half = size // 2
    height, width = gray.shape
    centre = np.rint(xy.clip(-1e6, 1e6)).astype(np.intp)
    fits = ((centre >= half) & (centre < (width - half, height - half))).all(axis=1)
    # rows and columns of each patch; patches that do not fit are moved inside, and erased below
    span = np.arange(-half, half + 1)
    columns = centre[:, 0, None, None].clip(half, width - half - 1) + span[None, None, :]
    rows = centre[:, 1, None, None].clip(half, height - half - 1) + span[None, :, None]
    cut = gray[rows, columns].reshape(len(xy), -1).astype(np.float64)
    cut[~fits] = np.nan
    return np.asarray(cut)


def zncc(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Zero-mean normalised cross-correlation ``[N]`` of patches ``[N, M]``; NaN where a patch is flat or missing."""
    # the patches less their means
    a = first - first.mean(axis=1, keepdims=True)
    b = second - second.mean(axis=1, keepdims=True)
    norm = np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(norm > 1e-6, (a * b).sum(axis=1) / norm, np.nan))
