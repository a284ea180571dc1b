"""The pinhole camera with radial-tangential distortion."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

TUM_DEPTH_FACTOR = 5000.0
"""Raw depth units a metre of TUM's files."""
STATED_WIDTH = 640
"""Width of the images in whose pixels sizes of things in the image are stated."""


@dataclass(frozen=True)
class Camera:
    """Pinhole intrinsics of a colour camera to which the depth image is registered.

    Attributes:
        width: Image width in pixels.
        height: Image height in pixels.
        fx: Focal length along x in pixels.
        fy: Focal length along y in pixels.
        cx: Principal point x in pixels (centre of the top-left pixel is 0).
        cy: Principal point y in pixels.
        distortion: Radial-tangential coefficients ``(k1, k2, p1, p2, k3)``, OpenCV's order.
        depth_factor: Raw 16-bit depth units a metre (5000 in TUM files, 1000 for millimetres); None
            where nothing states it. Depth images cannot be read without it.
        baseline_m: Baseline of the (virtual) stereo pair that turns depth into a right coordinate,
            in metres.
        readout_s: Seconds from the first row's exposure to the last one's, the frame's stamp being
            the middle row's time (rolling shutter); 0 is a global shutter, or one of which nothing
            is known.
        depth_delay_s: Seconds by which depth images are exposed later than their stamps say, beside
            the colour images; readers add it to the depth images' stamps before they pair them.
        R_body_cam: Rotation from the camera's axes to those of the body whose poses
            ``groundtruth.txt`` holds, the rows of a 3x3 matrix; the identity where these poses are
            the camera's. None where nothing states it: the data set decides, else the poses are the
            camera's.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_factor: float | None = None
    baseline_m: float = 0.075
    readout_s: float = 0.0
    depth_delay_s: float = 0.0
    # no part of a sequence's digest, which has the poses themselves
    R_body_cam: tuple[tuple[float, float, float], ...] | None = field(default=None, repr=False)

    @cached_property
    def matrix(self) -> NDArray[np.float64]:
        """The 3x3 calibration matrix K; it cannot be written, because all users of the camera share it."""
        K = np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])
        K.flags.writeable = False
        return K

    @property
    def written_depth_factor(self) -> float:
        """Raw units a metre in which depth is written for others: `depth_factor`, else TUM's 5000."""
        return TUM_DEPTH_FACTOR if self.depth_factor is None else self.depth_factor

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return any(self.distortion)

    def undistorted(self) -> Camera:
        """This camera's pinhole without distortion."""
        return replace(self, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the image resized to `width` x `height` pixels; the intrinsics are scaled along.

        Pixel centres are at integer coordinates, as in `cv2.resize`: ``u' = (u + 0.5) * s - 0.5``.
        """
        sx = width / self.width
        sy = height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project points ``[..., 3]`` of the camera frame (metres) to undistorted pixels ``[..., 2]``.

        Points with z <= 0 give inf or nan; the caller selects.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = points[..., :2] / points[..., 2:3]
        return xy * (self.fx, self.fy) + (self.cx, self.cy)

    def view(
        self, points: NDArray[np.float64], margin_px: float = 0.0
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Undistorted pixels of points ``[N, 3]`` of the camera frame, and which lie in the image or near it.

        The pixels of points behind the camera mean nothing.
        """
        # points at least 5 cm ahead; others are replaced by one that can be projected
        ahead = points[:, 2] > 0.05
        uv = self.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0]))
        size = self.width + margin_px, self.height + margin_px
        return uv, ahead & (uv >= -margin_px).all(axis=1) & (uv < size).all(axis=1)

    def unproject(
        self, pixels: NDArray[np.floating], depth: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """Points ``[..., 3]`` of the camera frame (metres) at undistorted pixels ``[..., 2]`` and z-depth ``[...]``."""
        z = np.asarray(depth, dtype=np.float64)[..., None]
        rays = (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        return np.concatenate([rays * z, z], axis=-1)

    def undistort_points(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Undistorted pixels ``[N, 2]`` of the distorted pixels ``[N, 2]``, same intrinsics."""
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        if not self.is_distorted or not len(pixels):
            return pixels
        import cv2

        # at most 20 iterations, until a step is below 1e-9
        coefficients = np.asarray(self.distortion)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-9)
        # the distortion is inverted by iteration; older OpenCV has criteria under another name
        if hasattr(cv2, "undistortPointsIter"):
            undistorted = cv2.undistortPointsIter(
                pixels[:, None], self.matrix, coefficients, np.eye(3), self.matrix, criteria
            )
        else:
            undistorted = cv2.undistortPoints(
                pixels[:, None], self.matrix, coefficients, None, self.matrix, criteria=criteria
            )
        return np.asarray(undistorted, dtype=np.float64).reshape(-1, 2)

    def undistortion_maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Places of an undistorted image's pixels in the distorted one: columns and rows, ``[H, W]``."""
        import cv2

        distortion = np.asarray(self.distortion)
        turn = np.eye(3)
        size = (self.width, self.height)
        columns, rows = cv2.initUndistortRectifyMap(
            self.matrix, distortion, turn, self.matrix, size, cv2.CV_32FC1
        )
        return np.asarray(columns, dtype=np.float32), np.asarray(rows, dtype=np.float32)

    def distort_points(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Distorted pixels ``[N, 2]`` of the undistorted pixels ``[N, 2]``; the inverse of `undistort_points`."""
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        # rays (x, y, 1), their squared radius, and where the lens puts them (OpenCV's model)
        k1, k2, p1, p2, k3 = self.distortion
        x, y = ((pixels - (self.cx, self.cy)) / (self.fx, self.fy)).T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([xd * self.fx + self.cx, yd * self.fy + self.cy], axis=-1)


# Reading an image at points.


def pixel_index(
    xy: NDArray[np.floating], shape: tuple[int, ...]
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], NDArray[np.bool_]]:
    """Rows and columns of pixels ``[..., 2]``, rounded and moved into an image ``(H, W)``, and which lie in it."""
    # what is no number counts as outside
    rounded = np.rint(np.nan_to_num(xy, nan=-1.0, posinf=-1.0, neginf=-1.0).clip(-1, 1e6)).astype(
        np.intp
    )
    column = rounded[..., 0]
    row = rounded[..., 1]
    visible = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    return (row.clip(0, shape[0] - 1), column.clip(0, shape[1] - 1)), visible


def at_width(size_px: float, width: int) -> float:
    """A size in the image, stated in pixels of an image 640 pixels wide, in pixels of one of another width.

    For the sizes of regions, which shrink with the image: how far a mask is grown, the cells in
    which points are counted. Not for the noise of a pixel's position, nor for patches that need a
    number of pixels.

    Args:
        size_px: The size at a width of `STATED_WIDTH`.
        width: The image's width, pixels.
    """
    return size_px * width / STATED_WIDTH


def feature_scale(width: int) -> float:
    """Pixels of an image in a pixel of octave 0 of its features; 1 unless the image is narrow.

    Features of an image narrower than `STATED_WIDTH` are extracted from one enlarged to that width.
    What is known of a feature's position in pixels holds in the enlarged image.

    Args:
        width: The image's width, pixels.
    """
    return at_width(1, min(width, STATED_WIDTH))


def inside(mask: NDArray[np.bool_], xy: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Bool ``[N]``: which raw pixels ``[N, 2]`` lie on the mask ``[H, W]``; pixels outside the image do not."""
    at, visible = pixel_index(xy, mask.shape)
    return np.asarray(visible & mask[at])
