"""DS-SLAM (Yu et al. 2018): if a moving corner lies near a person, the people go."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynslam_bench.contracts.tracker import TrackerContext, TrackerSpec
from dynslam_bench.culling.settings import MovingVoteSettings
from dynslam_bench.trackers.systems.composition import ObjectSettings, SemanticSystemSettings, compose, masks_in_words

if TYPE_CHECKING:
    from dynslam_bench.slam.pipeline import SlamPipeline


class DsSlamSettings(SemanticSystemSettings):
    """Masks and the moving-consistency vote."""

    segmentation: ObjectSettings = ObjectSettings()
    moving_vote: MovingVoteSettings = MovingVoteSettings()


def build(settings: DsSlamSettings, context: TrackerContext) -> SlamPipeline:
    """B3 on corners of its own, B11 as one global vote, B1 on people."""
    from dynslam_bench.culling.moving_vote import MovingVoteFilter

    return compose(settings, context, [MovingVoteFilter(settings.moving_vote, settings.segmentation)])


SPEC = TrackerSpec(
    id="ds-slam",
    entry_point=f"{__name__}:build",
    label="DS-SLAM (our back end)",
    settings=DsSlamSettings,
    summary="moving-consistency check on Lucas-Kanade tracks, one vote for all people",
    provenance="faithful-code",
    ranked=True,
    published_as=("DS-SLAM",),
    license="MIT (re-implemented from the description; the authors' code derives from ORB-SLAM2, GPL-3.0)",
    citation="Yu et al., DS-SLAM, IROS 2018",
    assumptions=(
        masks_in_words(DsSlamSettings().segmentation),
        "corners are undistorted before F is fitted (the code fits raw pixels)",
    ),
    remarks="has no degeneracy guard: the published system fails on walking_rpy (0.44 m)",
)
