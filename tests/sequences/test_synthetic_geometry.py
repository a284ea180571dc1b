"""What is exact about a rendered frame: poses, depth, masks and flow agree with each other."""

import ast
import hashlib
import itertools
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from helpers.sequence_folders import U, V, flipped, frame_hash, reprojected

import dynslam_bench.sequences.synthetic as package
from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry import se3
from dynslam_bench.sequences import Sequence, SequenceView, open_sequence
from dynslam_bench.sequences.synthetic import (
    CAMERA,
    REPLICA_IDS,
    SYNTHETIC_IDS,
    RenderSettings,
    SyntheticId,
    arithmetic,
    open_synthetic,
    parse_synthetic_id,
    render_synthetic,
)
from dynslam_bench.sequences.synthetic.people import draw_person, write_script
from dynslam_bench.sequences.synthetic.renderer import bounds_of
from dynslam_bench.sequences.synthetic.rooms import plan_room
from dynslam_bench.sequences.synthetic.scene import View
from dynslam_bench.sequences.synthetic.sequence import encode_png
from dynslam_bench.sequences.synthetic.settings import RENDERER_VERSION, ColorSensor, DepthSensor

CLEAN = {
    "depth": DepthSensor(noise=False), "color": ColorSensor(noise=False, shutter=0, exposure_drift=0, flicker=0)
}  # fmt: skip


def opened(name: str, **settings: object):
    return open_synthetic(f"synthetic/{name}", None, settings=RenderSettings(**settings), threads=1)


@pytest.fixture(scope="module")
def walking():
    return opened("walking_xyz?scene=1")


@pytest.mark.parametrize("other", [101, 112])
def test_static_flow_is_the_reprojection_of_the_exact_depth_and_people_do_not_follow_it(
    walking, other: int
) -> None:
    masks = walking.masks[100]
    still = masks.instances == 0
    assert still.mean() > 0.4
    assert {1, 2} <= masks.moving
    error = np.abs(walking.flow(100, other) - reprojected(walking, 100, other)).max(-1)
    assert error[still].max() < 1e-3
    assert all(np.median(error[masks.instances == person]) > 0.5 for person in (1, 2))


def test_colours_follow_the_flow() -> None:
    sequence = opened("walking_xyz?scene=0", **CLEAN)
    index = 72
    flow = sequence.flow(index)
    now = sequence[index].rgb.astype(float)
    after = sequence[index + 1].rgb.astype(float)
    x = np.float32(U + flow[..., 0])
    y = np.float32(V + flow[..., 1])
    inside = (x > 1) & (x < 637) & (y > 1) & (y < 477)
    followed = np.abs(cv2.remap(after, x, y, cv2.INTER_LINEAR) - now).mean(-1)
    seen = [inside & (sequence.masks[index].instances == instance) for instance in (0, 1, 2)]
    assert all(np.median(followed[pixels]) < 4 for pixels in seen if pixels.sum() >= 500)


def test_hits_lie_on_their_surfaces(walking) -> None:
    """Every hit point satisfies the implicit equation of its primitive (an independent formula)."""
    view = walking.scene.view(90)
    scene = walking.scene
    hit, depth = walking.renderer.cast(view)
    points = CAMERA.unproject(np.stack([U, V], -1), depth)[::3, ::3].reshape(-1, 3)
    keys = hit[::3, ::3].ravel()
    assert (keys >= 0).all()
    prims = keys >> 3
    faces = keys & 7
    world = points @ view.pose[:3, :3].T + view.pose[:3, 3]
    local = (
        np.einsum("nji,nj->ni", view.rotation[prims], world - view.origin[prims])
        / scene.scale[prims]
    )
    shape = scene.shape[prims]
    kind = scene.kind[prims]
    box = kind != 1
    cone = kind == 1
    axis = faces >> 1
    assert (
        np.abs(
            np.abs(local[box, axis[box]]) - np.where(kind[box] == 2, 0.0, shape[box, axis[box]])
        ).max()
        < 1e-9
    )
    (h, r1, r2) = shape[cone].T
    p = local[cone]
    radial = np.hypot(p[:, 0], p[:, 1])
    # Signed distance of a round cone: the nearest point of its axis, in the slanted metric of its
    # side.
    sine = np.where(h > 0, (r1 - r2) / np.where(h > 0, h, 1), 0)
    cosine = np.sqrt(1 - sine**2)
    k = p[:, 2] * cosine - radial * sine
    distance = np.where(
        k < 0, np.hypot(radial, p[:, 2]) - r1, radial * cosine + p[:, 2] * sine - r1
    )
    distance = np.where((k > h * cosine) & (h > 0), np.hypot(radial, p[:, 2] - h) - r2, distance)
    distance = np.where(h == 0, np.linalg.norm(p, axis=1) - r1, distance)
    assert np.abs(distance).max() < 1e-8


def test_depth_without_noise_is_exact_up_to_the_files_units() -> None:
    sequence = opened("sitting_rpy?scene=2", **CLEAN)
    assert np.abs(sequence[40].depth - sequence.exact_depth(40)).max() <= 0.5 / 5000 + 1e-6


def test_measured_depth_has_the_sensors_faults(walking) -> None:
    measured = walking[60].depth
    exact = walking.exact_depth(60)
    valid = measured > 0
    assert 0.6 < valid.mean() < 0.95
    assert measured[valid].min() >= 0.5
    assert measured.max() <= 5.4
    # Quantised disparity: the spread grows with the square of the distance.
    error = np.abs(measured - exact)
    near = valid & (exact < 1.6)
    far = valid & (exact > 3.0)
    assert np.median(error[near]) < 0.006
    assert 2 < np.median(error[far]) / np.median(error[near]) < 14
    disparity = CAMERA.fx * CAMERA.baseline_m / measured[valid & (exact > 3)]
    assert np.abs(disparity * 8 - np.rint(disparity * 8)).max() < 0.02


@pytest.mark.parametrize("name", REPLICA_IDS)
def test_every_replica_moves_like_its_original(name: str) -> None:
    sequence = open_synthetic(name, None)
    truth = sequence.ground_truth
    assert len(REPLICA_IDS) == 8
    assert len(truth) == len(sequence) == 600
    assert np.array_equal(truth.timestamps, sequence.timestamps)
    step = se3.inverse(truth.T_world_cam[:-1]) @ truth.T_world_cam[1:]
    speed = np.linalg.norm(step[:, :3, 3], axis=1) * 30
    turn = np.degrees(se3.rotation_angle(step)) * 30
    assert speed.max() < 1.0
    assert turn.max() < 90
    extent = np.ptp(truth.positions, axis=0)
    low, high, turns = {
        "xyz": (0.35, 0.6, 0), "static": (0.0, 0.05, 0), "rpy": (0.0, 0.05, 10), "halfsphere": (0.2, 1.0, 10)
    }[name.rpartition("_")[2]]  # fmt: skip
    assert (extent >= low).all(), extent
    assert (extent <= high).all(), extent
    assert turn.mean() > turns, extent


@pytest.mark.parametrize(("people", "persons"), [("frozen", True), ("none", False)])
def test_controls(walking, people: str, persons: bool) -> None:
    sequence = opened("walking_xyz?scene=1", people=people)
    masks = sequence.masks[33]
    assert masks.moving == frozenset()
    assert np.isin(masks.instances, (1, 2)).any() == persons
    assert np.array_equal(walking.ground_truth.T_world_cam, sequence.ground_truth.T_world_cam)
    assert sequence.digest() != walking.digest()


@pytest.mark.slow
@pytest.mark.parametrize("option", ["lighting_change", "glare", "shadow"])
def test_lighting_options_change_colours_only(option: str, walking) -> None:
    sequence = opened("walking_xyz?scene=1", **{option: True})
    changed = sequence[45]
    plain = walking[45]
    assert np.abs(changed.rgb.astype(int) - plain.rgb).mean() > 3
    assert np.array_equal(sequence.exact_depth(45), walking.exact_depth(45))
    assert np.array_equal(sequence.masks[45].instances, walking.masks[45].instances)


def test_bounds_hold_all_points_before_the_camera_and_no_more() -> None:
    rng = np.random.default_rng(3)
    # bit k of a corner's number is its axis k
    unit = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))[:, ::-1]
    turns = np.linalg.qr(rng.normal(size=(400, 3, 3)))[0]
    half = rng.uniform(0.02, 1.5, (400, 1, 3))
    centre = rng.uniform(-2, 2, (400, 1, 3))
    corners = (unit * half) @ turns + centre
    nearest, low_u, low_v, high_u, high_v = bounds_of(corners)
    assert np.array_equal(nearest, corners[:, :, 2].min(axis=1))
    inside = rng.uniform(-1, 1, (400, 4000, 3))
    # half of them on the surface
    inside[:, :2000] /= np.abs(inside[:, :2000]).max(axis=2, keepdims=True)
    points = (inside * half) @ turns + centre
    seen = points[:, :, 2] > 0.05
    assert (seen.any(axis=1) & ~seen.all(axis=1)).sum() > 50
    assert (~seen).all(axis=1).sum() > 50
    z = np.where(seen, points[:, :, 2], np.nan)
    u = points[:, :, 0] / z * CAMERA.fx + CAMERA.cx
    v = points[:, :, 1] / z * CAMERA.fy + CAMERA.cy
    for value, low, high in ((u, low_u, high_u), (v, low_v, high_v)):
        assert not (value < low[:, None]).any()
        assert not (value > high[:, None]).any()
    hidden = (corners[:, :, 2] <= 0.05).all(axis=1)
    assert (low_u[hidden] > high_u[hidden]).all()
    wholly = (corners[:, :, 2] > 0.05).all(axis=1)
    exact = (corners[..., 0] / corners[..., 2] * CAMERA.fx + CAMERA.cx)[wholly]
    assert np.abs(low_u[wholly] - exact.min(axis=1) + 2).max() < 1e-9


# The bytes of rendered frames stay what they were, on every processor; who changes them raises a
# version.


KEPT = [
    ("synthetic/walking_xyz", 301, 6, 0, "7b29ed5351537f6f"),
    ("synthetic/sitting_rpy@100", 40, 6, 0, "76436bc25ce51d1b"),
    ("synthetic/walking_static@7", 420, 6, 0, "00437b14d025f12e"),
    ("synthetic/loop_room@2", 700, 6, 1, "0761b775516c8b0a"),
    ("synthetic/fast_walking@1", 100, 6, 1, "05c7b5b125b81b77"),
]
"""Id, frame, version of the renderer and of the family, and the hash."""
OTHERWISE = {
    "sin",
    "cos",
    "tan",
    "arcsin",
    "arccos",
    "arctan",
    "arctan2",
    "atan",
    "atan2",
    "hypot",
    "exp",
    "log",
    "power",
    "pow",
    "linalg",
    "dot",
    "matmul",
    "einsum",
    "inner",
    "tensordot",
    "vecdot",
}
"""Functions of numpy and of the C library whose last bit depends on the processor."""


def fingerprint(id: str, index: int, threads: int = 1) -> str:
    """A hash of a frame's colours, depth, masks and flow, and of all poses."""
    sequence = open_synthetic(id, None, threads=threads)
    frame = sequence[index]
    flow = sequence.flow(index, index - 1)
    poses = sequence.ground_truth.T_world_cam
    parts = (frame.rgb, frame.depth, sequence.masks[index].instances, flow, poses)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()[:16]


@pytest.mark.slow
@pytest.mark.parametrize(("id", "index", "renderer", "family", "expected"), KEPT)
def test_frames_keep_their_bytes(
    id: str, index: int, renderer: int, family: int, expected: str
) -> None:
    assert (RENDERER_VERSION, parse_synthetic_id(id).variant.version) == (renderer, family), (
        "new bytes: renew the hash"
    )
    assert fingerprint(id, index) == expected


@pytest.mark.slow
def test_an_older_processor_and_several_threads_render_the_same_bytes() -> None:
    """OpenBLAS's kernels for a Nehalem, numpy without the SIMD that it found, the C library without multiply-adds."""
    extensions = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    older = {
        "PYTHONPATH": f"{Path(__file__).parent}{os.pathsep}{Path(__file__).parents[1]}",
        "OPENBLAS_CORETYPE": "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": " ".join(extensions),
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX2,-FMA,-AVX",
    }
    expected = {
        (id, index, 3): value
        for id, index, *_, value in KEPT
        if "walking_xyz" in id or "loop" in id
    }
    code = (
        "from test_synthetic_geometry import fingerprint; "
        f"print(*(fingerprint(*frame) for frame in {list(expected)}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | older, text=True, capture_output=True
    )
    assert done.stdout.split() == list(expected.values()), done.stderr


def test_nothing_is_rendered_with_what_depends_on_the_processor() -> None:
    """Products and functions come from `arithmetic.py`."""
    used = {f"{module}.{name}" for module in ("np", "math") for name in OTHERWISE}
    for path in Path(package.__file__).parent.rglob("*.py"):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        assert not any(isinstance(node, ast.MatMult) for node in nodes), path
        assert used.isdisjoint(
            ast.unparse(node) for node in nodes if isinstance(node, ast.Attribute)
        ), path


def test_functions_and_products_are_those_of_numpy_to_the_last_digit() -> None:
    rng = np.random.default_rng(0)
    right = np.pi / 2
    x = rng.uniform(-2e5, 2e5, 5000)
    y = rng.normal(size=5000)
    a, b = rng.normal(size=(2, 7, 3, 3))
    for ours, theirs in (
        (arithmetic.sin(x), np.sin(x)),
        (arithmetic.cos(x), np.cos(x)),
        (arithmetic.exp(y), np.exp(y)),
        (arithmetic.arctan2(y, x), np.arctan2(y, x)),
        (arithmetic.arctan2(np.array([0.0, 0, 1, -1]), np.array([0.0, -1, 0, 0])), [0, np.pi, right, -right]),
        (np.array([arithmetic.power(v, 0.7) for v in abs(x)]), abs(x) ** 0.7),
        (arithmetic.norm(a), np.linalg.norm(a, axis=-1)),
        (arithmetic.product(a, b, a[0]), a @ b @ a[0]),
        (arithmetic.product(a, b[0, 0]), a @ b[0, 0]),
        (arithmetic.product(a[0, 0], b), a[0, 0] @ b),
        (arithmetic.product(a[0, 0], b[0, 0]), a[0, 0] @ b[0, 0]),
    ):  # fmt: skip
        np.testing.assert_allclose(ours, theirs, rtol=2e-15, atol=3e-15)
    assert (arithmetic.sin(0.3), arithmetic.power(0.0, 0.7)) == (
        pytest.approx(np.sin(0.3), abs=3e-16),
        0.0,
    )


# Every family: depth, masks, flow and poses agree, and what is said to make it hard is there.


EVENTFUL = {  # a frame in which the named instance moves and is seen
    "objects_balloon": (40, 1), "objects_box_obstructing": (150, 1), "objects_box_aside": (130, 1),
    "objects_placed": (90, 1), "objects_removed": (230, 1), "objects_kidnapped": (120, 1), "objects_trolley": (120, 1),
    "objects_chair": (90, 1), "objects_door": (60, 1), "crowd_xyz": (140, 2), "synchronous": (30, 1),
    "tracking": (60, 8), "far_walking": (190, 1),
}  # fmt: skip


@pytest.mark.parametrize("name", SYNTHETIC_IDS)
def test_every_sequence_opens_and_says_what_it_is(name: str) -> None:
    sequence = open_synthetic(f"{name}?scene={137 if name.endswith('s') else 41}", None)
    assert isinstance(sequence, Sequence)
    parsed = parse_synthetic_id(sequence.id)
    assert parse_synthetic_id(str(parsed)) == parsed
    assert parsed.variant.version >= (name not in REPLICA_IDS)
    assert len(sequence) == parsed.variant.frames
    times = np.linspace(0, len(sequence) / 30, 40)
    assert all(se3.is_pose(pose, 1e-9) for pose in sequence.ground_truth.T_world_cam[::50])
    world = sequence.scene.world
    assert set(np.unique(sequence.scene.instance)) - {0} == set(world.class_names)
    assert max(world.class_names, default=0) < 256
    assert all(world.class_names.values())
    placed = [
        np.array([np.hstack([part.ravel() for part in body.path(t)]) for t in times])
        for body in world.bodies
    ]
    still = not world.actors and all(
        np.array_equal(there, there[:1].repeat(len(there), 0)) for there in placed
    )
    assert (parsed.variant.tag == "static") == still, "static is what nothing moves in"


@pytest.mark.parametrize("name", EVENTFUL)
def test_what_moves_is_what_the_masks_say_and_the_rest_stands_still(name: str) -> None:
    sequence = opened(name)
    index, instance = EVENTFUL[name]
    masks = sequence.masks[index]
    assert instance in sequence.scene.moving(index + 1)
    error = np.abs(sequence.flow(index) - reprojected(sequence, index, index + 1)).max(-1)
    still = ~np.isin(masks.instances, list(sequence.scene.moving(index + 1)))
    if still.any():  # the kidnapped camera sees nothing else
        chairs = [k for k, kind in masks.class_names.items() if kind == "chair"]
        assert error[still & ~np.isin(masks.instances, chairs)].max() < 1e-3
        assert error[still].max() < 0.1, (
            "a chair's back has a frame that is orthonormal to 4e-4 only, and may creep"
        )
    assert still.any() or name == "objects_kidnapped"
    pixels = masks.instances == instance
    assert pixels.sum() > 1500
    assert np.median(error[pixels]) > 0.5


def test_what_was_placed_stays_and_what_was_removed_is_gone() -> None:
    for name, moves in (("placed", range(35, 148)), ("removed", range(185, 298))):
        scene = opened(f"objects_{name}").scene
        assert all(1 in scene.moving(index) for index in moves[::20])
        assert not any(1 in scene.moving(index) for index in (5, 20, 320, 500, 900))
    late = opened("objects_removed").masks[500].instances
    assert (opened("objects_placed").masks[500].instances == 1).mean() > 0.08
    assert not (late == 1).any()


def test_people_step_in_time_with_the_camera() -> None:
    sequence = opened("synchronous")
    camera = sequence.ground_truth.positions[::10, 0]
    assert np.ptp(camera) > 0.8
    for _, posture in sequence.scene.world.actors:
        assert np.ptp([posture(i / 3).x - x for i, x in enumerate(camera)]) < 0.03
    assert np.mean([np.mean(sequence.masks[i].instances > 0) for i in (20, 60, 100)]) > 0.3


@pytest.mark.slow
def test_light_texture_and_depth_are_little_where_they_should_be() -> None:
    lit = opened("walking_xyz")[30]
    dark, outdoor, far = (opened(f"{name}_walking")[30] for name in ("dark", "outdoor", "far"))
    assert dark.rgb.mean() < 0.25 * lit.rgb.mean()
    assert (far.depth > 0).mean() < 0.45 < (lit.depth > 0).mean()
    assert (outdoor.depth > 0).mean() < 0.8 * (lit.depth > 0).mean()
    assert opened("blank_empty").scene.texture_names == ["plain"]


# A rolling shutter: each row has a pose of its own.


@pytest.fixture(scope="module")
def fast():
    return opened("fast_rpy")


def test_every_row_is_seen_from_its_own_pose(fast) -> None:
    poses = fast.row_poses(50)
    truth = fast.ground_truth.T_world_cam[50]
    assert np.abs(0.5 * (poses[239] + poses[240]) - truth).max() < 1e-6, (
        "the frame's pose is the middle's"
    )
    assert se3.rotation_angle(se3.inverse(poses[:1]) @ poses[-1:])[0] > 0.01
    depth = fast.exact_depth(50)
    now = fast.scene.view(50)
    for row in (0, 121, 300, 479):
        alone = fast.renderer.cast(View(poses[row], poses[row][None], now.rotation, now.origin))[1]
        assert np.abs(alone[row] - depth[row]).max() < 1e-9


def test_flow_ends_where_the_other_frames_rows_see_the_point(fast) -> None:
    now = fast.row_poses(50)
    after = fast.row_poses(51)
    pixels = np.stack(np.meshgrid(np.arange(5, 635, 45), np.arange(5, 475, 30)), axis=-1).reshape(
        -1, 2
    )
    ends = pixels + fast.flow(50)[pixels[:, 1], pixels[:, 0]]
    inside = ((ends >= 0) & (ends < (639, 479))).all(axis=1)
    assert inside.sum() > 100
    (columns, rows) = pixels[inside].T
    ends = ends[inside]
    points = CAMERA.unproject(pixels[inside], fast.exact_depth(50)[rows, columns])
    world = np.einsum("nij,nj->ni", now[rows, :3, :3], points) + now[rows, :3, 3]
    above = ends[:, 1].astype(int)
    share = ends[:, 1:] % 1
    seen = [
        CAMERA.project(np.einsum("nji,nj->ni", after[row, :3, :3], world - after[row, :3, 3]))
        for row in (above, above + 1)
    ]
    assert np.abs((1 - share) * seen[0] + share * seen[1] - ends).max() < 2e-3


# Long paths: laps of the length they say, places come back to, furniture moved out of sight, walls
# never met.


@pytest.mark.parametrize(("shape", "lap_m"), [("room", 20), ("corridor", 60), ("rooms", 120)])
@pytest.mark.parametrize("scene", [0, 131])
def test_laps_have_their_length_and_are_walked_more_than_once(
    shape: str, lap_m: float, scene: int
) -> None:
    sequence = opened(f"loop_{shape}?scene={scene}")
    walk = sequence.scene.world.camera.args[0]
    places = walk.at(np.linspace(0.0, walk.lap_s, 20 * len(walk.control) + 1))
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).sum() == pytest.approx(lap_m, rel=0.12)
    assert 1.1 * walk.lap_s < len(sequence) / 30 < 10_000 / 30
    assert len(sequence) >= 2000
    truth = sequence.ground_truth
    step = se3.inverse(truth.T_world_cam[:-1]) @ truth.T_world_cam[1:]
    assert (np.linalg.norm(step[:, :3, 3], axis=1) * 30).max() < 1.2
    assert (se3.rotation_angle(step) * 30).max() < 2.2
    lap = round(walk.lap_s * 30)
    again = np.linalg.norm(truth.positions[lap:] - truth.positions[:-lap], axis=1)
    assert 0.01 < again.max() < 0.6, "the same path again, not the same poses"
    assert np.linalg.norm(truth.positions[lap // 2] - truth.positions[0]) > 2


def test_furniture_is_moved_only_out_of_sight() -> None:
    sequence = opened("loop_room_moved?scene=1")
    still = opened("loop_room?scene=1")
    lap_s = sequence.scene.world.camera.args[0].lap_s
    half_laps = {
        (body.path.args[1] + (k + 0.5) * lap_s) * 30
        for body in sequence.scene.world.bodies
        for k in (0, 1)
    }
    steps = {
        i: sequence.scene.moving(i)
        for i in (int(np.ceil(t)) for t in half_laps if t < len(sequence))
    }
    assert len(steps) >= 6, "most pieces move at least once"
    assert all(steps.values()), "most pieces move at least once"
    for index, ids in steps.items():
        seen = [sequence.renderer.geometry(frame)[1] for frame in (index - 1, index)]
        assert not np.isin(seen, list(ids)).any(), f"frame {index} sees {ids} jump"
    assert not any(still.scene.moving(i) for i in steps)
    assert np.array_equal(still.renderer.geometry(40)[0], sequence.renderer.geometry(40)[0]), (
        "one lap is the same"
    )


def test_repeated_walls_share_their_textures_and_others_do_not() -> None:
    def posters(variant: str) -> int:
        static = parse_synthetic_id(f"synthetic/loop_{variant}").variant.build(3).static
        return len({name for part in static for name in part.texture if name.startswith("poster")})

    assert posters("corridor") > 40
    assert posters("corridor_repeated") < 12
    assert posters("rooms") > 150, "six rooms look the same, whatever their number"
    assert posters("rooms_repeated") < 24, "six rooms look the same, whatever their number"


# Ids of rendered sequences.


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("", SyntheticId("sitting_rpy", 0, 600, None)),
        *(
            (form, SyntheticId("sitting_rpy", 107, 33))
            for form in ("?scene=107&frames=33", "?frames=33&scene=107")
        ),
        ("@107?frames=33", SyntheticId("sitting_rpy", 107, 33)),
        ("?noise=5", SyntheticId("sitting_rpy", noise=5)),
        ("?scene=107&frames=33&noise=5", SyntheticId("sitting_rpy", 107, 33, noise=5)),
        ("?noise=005&scene=107&frames=033", SyntheticId("sitting_rpy", 107, 33, noise=5)),
    ],
)
def test_scene_length_and_noise_are_read_in_any_order(query: str, expected: SyntheticId) -> None:
    parsed = parse_synthetic_id(f"synthetic/sitting_rpy{query}")
    assert parsed == expected == parse_synthetic_id(str(parsed))
    assert parsed.split == ("held-out" if parsed.scene == 107 else "tune")
    assert str(parsed).replace("&frames=33", "").replace("&frames=600", "") == parsed.whole
    assert parsed.whole.endswith("&noise=5") == (parsed.noise == 5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("synthetic/walking_xyz?noise=-1", "noise '-1'"),
        ("synthetic/walking_xyz?noise", "unknown option 'noise'"),
        ("synthetic/walking_xyz?noise=1&noise=2", "names noise twice"),
        ("synthetic/walking_xyz?frames=3&nose=1", "unknown option 'nose=1'"),
        ("synthetic/walking_xyz?", "unknown option ''"),
        ("synthetic/walking_xy", "did you mean 'synthetic/walking_xyz'"),
        ("synthetic/Walking-static", "did you mean 'synthetic/walking_static'"),
        ("synthetic/walking_xyz?scene=18446744073709551616", "0 to 18446744073709551615"),
        ("synthetic/walking_xyz?scene=999999999999999999999", "0 to 18446744073709551615"),
        ("synthetic/walking_xyz?scene=sealed:2026a/17", "needs the salt of round 2026a"),
        ("synthetic/walking_xyz?scene=sealed:2026a", "scene 'sealed:2026a'"),
        ("synthetic/walking_xyz?scene=", "scene ''"),
        ("synthetic/walking_xyz?scene=0-3", "scene '0-3'"),
        ("synthetic/walking_xyz@40?scene=40", "names scene twice"),
        ("synthetic/walking_xyz@-1", "0 to 18446744073709551615"),
        ("synthetic/walking_xyz@", "scene ''"),
        ("synthetic/walking_xyz@1.5", "scene '1.5'"),
        ("synthetic/walking_xyz?frames=0", "from 1 to"),
        ("synthetic/walking_xyz?frames=many", "frames 'many'"),
        ("synthetic/walking_xyz?frame=3", "?frames=N"),
        ("tum/walking_xyz", "did you mean"),
        ("", "not the id"),
    ],
)
def test_bad_ids_say_what_is_wrong(text: str, words: str) -> None:
    with pytest.raises(SequenceError, match=r"^[^\n]+$") as caught:
        parse_synthetic_id(text)
    assert words in str(caught.value)


def test_the_first_read_is_what_later_reads_give(tmp_path: Path) -> None:
    sequence = open_synthetic("synthetic/walking_xyz?frames=9", tmp_path, threads=1)
    first = sequence[4]
    assert list(tmp_path.rglob("rgb/*.png"))
    other = pickle.loads(pickle.dumps(sequence))
    again = other[4]
    assert "renderer" not in vars(other), "the second read must not render"
    assert frame_hash(first) == frame_hash(again)
    assert again.depth.dtype == np.float32
    assert np.array_equal(sequence.masks[4].instances, sequence.renderer.geometry(4)[1])
    view = SequenceView(sequence, 3)
    assert np.array_equal(view.masks[1].instances, sequence.masks[4].instances)
    assert view[1].index == 1
    assert sequence[-1].index == 8
    with pytest.raises(IndexError):
        sequence[9]


def test_frames_do_not_depend_on_the_length(tmp_path: Path) -> None:
    short, long = (
        open_synthetic(f"synthetic/walking_rpy?frames={n}", tmp_path, threads=1) for n in (5, 600)
    )
    assert frame_hash(short[3]) == frame_hash(long[3])
    assert short.store.folder == long.store.folder
    assert np.array_equal(short.ground_truth.T_world_cam, long.ground_truth.T_world_cam[:5])
    assert np.array_equal(short.timestamps, long.timestamps[:5])
    assert short.digest() != long.digest()


def test_ground_truth_and_digest_need_no_rendering(tmp_path: Path) -> None:
    sequence = open_synthetic("synthetic/sitting_static", tmp_path)
    assert len(sequence.ground_truth) == 600
    assert sequence.digest() == opened("sitting_static?scene=0").digest()
    assert not list(tmp_path.iterdir())
    assert "renderer" not in vars(sequence)


@pytest.mark.slow
def test_rendering_goes_on_where_it_stopped(tmp_path: Path) -> None:
    progress = Mock(side_effect=[None, None, None, KeyboardInterrupt])
    with pytest.raises(KeyboardInterrupt):
        render_synthetic("synthetic/sitting_xyz?frames=6", tmp_path, threads=1, progress=progress)
    assert progress.call_args.args == (3, 6)
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("rgb/*.png")}
    assert len(kept) >= 3
    assert not [path for path in tmp_path.rglob(".*")], "no temporary file may stay"
    folder = render_synthetic("synthetic/sitting_xyz?frames=6", tmp_path, threads=1)
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in kept.items())
    assert len(list((folder / "rgb").glob("*.png"))) == 6
    assert open_synthetic("synthetic/sitting_xyz?frames=6", tmp_path).render() == 0
    masks = [
        line.split()[1]
        for line in (folder / "masks.txt").read_text().splitlines()
        if line[0] != "#"
    ]
    assert len(masks) == 6
    assert all((folder / file).is_file() for file in masks)


DAMAGES = (
    Path.unlink,
    lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    lambda path: path.write_bytes(flipped(path.read_bytes())),
    lambda path: path.write_bytes(encode_png(np.zeros((4, 4), np.uint8))),
)
SPOILED = f"synthetic/walking_static?frames={len(DAMAGES)}"


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache with a frame for each kind of damage."""
    root = tmp_path_factory.mktemp("rendered")
    open_synthetic(SPOILED, root, threads=1).render()
    return root


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rgb", "depth", "masks"])
def test_damaged_files_are_rendered_again(tmp_path: Path, rendered: Path, kind: str) -> None:
    root = shutil.copytree(rendered, tmp_path / "cache")
    before, after = (open_synthetic(SPOILED, each, threads=1) for each in (rendered, root))
    for stamp, damage in zip(after.timestamps, DAMAGES, strict=True):
        damage(after.store.path(kind, float(stamp)))
    expected = [
        (frame_hash(before[i]), before.masks[i].instances.tobytes()) for i in range(len(DAMAGES))
    ]
    assert [
        (frame_hash(after[i]), after.masks[i].instances.tobytes()) for i in range(len(DAMAGES))
    ] == expected
    assert "renderer" not in vars(before), "what it is compared with was rendered before the damage"
    assert after.render() == (len(DAMAGES) if kind == "masks" else 0), (
        "masks by themselves are not stored"
    )
    assert all(after.store.bytes_of(kind, float(stamp)) for stamp in after.timestamps)


def test_the_cache_is_a_folder_in_tum_layout(tmp_path: Path) -> None:
    """The folder reader, which knows nothing of rendering, gives the same frames, poses and camera."""
    sequence = open_synthetic("synthetic/walking_halfsphere?frames=3", tmp_path, threads=1)
    sequence.render()
    folder = open_sequence(sequence.store.folder)
    assert len(folder) == 3
    assert folder.camera == sequence.camera
    assert [frame_hash(folder[index]) for index in range(3)] == [
        frame_hash(sequence[index]) for index in range(3)
    ]
    assert np.abs(folder.ground_truth.T_world_cam - sequence.ground_truth.T_world_cam).max() < 1e-8
    assert np.array_equal(folder.timestamps, sequence.timestamps)


@pytest.mark.slow
def test_two_forked_processes_may_render_the_same_sequence_after_their_parent_has_rendered(
    tmp_path: Path,
) -> None:
    code = """
import os, sys
from pathlib import Path
from dynslam_bench.sequences.synthetic import open_synthetic, render_synthetic
sequence = open_synthetic("synthetic/walking_static?frames=3", None, threads=2)
before = sequence[1].rgb.tobytes()
for _ in range(2):
    if os.fork() == 0:
        render_synthetic("synthetic/walking_static?frames=3", Path(sys.argv[1]), threads=2)
        os._exit(0 if sequence[1].rgb.tobytes() == before else 1)
print(os.wait()[1], os.wait()[1])
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert done.stdout == "0 0\n", done.stderr
    assert open_synthetic("synthetic/walking_static?frames=3", tmp_path).render() == 0
    assert not [path for path in tmp_path.rglob(".*")]


def test_tuning_and_held_out_scenes_share_nothing() -> None:
    def traits(scene: int) -> set[object]:
        plan, script = plan_room(scene), write_script("walking", scene)
        values: set[object] = {
            ("back", plan.back_y),
            ("left", plan.left_x),
            ("desk", plan.desk_y, plan.desk_x),
        }
        values |= {("path", k, p[0].x, p[0].y) for k, p in enumerate(script.people)}
        if scene % 9 == 0:  # what moves takes longer to build
            for name in ("box_obstructing", "trolley", "kidnapped"):
                (body,) = (
                    parse_synthetic_id(f"synthetic/objects_{name}").variant.build(scene).bodies
                )
                values |= {(name, key) for key in body.path.args[0][2:4]}
        return values | {("height", k, draw_person(scene, k).height) for k in range(2)}

    tune, held_out = (set().union(*map(traits, scenes)) for scenes in (range(100), range(100, 200)))
    assert not tune & held_out
