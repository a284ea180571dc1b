"""The map's files: what they hold is read back with independent means."""

import csv
import struct

import cv2
import numpy as np
import pytest

from dynslam_bench.contracts.tracker import KeyframeRecord, MapOutputs
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.slam.map_files import write_keyframes_csv, write_ply
from dynslam_bench.slam.run_figure import write_run_figure


def outputs(points=50, keyframes=4):
    rng = np.random.default_rng(0)
    poses = se3.exp(rng.normal(0, 0.3, (keyframes, 6)))
    records = tuple(KeyframeRecord(i, 3 * i, 100.0 + i / 3, pose, 900, 300 + i) for i, pose in enumerate(poses))
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
        assert np.allclose(se3.from_quaternion(translation, quaternion), record.T_world_cam, atol=1e-8)
        assert int(row["observations"]) == record.observations


@pytest.mark.parametrize("points", [0, 50])
def test_binary_ply_byte_by_byte(tmp_path, points):
    map_outputs = outputs(points)
    write_ply(tmp_path / "map.ply", map_outputs)
    data = (tmp_path / "map.ply").read_bytes()
    head, body = data.split(b"end_header\n")
    assert head.startswith(b"ply\nformat binary_little_endian 1.0\n") and f"element vertex {points}\n".encode() in head
    assert len(body) == 19 * points
    for i, (x, y, z, r, g, b, n) in enumerate(struct.iter_unpack("<fffBBBi", body)):
        assert np.allclose((x, y, z), map_outputs.positions[i], atol=1e-6)
        assert (r, g, b) == tuple(map_outputs.colours[i]) and n == map_outputs.observations[i]


def test_the_figure_of_a_run_has_five_filled_panels(tmp_path):
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (480, 640, 3)).astype(np.uint8)
    poses = se3.exp(np.cumsum(rng.normal(0, 0.05, (30, 6)), axis=0))
    track, file = Trajectory(np.arange(30) / 30.0, poses), tmp_path / "figure.png"
    write_run_figure(file, "tum/fr1/xyz", image, [image] * 9, [image] * 5, outputs(400), track, track)
    figure = cv2.imread(str(file))
    for x, y in ((12, 72), (504, 72), (996, 72), (258, 472), (750, 472)):  # corners of the panels
        panel = figure[y : y + 360, x : x + 480]
        assert np.count_nonzero((panel != 255).any(axis=2)) > 500
    empty = MapOutputs((), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64))
    write_run_figure(file, "x", image, [], [], empty, Trajectory(np.zeros(0), np.zeros((0, 4, 4))))
    assert cv2.imread(str(file)).shape == figure.shape
