"""DS-SLAM (Yu et al. 2018): if a moving corner lies near a person, the people go."""

from dynslam_bench.contracts.tracker import TrackerSpec
from dynslam_bench.culling.settings import MovingVoteSettings
from dynslam_bench.trackers.systems.composition import ObjectSettings, SemanticSystemSettings, composed, describe_masks


class DsSlamSettings(SemanticSystemSettings):
    """Masks and the moving-consistency vote."""

    segmentation: ObjectSettings = ObjectSettings()
    moving_vote: MovingVoteSettings = MovingVoteSettings()


build = composed(("moving_vote:MovingVoteFilter", "moving_vote", "segmentation"))

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
        describe_masks(DsSlamSettings().segmentation),
        "corners are undistorted before F is fitted (the code fits raw pixels)",
    ),
    remarks="has no degeneracy guard: the published system fails on walking_rpy (0.44 m)",
)
