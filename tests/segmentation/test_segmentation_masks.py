"""Post-processing, carrying masks over, bridging missed detections, the schedule, and mask metrics."""

import time
from copy import deepcopy

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.segmenter import Instances
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.segmentation import schedule
from dynslam_bench.segmentation.postprocess import boxes_of, dilate, dynamic_mask, fill_holes, repair, select
from dynslam_bench.segmentation.schedule import MaskScheduler, MissedDetections
from dynslam_bench.segmentation.settings import SegmentationSettings
from dynslam_bench.segmentation.training.evaluate_masks import MaskTally, average_precision

H, W = 120, 160


def block(y0, y1, x0, x1):
    mask = np.zeros((H, W), bool)
    mask[y0:y1, x0:x1] = True
    return mask


def instances(*masks, names=None, scores=None, moving=None):
    stack = np.stack(masks) if masks else np.zeros((0, H, W), bool)
    return Instances(
        stack,
        boxes_of(stack),
        tuple(names or ["person"] * len(stack)),
        np.array(scores if scores is not None else [0.9] * len(stack), np.float32),
        None if moving is None else np.array(moving, bool),
    )


def frame_of(gray, index=0):
    return Frame(index, index / 30, gray[:, :, None].repeat(3, 2), np.zeros(gray.shape, np.float32))


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


# --- post-processing ---------------------------------------------------------------------------------------------


def test_selection_by_class_score_and_motion():
    masks = [block(0, 20, 0, 20), block(30, 50, 0, 20), block(60, 80, 0, 20), block(90, 92, 0, 2)]
    found = instances(*masks, names=["person", "chair", "person", "person"], scores=[0.9, 0.9, 0.2, 0.9])
    assert len(select(found, SegmentationSettings())) == 2
    assert len(select(found, SegmentationSettings(confidence=0.1))) == 3
    assert len(select(found, SegmentationSettings(classes="person,chair"))) == 3
    oracle = instances(*masks[:2], names=["person", "chair"], moving=[False, True])
    assert select(oracle, SegmentationSettings()).class_names == ("person", "chair")


@pytest.mark.parametrize("radius", [0, 1, 7, 15, 200])
def test_dilation_is_a_disc_of_that_radius(radius):
    mask = np.zeros((H, W), bool)
    mask[50, 60] = mask[0, 0] = True
    yy, xx = np.mgrid[:H, :W]
    expected = ((yy - 50) ** 2 + (xx - 60) ** 2 <= radius**2) | (yy**2 + xx**2 <= radius**2)
    assert np.array_equal(dilate(mask, radius), expected)
    assert not dilate(np.zeros((H, W), bool), radius).any()


def test_dynamic_mask_of_nothing():
    assert not dynamic_mask(Instances.empty(H, W), SegmentationSettings()).any()
    found = instances(block(10, 50, 10, 50), scores=[0.05])
    assert not dynamic_mask(found, SegmentationSettings()).any()


def test_holes_are_filled_and_bays_stay():
    mask = block(10, 110, 20, 100)
    assert np.array_equal(fill_holes(mask & ~block(40, 60, 40, 60)), mask)
    bay = mask & ~block(40, 80, 60, 100)
    assert np.array_equal(fill_holes(bay)[45:75, 65:100], bay[45:75, 65:100])
    assert fill_holes(np.ones((H, W), bool)).all() and not fill_holes(np.zeros((H, W), bool)).any()


def test_depth_repair_fits_the_border_to_the_depth_edge():
    truth = block(20, 100, 50, 110)
    depth = np.where(truth, 1.5, 3.0).astype(np.float32)
    depth[::7] = 0  # missing rows decide nothing
    settings = SegmentationSettings(repair="depth", dilation_px=0)
    for wrong in (block(25, 95, 55, 105), block(15, 105, 45, 115), block(20, 100, 54, 114)):
        repaired = dynamic_mask(instances(wrong), settings, depth)
        assert iou(repaired, truth) > 0.93 > iou(wrong, truth)
    wrong = block(25, 95, 55, 105)
    assert np.array_equal(dynamic_mask(instances(wrong), settings), wrong)
    assert np.array_equal(repair(wrong, np.zeros((H, W), np.float32), 0.2), wrong)


# --- carrying ----------------------------------------------------------------------------------------------------


def scene(shift_x, shift_y=0, scale=1.0, seed=0):
    """A textured square that moves over another texture; the image and the square's mask."""
    rng = np.random.default_rng(seed)
    background = cv2.GaussianBlur(rng.integers(0, 255, (480, 640)).astype(np.uint8), (0, 0), 2.5)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (480, 640)).astype(np.uint8), (0, 0), 2.5)
    stretch = [cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX) for image in (background, texture)]
    square = np.zeros((480, 640), np.uint8)
    square[150:330, 200:360] = 255
    move = np.array([[scale, 0, 280 * (1 - scale) + shift_x], [0, scale, 240 * (1 - scale) + shift_y]])
    mask = cv2.warpAffine(square, move, (640, 480)) >= 128
    image = np.where(mask, cv2.warpAffine(stretch[1], move, (640, 480)), stretch[0]).astype(np.uint8)
    return image, mask


def carry_dense(found, before, after):
    return schedule.carry_dense(found, schedule.dense_flow(before, after))


@pytest.mark.parametrize("move", [carry_dense, schedule.carry_sparse])
@pytest.mark.parametrize("motion", [(0, 0, 1.0), (9, 3, 1.0), (-14, 6, 1.05)])
def test_masks_follow_the_motion(move, motion):
    before, mask = scene(0)
    after, moved = scene(*motion)
    carried = move(instances(mask, scores=[0.8]), before, after)
    assert iou(carried.masks[0], moved) > 0.93
    assert carried.boxes[0] == pytest.approx(boxes_of(moved[None])[0], abs=8)
    assert carried.class_names == ("person",) and carried.scores == pytest.approx([0.8])


@pytest.mark.parametrize("move", [carry_dense, schedule.carry_sparse])
def test_carrying_nothing_and_carrying_over_black_images(move):
    black = np.zeros((H, W), np.uint8)
    assert len(move(Instances.empty(H, W), black, black)) == 0
    kept = move(instances(block(20, 80, 30, 90)), black, black)
    assert iou(kept.masks[0], block(20, 80, 30, 90)) > 0.95


def test_an_exact_flow_moves_masks_exactly():
    mask = block(30, 60, 40, 80)
    flow = np.full((H, W, 2), (7, -4), np.float32)
    assert np.array_equal(schedule.push_mask(mask, flow), block(26, 56, 47, 87))
    assert not schedule.push_mask(mask, flow + 500).any()
    assert np.array_equal(schedule.push_mask(mask, flow[::2, ::2] / 2), block(26, 56, 47, 87))


# --- missed detections -------------------------------------------------------------------------------------------


def walker(k):
    return block(30, 90, 20 + 5 * k, 50 + 5 * k)


def test_a_missed_detection_is_bridged_at_constant_velocity():
    bridge = MissedDetections(2)
    for k in range(4):
        assert len(bridge.update(instances(walker(k)))) == 1
    for k in (4, 5):
        bridged = bridge.update(instances())
        assert len(bridged) == 1 and bridged.scores[0] == np.float32(0.9)
        assert iou(bridged.masks[0], walker(k)) > 0.75
    assert len(bridge.update(instances())) == 0


@pytest.mark.parametrize("when", ["every", "every_nth"])
@pytest.mark.parametrize("promised", [0, 1, 3, 5])
def test_a_miss_is_bridged_for_as_many_segmented_frames_as_promised_however_weak_the_detection(promised, when):
    class Weak:
        def segment(self, frame):
            return instances(walker(1), scores=[0.31]) if frame.index < 6 else instances()

    settings = SegmentationSettings(compensate=promised, schedule=when, n=2, confidence=0.3)
    stage, seen = MaskScheduler(settings, Weak()), []
    gray = np.random.default_rng(0).integers(0, 255, (H, W), dtype=np.uint8)
    for index in range(20):
        used = select(stage.masks_for(frame_of(gray, index), gray, keyframe=False), settings)
        seen += [len(used)] if stage.segmented and index >= 6 else []
    assert seen == [1] * promised + [0] * (len(seen) - promised)


def test_single_detections_leaving_objects_and_oracles_are_not_bridged():
    bridge = MissedDetections(5)
    bridge.update(instances(walker(0)))
    assert len(bridge.update(instances())) == 0
    for k in range(4):
        bridge.update(instances(block(30, 90, max(0, 30 - 12 * k), 60 - 12 * k)))
    assert [len(bridge.update(instances())) for _ in range(3)][-1] == 0
    assert len(MissedDetections(0).update(instances(walker(0)))) == 1
    oracle = MissedDetections(5)
    for k in range(3):
        oracle.update(instances(walker(k), moving=[True]))
    assert len(oracle.update(instances(moving=[]))) == 0


# --- schedule ----------------------------------------------------------------------------------------------------


class Square:
    """Finds the square of `scene` where it is."""

    def __init__(self):
        self.calls = []

    def segment(self, frame):
        self.calls.append(frame.index)
        return instances(scene(3 * frame.index)[1])


def run(settings, count=10, keyframes=()):
    segmenter, quality = Square(), []
    stage = MaskScheduler(settings, segmenter)
    for index in range(count):
        gray, truth = scene(3 * index)
        found = stage.masks_for(frame_of(gray, index), gray, keyframe=index in keyframes)
        assert stage.segmented == (segmenter.calls[-1] == index)
        quality.append(iou(found.union(), truth))
    return segmenter.calls, quality


def test_every_frame_every_nth_and_keyframes(monkeypatch):
    assert run(SegmentationSettings())[0] == list(range(10))
    calls, quality = run(SegmentationSettings(schedule="every_nth", n=4))
    assert calls == [0, 4, 8] and min(quality) > 0.9
    calls, quality = run(SegmentationSettings(schedule="keyframes"), keyframes=(0, 7))
    assert calls == [0, 7] and min(quality) > 0.88
    monkeypatch.setattr(schedule, "MAX_CARRY", 3)
    assert run(SegmentationSettings(schedule="keyframes"))[0] == [0, 3, 6, 9]
    assert min(run(SegmentationSettings(schedule="every_nth", n=5, carry="sparse"))[1]) > 0.9


@pytest.mark.parametrize(("when", "rests"), [("every_nth", [0, 4, 8]), ("keyframes", [0])])
def test_where_masks_cover_much_of_the_view_every_frame_is_segmented(when, rests):
    covered = scene(0)[1].mean()  # carried masks may cover a little less or more
    settings = SegmentationSettings(schedule=when, n=4)
    less, more = (settings.model_copy(update={"crowded_share": factor * covered}) for factor in (0.5, 1.5))
    assert run(less, keyframes=(0,))[0] == list(range(10))
    assert run(more, keyframes=(0,))[0] == rests
    assert run(less.model_copy(update={"confidence": 0.95}), keyframes=(0,))[0] == rests, "masks that do not count"


@pytest.mark.parametrize("slow", [False, True])
def test_beside_tracking_masks_come_late_by_the_stamps_and_are_carried_to_the_frame(slow):
    class Slow(Square):
        def segment(self, frame):
            time.sleep(0.05 * slow)
            return super().segment(frame)

    stage = MaskScheduler(SegmentationSettings(schedule="async", latency_s=0.09), Slow())
    taken, quality = [], []
    for index in range(14):
        gray, truth = scene(3 * index)
        if index == 8:
            stage = deepcopy(stage)
        found = stage.masks_for(frame_of(gray, index), gray, keyframe=True)
        taken += [index] * stage.segmented
        quality.append(iou(found.union(), truth))
    stage.reset()
    assert stage.segmenter.calls == [0, 1, 4, 7, 10, 13] and taken == [0, 4, 7, 10, 13]
    assert min(quality) > 0.85
    stage.masks_for(frame_of(gray), gray, keyframe=True)
    assert stage.segmented, "a sequence begins with masks"


def test_beside_tracking_missed_detections_count_the_frames_between_those_segmented(monkeypatch):
    stage, apart = MaskScheduler(SegmentationSettings(schedule="async", latency_s=0.09), Square()), []
    update = stage._missed.update
    monkeypatch.setattr(stage._missed, "update", lambda found, frames: apart.append(frames) or update(found, frames))
    for index in range(11):
        gray = scene(3 * index)[0]
        stage.masks_for(frame_of(gray, index), gray, keyframe=False)
    assert stage.segmenter.calls[:4] == [0, 1, 4, 7] and apart == [1, 1, 3, 3]


def test_an_error_of_the_segmenter_beside_tracking_is_raised_where_its_masks_are_taken():
    class Broken(Square):
        def segment(self, frame):
            if frame.index == 4:
                raise RuntimeError("frame 4")
            return super().segment(frame)

    stage = MaskScheduler(SegmentationSettings(schedule="async", latency_s=0.09), Broken())
    gray = scene(0)[0]
    for index in range(7):
        stage.masks_for(frame_of(gray, index), gray, keyframe=False)
    with pytest.raises(RuntimeError, match="frame 4"):
        stage.masks_for(frame_of(gray, 7), gray, keyframe=False)


def test_the_schedule_may_change_while_the_segmenter_runs_beside_tracking():
    """It finishes first, what it was asked before is forgotten, and masks stay those of the frame."""
    beside, every = (SegmentationSettings(schedule=when, latency_s=0.09) for when in ("async", "every"))
    stage = MaskScheduler(beside, Square())
    taken = []
    for index in range(12):
        stage.configure(every if index in (3, 4) else beside)
        gray, truth = scene(3 * index)
        assert iou(stage.masks_for(frame_of(gray, index), gray, keyframe=False).union(), truth) > 0.85
        taken += [index] * stage.segmented
    stage.reset()
    assert taken == [0, 3, 4, 8, 11] and stage.segmenter.calls == [0, 1, 3, 4, 5, 8, 11]


def test_settings_may_change_while_a_run_lasts_and_reset_forgets():
    segmenter = Square()
    settings = SegmentationSettings(schedule="every_nth", n=10)
    stage = MaskScheduler(settings, segmenter)
    gray = scene(0)[0]

    changes = {2: settings.model_copy(update={"n": 1}), 3: settings}
    for index in range(5):
        stage.configure(changes.get(index, settings))
        if index == 4:
            stage.reset()
        stage.masks_for(frame_of(gray, index), gray, keyframe=False)
    assert segmenter.calls == [0, 2, 4]


# --- metrics -----------------------------------------------------------------------------------------------------


def test_average_precision_by_hand():
    hits = np.array([True, False, True])
    # recall .5 at precision 1, recall 1 at precision 2/3: 51 points at 1, 50 at 2/3
    assert average_precision(np.array([0.9, 0.8, 0.7]), hits, 2) == pytest.approx((51 + 50 * 2 / 3) / 101)
    assert average_precision(np.array([0.9]), np.array([True]), 2) == pytest.approx(51 / 101)
    assert average_precision(np.array([]), np.zeros(0, bool), 3) == 0.0
    assert np.isnan(average_precision(np.array([0.5]), np.array([False]), 0))


def add(tally, true=(), guess=(), scores=None):
    found = instances(*guess, scores=scores)
    tally.add(instances(*true).masks, found.masks, found.scores)


def test_quality_of_perfect_shifted_missed_and_false_detections():
    tally = MaskTally()
    add(tally, [walker(0), walker(10)], [walker(0), walker(10)])
    perfect = tally.quality()
    assert [perfect[name] for name in ("ap", "iou", "instance_iou", "recall", "truths")] == [1, 1, 1, 1, 2]
    add(tally, [walker(5)])
    add(tally, [], [walker(5)])
    quality = tally.quality()
    assert (quality["truths"], quality["detections"]) == (3, 3) and 0 < quality["ap50"] < 1
    assert quality["recall"] == pytest.approx(2 / 3) and quality["instance_iou"] == pytest.approx(2 / 3)
    assert quality["iou"] == pytest.approx(2 / 4) and quality["frame_iou"] == pytest.approx(1 / 3)
    nothing = MaskTally().quality()
    assert nothing["truths"] == 0 and nothing["ap"] is None and nothing["iou"] is None


def test_two_detections_of_one_object_count_once_and_small_objects_are_left_out():
    tally = MaskTally()
    add(tally, [walker(0)], [walker(0), walker(0)], scores=[0.9, 0.8])
    assert tally.quality()["ap50"] == 1.0
    add(tally, [walker(0)], [walker(0)], scores=[0.7])
    assert tally.quality()["ap50"] < 1.0  # the duplicate at .8 lies between the hits
    small = MaskTally(min_area=100)
    add(small, [walker(0), block(0, 5, 0, 5)], [walker(0), block(0, 5, 0, 5)])
    assert (small.quality()["truths"], small.quality()["ap"]) == (1, 1.0)
