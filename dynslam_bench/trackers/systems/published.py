"""Published systems, and the two references beside them, as compositions of filters on the shared back end: a table.

An entry names the filters of a system with their settings, and every deviation from its source.
"""

from typing import Any

from dynslam_bench.contracts import Tracker, TrackerContext
from dynslam_bench.culling.settings import (
    BoxDepthSettings,
    BoxEpipolarSettings,
    ClassRuleSettings,
    CorrelationSettings,
    DepthBlockSettings,
    DepthRansacSettings,
    EpipolarSettings,
    GuardSettings,
    MovingVoteSettings,
    MultiViewSettings,
    ProbabilitySettings,
    ReseedingSettings,
    ResidualSettings,
    TemplateSettings,
)
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.flow.settings import FlowMethodSettings, PublishedFlowSettings
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.slam.settings import MonocularBackendSettings
from dynslam_bench.trackers.systems.composition import (
    BACKEND,
    CFPN,
    FAST_MASKS,
    MonocularSemanticSettings,
    ObjectSettings,
    SemanticSystemSettings,
    SystemSettings,
    UnfilteredSystemSettings,
    UnrepairedSettings,
    compose,
    system_spec,
)

# Rules and the groups of settings that they take, see `UnfilteredSystemSettings.filters`.
SEMANTIC = ("semantic:SemanticFilter", "segmentation")
BOX_EPIPOLAR = ("epipolar:BoxEpipolarFilter", "box_epipolar", "segmentation")
CLASS_RULE = ("epipolar:ClassRuleFilter", "class_rule", "segmentation")
PROBABILITY = ("moving_probability:ProbabilityFilter", "probability", "segmentation")
MULTIVIEW = ("multiview_depth:MultiViewFilter", "multiview")

# Settings and texts that several systems share.
LUCAS_KANADE = PublishedFlowSettings()
"""The flow of all published systems."""
WHOLE_OBJECTS = ObjectSettings()
"""Masks as they are, neither repaired nor grown."""
BOTH_SIDES = BoxEpipolarSettings(inside_px=1.0, outside_px=1.0, fit="kept")
"""The epipolar test of Chen et al. and of MOR-SLAM."""
UNGUARDED = EpipolarSettings(
    min_parallax_px=0.0,
    parallax_share=0.0,
    homography_share=1.0,
    min_share=0.0,
    max_contradiction=1.0,
)
"""The epipolar test on every frame and for every feature, as papers state it."""
REIMPLEMENTED = "MIT (re-implemented from the description)"
"""License of a system without the authors' code."""


def build_detect_slam(settings: SemanticSystemSettings, context: TrackerContext) -> Tracker:
    """Detect-SLAM: boxes on keyframes, in place of masks, feed the moving probability."""
    from dynslam_bench.culling.moving_probability import ProbabilityFilter

    boxes_filter = ProbabilityFilter(settings.probability, settings.segmentation, evidence="boxes")  # type: ignore[attr-defined]
    return compose(settings, context, [boxes_filter], settings.flow)  # type: ignore[attr-defined]


ORB_SLAM2 = (
    "features spread by the cells of a grid, not by a quadtree",
    "relocalisation and matching without a bag of words",
    "mapping in step with tracking, in one thread",
    "residuals weigh by Cauchy's kernel, as wide as they are, where ORB-SLAM2 has Huber's",
    "the rolling shutter of a camera whose readout is known is undone, which ORB-SLAM2 does not do",
)
"""Deviations of the shared back end from ORB-SLAM2, with depth and without."""
ORB_SLAM2_LICENSE = "MIT (our code; ORB-SLAM2 itself is GPL-3.0 and not used)"
ORB_SLAM2_REMARKS = "the identity filter on our own back end, not the ORB-SLAM2 program"
CHEN: dict[str, Any] = {
    "provenance": "inspired",
    "ranked": False,
    "license": REIMPLEMENTED,
    "citation": "Chen et al., Micromachines 13(11) 2006, 2022",
}
CHEN_ASSUMPTIONS = (
    "{masks}",
    "{matches}",
    "{dilation}",
    "epipolar threshold 1 px; RANSAC 1 px, 0.99, refitted to its inliers",
)
DYNASLAM_LICENSE = "MIT (re-implemented from the description; the authors' code is GPL-3.0)"
NINETEEN = SegmentationSettings(classes="dynaslam19")
DYNASLAM_MASKS = (
    "{masks}",
    CFPN,
    "nineteen classes where masks are exact or from a COCO network; the embedded network finds people alone",
    "masks are grown by 15 px, as in the code",
    "the further 15 px at the border of the semantic masks, whose features the code drops, stay",
)
DYNASLAM_GEOMETRY = (
    "a seed needs a neighbourhood of nearly one depth (variance below 0.001 m^2, missing depth as 0), as in the code",
    "the next pixel of a region is the one nearest to its mean to 5 mm",
    "the low-cost tracking matches the last frame alone",
    "parallax is taken between camera centres (the code's translation is in another frame)",
)
DYNASLAM_PAPER = (
    "the geometric test acts from the first keyframe on (the paper is silent, the code waits for five)",
    "features at the border of the geometric mask stay (the code drops those within 15 px, the paper does not)",
)
DYNASLAM_UNION = "the masks of N and G are united, as in the code (the paper keeps G's where both find an object)"
NO_INPAINTING = "background inpainting is left out: it rejects nothing"

SPECS = (
    # The shared back end alone, in the manner of ORB-SLAM2 (Mur-Artal and Tardos 2017), with depth
    # and without: no dynamic handling beyond the robust kernel and the chi-square tests of the pose
    # optimiser. `system_spec` gives every entry the factory `composition.build`.
    system_spec(
        "orb-slam2",
        "ORB-SLAM2 style (our back end)",
        filters=(),
        groups={},
        base=UnfilteredSystemSettings,
        summary="the shared RGB-D back end without dynamic handling: the reference of every ratio",
        provenance="own",
        published_as=("ORB-SLAM2",),
        license=ORB_SLAM2_LICENSE,
        citation="Mur-Artal and Tardos, ORB-SLAM2, IEEE T-RO 2017",
        assumptions=(
            "no loop closing unless asked for (backend.loop_closing.enabled), and no global bundle adjustment",
            *ORB_SLAM2,
        ),
        remarks=ORB_SLAM2_REMARKS,
    ),
    system_spec(
        "orb-slam2-mono",
        "ORB-SLAM2 style, monocular (our back end)",
        filters=(),
        groups={"backend": MonocularBackendSettings()},
        base=UnfilteredSystemSettings,
        summary="the shared back end without depth and without dynamic handling",
        sensors="rgb",
        provenance="own",
        license=ORB_SLAM2_LICENSE,
        citation=(
            "Mur-Artal, Montiel and Tardos, ORB-SLAM, IEEE T-RO 2015; Mur-Artal and Tardos, ORB-SLAM2, IEEE T-RO 2017"
        ),
        assumptions=(BACKEND, *ORB_SLAM2),
        remarks=ORB_SLAM2_REMARKS,
    ),
    # Masks of people as the only filter; `dynaslam-n` is the published system with the same rule.
    system_spec(
        "mask-rcnn",
        "Mask R-CNN culling (our back end)",
        (SEMANTIC,),
        {},
        summary="drops the features on dilated masks of people; the masks' source is a setting",
        provenance="own",
        presets=FAST_MASKS,
        license="MIT",
        citation="He et al., Mask R-CNN, ICCV 2017; Bescos et al., DynaSLAM, IEEE RA-L 2018 (variant N)",
        assumptions=(
            "{masks}",
            CFPN,
            "masks of people alone; DynaSLAM, whose rule it is, culls nineteen classes (dynaslam-n)",
            "no further drop of features at the border of the grown mask",
        ),
    ),
    # Blitz-SLAM (Fan et al. 2022): masks repaired by depth, then a strict epipolar test inside the
    # boxes.
    system_spec(
        "blitz-slam",
        "Blitz-SLAM (our back end)",
        (
            ("depth_regions:DepthBlockFilter", "depth_blocks", "segmentation"),
            BOX_EPIPOLAR,
        ),
        {
            "segmentation": UnrepairedSettings(dilation_px=0),
            "depth_blocks": DepthBlockSettings(),
            "box_epipolar": BoxEpipolarSettings(inside_px=0.5, test_outside=False),
            "flow": LUCAS_KANADE,
        },
        summary="masks repaired by depth, epipolar test of 0.5 px inside person boxes",
        provenance="faithful-paper",
        ranked=True,
        published_as=("Blitz-SLAM",),
        license=REIMPLEMENTED,
        citation="Fan et al., Blitz-SLAM, Pattern Recognition 2022",
        assumptions=(
            "{masks}",
            "{matches}",
            "RANSAC of 1 px, 0.99 for the fundamental matrix (not stated), refitted to its inliers",
            "with fewer than 20 matches outside the boxes all kept ones count; its boxes are those of the masks",
            "which classes are movable (not stated)",
            "the residual removal of its mapping is left out: it does not touch the pose",
        ),
    ),
    # CFP-SLAM (Hu et al. 2022): a static probability weighs each point instead of dropping it.
    system_spec(
        "cfp-slam",
        "CFP-SLAM (our back end)",
        (PROBABILITY,),
        {
            "segmentation": SegmentationSettings(compensate=5, repair="depth", dilation_px=7),
            "probability": ProbabilitySettings(threshold=0.7, soft=True),
            "flow": LUCAS_KANADE,
        },
        summary="static probability as weight of the pose optimiser, points below 0.3 dropped",
        provenance="inspired",
        ranked=False,
        published_as=("CFP-SLAM",),
        license=REIMPLEMENTED,
        citation="Hu et al., CFP-SLAM, IROS 2022",
        assumptions=(
            "{masks}",
            "{links}",
            "constant-velocity boxes instead of its Kalman filter",
            "depth repair instead of DBSCAN in the box",
            "{dilation}",
            "a Bayes filter of 0.9 on the masks as static probability, a feature's and not a map point's",
            "greedy association of boxes instead of the Hungarian one",
        ),
    ),
    # Chen et al. (Micromachines 2022), the paper's direct parent: masks, Lucas-Kanade, epipolar
    # culling. Theirs is monocular: chen-slam is the same with depth, to stand beside the other
    # systems.
    system_spec(
        "chen-slam",
        "Chen et al. 2022 (our back end)",
        (SEMANTIC, BOX_EPIPOLAR),
        {"box_epipolar": BOTH_SIDES, "flow": LUCAS_KANADE},
        summary="masks, then the epipolar test on Lucas-Kanade flow",
        **CHEN,
        assumptions=(*CHEN_ASSUMPTIONS, "RGB-D back end (theirs is monocular: chen-slam-mono)"),
    ),
    system_spec(
        "chen-slam-mono",
        "Chen et al. 2022, monocular (our back end)",
        (SEMANTIC, BOX_EPIPOLAR),
        {"box_epipolar": BOTH_SIDES, "flow": LUCAS_KANADE},
        base=MonocularSemanticSettings,
        summary="masks, then the epipolar test on Lucas-Kanade flow, without depth as published",
        sensors="rgb",
        **CHEN,
        assumptions=(*CHEN_ASSUMPTIONS, BACKEND),
    ),
    # Dai et al. (TPAMI 2020): point correlations on a Delaunay graph, no semantics.
    system_spec(
        "dai-slam",
        "Dai et al. (our back end)",
        (("correlation_graph:CorrelationFilter", "correlation"),),
        {"correlation": CorrelationSettings(), "flow": FlowMethodSettings(method="lucas-kanade")},
        base=SystemSettings,
        summary="cuts inconsistent edges of a Delaunay graph, keeps the largest rigid component",
        provenance="inspired",
        ranked=False,
        published_as=("Dai et al. DSLAM",),
        license=REIMPLEMENTED,
        citation="Dai et al., RGB-D SLAM in Dynamic Environments Using Point Correlations, TPAMI 2020",
        assumptions=(
            "the graph is over tracked features and their last frames; the paper's is over map points and their "
            "keyframes, with a second one over a window of keyframes",
            "features are followed by {tracks}; one that it loses is not judged",
            "each edge is tested against the oldest common observation of at most 8 frames ago; no Huber step",
            "components are those of points observed for 4 frames or more; younger points follow the settled ones "
            "around them; what has neither flow nor depth is never judged",
            "the static part is the component of the largest volume, as in the back end of the paper",
            "chi-square quantile of 0.95 and 1 px per keypoint (not stated)",
        ),
        remarks="within 8 frames people move less than depth noise shows, edges stay whole and one component holds "
        "people and room: 4 % of the features on people go on a rendered half sphere; its authors' name "
        "DSLAM also stands for Decentralised SLAM elsewhere",
    ),
    # Detect-SLAM (Zhong et al. 2018): a moving probability for every feature, fed by boxes on
    # keyframes.
    system_spec(
        "detect-slam",
        "Detect-SLAM (our back end)",
        (),
        {
            "segmentation": ObjectSettings(schedule="keyframes"),
            "probability": ProbabilitySettings(rule="average", threshold=0.75, expand_px=32.0),
            "flow": LUCAS_KANADE,
        },
        entry_point=f"{__name__}:build_detect_slam",
        summary="moving probability by an exponential average over boxes",
        provenance="inspired",
        ranked=False,
        license=REIMPLEMENTED,
        citation="Zhong et al., Detect-SLAM, WACV 2018",
        assumptions=(
            "{boxes}",
            "{links}",
            "rate 0.3 and threshold 0.75 (no readable source)",
            "between keyframes boxes are carried by optical flow, and probabilities updated with them; a detection "
            "at least on every tenth frame",
            "GrabCut inside boxes is left out",
            "matching point expansion: nearest sure feature within 32 px, with a Gaussian of half that",
        ),
    ),
    # DGS-SLAM (Yan et al. 2022): clusters of high residual move, people more readily.
    system_spec(
        "dgs-slam",
        "DGS-SLAM (Yan 2022) (our back end)",
        (("residual_clusters:ResidualFilter", "residual", "segmentation"),),
        {"segmentation": WHOLE_OBJECTS, "residual": ResidualSettings()},
        summary="residual clusters of the warped image with a semantic prior",
        provenance="inspired",
        ranked=False,
        published_as=("DGS-SLAM",),
        license=REIMPLEMENTED,
        citation="Yan et al., DGS-SLAM, Remote Sensing 14(3) 795, 2022",
        assumptions=(
            "{masks}",
            "the warp: every eighth pixel of the frame goes to the nearest one of the previous image by the motion "
            "model's prediction, before the frame's own pose is known",
            "24 clusters that move with a prior of 0.9 (people) or 0.05, four times the residual where they do",
            "its classes of features with priority in tracking are left out",
            "segmentation on every frame instead of selected ones",
        ),
        remarks="not the Gaussian-splatting DGS-SLAM of Kong et al. 2024",
    ),
    # DI-SLAM (Wei et al. 2025): boxes, epipolar test, multi-view geometry.
    system_spec(
        "di-slam",
        "DI-SLAM (our back end)",
        (
            BOX_EPIPOLAR,
            MULTIVIEW,
        ),
        {
            "segmentation": ObjectSettings(confidence=0.1),
            "guard": GuardSettings(min_fraction=0.1),
            "box_epipolar": BoxEpipolarSettings(
                inside_px=0.2, outside_px=1.0, fit="outside previous"
            ),
            "multiview": MultiViewSettings(grow=False, min_keyframes=5),
            "flow": LUCAS_KANADE,
        },
        summary="epipolar test of 0.2 px inside and 1 px outside boxes, then multi-view depth",
        provenance="inspired",
        ranked=False,
        published_as=("DI-SLAM",),
        license=REIMPLEMENTED,
        citation="Wei et al., DI-SLAM, Applied Sciences 15(8) 4446, 2025",
        assumptions=(
            "{boxes}",
            "{matches}",
            "the published code of SG-SLAM stands in for the epipolar half; that code judges a feature that the "
            "flow loses by the place where it was lost (`unmatched = judge`), and takes distances in the previous "
            "image",
            "F is refitted to RANSAC's inliers; with fewer than 20 matches outside the boxes it is fitted to all "
            "kept ones",
            "seeds of the multi-view test are grown by 15 px",
            "multi-view depth without growing regions; where fewer than a tenth of the features remain the guard "
            "undoes it first (SG-SLAM restores all)",
        ),
    ),
    # DS-SLAM (Yu et al. 2018): if a moving corner lies near a person, the people go.
    system_spec(
        "ds-slam",
        "DS-SLAM (our back end)",
        (("epipolar:MovingVoteFilter", "moving_vote", "segmentation"),),
        {"segmentation": WHOLE_OBJECTS, "moving_vote": MovingVoteSettings()},
        summary="moving-consistency check on Lucas-Kanade tracks, one vote for all people",
        provenance="faithful-code",
        ranked=True,
        published_as=("DS-SLAM",),
        license="MIT (re-implemented from the description; the authors' code derives from ORB-SLAM2, GPL-3.0)",
        citation="Yu et al., DS-SLAM, IROS 2018",
        assumptions=(
            "{masks}",
            "corners are undistorted before F is fitted (the code fits raw pixels)",
        ),
        remarks="has no degeneracy guard: the published system fails on walking_rpy (0.44 m)",
    ),
    # DynaSLAM (Bescos et al. 2018): masks of a-priori dynamic classes, multi-view geometry, or
    # both.
    system_spec(
        "dynaslam",
        "DynaSLAM N+G (our back end)",
        (SEMANTIC, MULTIVIEW),
        {"segmentation": NINETEEN, "multiview": MultiViewSettings()},
        summary="DynaSLAM, variant N+G",
        provenance="faithful-paper",
        ranked=True,
        published_as=("DynaSLAM N+G", "DynaSLAM"),
        license=DYNASLAM_LICENSE,
        citation="Bescos et al., DynaSLAM, IEEE RA-L 2018",
        assumptions=(*DYNASLAM_MASKS, *DYNASLAM_GEOMETRY, *DYNASLAM_PAPER, DYNASLAM_UNION),
        remarks=NO_INPAINTING,
    ),
    system_spec(
        "dynaslam-code",
        "DynaSLAM N+G (code's constants) (our back end)",
        (SEMANTIC, MULTIVIEW),
        {
            "segmentation": NINETEEN,
            "multiview": MultiViewSettings(
                tau_m=0.6, order="farthest", min_keyframes=5, border_px=15
            ),
        },
        summary="DynaSLAM, variant N+G (code's constants)",
        provenance="faithful-code",
        ranked=True,
        published_as=("DynaSLAM N+G", "DynaSLAM"),
        license=DYNASLAM_LICENSE,
        citation="Bescos et al., DynaSLAM, IEEE RA-L 2018",
        assumptions=(*DYNASLAM_MASKS, *DYNASLAM_GEOMETRY, DYNASLAM_UNION),
        remarks=NO_INPAINTING,
    ),
    system_spec(
        "dynaslam-n",
        "DynaSLAM N (our back end)",
        (SEMANTIC, MULTIVIEW),
        {"segmentation": NINETEEN},
        summary="DynaSLAM, variant N",
        provenance="faithful-code",
        ranked=True,
        published_as=("DynaSLAM N",),
        license=DYNASLAM_LICENSE,
        citation="Bescos et al., DynaSLAM, IEEE RA-L 2018",
        assumptions=DYNASLAM_MASKS,
        remarks=NO_INPAINTING,
    ),
    system_spec(
        "dynaslam-g",
        "DynaSLAM G (our back end)",
        (SEMANTIC, MULTIVIEW),
        {"multiview": MultiViewSettings()},
        base=SystemSettings,
        summary="DynaSLAM, variant G",
        provenance="inspired",
        ranked=False,
        published_as=("DynaSLAM G",),
        license=DYNASLAM_LICENSE,
        citation="Bescos et al., DynaSLAM, IEEE RA-L 2018",
        assumptions=(*DYNASLAM_GEOMETRY, *DYNASLAM_PAPER),
        remarks=(
            f"{NO_INPAINTING}; worse than a static camera where people fill the view from the start (Bonn from frames "
            "80 and 120: 0.074 and 0.044 m against 0.053 and 0.029), which nobody reports of the authors' program: "
            "hence inspired"
        ),
    ),
    # DynaTM-SLAM (Zhong et al. 2024): template matching over a window inside boxes.
    system_spec(
        "dynatm-slam",
        "DynaTM-SLAM (our back end)",
        (("template_matching:TemplateFilter", "template", "segmentation"),),
        {"segmentation": WHOLE_OBJECTS, "template": TemplateSettings()},
        summary="inside boxes, keeps what is found where the camera's motion predicts it",
        provenance="inspired",
        ranked=False,
        published_as=("DynaTM-SLAM",),
        license=REIMPLEMENTED,
        citation="Zhong et al., DynaTM-SLAM, Robotics and Autonomous Systems 174, 2024",
        assumptions=(
            "{boxes}",
            "patch, window and correlation threshold; the patch is shifted, not warped",
            "a feature in a box without depth or history goes with the box",
            "no object constraints in bundle adjustment",
        ),
    ),
    # Huai et al. (Sensors 2025): missed masks bridged, split by depth, moving probability of
    # keypoints.
    system_spec(
        "huai-slam",
        "Huai et al. 2025 (our back end)",
        (PROBABILITY,),
        {
            "segmentation": SegmentationSettings(
                compensate=5, repair="depth", repair_depth_m=0.33, dilation_px=7
            ),
            "probability": ProbabilitySettings(),
            "flow": LUCAS_KANADE,
        },
        summary="bridges missed masks, splits them by depth, accumulates a moving probability",
        provenance="inspired",
        ranked=False,
        license=REIMPLEMENTED,
        citation="Huai et al., Sensors 25(6) 1696, 2025",
        assumptions=(
            "{masks}",
            "{links}",
            "{dilation}",
            "Bayes filter of 0.9; greedy association of constant-velocity boxes",
            "masks are fitted to depth at their border, within 0.33 m, and not cut by it as a whole",
        ),
    ),
    # MOR-SLAM (Yao et al. 2023): repaired masks, F from outside them, epipolar test.
    system_spec(
        "mor-slam",
        "MOR-SLAM (our back end)",
        (
            SEMANTIC,
            BOX_EPIPOLAR,
        ),
        {
            "segmentation": SegmentationSettings(repair="depth", repair_depth_m=0.1, dilation_px=0),
            "box_epipolar": BoxEpipolarSettings(inside_px=1.0, outside_px=1.0, fit="kept"),
            "flow": LUCAS_KANADE,
        },
        summary="masks repaired by closing and depth, then the epipolar test",
        provenance="inspired",
        ranked=False,
        license=REIMPLEMENTED,
        citation="Yao et al., MOR-SLAM, Mathematics 11(19) 4037, 2023",
        assumptions=(
            "{masks}",
            "{matches}",
            "closing of 7 px, depth step 0.1 m, epipolar threshold 1 px; RANSAC 1 px, 0.99, refitted to its inliers",
            "depth decides within 8 px of a mask's border; holes inside are filled whatever their depth",
        ),
    ),
    # NGD-SLAM (Zhang et al. 2024): boxes cut out by depth, propagated between detections.
    system_spec(
        "ngd-slam",
        "NGD-SLAM (our back end)",
        (
            ("depth_regions:BoxDepthFilter", "box_depth", "segmentation"),
            ("reseeding:ReseedingFilter", "reseeding", "features"),
        ),
        {
            "features": FeatureSettings(n_features=1500),
            "segmentation": ObjectSettings(schedule="every_nth", n=3, carry="sparse"),
            "box_depth": BoxDepthSettings(),
            "reseeding": ReseedingSettings(budget=1000),
        },
        summary="cuts people out of their boxes by depth, detects on every third frame",
        provenance="inspired",
        ranked=False,
        published_as=("NGD-SLAM",),
        license=REIMPLEMENTED,
        citation="Zhang et al., NGD-SLAM, arXiv 2405.07392",
        assumptions=(
            "{boxes}",
            "detection on every third frame stands in for its asynchronous detector",
            "masks are carried by our sparse flow, not by its clustering of corners",
            "its tracking of static corners with a PnP of its own between keyframes is left out",
            "a person's depth is the median in the box alone (its code adds a second order statistic)",
            "at most 1,000 of its 1,500 features are used, so that others have as many",
        ),
    ),
    # OPF-SLAM: named in the paper without a citation; nobody knows what it is.
    system_spec(
        "opf-slam",
        "OPF-SLAM (our back end)",
        (("epipolar:EpipolarFilter", "epipolar"),),
        {"epipolar": UNGUARDED, "flow": LUCAS_KANADE},
        base=SystemSettings,
        summary="Lucas-Kanade flow, fundamental matrix, epipolar test; no semantics",
        provenance="assumed",
        ranked=False,
        published_as=("OPF-SLAM",),
        license=REIMPLEMENTED,
        citation="unknown: the paper gives no reference",
        assumptions=("everything: the name alone is known",),
        remarks="perhaps OFM-SLAM or the optical-flow system of Chen et al. 2022 is meant",
    ),
    # SEG-SLAM (Cong et al. 2024): three rules: class, depth, epipolar line.
    system_spec(
        "seg-slam",
        "SEG-SLAM (our back end)",
        (CLASS_RULE,),
        {"class_rule": ClassRuleSettings(), "flow": LUCAS_KANADE},
        summary="people go; movable things by epipolar line and depth",
        provenance="inspired",
        ranked=False,
        license=REIMPLEMENTED,
        citation="Cong et al., SEG-SLAM, Sensors 24(7) 2102, 2024",
        assumptions=(
            "{masks}",
            "{matches}",
            "{dilation}",
            "0.3 m, 1 px (RANSAC 1 px, 0.99, refitted to its inliers), 30 % of an object's points",
        ),
    ),
    # SGC-VSLAM (Yang et al. 2020): F from the points outside the boxes, the test for all.
    system_spec(
        "sgc-slam",
        "SGC-VSLAM (our back end)",
        (BOX_EPIPOLAR,),
        {
            "segmentation": WHOLE_OBJECTS,
            "box_epipolar": BoxEpipolarSettings(inside_px=1.0, outside_px=1.0),
            "flow": LUCAS_KANADE,
        },
        summary="epipolar test of all points with F from outside the person boxes",
        provenance="inspired",
        ranked=False,
        license=REIMPLEMENTED,
        citation="Yang et al., SGC-VSLAM, Sensors 2020",
        assumptions=(
            "{boxes}",
            "{matches}",
            "RANSAC 1 px, 0.99, refitted to its inliers; distance 1 px",
            "with fewer than 20 matches outside the boxes F is fitted to all kept ones",
            "its improved quadtree of features is left out",
        ),
    ),
    # SOF-SLAM (Cui and Ma 2019): F from static-labelled points, tested on movable things; people
    # go.
    system_spec(
        "sof-slam",
        "SOF-SLAM (our back end)",
        (CLASS_RULE,),
        {
            "class_rule": ClassRuleSettings(movable="chair,tv", depth_m=0.0, vote_share=1.0),
            "flow": LUCAS_KANADE,
        },
        summary="people go, movable things are tested against the epipolar line",
        provenance="inspired",
        ranked=False,
        license=REIMPLEMENTED,
        citation="Cui and Ma, SOF-SLAM, IEEE Access 2019",
        assumptions=(
            "{masks}",
            "{matches}",
            "{dilation}",
            "potentially dynamic are chairs and monitors (the class list is not public)",
            "RANSAC 1 px, 0.99, refitted to its inliers; distance 1 px",
        ),
    ),
    # YOLO-SLAM (Wu et al. 2022): depth RANSAC among the features of a person's box.
    system_spec(
        "yolo-slam",
        "YOLO-SLAM (our back end)",
        (("depth_regions:DepthRansacFilter", "depth_ransac", "segmentation"),),
        {"segmentation": WHOLE_OBJECTS, "depth_ransac": DepthRansacSettings()},
        summary="drops, in a person's box, the largest set of features of like depth",
        provenance="faithful-paper",
        ranked=True,
        published_as=("YOLO-SLAM",),
        license=REIMPLEMENTED,
        citation="Wu et al., YOLO-SLAM, Neural Computing and Applications 2022",
        assumptions=(
            "the set grows by the nearest depth first (order not stated); 0.43 is taken in square metres",
            "features of a box without depth go with the person",
            "RANSAC draws at most 50 pairs for a probability of 0.99; a box with fewer than three depths keeps all",
            "{boxes}",
        ),
    ),
)
