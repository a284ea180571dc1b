"""A map that is saved, loaded and continued: the same bits, unchanged where a run only localises, checked when read."""

import csv
import json
import struct

import cv2
import numpy as np
import pytest
from helpers.point_world import PointWorld, make_backend, states, track_all

from dynslam_bench.contracts.tracker import KeyframeRecord, MapOutputs
from dynslam_bench.core.errors import DynslamError, SettingsError, TrackerError
from dynslam_bench.geometry import Trajectory, se3
from dynslam_bench.slam.atlas import packed
from dynslam_bench.slam.backend import Backend
from dynslam_bench.slam.map_files import (
    HEADER,
    MAP_SCHEMA,
    read_map,
    write_keyframes_csv,
    write_ply,
)
from dynslam_bench.slam.run_figure import write_run_figure
from dynslam_bench.slam.settings import BackendSettings, StartMapSettings

HALF = 45
"""Frames that the map is made of."""


def errors_m(results, poses, first):
    """Position errors of tracked frames in the world of the first pose."""
    true = se3.transform(se3.inverse(first), poses[:, :3, 3])
    return np.array(
        [np.linalg.norm(r.T_world_cam[:3, 3] - at) for r, at in zip(results, true, strict=True)]
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A room, the poses of a path in it, the map of the first half, and its back end."""
    room = PointWorld()
    file = tmp_path_factory.mktemp("map") / "map.npz"
    poses = room.path(2 * HALF)
    backend = make_backend(room)
    track_all(backend, [room.see(pose, i) for i, pose in enumerate(poses[:HALF])])
    backend.save_map(file, "a run")
    return room, poses, file, backend


def test_a_loaded_map_is_the_saved_one_to_the_last_bit(made, tmp_path):
    room, _, file, backend = made
    saved = packed(backend.map, [])
    loaded = read_map(file)
    assert loaded.header.made_by == "a run"
    assert saved.keys() == loaded.arrays.keys()
    assert len(saved["id"]) > 300
    for name, array in saved.items():
        assert array.dtype == loaded.arrays[name].dtype, name
        assert array.tobytes() == loaded.arrays[name].tobytes(), name
    again = make_backend(room, map__file=str(file))
    again.save_map(tmp_path / "again.npz", "a run")
    assert (tmp_path / "again.npz").read_bytes() == file.read_bytes()
    before = backend.outputs()
    after = again.outputs()
    # slots are used again in memory, and follow each other in the file
    order = np.argsort(before.ids)
    assert np.array_equal(before.ids[order], after.ids)
    assert np.array_equal(before.positions[order], after.positions)


def test_localisation_only_relocalises_and_leaves_the_map_unchanged(made, tmp_path):
    room, poses, file, _ = made
    backend = make_backend(room, map__file=str(file), map__localisation_only=True)
    assert backend.predict_T_world_cam(0.0) == (None, None)
    elsewhere = [PointWorld(seed=9).see(pose, i) for i, pose in enumerate(poses[:8])]
    # from the end of the path, which the map does not know
    order = [*range(2 * HALF - 1, HALF // 2, -1)]
    here = [room.see(poses[i], 8 + number) for number, i in enumerate(order)]
    blind = [room.blind(8 + len(here) + i) for i in range(4)]
    back = [room.see(pose, 12 + len(here) + i) for i, pose in enumerate(poses[20:25])]
    results = track_all(backend, [*elsewhere, *here, *blind, *back])
    assert states(results) == ["lost"] * 8 + ["ok"] * len(here) + ["lost"] * 4 + ["ok"] * 5
    assert all(r.T_world_cam is None for r in results[:8])
    assert not any(r.keyframe for r in results)
    assert results[8].relocalised
    assert not results[12].relocalised
    tracked = [r for r in results if r.state == "ok"]
    assert errors_m(tracked, poses[[*order, *range(20, 25)]], poses[0]).max() < 0.05
    backend.save_map(tmp_path / "after.npz", "a run")
    assert (tmp_path / "after.npz").read_bytes() == file.read_bytes()
    assert len(backend.finalize()) == len(tracked)


@pytest.mark.parametrize("loops", [False, True])
def test_a_loaded_map_continues_to_grow(made, tmp_path, loops):
    room, poses, file, before = made
    backend = make_backend(room, map__file=str(file), loop_closing__enabled=loops)
    frames = [
        *(room.blind(i) for i in range(3)),
        *(room.see(p, 3 + i) for i, p in enumerate(poses[HALF:])),
    ]
    results = track_all(backend, frames)
    assert states(results) == ["lost"] * 3 + ["ok"] * HALF
    assert errors_m(results[3:], poses[HALF:], poses[0]).max() < 0.05
    assert results[-1].map_points > len(before.map.points)
    assert any(r.keyframe for r in results)
    new = [record.frame for record in backend.outputs().keyframes if record.frame >= 0]
    assert 0 < len(new) < backend.map.keyframe_count
    assert min(new) >= 3
    backend.save_map(tmp_path / "grown.npz")
    assert len(read_map(tmp_path / "grown.npz").arrays["kf_id"]) == backend.map.keyframe_count


@pytest.mark.parametrize(
    ("change", "features", "words"),
    [
        ({"monocular": True}, {}, "sensors rgbd instead of rgb"),
        ({}, {"levels": 4}, "levels 8 instead of 4"),
        ({}, {"extractor": "mine"}, "extractor orb instead of mine"),
        ({"size": (320, 240)}, {}, "width 640.0 instead of 320.0"),
        ({"file": "none.npz"}, {}, "none.npz"),
    ],
)
def test_a_map_of_another_sensor_or_other_features_is_refused(made, change, features, words):
    room, _, file, _ = made
    camera = room.camera.resized(*change["size"]) if "size" in change else room.camera
    settings = StartMapSettings(file=str(file.parent / change.get("file", file.name)))
    backend = Backend(BackendSettings(map=settings), **features)
    backend.uses_depth = not change.get("monocular", False)
    with pytest.raises(SettingsError, match=words):
        backend.reset(camera, 0)


def test_other_descriptors_and_missing_maps_are_refused(made, tmp_path):
    room, poses, file, _ = made
    frame = room.see(poses[0], 0)
    frame.keypoints.descriptors.resize((len(frame), 64), refcheck=False)
    with pytest.raises(TrackerError, match=r"32 bytes.* 64"):
        track_all(make_backend(room, map__file=str(file)), [frame])
    for settings in (
        StartMapSettings(localisation_only=True),
        StartMapSettings(file=str(tmp_path)),
    ):
        with pytest.raises(SettingsError):
            settings.verify()
    with pytest.raises(TrackerError):
        make_backend(room).save_map(tmp_path / "map.npz")


@pytest.fixture
def arrays(made):
    """Arrays of the map's file."""
    with np.load(made[2]) as stored:
        return dict(stored)


def put(name, index, value):
    return lambda arrays: arrays[name].__setitem__(index, value)


def twice(arrays):
    """Two points are observed by one feature."""
    one, other = np.flatnonzero(arrays["obs_kf"] == 0)[:2]
    arrays["obs_ft"][other] = arrays["obs_ft"][one]


def with_two_features(arrays):
    """The keyframe that observes the first point observes it with a further feature, too."""
    keyframe = arrays["obs_kf"][0]
    used = arrays["obs_ft"][arrays["obs_kf"] == keyframe]
    arrays["obs_ft"][1] = np.setdiff1d(np.arange(arrays["kf_count"][keyframe]), used)[0]
    arrays["obs_kf"][1] = keyframe


FAULTS = [
    (put("position", 0, np.nan), "'position' holds values that are not finite"),
    (twice, "two points"),
    (with_two_features, "with two features"),
    (put("obs_ft", 0, 30000), "features that the keyframe does not have"),
    (put("obs_kf", 0, 99), "above"),
    (put("n_obs", 0, 30000), "does not add up"),
    (put("kf_count", 0, 2**60), "claims tables"),
    (put("kf_octave", 0, 63), "above"),
    (put("n_obs", 0, 0), "none observes"),
    (lambda arrays: arrays.pop("far"), "no array"),
    (lambda arrays: arrays.update(further=np.zeros(1)), "unknown array"),
    (lambda arrays: arrays.update(far=np.zeros(1)), "shape"),
]


@pytest.mark.parametrize(("change", "words"), FAULTS)
def test_a_damaged_map_is_refused_before_it_is_used(arrays, tmp_path, change, words):
    change(arrays)
    np.savez(tmp_path / "odd.npz", **arrays)
    with pytest.raises(SettingsError, match=words):
        read_map(tmp_path / "odd.npz")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("header", "words"),
    [({"schema_version": MAP_SCHEMA + 1}, "upgrade"), ({"kind": "a run"}, "kind"), ({"next_point": 5}, "above 4"),
     ({}, "8000 words")],
)  # fmt: skip
def test_a_file_of_another_version_kind_or_size_is_refused(made, arrays, tmp_path, header, words):
    text = json.dumps(json.loads(arrays[HEADER].tobytes()) | header)
    arrays[HEADER] = np.frombuffer(text.encode(), np.uint8)
    if not header:  # a small file that claims large tables
        arrays |= {
            name: np.zeros((len(arrays[name]), 8000), np.uint64) for name in ("kf_words", "words")
        }
    np.savez_compressed(tmp_path / "odd.npz", **arrays)
    with pytest.raises(SettingsError, match=words):
        read_map(tmp_path / "odd.npz")
    (tmp_path / "odd.npz").write_bytes(made[2].read_bytes()[:-100])
    with pytest.raises(DynslamError):
        read_map(tmp_path / "odd.npz")


# The map's files: what they hold is read back with independent means.


def outputs(points=50, keyframes=4):
    rng = np.random.default_rng(0)
    poses = se3.exp(rng.normal(0, 0.3, (keyframes, 6)))
    records = tuple(
        KeyframeRecord(i, 3 * i, 100.0 + i / 3, pose, 900, 300 + i) for i, pose in enumerate(poses)
    )
    return MapOutputs(
        records,
        np.arange(points),
        rng.normal(0, 2, (points, 3)),
        rng.integers(0, 256, (points, 3)).astype(np.uint8),
        rng.integers(1, 9, points),
    )


def test_keyframes_csv(tmp_path):
    map_outputs = outputs()
    write_keyframes_csv(tmp_path / "keyframes.csv", map_outputs)
    with (tmp_path / "keyframes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == [0, 3, 6, 9]
    assert rows[1]["timestamp"] == "100.333333333"
    for row, record in zip(rows, map_outputs.keyframes, strict=True):
        translation = np.array([float(row[k]) for k in ("tx", "ty", "tz")])
        quaternion = np.array([float(row[k]) for k in ("qx", "qy", "qz", "qw")])
        assert np.allclose(
            se3.from_quaternion(translation, quaternion), record.T_world_cam, atol=1e-8
        )
        assert int(row["observations"]) == record.observations


@pytest.mark.parametrize("points", [0, 50])
def test_binary_ply_byte_by_byte(tmp_path, points):
    map_outputs = outputs(points)
    write_ply(tmp_path / "map.ply", map_outputs)
    head, body = (tmp_path / "map.ply").read_bytes().split(b"end_header\n")
    assert head.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert f"element vertex {points}\n".encode() in head
    assert len(body) == 19 * points
    for i, (x, y, z, r, g, b, n) in enumerate(struct.iter_unpack("<fffBBBi", body)):
        assert np.allclose((x, y, z), map_outputs.positions[i], atol=1e-6)
        assert (r, g, b) == tuple(map_outputs.colours[i])
        assert n == map_outputs.observations[i]


def test_the_figure_of_nothing_is_as_large_as_that_of_a_run(tmp_path):
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (480, 640, 3)).astype(np.uint8)
    poses = se3.exp(np.cumsum(rng.normal(0, 0.05, (30, 6)), axis=0))
    track = Trajectory(np.arange(30) / 30.0, poses)
    file = tmp_path / "figure.png"
    write_run_figure(
        file, "tum/fr1/xyz", image, [image] * 9, [image] * 5, outputs(400), track, track
    )
    figure = cv2.imread(str(file))
    empty = MapOutputs(
        (),
        np.zeros(0, np.int64),
        np.zeros((0, 3)),
        np.zeros((0, 3), np.uint8),
        np.zeros(0, np.int64),
    )
    write_run_figure(file, "x", image, [], [], empty, Trajectory(np.zeros(0), np.zeros((0, 4, 4))))
    assert cv2.imread(str(file)).shape == figure.shape
