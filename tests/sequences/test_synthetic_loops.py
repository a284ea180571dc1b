"""Long paths: laps of the length they say, places come back to, furniture moved out of sight, walls never met."""

import numpy as np
import pytest

from dynslam_bench.geometry import se3
from dynslam_bench.sequences.synthetic import open_synthetic, parse_synthetic_id


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


def test_furniture_is_moved_out_of_sight_and_nowhere_else() -> None:
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
