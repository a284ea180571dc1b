"""Tags: what moves in a scene, and what a camera's path is like."""

import numpy as np
import pytest

from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.sequences.synthetic.settings import RenderSettings
from dynslam_bench.sequences.tags import motion_tags, sequence_tags
from dynslam_bench.sequences.view import SequenceView


def path(positions):
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, : positions.shape[1], 3] = positions
    return Trajectory(np.arange(len(positions)) / 30, poses)


@pytest.mark.parametrize(
    ("name", "tags"),
    [
        ("walking_xyz?scene=100", ["high-dynamic"]),
        ("sitting_rpy?scene=100", ["low-dynamic"]),
        ("fast_desk?scene=100", ["fast", "static"]),
        ("loop_room_moved?scene=100", ["loop", "low-dynamic"]),
        ("objects_trolley?scene=100", ["unknown-objects"]),
    ],
)
def test_tags_of_rendered_sequences(name, tags):
    sequence = open_synthetic(f"synthetic/{name}", None)
    assert sequence_tags(sequence) == tags
    assert "loop" not in sequence_tags(SequenceView(sequence, 0, 200)), "the part has not come back yet"


def test_nothing_moves_where_people_are_frozen():
    frozen = RenderSettings(people="frozen")
    sequence = open_synthetic("synthetic/walking_xyz?scene=100&frames=5", None, settings=frozen)
    assert sequence_tags(sequence) == ["static"]


@pytest.mark.parametrize(("radius_m", "turns", "loop"), [(2.5, 1.0, True), (2.5, 0.8, False), (0.9, 4.0, False)])
def test_a_loop_is_a_long_path_that_comes_back_to_where_it_was(radius_m, turns, loop):
    angle = 2 * np.pi * np.linspace(0, turns, 1200)
    circle = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert ("loop" in motion_tags(path(circle))) == loop


def test_noise_of_the_ground_truth_is_no_fast_motion():
    noise = np.random.default_rng(0).normal(0, 0.005, (3000, 3))
    still = path(noise)
    at_300_hz = Trajectory(still.timestamps / 10, still.T_world_cam)
    assert motion_tags(at_300_hz) == set()
    straight = path(np.linspace(0, 1.2, 31)[:, None])
    assert motion_tags(straight) == {"fast"}
