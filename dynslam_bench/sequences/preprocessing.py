"""The paper's preprocessing: undistort, resize to a common resolution, normalise brightness and contrast."""

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, FrameMasks, MaskSource, Sequence
from dynslam_bench.core.records import digest
from dynslam_bench.geometry import Camera
from dynslam_bench.sequences.settings import PreprocessingSettings
from dynslam_bench.sequences.view import Masks, Wrapped

Image = NDArray[np.integer | np.floating]


class Preprocessed(Wrapped):
    """A sequence whose images are undistorted, resized and normalised when they are read; the camera follows.

    Args:
        base: The sequence as recorded. Its depth images may differ in size from its colour images
            if a common resolution is asked for.
        settings: What to do.

    Attributes:
        camera: Intrinsics after preprocessing: without distortion if it is removed, scaled along
            with the images.
    """

    def __init__(self, base: Sequence, settings: PreprocessingSettings) -> None:
        self.base = base
        self.settings = settings
        self.camera = base.camera.undistorted() if settings.undistort else base.camera
        if settings.width is not None and settings.height is not None:
            self.camera = self.camera.resized(settings.width, settings.height)

    @property
    def masks(self) -> MaskSource | None:
        """Masks of the base sequence, undistorted and resized like the depth image."""
        source = self.base.masks
        return None if source is None else Masks(lambda index: self._masks_of(source[index]))

    def _masks_of(self, masks: FrameMasks) -> FrameMasks:
        """A frame's masks, undistorted and resized."""
        kind = masks.instances.dtype
        # what OpenCV can remap
        narrow = kind if kind in (np.uint8, np.int16, np.uint16) else np.int16
        instances = self._geometry(masks.instances.astype(narrow), colour=False).astype(kind)
        return FrameMasks(instances, masks.class_names, masks.moving)

    def digest(self) -> str:
        """Digest of the base sequence and of the settings."""
        return digest([self.base.digest(), self.settings.model_dump()])

    def __len__(self) -> int:
        return len(self.base)

    def __getitem__(self, index: int) -> Frame:
        frame = self.base[index]
        rgb = normalise(self._geometry(frame.rgb, colour=True), self.settings)
        return Frame(frame.index, frame.timestamp, rgb, self._geometry(frame.depth, colour=False))

    def _geometry(self, image: Image, *, colour: bool) -> Any:
        """An image ``[H, W]`` or ``[H, W, 3]``, undistorted and resized; only colours are interpolated."""
        if self.settings.undistort and self.base.camera.is_distorted:
            maps = _undistortion(self.base.camera.resized(image.shape[1], image.shape[0]))
            interpolation = cv2.INTER_LINEAR if colour else cv2.INTER_NEAREST
            image = cv2.remap(
                image, *maps, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=0
            )
        return resize(image, self.camera.width, self.camera.height, colour=colour)


_undistortion = lru_cache(maxsize=4)(Camera.undistortion_maps)


def resize(image: Image, width: int, height: int, *, colour: bool) -> Any:
    """Resize with pixel centres aligned: colour by area (smaller) or bilinear (larger), else nearest neighbour.

    Depth and masks are never averaged, so that no depth appears between foreground and background.
    """
    if image.shape[:2] == (height, width):
        return image
    smaller = width * height < image.shape[0] * image.shape[1]
    if not colour:
        interpolation = cv2.INTER_NEAREST_EXACT
    elif smaller:
        interpolation = cv2.INTER_AREA
    else:
        interpolation = cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=interpolation)


def normalise(rgb: NDArray[np.uint8], settings: PreprocessingSettings) -> NDArray[np.uint8]:
    """Normalise the brightness and contrast of a uint8 ``[H, W, 3]`` image; the hue stays.

    The luminance (Y of YCrCb) is changed: ``equalise`` spreads its histogram, ``clahe`` does so by
    tiles with limited contrast, ``mean-std`` moves it to a given mean and standard deviation. An
    image of one brightness only has no contrast to spread and keeps it under ``mean-std`` (it moves
    to the mean).
    """
    if settings.normalisation == "none":
        return rgb
    # luminance and two channels of colour, of which only the first is changed
    luminance, *chroma = cv2.split(cv2.cvtColor(rgb, cv2.COLOR_RGB2YCrCb))
    if settings.normalisation == "equalise":
        luminance = cv2.equalizeHist(luminance)
    elif settings.normalisation == "clahe":
        tiles = (settings.clahe_tiles, settings.clahe_tiles)
        luminance = cv2.createCLAHE(settings.clahe_clip, tiles).apply(luminance)
    else:
        mean, std = cv2.meanStdDev(luminance)
        gain = 255 * settings.target_std / std.item() if std.item() > 0 else 1.0
        luminance = cv2.convertScaleAbs(
            np.clip((luminance - mean.item()) * gain + 255 * settings.target_mean, 0, 255)
        )

    # back to RGB
    merged = cv2.merge([luminance, *chroma])
    return np.asarray(cv2.cvtColor(merged, cv2.COLOR_YCrCb2RGB), dtype=np.uint8)
