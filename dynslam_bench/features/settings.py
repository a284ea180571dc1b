"""Settings of the feature stage; importing this loads no OpenCV."""

from __future__ import annotations

from typing import Any

from pydantic import Field, field_validator

from dynslam_bench.core.settings import Settings, tunable

_ORB = {"extractor": ["orb"]}


class FeatureSettings(Settings):
    """How keypoints are found and described."""

    extractor: str = Field("orb", description="id of the extractor: built in ('orb') or a plug-in of kind 'features'")
    n_features: int = tunable(
        1000, low=300, high=3000, limits=(1, 20000), scale="log", meaning="keypoints sought in each image"
    )
    levels: int = tunable(8, low=1, high=10, limits=(1, 16), meaning="levels of the image pyramid")
    scale_factor: float = tunable(
        1.2, low=1.1, high=1.5, limits=(1.01, 3.0), meaning="ratio of the sizes of consecutive pyramid levels"
    )
    fast_threshold: int = tunable(
        20, low=8, high=40, limits=(1, 254), unit="grey levels", online=True, when=_ORB,
        meaning="FAST contrast sought first",
    )  # fmt: skip
    fast_threshold_min: int = tunable(
        7, low=3, high=20, limits=(1, 254), unit="grey levels", online=True, when=_ORB,
        meaning="FAST contrast accepted in cells where the first threshold finds nothing",
    )  # fmt: skip
    cell_px: int = tunable(
        30, low=12, high=80, limits=(4, 1000), scale="log", unit="px",
        meaning="side of the cells over which keypoints are spread, at each level's own resolution",
    )  # fmt: skip
    options: dict[str, Any] = Field(
        default_factory=dict, description="options of a plug-in extractor, passed as they are"
    )

    @field_validator("extractor")
    @classmethod
    def _named(cls, value: str) -> str:
        if not value.strip():
            raise ValueError("an extractor's id is not empty")
        return value
