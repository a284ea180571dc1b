"""Settings of the preprocessing of frames; importing this loads neither torch nor OpenCV."""

from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from dynslam_bench.core.settings import Settings, tunable

Normalisation = Literal["none", "equalise", "clahe", "mean-std"]


class PreprocessingSettings(Settings):
    """Settings of the steps between a recorded frame and a tracker; the default changes nothing.

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
        default=None,
        ge=16,
        le=16384,
        description="width of the common resolution; none: as recorded",
    )
    height: int | None = Field(
        default=None,
        ge=16,
        le=16384,
        description="height of the common resolution; none: as recorded",
    )
    undistort: bool = Field(
        default=False,
        description="remove the lens distortion (colour bilinear, depth nearest neighbour)",
    )
    normalisation: Normalisation = tunable(
        "none", meaning="brightness and contrast normalisation of the colour image"
    )
    clahe_clip: float = Field(
        2.0,
        ge=0.01,
        le=100.0,
        description="contrast limit of the adaptive histogram equalisation (`clahe`)",
    )
    clahe_tiles: int = Field(
        8, ge=1, le=64, description="tiles along each side of the image (`clahe`)"
    )
    target_mean: float = Field(
        0.45,
        ge=0.0,
        le=1.0,
        description="mean luminance after normalisation, of [0, 1] (`mean-std`)",
    )
    target_std: float = Field(
        0.22,
        ge=0.001,
        le=1.0,
        description="standard deviation of the luminance after normalisation, of [0, 1] (`mean-std`)",
    )

    @field_validator("height")
    @classmethod
    def _both_sides(cls, height: int | None, info: ValidationInfo) -> int | None:
        """Refuse a width without a height, and the reverse."""
        width = info.data.get("width")
        if (width is None) != (height is None):
            raise ValueError(f"width is {width} but height is {height}; give both or neither")
        return height

    @property
    def changes_images(self) -> bool:
        """Whether any image is altered, as opposed to only their pairing."""
        return self.width is not None or self.undistort or self.normalisation != "none"
