"""Settings of the preprocessing of frames; importing this loads neither torch nor OpenCV."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from dynslam_bench.core.settings import Settings, tunable

Normalisation = Literal["none", "equalise", "clahe", "mean-std"]


class PreprocessingSettings(Settings):
    """What is done to a recorded frame before a tracker sees it; the default changes nothing.

    The order is: synchronise, undistort, resize, normalise.
    """

    max_time_difference_s: float = Field(
        0.02,
        ge=1e-6,
        le=1.0,
        description="colour and depth images further apart than this (s, strictly) are not paired",
    )
    """Decides which frames there are, and so is nothing to tune."""
    width: int | None = Field(
        default=None, ge=16, le=16384, description="width of the common resolution; none: as recorded"
    )
    height: int | None = Field(
        default=None, ge=16, le=16384, description="height of the common resolution; none: as recorded"
    )
    undistort: bool = Field(
        default=False, description="remove the lens distortion (colour bilinear, depth nearest neighbour)"
    )
    normalisation: Normalisation = tunable("none", meaning="brightness and contrast normalisation of the colour image")
    clahe_clip: float = tunable(
        2.0, low=1.0, high=8.0, scale="log", limits=(0.01, 100.0), when={"normalisation": ["clahe"]},
        meaning="contrast limit of the adaptive histogram equalisation",
    )  # fmt: skip
    clahe_tiles: int = tunable(
        8,
        low=2,
        high=16,
        limits=(1, 64),
        when={"normalisation": ["clahe"]},
        meaning="tiles along each side of the image in the adaptive histogram equalisation",
    )
    target_mean: float = tunable(
        0.45,
        low=0.3,
        high=0.6,
        limits=(0.0, 1.0),
        when={"normalisation": ["mean-std"]},
        meaning="mean luminance after normalisation, of [0, 1]",
    )
    target_std: float = tunable(
        0.22,
        low=0.1,
        high=0.35,
        limits=(0.001, 1.0),
        when={"normalisation": ["mean-std"]},
        meaning="standard deviation of the luminance after normalisation, of [0, 1]",
    )

    @field_validator("height")
    @classmethod
    def _both_sides(cls, height: int | None, info: ValidationInfo) -> int | None:
        width = info.data.get("width")
        if (width is None) != (height is None):
            raise ValueError(f"width is {width} but height is {height}; give both or neither")
        return height

    @property
    def changes_images(self) -> bool:
        """Whether any image is altered, as opposed to only their pairing."""
        return self.width is not None or self.undistort or self.normalisation != "none"
