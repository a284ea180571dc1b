"""Features whose flow fails: each published system judges them by its own rule, and by no check that is ours."""

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.features import Keypoints
from dynslam_bench.contracts.filter import FilterState, FrameBundle
from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.flow.opencv import LEVELS
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.slam.pipeline import SlamPipeline
from dynslam_bench.trackers import TRACKERS, TrackerContext, build_tracker
from dynslam_bench.trackers.registry import all_specs

CAMERA = Camera(640, 480, 535.4, 539.2, 320.1, 247.6)
TESTED = {
    "sgc-slam", "di-slam", "blitz-slam", "chen-slam", "chen-slam-mono", "mor-slam", "sof-slam", "seg-slam", "opf-slam",
}  # fmt: skip
"""Systems that test matches; a feature without one stays."""
FOLLOWED = {"detect-slam", "huai-slam", "cfp-slam"}
"""Systems that follow features from frame to frame."""
UNPUBLISHED = {"dai-slam"}
"""Its tracks are judged over a window: `correlation_graph.py`."""


def moving_scene(thing: str) -> tuple[FrameBundle, FilterState, np.ndarray, np.ndarray]:
    """A wall of 300 features, and a thing with 80 that moved across; the flow of half of these failed.

    Returns:
        The frame, the state, and bool ``[N]``: the moving features, and those whose flow failed.
    """
    rng = np.random.default_rng(1)
    wall = rng.uniform((20, 20), (180, 460), (300, 2))
    wall[150:] += (440, 0)
    xy = np.concatenate([wall, rng.uniform((240, 120), (400, 360), (80, 2))])
    moving = np.arange(380) >= 300
    z = np.where(moving, 1.5, rng.uniform(1.5, 4.0, 380))
    motion = se3.exp(np.array([0.06, 0.02, 0.03, 0.01, -0.01, 0.005]))
    points = se3.transform(motion, CAMERA.unproject(xy, z))
    points[moving] -= (0.0, 0.05, 0.0)
    before = CAMERA.project(points)
    valid = ~moving | (np.arange(380) % 2 == 0)
    frame, previous = (bundle(xy, z, thing), bundle(before, points[:, 2], thing))
    state = FilterState(
        camera=CAMERA,
        keep=np.ones(380, bool),
        previous=previous,
        previous_keep=np.ones(380, bool),
        T_world_prev=np.eye(4),
        T_world_pred=motion,
        flow=FlowResult(before.astype(np.float32), valid, np.zeros(380, np.float32)),
    )
    return frame, state, moving, ~valid


def bundle(xy: np.ndarray, z: np.ndarray, thing: str) -> FrameBundle:
    zeros, ones = np.zeros(len(xy), np.float32), np.ones(len(xy), np.float32)
    keypoints = Keypoints(xy.astype(np.float32), zeros.astype(np.int32), zeros, ones, np.zeros((len(xy), 32), np.uint8))
    mask = np.zeros((1, 480, 640), bool)
    mask[0, 80:400, 220:420] = True
    instances = Instances(mask, np.array([[220, 80, 420, 400]], np.float32), (thing,), np.ones(1, np.float32))
    image, depth = np.zeros((480, 640, 3), np.uint8), np.full((480, 640), 1.5, np.float32)
    return FrameBundle(0, 0.0, image, image[:, :, 0], depth, keypoints, xy, z.astype(np.float32), instances)


def system(name: str, **settings: object) -> SlamPipeline:
    """A tracker that needs no network: its masks are set by the tests."""
    if "segmentation" in TRACKERS.get(name).settings.model_fields:
        settings["segmentation.source"] = "oracle"
    return build_tracker(name, settings, TrackerContext(masks=[]))


def test_every_published_flow_is_covered() -> None:
    with_flow = {spec.id for spec in all_specs() if "flow" in spec.settings.model_fields}
    assert {name for name in with_flow if not name.startswith("emfoa-oft")} == TESTED | FOLLOWED | UNPUBLISHED


@pytest.mark.parametrize("rule", ["keep", "drop", "judge"])
@pytest.mark.parametrize("name", sorted(TESTED - {"opf-slam"}))
def test_a_moving_region_whose_flow_fails_goes_by_the_named_rule(name: str, rule: str) -> None:
    block = next(block for block in system(name)._filters if "flow" in block.needs)
    assert block.settings.unmatched == "keep"
    block.settings = block.settings.model_copy(update={"unmatched": rule})
    movable = name in ("sof-slam", "seg-slam")
    frame, state, moving, lost = moving_scene("chair" if movable else "person")
    if movable:  # the depth of a moving thing takes its unmatched features along: not what is tested here
        block.settings = block.settings.model_copy(update={"depth_m": 0.0})
    keep = block.apply(frame, state).keep
    assert keep[~moving].mean() > 0.99 and not keep[moving & ~lost].any()
    assert keep[lost].all() if rule == "keep" else not keep[lost].any()


@pytest.mark.parametrize("name", sorted(TESTED | FOLLOWED))
def test_published_flows_are_lucas_kanade_without_a_check_of_ours(name: str) -> None:
    """What the flow of a system finds is what OpenCV's tracker finds, though a way back would contradict some of it."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (240, 320), dtype=np.uint8), (0, 0), 2.0)
    first = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    second = np.roll(first, (3, 9), (0, 1))
    second[60:180, 80:240] = cv2.GaussianBlur(second[60:180, 240:80:-1], (0, 0), 4.0)  # something else came in
    grid = np.mgrid[20:300:12, 20:220:12].reshape(2, -1).T.astype(np.float32)
    flow = system(name)._flow
    found = flow.track(flow.prepare(first), flow.prepare(second), grid)
    settings = TRACKERS.get(name).settings().flow
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        grid,
        grid.copy(),
        winSize=(settings.window_px,) * 2,
        maxLevel=LEVELS - 1,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    in_image = ((there >= 0) & (there <= (319, 239))).all(axis=1)
    np.testing.assert_array_equal(found.valid, (status.ravel() > 0) & in_image)
    checked = system(name, **{"flow.forward_backward_px": 1.5})._flow
    kept = checked.track(checked.prepare(first), checked.prepare(second), grid).valid
    assert np.count_nonzero(kept) < 0.9 * np.count_nonzero(found.valid), "the check would have changed the verdicts"
