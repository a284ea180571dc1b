"""Readout time, delay of depth and depth factor, from exact points, a rendered sequence, and what cannot tell them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sequence_folders import Altered, make_folder, scaled

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.calibration import Window, adjust, calibrate
from dynslam_bench.sequences.cameras import read_camera, write_camera
from dynslam_bench.sequences.synthetic import open_synthetic

CAMERA = Camera(320, 240, 260.0, 262.0, 160.0, 118.0)
FPS, FRAMES = 30.0, 12
NORMAL, DISTANCE = np.array([0.35, 0.5, 1.0]), 2.0
"""The world is the plane NORMAL . X = DISTANCE."""


def pose(times):
    """Rotations camera to world ``[N, 3, 3]`` and centres ``[N, 3]`` of a camera that is turned to and fro."""
    t = np.asarray(times)[:, None]
    angles = np.array([0.12, 0.15, 0.2]) * np.sin(2 * np.pi * np.array([1.1, 0.9, 1.3]) * t + (0.3, 1.2, 2.5))
    centres = 0.12 * np.sin(2 * np.pi * np.array([0.8, 1.2, 0.7]) * t + (0.0, 2.0, 4.0))
    return Rotation.from_rotvec(angles).as_matrix(), centres


def depth_image(stamp, readout_s):
    """Depth of the plane, every row from its own pose."""
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(float)
    R, centre = pose(stamp + ((np.arange(CAMERA.height) + 0.5) / CAMERA.height - 0.5) * readout_s)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1)
    along = np.einsum("rij,rcj,i->rc", R, rays, NORMAL)
    return ((DISTANCE - centre @ NORMAL)[:, None] / along).astype(np.float32)


def seen(points, stamp, readout_s):
    """Pixels ``[L, 2]`` of points, each by the pose of the row that it falls on; NaN outside of the image."""
    late = np.zeros(len(points))
    for _ in range(8):
        R, centre = pose(stamp + late)
        pixels = CAMERA.project(np.einsum("nji,nj->ni", R, points - centre))
        late = ((pixels[:, 1] + 0.5) / CAMERA.height - 0.5) * readout_s
    outside = ((pixels < 4) | (pixels > (CAMERA.width - 5, CAMERA.height - 5))).any(axis=1)
    return np.where(outside[:, None], np.nan, pixels)


def window(first, readout_s, delay_s, rng):
    """Exact tracks through some frames, but for a tenth of a pixel."""
    stamps = (first + np.arange(FRAMES)) / FPS
    at = rng.uniform(-1.5, 1.5, (150, 2))
    points = np.column_stack([at, (DISTANCE - at @ NORMAL[:2]) / NORMAL[2]])
    pixels = np.stack([seen(points, stamp, readout_s) for stamp in stamps], axis=1)
    pixels += rng.normal(0, 0.1, pixels.shape)
    depth = np.stack([depth_image(stamp + delay_s, readout_s) for stamp in stamps])
    return Window(CAMERA, stamps, pixels[np.isfinite(pixels[..., 0]).sum(1) >= 4], depth, np.zeros(FRAMES))


@pytest.mark.parametrize(("readout_s", "delay_s"), [(0.0, 0.0), (0.02, 0.012), (0.03, -0.034)])
def test_exact_points_give_back_readout_and_delay(readout_s, delay_s):
    rng = np.random.default_rng(3)
    readout, delay = adjust([window(first, readout_s, delay_s, rng) for first in (0, 12, 24, 36)])
    assert readout.value == pytest.approx(readout_s, abs=5e-4)
    assert delay.value == pytest.approx(delay_s, abs=1e-3)
    assert abs(readout.value - readout_s) < readout.half < 0.004
    assert abs(delay.value - delay_s) < delay.half < 0.004


@pytest.fixture(scope="module")
def fast(tmp_path_factory):
    sequence = open_synthetic("synthetic/fast_desk@0?frames=26", tmp_path_factory.mktemp("rendered"))
    other = Altered(sequence, truth=scaled(2.0), camera=lambda camera: replace(camera, readout_s=0.0))
    return calibrate(sequence), calibrate(other)


def test_a_rendered_rolling_shutter_is_measured(fast):
    readout, delay, factor = fast[0].quantities
    assert readout.value == pytest.approx(0.026, abs=0.003)
    assert readout.low < 0.026 < readout.high
    assert readout.observable
    assert readout.written is None, "it is what the camera states"
    assert delay.low < 0.0 < delay.high
    assert factor.low < 5000 < factor.high
    assert not fast[0].measured


def test_what_differs_from_the_camera_is_to_be_written(fast):
    readout, _, factor = fast[1].quantities
    assert fast[1].camera.readout_s == readout.written == pytest.approx(0.026, abs=0.003)
    assert factor.low < 2500 < factor.high
    assert fast[1].measured


def test_a_camera_file_keeps_the_delay_and_pairs_by_it(tmp_path):
    folder, _, raw = make_folder(tmp_path / "own")
    file = folder / "camera.toml"
    write_camera(file, replace(read_camera(file).camera(), depth_delay_s=1 / 30, readout_s=0.02), fps=30.0)
    assert read_camera(file).camera().depth_delay_s == 1 / 30
    sequence = open_sequence(folder)
    assert len(sequence) == 3
    np.testing.assert_array_equal(sequence[0].depth, raw[0].astype(np.float32) / np.float32(5000))
    np.testing.assert_allclose(sequence.depth_timestamps, sequence.timestamps, atol=1e-6)
    part = open_sequence(folder, frames="1:")
    np.testing.assert_allclose(part.depth_timestamps, part.timestamps, atol=1e-6)


@pytest.fixture
def still(tmp_path):
    """A camera at rest before a textured wall."""
    folder, *_ = make_folder(tmp_path / "still", frames=18, width=320, height=240)
    (folder / "groundtruth.txt").unlink()
    write_camera(folder / "camera.toml", CAMERA, fps=FPS)
    noise = np.random.default_rng(1).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    texture = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)
    for i in range(18):
        cv2.imwrite(str(folder / f"rgb/{i}.png"), texture)
        cv2.imwrite(str(folder / f"depth/{i}.png"), np.full((240, 320), 10000, np.uint16))
    return folder


def test_a_camera_at_rest_tells_nothing(still):
    found = calibrate(open_sequence(still))
    assert [each.observable for each in found.quantities] == [False] * 3
    assert all(each.reason for each in found.quantities)
    assert found.camera == CAMERA


@pytest.mark.parametrize("fault", ["frames", "black", "depth"])
def test_recordings_that_cannot_be_used_are_one_clear_line(still, fault):
    for i in range(18):
        if fault == "black":
            cv2.imwrite(str(still / f"rgb/{i}.png"), np.zeros((240, 320, 3), np.uint8))
        elif fault == "depth":
            cv2.imwrite(str(still / f"depth/{i}.png"), np.zeros((240, 320), np.uint16))
    sequence = open_sequence(still, frames="0:1" if fault == "frames" else None)
    with pytest.raises(SequenceError) as error:
        calibrate(sequence)
    assert {"frames": "1 frame", "black": "points", "depth": "depth"}[fault] in str(error.value)
    assert error.value.hint
