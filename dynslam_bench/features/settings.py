"""Settings of the feature stage; importing this module loads no OpenCV."""

from typing import Any

from pydantic import Field

from dynslam_bench.core.settings import Settings, names, tunable


class FeatureSettings(Settings):
    """Extraction and description of keypoints."""

    extractor: str = names(
        "orb",
        "features",
        meaning="id of the extractor: built in ('orb') or a plug-in of kind 'features'",
    )
    n_features: int = tunable(
        1000,
        low=300,
        high=3000,
        limits=(1, 20000),
        scale="log",
        online=True,
        meaning="keypoints extracted from each image",
    )
    fast_threshold: int = tunable(
        20,
        low=8,
        high=40,
        limits=(1, 254),
        unit="grey levels",
        online=True,
        meaning="FAST contrast tried first",
    )
    fast_threshold_min: int = tunable(
        7,
        low=3,
        high=20,
        limits=(1, 254),
        unit="grey levels",
        online=True,
        meaning="FAST contrast accepted in cells where the first threshold gives no corner",
    )
    levels: int = Field(8, ge=1, le=16, description="levels of the image pyramid")
    scale_factor: float = Field(
        1.2, ge=1.01, le=3.0, description="ratio of the sizes of consecutive pyramid levels"
    )
    cell_px: int = Field(
        30,
        ge=4,
        le=1000,
        description="side of the cells over which keypoints are spread, in pixels of each level",
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="options of a plug-in extractor, passed as they are"
    )
