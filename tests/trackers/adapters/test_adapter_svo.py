"""The real SVO, where it is installed; the way to it where it is not."""

import importlib.util

import numpy as np
import pytest
from test_adapter_batch import EXAMPLES
from test_adapter_orbslam3 import XYZ

from dynslam_bench import api as db
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.sequences import open_sequence
from dynslam_bench.trackers import build_tracker

INSTALLED = importlib.util.find_spec("svo_cpp") is not None
needs_svo = pytest.mark.skipif(not INSTALLED, reason="svo-cpp is not installed")
needs_data = pytest.mark.skipif(not XYZ.is_dir(), reason="no TUM excerpt beside the checkout")


@pytest.mark.skipif(INSTALLED, reason="svo-cpp is installed")
def test_without_its_package_one_line_says_how_to_get_it():
    with pytest.raises(DynslamError, match="pip install --no-deps svo-cpp") as caught:
        build_tracker("svo")
    assert "\n" not in str(caught.value)


@needs_svo
@needs_data
def test_on_real_frames(tmp_path):
    run = db.run("svo", XYZ, results=tmp_path, protocol="tum-rgbd/v1-sim3")
    assert run.status == "ok" and run.record.coverage > 0.5
    assert run.metrics["ate_rmse_m"] < 0.4 * run.metrics["static_camera_ate_rmse_m"]
    assert run.metrics["rpe_1f_rot_rmse_deg"] < 3


@needs_svo
@needs_data
def test_as_a_batch_program(tmp_path):
    run = db.run(f"batch:{EXAMPLES / 'svo.toml'}", XYZ, results=tmp_path, protocol="tum-rgbd/v1-sim3")
    assert run.status == "ok" and run.record.coverage > 0.5 and run.record.tracker.sensors == "rgb"


@needs_svo
@needs_data
def test_settings_reach_it():
    """With a smaller disparity the map begins earlier."""
    sequence, begun = open_sequence(XYZ, frames=(0, 12)), []
    for disparity in (50, 10):
        tracker = build_tracker("svo", {"init_disparity_px": disparity})
        tracker.reset(sequence.camera, rng=np.random.default_rng(0))
        states = [tracker.track(sequence[index]).state for index in range(len(sequence))]
        tracker.close()
        begun.append(states.index("ok"))
    assert begun[1] < begun[0]
