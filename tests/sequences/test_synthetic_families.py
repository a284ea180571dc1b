"""Every family: depth, masks, flow and poses agree, and what is said to make it hard is there."""

import numpy as np
import pytest
from sequence_folders import U, V, reprojected

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.geometry import se3
from dynslam_bench.sequences.synthetic import CAMERA, REPLICA_IDS, SYNTHETIC_IDS, open_synthetic, parse_synthetic_id
from dynslam_bench.sequences.synthetic.parts import BOX
from dynslam_bench.sequences.synthetic.scene import View

EVENTFUL = {  # a frame in which the named instance moves and is seen
    "objects_balloon": (40, 1), "objects_box_obstructing": (150, 1), "objects_box_aside": (130, 1),
    "objects_placed": (90, 1), "objects_removed": (230, 1), "objects_kidnapped": (120, 1), "objects_trolley": (120, 1),
    "objects_chair": (90, 1), "objects_door": (60, 1), "crowd_xyz": (140, 2), "synchronous": (30, 1),
    "tracking": (60, 8), "far_walking": (190, 1),
}  # fmt: skip


def opened(name: str):
    return open_synthetic(f"synthetic/{name}", None, threads=1)


@pytest.mark.parametrize("name", SYNTHETIC_IDS)
def test_every_sequence_opens_and_says_what_it_is(name: str) -> None:
    sequence = open_synthetic(f"{name}?scene={137 if name.endswith('s') else 41}", None)
    assert isinstance(sequence, Sequence)
    parsed = parse_synthetic_id(sequence.id)
    assert parse_synthetic_id(str(parsed)) == parsed and parsed.variant.version >= (name not in REPLICA_IDS)
    assert len(sequence) == parsed.variant.frames
    times = np.linspace(0, len(sequence) / 30, 40)
    assert all(se3.is_pose(pose, 1e-9) for pose in sequence.ground_truth.T_world_cam[::50])
    world = sequence.scene.world
    assert set(np.unique(sequence.scene.instance)) - {0} == set(world.class_names)
    assert max(world.class_names, default=0) < 256 and all(world.class_names.values())
    placed = [np.array([np.hstack([part.ravel() for part in body.path(t)]) for t in times]) for body in world.bodies]
    still = not world.actors and all(np.array_equal(there, there[:1].repeat(len(there), 0)) for there in placed)
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
        assert error[still].max() < 0.1, "a chair's back has a frame that is orthonormal to 4e-4 only, and may creep"
    assert still.any() or name == "objects_kidnapped"
    pixels = masks.instances == instance
    assert pixels.sum() > 1500
    assert np.median(error[pixels]) > 0.5


@pytest.mark.parametrize("name", [name for name in EVENTFUL if name.startswith("objects")])
def test_pixels_of_a_body_lie_on_it(name: str) -> None:
    """An independent look: the points behind a mask's pixels, put into the body's frame, lie on its primitives' box."""
    sequence = opened(name)
    index, instance = EVENTFUL[name]
    (body,) = [each for each in sequence.scene.world.bodies if each.instance == instance]
    depth, ids = sequence.renderer.geometry(index)
    points = CAMERA.unproject(np.stack([U, V], -1), depth)[ids == instance]
    pose = sequence.ground_truth.T_world_cam[index]
    rotation, origin = body.path(index / 30)
    local = (points @ pose[:3, :3].T + pose[:3, 3] - origin) @ rotation
    inside = np.zeros(len(local), bool)
    for part in body.parts:
        own, widest = (local - part.origin) @ part.rotation / part.scale, max(part.shape[1:])
        reach = part.shape if part.kind == BOX else np.array([widest, widest, part.shape[0] + widest])
        inside |= (np.abs(own) <= reach + 1e-6).all(axis=1)
    assert inside.mean() > 0.999


def test_what_was_placed_stays_and_what_was_removed_is_gone() -> None:
    for name, moves in (("placed", range(35, 148)), ("removed", range(185, 298))):
        scene = opened(f"objects_{name}").scene
        assert all(1 in scene.moving(index) for index in moves[::20])
        assert not any(1 in scene.moving(index) for index in (5, 20, 320, 500, 900))
    late = opened("objects_removed").masks[500].instances
    assert (opened("objects_placed").masks[500].instances == 1).mean() > 0.08 and not (late == 1).any()


def test_people_step_in_time_with_the_camera() -> None:
    sequence = opened("synchronous")
    camera = sequence.ground_truth.positions[::10, 0]
    assert np.ptp(camera) > 0.8
    for _, posture in sequence.scene.world.actors:
        assert np.ptp([posture(i / 3).x - x for i, x in enumerate(camera)]) < 0.03
    assert np.mean([np.mean(sequence.masks[i].instances > 0) for i in (20, 60, 100)]) > 0.3


def test_light_texture_and_depth_are_little_where_they_should_be() -> None:
    lit = opened("walking_xyz")[30]
    dark, outdoor, far = (opened(f"{name}_walking")[30] for name in ("dark", "outdoor", "far"))
    assert dark.rgb.mean() < 0.25 * lit.rgb.mean()
    assert (far.depth > 0).mean() < 0.45 < (lit.depth > 0).mean()
    assert (outdoor.depth > 0).mean() < 0.8 * (lit.depth > 0).mean()
    assert opened("blank_empty").scene.texture_names == ["plain"]


class TestRollingShutter:
    """Each row has a pose of its own."""

    def test_every_row_is_seen_from_its_own_pose(self) -> None:
        sequence = opened("fast_rpy")
        index, poses = 50, sequence.row_poses(50)
        truth = sequence.ground_truth.T_world_cam[index]
        assert np.abs(0.5 * (poses[239] + poses[240]) - truth).max() < 1e-6, "the frame's pose is the middle's"
        assert se3.rotation_angle(se3.inverse(poses[:1]) @ poses[-1:])[0] > 0.01
        depth, now = sequence.exact_depth(index), sequence.scene.view(index)
        for row in (0, 121, 300, 479):
            view = View(poses[row], poses[row][None], now.rotation, now.origin)
            alone = sequence.renderer.cast(view)[1]
            assert np.abs(alone[row] - depth[row]).max() < 1e-9

    def test_flow_ends_where_the_other_frames_rows_see_the_point(self) -> None:
        sequence = opened("fast_rpy")
        now, after = sequence.row_poses(50), sequence.row_poses(51)
        rows, columns = (part.ravel() for part in np.mgrid[5:475:30, 5:635:45])
        pixels = np.stack([columns, rows], axis=-1)
        ends = pixels + sequence.flow(50)[rows, columns]
        inside = ((ends >= 0) & (ends < (639, 479))).all(axis=1)
        assert inside.sum() > 100
        pixels, ends, rows, columns = pixels[inside], ends[inside], rows[inside], columns[inside]
        points = CAMERA.unproject(pixels, sequence.exact_depth(50)[rows, columns])
        world = np.einsum("nij,nj->ni", now[rows, :3, :3], points) + now[rows, :3, 3]
        above, share = ends[:, 1].astype(int), ends[:, 1:] % 1
        seen = [
            CAMERA.project(np.einsum("nji,nj->ni", after[row, :3, :3], world - after[row, :3, 3]))
            for row in (above, above + 1)
        ]
        assert np.abs((1 - share) * seen[0] + share * seen[1] - ends).max() < 2e-3


def test_splits_share_no_place_of_any_thing() -> None:
    def places(scene: int) -> set[tuple[float, ...]]:
        found = set()
        for variant in ("box_obstructing", "trolley", "kidnapped"):
            (body,) = parse_synthetic_id(f"synthetic/objects_{variant}").variant.build(scene).bodies
            found |= {(variant, key.x, key.y, key.z, key.yaw) for key in body.path.args[0][2:4]}
        return found

    tune, held_out = (set().union(*map(places, span)) for span in (range(0, 100, 9), range(100, 200, 9)))
    assert len(tune) > 20 and not tune & held_out


# Long paths: laps of the length they say, places come back to, furniture moved out of sight, walls never met.


def walk_of(name: str):
    return open_synthetic(name, None, threads=1).scene.world.camera.args[0]


@pytest.mark.parametrize(("shape", "lap_m"), [("room", 20), ("corridor", 60), ("rooms", 120)])
@pytest.mark.parametrize("scene", [0, 131])
def test_laps_have_their_length_and_are_walked_more_than_once(shape: str, lap_m: float, scene: int) -> None:
    sequence = open_synthetic(f"synthetic/loop_{shape}?scene={scene}", None)
    walk = walk_of(f"synthetic/loop_{shape}?scene={scene}")
    places = walk.at(np.linspace(0.0, walk.lap_s, 20 * len(walk.control) + 1))
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).sum() == pytest.approx(lap_m, rel=0.12)
    assert 1.1 * walk.lap_s < len(sequence) / 30 < 10_000 / 30 and len(sequence) >= 2000
    truth = sequence.ground_truth
    step = se3.inverse(truth.T_world_cam[:-1]) @ truth.T_world_cam[1:]
    assert (np.linalg.norm(step[:, :3, 3], axis=1) * 30).max() < 1.2
    assert (se3.rotation_angle(step) * 30).max() < 2.2
    lap = round(walk.lap_s * 30)
    again = np.linalg.norm(truth.positions[lap:] - truth.positions[:-lap], axis=1)
    assert 0.01 < again.max() < 0.6, "the same path again, not the same poses"
    middle = lap // 2
    assert np.linalg.norm(truth.positions[middle] - truth.positions[0]) > 2


def test_furniture_is_moved_only_out_of_sight() -> None:
    sequence = open_synthetic("synthetic/loop_room_moved?scene=1", None, threads=1)
    lap_s = walk_of("synthetic/loop_room_moved?scene=1").lap_s
    half_laps = {(body.path.args[1] + (k + 0.5) * lap_s) * 30 for body in sequence.scene.world.bodies for k in (0, 1)}
    steps = {i: sequence.scene.moving(i) for i in (int(np.ceil(t)) for t in half_laps if t < len(sequence))}
    assert len(steps) >= 6 and all(steps.values()), "most pieces move at least once"
    for index, ids in steps.items():
        assert not np.isin(sequence.renderer.geometry(index)[1], list(ids)).any(), f"frame {index} sees {ids} jump"
        assert not np.isin(sequence.renderer.geometry(index - 1)[1], list(ids)).any(), f"frame {index} sees {ids} jump"
    still = open_synthetic("synthetic/loop_room?scene=1", None, threads=1)
    assert not any(still.scene.moving(i) for i in steps)
    assert np.array_equal(still.renderer.geometry(40)[0], sequence.renderer.geometry(40)[0]), "one lap is the same"


def test_repeated_walls_share_their_textures_and_others_do_not() -> None:
    def names(variant: str) -> set[str]:
        static = parse_synthetic_id(f"synthetic/loop_{variant}").variant.build(3).static
        return {name for part in static for name in part.texture if name.startswith("poster")}

    assert len(names("corridor")) > 40
    assert len(names("corridor_repeated")) < 12
    assert len(names("rooms")) > 150
    assert len(names("rooms_repeated")) < 24, "six rooms look the same, whatever their number"
