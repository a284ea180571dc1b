"""Detect-SLAM (Zhong et al. 2018): a moving probability for every feature, fed by boxes on keyframes."""

from dynslam_bench.contracts.tracker import Tracker, TrackerContext, TrackerSpec
from dynslam_bench.culling.settings import ProbabilitySettings
from dynslam_bench.trackers.systems.composition import (
    ObjectSettings,
    PublishedFlowSettings,
    SemanticSystemSettings,
    compose,
    describe_links,
    describe_masks,
)


class DetectSlamSettings(SemanticSystemSettings):
    """Boxes on keyframes and the moving average."""

    segmentation: ObjectSettings = ObjectSettings(schedule="keyframes")
    probability: ProbabilitySettings = ProbabilitySettings(rule="average", threshold=0.75, expand_px=32.0)
    flow: PublishedFlowSettings = PublishedFlowSettings()


def build(settings: DetectSlamSettings, context: TrackerContext) -> Tracker:
    """Boxes on keyframes feed the moving probability."""
    from dynslam_bench.culling.moving_probability import ProbabilityFilter

    block = ProbabilityFilter(settings.probability, settings.segmentation, evidence="boxes")
    return compose(settings, context, [block], settings.flow)


SPEC = TrackerSpec(
    id="detect-slam",
    entry_point=f"{__name__}:build",
    label="Detect-SLAM (our back end)",
    settings=DetectSlamSettings,
    summary="moving probability by an exponential average over boxes",
    provenance="inspired",
    ranked=False,
    license="MIT (re-implemented from the description)",
    citation="Zhong et al., Detect-SLAM, WACV 2018",
    assumptions=(
        describe_masks(DetectSlamSettings().segmentation, boxes=True),
        describe_links(DetectSlamSettings().flow),
        "rate 0.3 and threshold 0.75 (no readable source)",
        "between keyframes boxes are carried by optical flow, and probabilities updated with them; a detection at "
        "least on every tenth frame",
        "GrabCut inside boxes is left out",
        "matching point expansion: nearest sure feature within 32 px, with a Gaussian of half that",
    ),
)
