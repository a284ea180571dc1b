"""A map that is saved, loaded and worked on: the same bits there and back, frozen where a run only localises."""

import json

import numpy as np
import pytest
from point_world import PointWorld, track_all

from dynslam_bench.core.errors import DynslamError, SettingsError, TrackerError
from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.geometry import se3
from dynslam_bench.slam.atlas import Atlas, packed
from dynslam_bench.slam.backend import MonocularBackend, RgbdBackend
from dynslam_bench.slam.map_files import HEADER, MAP_SCHEMA, read_map
from dynslam_bench.slam.settings import BackendSettings, MonocularBackendSettings

HALF = 45
"""Frames that the map is made of."""


def started(room, file, kind=RgbdBackend, settings=BackendSettings, features=(), **overrides):
    """A back end that begins in a map."""
    own = apply_overrides(settings(), {"map.file": str(file), **overrides})
    backend = kind(own, **dict(features))
    backend.reset(room.camera, 0)
    return backend


def off_m(results, poses, first):
    """Distances of tracked cameras from where they were, in the world of the first pose."""
    true = se3.transform(se3.inverse(first), poses[:, :3, 3])
    return np.array([np.linalg.norm(found.T_world_cam[:3, 3] - at) for found, at in zip(results, true, strict=True)])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A room, the poses of a walk in it, and the map of the walk's first half."""
    room, file = PointWorld(), tmp_path_factory.mktemp("map") / "map.npz"
    poses = room.path(2 * HALF)
    backend = RgbdBackend()
    backend.reset(room.camera, 0)
    track_all(backend, [room.see(pose, i) for i, pose in enumerate(poses[:HALF])])
    backend.save_map(file, "a walk")
    return room, poses, file, backend


def test_a_loaded_map_is_the_saved_one_to_the_last_bit(made, tmp_path):
    room, _, file, backend = made
    saved, loaded = packed(backend.world, Atlas()), read_map(file)  # what is in memory, and as it was stored
    assert loaded.header.made_by == "a walk" and saved.keys() == loaded.arrays.keys() and len(saved["id"]) > 300
    for name, array in saved.items():
        assert array.dtype == loaded.arrays[name].dtype and array.tobytes() == loaded.arrays[name].tobytes(), name
    again = started(room, file)
    again.save_map(tmp_path / "again.npz", "a walk")
    assert (tmp_path / "again.npz").read_bytes() == file.read_bytes()
    before, after = backend.outputs(), again.outputs()
    order = np.argsort(before.ids)  # slots are used again in memory, and follow each other in the file
    assert np.array_equal(before.ids[order], after.ids) and np.array_equal(before.positions[order], after.positions)


def test_localisation_only_finds_the_camera_at_once_and_leaves_the_map_alone(made, tmp_path):
    room, poses, file, _ = made
    backend = started(room, file, **{"map.localisation_only": True})
    assert backend.predict(0.0) is None
    order = range(2 * HALF - 1, HALF // 2, -1)  # from the end of the way, which the map does not know
    results = track_all(backend, [room.see(poses[i], i, stamp=number / 30) for number, i in enumerate(order)])
    states = np.array([found.state for found in results])
    assert (states == "ok").all() and not any(found.keyframe for found in results)
    assert off_m(results, poses[list(order)], poses[0]).max() < 0.05
    assert results[0].relocalised and not results[-1].relocalised
    backend.save_map(tmp_path / "after.npz", "a walk")
    assert (tmp_path / "after.npz").read_bytes() == file.read_bytes()
    assert len(backend.finalize()) == len(order)


def test_localisation_only_says_lost_without_a_pose_until_it_knows_the_place(made):
    room, poses, file, _ = made
    backend = started(room, file, **{"map.localisation_only": True})
    elsewhere = [PointWorld(seed=9).see(pose, i) for i, pose in enumerate(poses[:8])]
    here = [room.see(pose, 8 + i) for i, pose in enumerate(poses[:5])]
    blind = [room.blind(13 + i) for i in range(4)]
    back = [room.see(pose, 17 + i) for i, pose in enumerate(poses[20:25])]
    results = track_all(backend, [*elsewhere, *here, *blind, *back])
    assert [found.state for found in results] == ["lost"] * 8 + ["ok"] * 5 + ["lost"] * 4 + ["ok"] * 5
    assert all(found.T_world_cam is None for found in results[:8])
    assert off_m(results[17:], poses[20:25], poses[0]).max() < 0.05


@pytest.mark.parametrize("loops", [False, True])
def test_a_map_goes_on_growing(made, tmp_path, loops):
    room, poses, file, before = made
    backend = started(room, file, **{"loop_closing.enabled": loops})
    blind = [room.blind(i) for i in range(3)]
    results = track_all(backend, [*blind, *(room.see(pose, 3 + i) for i, pose in enumerate(poses[HALF:]))])
    assert [found.state for found in results] == ["lost"] * 3 + ["ok"] * HALF
    assert off_m(results[3:], poses[HALF:], poses[0]).max() < 0.05
    assert results[-1].map_points > len(before.world.points) and any(found.keyframe for found in results)
    own = [record for record in backend.outputs().keyframes if record.frame >= 0]
    assert 0 < len(own) < backend.world.keyframe_count and min(record.frame for record in own) >= 3
    backend.save_map(tmp_path / "grown.npz")
    assert len(read_map(tmp_path / "grown.npz").arrays["kf_id"]) == backend.world.keyframe_count


def test_a_map_that_does_not_fit_is_refused_in_one_line(made):
    room, poses, file, _ = made
    other = PointWorld()
    other.camera = room.camera.resized(320, 240)
    for fault, words in (
        (lambda: started(other, file), "another camera: width 640.0 instead of 320.0"),
        (lambda: started(room, file, features={"levels": 4}), "8 levels of 1.2.* than this system's .orb, 4 levels"),
        (lambda: started(room, file, features={"extractor": "mine"}), "than this system's .mine, 8 levels"),
        (lambda: started(room, file, MonocularBackend, MonocularBackendSettings), "an RGB-D map, and this is a mono"),
        (lambda: started(room, file.parent / "none.npz"), "cannot read .*none.npz"),
    ):
        with pytest.raises(SettingsError, match=words) as refused:
            fault()
        assert "\n" not in str(refused.value)
    backend = started(room, file)
    frame = room.see(poses[0], 0)
    frame.keypoints.descriptors.resize((len(frame), 64), refcheck=False)
    with pytest.raises(TrackerError, match="descriptors have 32 bytes, frame 0's 64"):
        track_all(backend, [frame])


def test_only_a_named_map_can_be_localised_in(tmp_path):
    with pytest.raises(SettingsError, match="localisation only needs a map"):
        apply_overrides(BackendSettings(), {"map.localisation_only": True}).map.verify()
    with pytest.raises(SettingsError, match="which is no file"):
        apply_overrides(BackendSettings(), {"map.file": str(tmp_path)}).map.verify()
    backend = RgbdBackend()
    backend.reset(PointWorld().camera, 0)
    with pytest.raises(TrackerError, match="no map to save"):
        backend.save_map(tmp_path / "map.npz")


def test_a_file_of_another_version_or_kind_is_none(made, tmp_path):
    _, _, file, _ = made
    with np.load(file) as stored:
        arrays = dict(stored)
    header = json.loads(arrays[HEADER].tobytes())
    for change, words in (
        ({"schema_version": MAP_SCHEMA + 1}, "upgrade"),
        ({"kind": "a run"}, "kind"),
        ({"next_point": 5}, "'id' holds values above 4"),
    ):
        text = json.dumps(header | change).encode()
        np.savez(tmp_path / "odd.npz", **(arrays | {HEADER: np.frombuffer(text, np.uint8)}))
        with pytest.raises(SettingsError, match=words):
            read_map(tmp_path / "odd.npz")
    (tmp_path / "odd.npz").write_bytes(file.read_bytes()[:-100])
    with pytest.raises(DynslamError, match="holds no arrays"):
        read_map(tmp_path / "odd.npz")


def spoiled(arrays, name, change):
    """The arrays with one of them changed in place, in a copy."""
    array = arrays[name].copy()
    change(array)
    return arrays | {name: array}


FAULTS = {
    "kf_point": (lambda a: a.__setitem__(np.flatnonzero(a >= 0)[0], -1), "do not agree"),
    "obs_ft": (lambda a: a.__setitem__(0, 30000), "features that the keyframe does not have"),
    "obs_kf": (lambda a: a.__setitem__(0, 99), "values above"),
    "n_obs": (lambda a: a.__setitem__(0, a[0] + 1), "does not add up"),
    "kf_count": (lambda a: a.__setitem__(0, 2**60), "claims tables"),
    "kf_pose": (lambda a: a.__imul__(1.5), "no rigid transformation"),
    "position": (lambda a: a.__setitem__((0, 0), np.nan), "not finite"),
    "kf_right": (lambda a: a.__setitem__(0, np.inf), "'kf_right'"),
    "id": (lambda a: a.__setitem__(1, a[0]), "ascending"),
    "far": (lambda a: a.__setitem__(0, 0.0), "not above 0"),
    "visible": (lambda a: a.__setitem__(0, 0), "below 1"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_damaged_map_is_refused_before_anything_is_looked_up_in_it(made, tmp_path, name):
    _, _, file, _ = made
    with np.load(file) as stored:
        arrays = spoiled(dict(stored), name, FAULTS[name][0])
    np.savez(tmp_path / "odd.npz", **arrays)
    with pytest.raises(SettingsError, match=FAULTS[name][1]):
        read_map(tmp_path / "odd.npz")
    for missing in (arrays.keys() - {name}, {*arrays, "further"}):
        np.savez(tmp_path / "odd.npz", **{key: arrays.get(key, np.zeros(1)) for key in missing})
        with pytest.raises(SettingsError, match=r"no array|unknown array"):
            read_map(tmp_path / "odd.npz")


def test_a_small_file_claims_no_large_tables(made, tmp_path):
    _, _, file, _ = made
    with np.load(file) as stored:
        arrays = dict(stored)
    for name in ("kf_words", "words"):
        arrays[name] = np.zeros((len(arrays[name]), 8000), np.uint64)
    np.savez_compressed(tmp_path / "odd.npz", **arrays)
    with pytest.raises(SettingsError, match="a descriptor has 8000 words of 64 bits, at most 64"):
        read_map(tmp_path / "odd.npz")


def test_a_higher_octave_than_the_features_have_is_refused(made, tmp_path):
    _, _, file, _ = made
    with np.load(file) as stored:
        arrays = spoiled(dict(stored), "kf_octave", lambda a: a.__setitem__(0, 63))
    np.savez(tmp_path / "odd.npz", **arrays)
    with pytest.raises(SettingsError, match="'kf_octave' holds values above"):
        read_map(tmp_path / "odd.npz")
