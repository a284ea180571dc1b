"""What is exact about a rendered frame: poses, depth, masks and flow agree with each other."""

import cv2
import numpy as np
import pytest
from sequence_folders import U, V, reprojected

from dynslam_bench.geometry import se3
from dynslam_bench.sequences.synthetic import CAMERA, REPLICA_IDS, RenderSettings, open_synthetic
from dynslam_bench.sequences.synthetic.renderer import bounds_of
from dynslam_bench.sequences.synthetic.settings import ColorSensor, DepthSensor

CLEAN = RenderSettings(
    depth=DepthSensor(noise=False), color=ColorSensor(noise=False, shutter=0, exposure_drift=0, flicker=0)
)


@pytest.fixture(scope="module")
def walking():
    return open_synthetic("synthetic/walking_xyz?scene=1", None, threads=1)


@pytest.mark.parametrize("other", [101, 112])
def test_static_flow_is_the_reprojection_of_the_exact_depth(walking, other: int) -> None:
    still = walking.masks[100].instances == 0
    assert still.mean() > 0.4
    error = np.abs(walking.flow(100, other) - reprojected(walking, 100, other)).max(-1)
    assert error[still].max() < 1e-3


def test_moving_instances_do_not_follow_the_camera(walking) -> None:
    index = 90  # both people walk
    masks = walking.masks[index]
    assert {1, 2} <= masks.moving
    error = np.abs(walking.flow(index) - reprojected(walking, index, index + 1)).max(-1)
    for person in (1, 2):
        pixels = masks.instances == person
        if pixels.sum() > 500:
            assert np.median(error[pixels]) > 0.5


def test_colours_follow_the_flow() -> None:
    sequence = open_synthetic("synthetic/walking_xyz?scene=0", None, settings=CLEAN, threads=1)
    index = 72
    flow, now, after = sequence.flow(index), sequence[index].rgb.astype(float), sequence[index + 1].rgb.astype(float)
    x, y = np.float32(U + flow[..., 0]), np.float32(V + flow[..., 1])
    inside = (x > 1) & (x < 637) & (y > 1) & (y < 477)
    seen = cv2.remap(after, x, y, cv2.INTER_LINEAR)
    ids = sequence.masks[index].instances
    for instance in (0, 1, 2):
        pixels = inside & (ids == instance)
        if pixels.sum() < 500:
            continue
        followed = np.median(np.abs(seen - now).mean(-1)[pixels])
        assert followed < 4, f"instance {instance}"


def test_hits_lie_on_their_surfaces(walking) -> None:
    """Every hit point satisfies the implicit equation of its primitive (an independent formula)."""
    scene, view = walking.scene, walking.scene.view(90)
    hit, depth = walking.renderer.cast(view)
    points = CAMERA.unproject(np.stack([U, V], -1), depth)[::3, ::3].reshape(-1, 3)
    keys = hit[::3, ::3].ravel()
    assert (keys >= 0).all()
    prims, faces = keys >> 3, keys & 7
    world = points @ view.pose[:3, :3].T + view.pose[:3, 3]
    local = np.einsum("nji,nj->ni", view.rotation[prims], world - view.origin[prims]) / scene.scale[prims]
    shape, kind = scene.shape[prims], scene.kind[prims]
    box = kind != 1
    axis = faces[box] >> 1
    expected = np.where(kind[box] == 2, 0.0, shape[box, axis])
    assert np.abs(np.abs(local[box, axis]) - expected).max() < 1e-9
    cone = ~box
    h, r1, r2 = shape[cone].T
    p = local[cone]
    radial = np.hypot(p[:, 0], p[:, 1])
    # Signed distance of a round cone: the nearest point of its axis, in the slanted metric of its side.
    sine = np.where(h > 0, (r1 - r2) / np.where(h > 0, h, 1), 0)
    cosine = np.sqrt(1 - sine**2)
    k = p[:, 2] * cosine - radial * sine
    distance = np.where(k < 0, np.hypot(radial, p[:, 2]) - r1, radial * cosine + p[:, 2] * sine - r1)
    distance = np.where((k > h * cosine) & (h > 0), np.hypot(radial, p[:, 2] - h) - r2, distance)
    distance = np.where(h == 0, np.linalg.norm(p, axis=1) - r1, distance)
    assert np.abs(distance).max() < 1e-8


def test_depth_without_noise_is_exact_up_to_the_files_units() -> None:
    sequence = open_synthetic("synthetic/sitting_rpy?scene=2", None, settings=CLEAN, threads=1)
    assert np.abs(sequence[40].depth - sequence.exact_depth(40)).max() <= 0.5 / 5000 + 1e-6


def test_measured_depth_has_the_sensors_faults(walking) -> None:
    measured, exact = walking[60].depth, walking.exact_depth(60)
    valid = measured > 0
    assert 0.6 < valid.mean() < 0.95
    assert measured[valid].min() >= 0.5
    assert measured.max() <= 5.4
    # Quantised disparity: the spread grows with the square of the distance.
    error = np.abs(measured - exact)
    near, far = valid & (exact < 1.6), valid & (exact > 3.0)
    assert np.median(error[near]) < 0.006
    assert 2 < np.median(error[far]) / np.median(error[near]) < 14
    disparity = CAMERA.fx * CAMERA.baseline_m / measured[valid & (exact > 3)]
    assert np.abs(disparity * 8 - np.rint(disparity * 8)).max() < 0.02


@pytest.mark.parametrize("name", REPLICA_IDS)
def test_every_replica_moves_like_its_original(name: str) -> None:
    sequence = open_synthetic(name, None)
    truth = sequence.ground_truth
    assert len(REPLICA_IDS) == 8 and len(truth) == len(sequence) == 600
    assert np.array_equal(truth.timestamps, sequence.timestamps)
    step = se3.inverse(truth.T_world_cam[:-1]) @ truth.T_world_cam[1:]
    speed = np.linalg.norm(step[:, :3, 3], axis=1) * 30
    turn = np.degrees(se3.rotation_angle(step)) * 30
    assert speed.max() < 1.0 and turn.max() < 90
    extent = np.ptp(truth.positions, axis=0)
    motion = name.rpartition("_")[2]
    expected = {"xyz": (0.35, 0.6), "static": (0.0, 0.05), "rpy": (0.0, 0.05), "halfsphere": (0.2, 1.0)}[motion]
    assert (extent >= expected[0]).all() and (extent <= expected[1]).all(), extent
    if motion in ("rpy", "halfsphere"):
        assert turn.mean() > 10


@pytest.mark.parametrize(("people", "persons"), [("frozen", True), ("none", False)])
def test_controls(people: str, persons: bool) -> None:
    sequence = open_synthetic("synthetic/walking_xyz", None, settings=RenderSettings(people=people), threads=1)
    masks = sequence.masks[33]
    assert masks.moving == frozenset()
    assert np.isin(masks.instances, (1, 2)).any() == persons
    still = open_synthetic("synthetic/walking_xyz", None, threads=1)
    assert np.array_equal(still.ground_truth.T_world_cam, sequence.ground_truth.T_world_cam)
    assert sequence.digest() != still.digest()


@pytest.mark.parametrize("option", ["lighting_change", "glare", "shadow"])
def test_lighting_options_change_colours_only(option: str, walking) -> None:
    settings = RenderSettings(**{option: True})
    sequence = open_synthetic("synthetic/walking_xyz?scene=1", None, settings=settings, threads=1)
    changed, plain = sequence[45], walking[45]
    assert np.abs(changed.rgb.astype(int) - plain.rgb).mean() > 3
    assert np.array_equal(sequence.exact_depth(45), walking.exact_depth(45))
    assert np.array_equal(sequence.masks[45].instances, walking.masks[45].instances)


def test_bounds_hold_all_points_before_the_camera_and_no_more() -> None:
    rng = np.random.default_rng(3)
    unit = np.array([[(i >> a & 1) * 2.0 - 1 for a in range(3)] for i in range(8)])
    turns = np.linalg.qr(rng.normal(size=(400, 3, 3)))[0]
    half, centre = rng.uniform(0.02, 1.5, (400, 1, 3)), rng.uniform(-2, 2, (400, 1, 3))
    corners = (unit * half) @ turns + centre
    nearest, *rectangle = bounds_of(corners)
    assert np.array_equal(nearest, corners[:, :, 2].min(axis=1))
    low_u, low_v, high_u, high_v = rectangle
    inside = rng.uniform(-1, 1, (400, 4000, 3))
    inside[:, :2000] /= np.abs(inside[:, :2000]).max(axis=2, keepdims=True)  # half of them on the surface
    points = (inside * half) @ turns + centre
    seen = points[:, :, 2] > 0.05
    crossing = seen.any(axis=1) & ~seen.all(axis=1)
    assert crossing.sum() > 50 and (~seen).all(axis=1).sum() > 50
    z = np.where(seen, points[:, :, 2], np.nan)
    u, v = points[:, :, 0] / z * CAMERA.fx + CAMERA.cx, points[:, :, 1] / z * CAMERA.fy + CAMERA.cy
    for value, low, high in ((u, low_u, high_u), (v, low_v, high_v)):
        assert not (value < low[:, None]).any() and not (value > high[:, None]).any()
    hidden = (corners[:, :, 2] <= 0.05).all(axis=1)
    assert (low_u[hidden] > high_u[hidden]).all()
    wholly = (corners[:, :, 2] > 0.05).all(axis=1)
    exact = (corners[..., 0] / corners[..., 2] * CAMERA.fx + CAMERA.cx)[wholly]
    assert np.abs(low_u[wholly] - exact.min(axis=1) + 2).max() < 1e-9
